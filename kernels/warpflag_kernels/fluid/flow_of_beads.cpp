// Flow at node i of the loads on the n beads from `own` on, with stored coefficients.
const REAL* __restrict__ X = shell.x.data + own; const REAL* __restrict__ Y = shell.y.data + own;
const REAL* __restrict__ Z = shell.z.data + own;
const REAL* __restrict__ C = shell.c.data + row; const REAL* __restrict__ D = shell.d.data + row;
const REAL* __restrict__ F = shell.load.data + at; const REAL* __restrict__ G = shell.load.data + at + n;
const REAL* __restrict__ H = shell.load.data + at + 2 * n;
const REAL xi = shell.px.data[i], yi = shell.py.data[i], zi = shell.pz.data[i];
REAL ux = 0, uy = 0, uz = 0;
for (int j = 0; j < n; ++j) {
    const REAL dx = xi - X[j], dy = yi - Y[j], dz = zi - Z[j];
    const REAL c = C[j], along = D[j] * (dx * F[j] + dy * G[j] + dz * H[j]);
    ux += c * F[j] + along * dx; uy += c * G[j] + along * dy; uz += c * H[j] + along * dz;
}
return {ux, uy, uz};
