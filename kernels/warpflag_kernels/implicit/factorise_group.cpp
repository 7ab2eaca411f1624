// Factors of a group, from its last row to its first.
PLACES
V c1_before[4][4], inverse1[4][4], inverse2[4][4];  // C_(i+1,i+2); C^-1 of the last two rows
for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) c1_before[r][c] = inverse1[r][c] = inverse2[r][c] = zero;
auto positive = zero == zero;
for (int i = rows - 1; i >= 0; --i) {
    REAL* block = F + NUMBERS * W * i;
    V d[4][4], c1[4][4], c2[4][4];
    for (int l = 0; l < W; ++l) {
        const REAL* from = (const REAL*)diagonal.data + 16 * element(l, i);
        const REAL* from1 = (const REAL*)lower1.data + 16 * element(l, i + 1);
        const REAL* from2 = (const REAL*)lower2.data + 16 * element(l, i + 2);
        for (int r = 0; r < 4; ++r) for (int c = 0; c <= r; ++c) d[r][c][l] = from[4 * r + c];
        for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) c1[c][r][l] = from1[4 * r + c];
        for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) c2[c][r][l] = from2[4 * r + c];
    }
    if (i + 2 >= shortest) for (int l = 0; l < W; ++l)
        for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) {
            if (c <= r && i > last[l]) d[r][c][l] = r == c;
            if (i + 1 > last[l]) c1[r][c][l] = 0;
            if (i + 2 > last[l]) c2[r][c][l] = 0;
        }
    for (int r = 0; r < 4; ++r) {  // every row of c1 and c2 from its end, in place
        for (int c = 3; c >= 0; --c) {
            V sum = c2[r][c] * inverse2[c][c];
            for (int m = 0; m < c; ++m) sum += c2[r][m] * inverse2[c][m];
            c2[r][c] = sum;
        }
        for (int c = 0; c < 4; ++c) for (int m = 0; m < 4; ++m) c1[r][c] -= c2[r][m] * c1_before[c][m];
        for (int c = 3; c >= 0; --c) {
            V sum = c1[r][c] * inverse1[c][c];
            for (int m = 0; m < c; ++m) sum += c1[r][m] * inverse1[c][m];
            c1[r][c] = sum;
        }
        for (int c = 0; c <= r; ++c)
            for (int m = 0; m < 4; ++m) d[r][c] -= c1[r][m] * c1[c][m] + c2[r][m] * c2[c][m];
    }
    for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) {
        put(block + (10 + 4 * r + c) * W, c1[r][c]);
        put(block + (26 + 4 * r + c) * W, c2[r][c]);
        c1_before[r][c] = c1[r][c];
        inverse2[r][c] = inverse1[r][c];
    }
    auto valid = zero == zero;
    for (int c = 0; c < 4; ++c) {  // Cholesky factor of d, in place; its diagonal inverted
        valid = valid & (d[c][c] > zero);  // NaN fails this, too
        d[c][c] = REAL(1) / __builtin_elementwise_sqrt(d[c][c]);
        for (int r = c + 1; r < 4; ++r) {
            d[r][c] *= d[c][c];
            for (int m = c + 1; m <= r; ++m) d[r][m] -= d[r][c] * (m < r ? d[m][c] : d[r][c]);
        }
    }
    positive = positive & valid;
    for (int c = 0; c < 4; ++c) for (int r = c; r < 4; ++r) {
        V sum = zero;
        for (int m = c; m < r; ++m) sum -= d[r][m] * inverse1[m][c];
        inverse1[r][c] = r == c ? d[c][c] : sum * d[r][r];
    }
    for (int r = 0, t = 0; r < 4; ++r) for (int c = 0; c <= r; ++c, ++t) {
        inverse1[r][c] = valid ? inverse1[r][c] : zero;
        put(block + t * W, inverse1[r][c]);
    }
}
for (int l = 0; l < W; ++l) if (!positive[l]) singular.data[cell] = 1;
