// New gaps from the scalar equations gap - d F(gap) = c of every contact, d the diagonal compliance. Their left sides are
// concave: Newton's method overshoots once from above; from below it rises to the solution.
LAW
REAL* __restrict__ G = law_in.solved_gap.data;
const REAL* __restrict__ A = law_in.applied.data; const REAL* __restrict__ F = law_in.force.data;
const REAL* __restrict__ Y = law_in.diagonal.data; const REAL* __restrict__ S = law_in.stiffness_ratio.data;
const REAL* __restrict__ C = law_in.wanted.data;
const REAL most = (REAL)CUTOFF * diameter, least = (REAL)LINEAR * diameter;
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int i = begin + thread; i < stop; i += THREADS) {
    const REAL gap = G[i], y = Y[i], alone = gap - y * (A[i] + F[i]) + C[i];
    REAL g = gap + C[i] * (1 - S[i]), f, k;
    g = g < least ? least : (g > most ? most : g);
    for (int n = 0; n < NEWTON_STEPS; ++n) {
        law(g, strength, diameter, f, k);
        g += (alone + y * f - g) / (1 + y * k);
    }
    G[i] = alone >= most ? alone : g;
}
