// Flow at node i, whose radius is a, of the loads on the n beads from `own` on, whose radius is b.
UNEQUAL
const REAL xi = shell.px.data[i], yi = shell.py.data[i], zi = shell.pz.data[i];
REAL ux = 0, uy = 0, uz = 0;
for (int j = 0; j < n; ++j) {
    const REAL dx = xi - shell.x.data[own + j], dy = yi - shell.y.data[own + j], dz = zi - shell.z.data[own + j];
    const REAL f = shell.load.data[at + j], g = shell.load.data[at + n + j], h = shell.load.data[at + 2 * n + j];
    REAL c, d;
    unequal_tensor(dx * dx + dy * dy + dz * dz, a, b, c, d);
    const REAL along = d * (dx * f + dy * g + dz * h);
    ux += c * f + along * dx; uy += c * g + along * dy; uz += c * h + along * dz;
}
return {ux, uy, uz};
