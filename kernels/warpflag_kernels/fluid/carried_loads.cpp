// Loads on n beads whose body moves: those of the held one with the opposite sign, and those of its motion in fluid at
// rest, at the velocity u and the spin w, each over the mobility 1/(8 pi eta).
const int rows = 3 * n;
const REAL* __restrict__ R = shell.rigid.data + 18 * own;
REAL* __restrict__ L = shell.load.data + at;
const REAL u0 = u[0], u1 = u[1], u2 = u[2], w0 = w[0], w1 = w[1], w2 = w[2];
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int r = first; r < end; ++r)
    L[r] = R[r] * u0 + R[rows + r] * u1 + R[2 * rows + r] * u2 + R[3 * rows + r] * w0 + R[4 * rows + r] * w1
         + R[5 * rows + r] * w2 - L[r];
