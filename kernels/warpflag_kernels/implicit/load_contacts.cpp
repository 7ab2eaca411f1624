// Forces at the solved gaps less those that W has been applied to, into `load`, and `stiffness_ratio`; returns this thread's part
// of the sum of the squares of `load`.
LAW
const REAL* __restrict__ G = law_in.solved_gap.data; const REAL* __restrict__ F = law_in.force.data;
const REAL* __restrict__ Y = law_in.diagonal.data; const REAL* __restrict__ A = law_in.applied.data;
REAL* __restrict__ L = law_in.load.data; REAL* __restrict__ S = law_in.stiffness_ratio.data;
REAL total = 0;
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int i = begin + thread; i < stop; i += THREADS) {
    REAL f, k;
    law(G[i], strength, diameter, f, k);
    L[i] = f - F[i] - A[i];
    S[i] = Y[i] * k / (1 + Y[i] * k);
    total += L[i] * L[i];
}
return total;
