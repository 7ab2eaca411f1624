// This thread's part of the sum over contacts of a b weight.
const REAL* __restrict__ A = a.data + i; const REAL* __restrict__ B = b.data + j;
const REAL* __restrict__ W = weight.data + k;
REAL total = 0;
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int n = thread; n < count; n += THREADS) total += A[n] * B[n] * W[n];
return total;
