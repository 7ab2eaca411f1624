// Residuals, and the largest of this thread. Compared as integers, NaN is larger than all numbers.
const REAL* __restrict__ G = law_in.solved_gap.data; const REAL* __restrict__ F = law_in.free_gap.data;
const REAL* __restrict__ N = law_in.answered.data; REAL* __restrict__ R = law_in.residual.data;
BITS worst = 0;
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int i = begin + thread; i < stop; i += THREADS) {
    union { REAL value; BITS bits; } r;
    R[i] = G[i] - F[i] - N[i];
    r.value = wp::abs(R[i]);
    worst = r.bits > worst ? r.bits : worst;
}
union { BITS bits; REAL value; } r;
r.bits = worst;
return r.value < (REAL)3.0e38 ? r.value : (REAL)3.0e38;
