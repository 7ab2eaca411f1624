// The Rotne-Prager tensor of two spheres of radii a and b, in units of 1/(8 pi eta): c I + d dd^T, with dd the vector
// between their centres and r2 its square: apart, overlapping, one inside the other.
const auto unequal_tensor = [](REAL r2, REAL a, REAL b, REAL& c, REAL& d) {
    const REAL inv_r = REAL(1) / wp::sqrt(r2 > REAL(0) ? r2 : REAL(1));
    const REAL inv_r2 = inv_r * inv_r, inv_r3 = inv_r * inv_r2;
    const REAL sum = a + b, less2 = (a - b) * (a - b), squares = a * a + b * b, scale = REAL(1) / (REAL(24) * a * b);
    const REAL fall = less2 + REAL(3) * r2, rise = less2 - r2;
    const bool far = r2 > sum * sum, inside = r2 <= less2;
    const REAL near_c = inside ? REAL(4) / (REAL(3) * (a > b ? a : b)) : scale * (REAL(16) * sum - fall * fall * inv_r3);
    const REAL near_d = inside ? REAL(0) : REAL(3) * scale * rise * rise * inv_r3 * inv_r2;
    c = far ? inv_r * (REAL(1) + squares / REAL(3) * inv_r2) : near_c;
    d = far ? inv_r3 * (REAL(1) - squares * inv_r2) : near_d;
};
