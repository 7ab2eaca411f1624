// Secant pair i less projection times secant pair j.
REAL* __restrict__ A = law.loads.data + i; const REAL* __restrict__ B = law.loads.data + j;
REAL* __restrict__ C = law.responses.data + i; const REAL* __restrict__ D = law.responses.data + j;
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int n = thread; n < count; n += THREADS) { A[n] -= projection * B[n]; C[n] -= projection * D[n]; }
