// The tensor of nodes i and j, each with its own radius.
UNEQUAL
const REAL* __restrict__ RADIUS = SUM.radius.data;
const REAL own = RADIUS[i];
const auto tensor = [&](REAL r2, int j, REAL& c, REAL& d) { unequal_tensor(r2, own, RADIUS[j], c, d); };
