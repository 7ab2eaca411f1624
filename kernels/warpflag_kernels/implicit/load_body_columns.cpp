// Right-hand sides of the body's columns, MANY of them.
for (int l = 0; l < W; ++l) {
    const REAL* from = (const REAL*)to_body.data + 24 * (3 * flagellum[l] + i) + column;
    for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) b[r][m][l] = weight * from[6 * r + m];
}
