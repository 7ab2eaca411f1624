// Sum over nodes j of [begin, end), every THREADS-th of them, of the tensor times the force; node i itself left out.
TENSOR
const REAL xi = s.x.data[i], yi = s.y.data[i], zi = s.z.data[i];
REAL ux = 0, uy = 0, uz = 0;
#ifdef __CUDACC__
#pragma unroll 1  // unrolled it takes a fifth more registers, which costs occupancy in float64
#endif
for (int j = begin; j < end; j += THREADS) {
    const REAL dx = xi - s.x.data[j], dy = yi - s.y.data[j], dz = zi - s.z.data[j];
    const REAL fx = s.fx.data[j], fy = s.fy.data[j], fz = s.fz.data[j];
    REAL c, d;
    tensor(dx * dx + dy * dy + dz * dz, j, c, d);
    const REAL other = j == i ? REAL(0) : REAL(1);
    const REAL along = other * d * (dx * fx + dy * fy + dz * fz);
    c = other * c;
    ux += c * fx + along * dx;
    uy += c * fy + along * dy;
    uz += c * fz + along * dz;
}
return {ux, uy, uz};
