// The linear system, row by row: 1 + loads . stiffness_ratio responses, and loads . stiffness_ratio residual. A thread of a GPU does single
// entries, a CPU four columns at once.
const REAL* L = law.loads.data + own; const REAL* A = law.responses.data + own;
const REAL* __restrict__ W = law.stiffness_ratio.data + begin; const REAL* R = law.residual.data + begin;
#ifdef __CUDACC__
for (int entry = thread; entry < n * (n + 1); entry += THREADS) {
    const int row = entry / (n + 1), column = entry % (n + 1);
    const REAL* X = L + row * capacity; const REAL* Y = column < n ? A + column * capacity : R;
    REAL total = row == column ? 1 : 0;
    for (int i = 0; i < count; ++i) total += X[i] * W[i] * Y[i];
    law.small.data[first + entry] = total;
}
#else
for (int row = 0; row < n; ++row) {
    const REAL* __restrict__ X = L + row * capacity;
    REAL* out = law.small.data + first + row * (n + 1);
    for (int column = 0; column <= n; column += 4) {
        const REAL* Y[4];
        for (int j = 0; j < 4; ++j) Y[j] = column + j < n ? A + (column + j) * capacity : R;
        const REAL* __restrict__ Y0 = Y[0]; const REAL* __restrict__ Y1 = Y[1];
        const REAL* __restrict__ Y2 = Y[2]; const REAL* __restrict__ Y3 = Y[3];
        REAL s0 = 0, s1 = 0, s2 = 0, s3 = 0;
        #pragma clang loop vectorize(assume_safety)
        for (int i = 0; i < count; ++i) {
            const REAL x = X[i] * W[i];
            s0 += x * Y0[i]; s1 += x * Y1[i]; s2 += x * Y2[i]; s3 += x * Y3[i];
        }
        const REAL sum[4] = {s0, s1, s2, s3};
        for (int j = 0; j < 4 && column + j <= n; ++j) out[column + j] = sum[j] + (row == column + j ? 1 : 0);
    }
}
#endif
