// The Rotne-Prager tensor of two nodes with the same pair radius a, in units of 1/(8 pi eta): c I + d dd^T, with dd the vector
// between the nodes and r2 its square. Beyond 2a that of two spheres, below that of overlapping ones.
const REAL a2 = a * a, near = 4 * a2;
const REAL touching = REAL(4) / (REAL(3) * a), slope = REAL(0.375) / a2, slope_along = REAL(0.125) / a2;
const auto tensor = [&](REAL r2, int, REAL& c, REAL& d) {
    const REAL inv_r = REAL(1) / wp::sqrt(r2 > REAL(0) ? r2 : REAL(1));
    const REAL inv_r2 = inv_r * inv_r, q = a2 * inv_r2;
    const bool far = r2 > near;
    c = far ? inv_r * (REAL(1) + REAL(2) / REAL(3) * q) : touching - slope * (r2 * inv_r);
    d = far ? inv_r * inv_r2 * (REAL(1) - REAL(2) * q) : slope_along * inv_r;
};
