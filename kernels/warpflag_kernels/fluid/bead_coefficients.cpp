// Coefficients of the tensors of node i, whose radius is a, and the n beads from `own` on, whose radius is b.
UNEQUAL
const REAL* __restrict__ X = shell.x.data + own; const REAL* __restrict__ Y = shell.y.data + own;
const REAL* __restrict__ Z = shell.z.data + own;
REAL* __restrict__ C = shell.c.data + row; REAL* __restrict__ D = shell.d.data + row;
const REAL xi = shell.px.data[i], yi = shell.py.data[i], zi = shell.pz.data[i];
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int j = 0; j < n; ++j) {
    const REAL dx = X[j] - xi, dy = Y[j] - yi, dz = Z[j] - zi;
    REAL c, d;
    unequal_tensor(dx * dx + dy * dy + dz * dz, a, b, c, d);
    C[j] = c; D[j] = d;
}
