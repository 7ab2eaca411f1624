// Adds the flow of the force on node i to the flows at the n beads from `own` on, with stored coefficients.
const REAL* __restrict__ X = shell.x.data + own; const REAL* __restrict__ Y = shell.y.data + own;
const REAL* __restrict__ Z = shell.z.data + own;
const REAL* __restrict__ C = shell.c.data + row; const REAL* __restrict__ D = shell.d.data + row;
REAL* __restrict__ U = shell.flow.data + at; REAL* __restrict__ V = shell.flow.data + at + n;
REAL* __restrict__ W = shell.flow.data + at + 2 * n;
const REAL xi = shell.px.data[i], yi = shell.py.data[i], zi = shell.pz.data[i];
const REAL fi = shell.fx.data[i], gi = shell.fy.data[i], hi = shell.fz.data[i];
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int j = 0; j < n; ++j) {
    const REAL dx = X[j] - xi, dy = Y[j] - yi, dz = Z[j] - zi;
    const REAL c = C[j], along = D[j] * (dx * fi + dy * gi + dz * hi);
    U[j] += c * fi + along * dx; V[j] += c * gi + along * dy; W[j] += c * hi + along * dz;
}
