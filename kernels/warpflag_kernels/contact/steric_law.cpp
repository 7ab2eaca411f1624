// The steric force and its stiffness -dF/dr at distance r. Without branches, so that loops over it can be vectorised; NaN
// gives NaN.
const auto law = [](REAL r, REAL strength, REAL diameter, REAL& force, REAL& stiffness) {
    const REAL x = r / diameter, below = (REAL)LINEAR - x;
    const REAL y = 1 / (below > 0 ? (REAL)LINEAR : x), y2 = y * y, y6 = y2 * y2 * y2;
    const bool open = x >= (REAL)CUTOFF;
    force = open ? 0 : strength * (y6 * y * (2 * y6 - 1) + (below > 0 ? (REAL)SLOPE * below : 0));
    stiffness = open ? 0 : strength / diameter * (y6 * y2) * (26 * y6 - 7);
};
