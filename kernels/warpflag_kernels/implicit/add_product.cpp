// Adds a product to the sums of all products: over contacts [begin, stop) and over elements [first, end).
REAL* __restrict__ A = law_in.applied.data; const REAL* __restrict__ L = law_in.load.data;
REAL* __restrict__ N = law_in.answered.data; const REAL* __restrict__ C = law_in.change.data;
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int i = begin + thread; i < stop; i += THREADS) { A[i] += L[i]; N[i] += C[i]; }
REAL* __restrict__ X = reinterpret_cast<REAL*>(x.node.data);
const REAL* __restrict__ Y = reinterpret_cast<const REAL*>(law_in.response.node.data);
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int i = 4 * first + thread; i < 4 * end; i += THREADS) X[i] += Y[i];
