// Copies nodes [begin, end) into one array per component, and sets their sums to zero.
const RUN* __restrict__ P = reinterpret_cast<const RUN*>(position.data);
const RUN* __restrict__ Q = reinterpret_cast<const RUN*>(force.data);
REAL* __restrict__ X = s.x.data; REAL* __restrict__ Y = s.y.data; REAL* __restrict__ Z = s.z.data;
REAL* __restrict__ F = s.fx.data; REAL* __restrict__ G = s.fy.data; REAL* __restrict__ H = s.fz.data;
REAL* __restrict__ U = s.ux.data; REAL* __restrict__ V = s.uy.data; REAL* __restrict__ W = s.uz.data;
for (int i = begin; i < end; ++i) {
    X[i] = P[3 * i]; Y[i] = P[3 * i + 1]; Z[i] = P[3 * i + 2];
    F[i] = Q[3 * i]; G[i] = Q[3 * i + 1]; H[i] = Q[3 * i + 2];
    U[i] = 0; V[i] = 0; W[i] = 0;
}
