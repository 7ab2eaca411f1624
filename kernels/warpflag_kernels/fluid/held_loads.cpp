// Loads on the n beads of a body that is held in the flows at them: the inverse of their mobility, of symmetric rows,
// times the flows.
const int rows = 3 * n;
const REAL* __restrict__ M = shell.inverse.data + entry;
const REAL* __restrict__ U = shell.flow.data + at;
REAL* __restrict__ L = shell.load.data + at;
for (int r = 0; r < rows; ++r) L[r] = 0;
for (int k = 0; k < rows; k += 4) {
    const REAL* __restrict__ A = M + k * rows;
    const REAL u0 = U[k], u1 = U[k + 1], u2 = U[k + 2], u3 = U[k + 3];
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
    for (int r = 0; r < rows; ++r)
        L[r] += A[r] * u0 + A[rows + r] * u1 + A[2 * rows + r] * u2 + A[3 * rows + r] * u3;
}
