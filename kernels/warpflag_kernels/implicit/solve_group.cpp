// Solutions with the factors of a group. Right-hand sides are taken MANY at a time, which share the loads of the blocks;
// all are zero from row FILLED on.
PLACES
for (int column = 0; column < COLUMNS; column += MANY) {
    ROOM
    V p[4][MANY], q[4][MANY];  // solutions of the last two rows
    for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) p[r][m] = q[r][m] = zero;
    for (int i = wp::min(FILLED, rows) - 1; i >= 0; --i) {
        const REAL* block = F + NUMBERS * W * i;
        V b[4][MANY];
        LOAD
        for (int c = 0; c < 4; ++c) for (int r = 0; r < 4; ++r) {
            const V f1 = get(block + (10 + 4 * r + c) * W), f2 = get(block + (26 + 4 * r + c) * W);
            for (int m = 0; m < MANY; ++m) b[r][m] -= f1 * p[c][m] + f2 * q[c][m];
        }
        for (int r = 0, t = 0; r < 4; ++r) {
            for (int m = 0; m < MANY; ++m) { q[r][m] = p[r][m]; p[r][m] = zero; }
            for (int c = 0; c <= r; ++c, ++t)
                for (int m = 0; m < MANY; ++m) p[r][m] += get(block + t * W) * b[c][m];
        }
        for (int r = 0; r < 4; ++r)
            for (int m = 0; m < MANY; ++m) put(S + ((4 * i + r) * MANY + m) * W, p[r][m]);
    }
    for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) p[r][m] = q[r][m] = zero;
    // Here they are what the rows already solved take away from the next one, and from the one after.
    for (int i = 0; i < rows; ++i) {
        const REAL* block = F + NUMBERS * W * i;
        V y[4][MANY];
        for (int c = 0; c < 4; ++c) for (int m = 0; m < MANY; ++m) y[c][m] = zero;
        for (int r = 0, t = 0; r < 4; ++r) {
            V b[MANY];
            for (int m = 0; m < MANY; ++m)
                b[m] = (i < FILLED ? get(S + ((4 * i + r) * MANY + m) * W) : zero) - p[r][m];
            for (int c = 0; c <= r; ++c, ++t)
                for (int m = 0; m < MANY; ++m) y[c][m] += get(block + t * W) * b[m];
        }
        for (int c = 0; c < 4; ++c) for (int m = 0; m < MANY; ++m) { p[c][m] = q[c][m]; q[c][m] = zero; }
        for (int c = 0; c < 4; ++c) for (int r = 0; r < 4; ++r) {
            const V f1 = get(block + (10 + 4 * r + c) * W), f2 = get(block + (26 + 4 * r + c) * W);
            for (int m = 0; m < MANY; ++m) { p[c][m] += f1 * y[r][m]; q[c][m] += f2 * y[r][m]; }
        }
        for (int l = 0; l < W; ++l) if (i <= last[l]) {
            REAL* to = (REAL*)(x.data + COLUMNS * (node[l] + i) + column);
            for (int m = 0; m < MANY; ++m) for (int r = 0; r < 4; ++r) to[4 * m + r] = y[r][m][l];
        }
    }
}
