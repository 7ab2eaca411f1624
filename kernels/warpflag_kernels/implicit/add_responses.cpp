// The wanted change of the gaps: -residual plus the responses, each times its coefficient from the linear system.
REAL* __restrict__ C = law.wanted.data + begin; const REAL* __restrict__ R = law.residual.data + begin;
for (int i = thread; i < count; i += THREADS) C[i] = -R[i];
for (int m = 0; m < n; ++m) {
    const REAL* __restrict__ A = law.responses.data + own + m * capacity;
    const REAL coefficient = law.small.data[first + m * (n + 1) + n];
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int i = thread; i < count; i += THREADS) C[i] += coefficient * A[i];
}
