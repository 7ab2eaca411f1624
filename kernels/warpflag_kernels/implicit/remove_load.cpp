// Secant pair i less share times secant pair j.
REAL* __restrict__ A = law.loads.data + i; const REAL* __restrict__ B = law.loads.data + j;
REAL* __restrict__ C = law.answers.data + i; const REAL* __restrict__ D = law.answers.data + j;
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int n = thread; n < count; n += THREADS) { A[n] -= share * B[n]; C[n] -= share * D[n]; }
