// Right-hand sides of nodes.
for (int l = 0; l < W; ++l) {
    const REAL* from = (const REAL*)x.data + 4 * element(l, i);
    for (int r = 0; r < 4; ++r) b[r][0][l] = from[r];
}
