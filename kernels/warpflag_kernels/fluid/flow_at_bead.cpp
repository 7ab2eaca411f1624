// Flow at bead j, whose radius is b, of the forces on nodes [begin, end), whose radius is a.
UNEQUAL
const REAL xj = shell.x.data[j], yj = shell.y.data[j], zj = shell.z.data[j];
REAL ux = 0, uy = 0, uz = 0;
for (int i = begin; i < end; ++i) {
    const REAL dx = xj - shell.px.data[i], dy = yj - shell.py.data[i], dz = zj - shell.pz.data[i];
    const REAL fi = shell.fx.data[i], gi = shell.fy.data[i], hi = shell.fz.data[i];
    REAL c, d;
    unequal_tensor(dx * dx + dy * dy + dz * dz, a, b, c, d);
    const REAL along = d * (dx * fi + dy * gi + dz * hi);
    ux += c * fi + along * dx; uy += c * gi + along * dy; uz += c * hi + along * dz;
}
return {ux, uy, uz};
