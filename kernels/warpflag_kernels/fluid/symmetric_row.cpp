// One row of the symmetric sum: pairs (i, j) for j in [begin, end), counted at both nodes. Whole vectors first, then what
// is left in one masked vector: rows are short, and one by one it would cost as much as the rest.
TENSOR
const REAL* __restrict__ X = s.x.data; const REAL* __restrict__ Y = s.y.data; const REAL* __restrict__ Z = s.z.data;
const REAL* __restrict__ F = s.fx.data; const REAL* __restrict__ G = s.fy.data; const REAL* __restrict__ H = s.fz.data;
REAL* __restrict__ U = s.ux.data; REAL* __restrict__ V = s.uy.data; REAL* __restrict__ W = s.uz.data;
const REAL xi = X[i], yi = Y[i], zi = Z[i], fi = F[i], gi = G[i], hi = H[i];
REAL ui = 0, vi = 0, wi = 0;
const auto add_pair = [&](int j) {
    const REAL dx = xi - X[j], dy = yi - Y[j], dz = zi - Z[j];
    REAL c, d;
    tensor(dx * dx + dy * dy + dz * dz, j, c, d);
    const REAL dj = d * (dx * F[j] + dy * G[j] + dz * H[j]), di = d * (dx * fi + dy * gi + dz * hi);
    ui += c * F[j] + dj * dx; vi += c * G[j] + dj * dy; wi += c * H[j] + dj * dz;
    U[j] += c * fi + di * dx; V[j] += c * gi + di * dy; W[j] += c * hi + di * dz;
};
const int lanes = 64 / static_cast<int>(sizeof(REAL)), whole = end - (end - begin) % lanes;
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety) interleave(disable)
#endif
for (int j = begin; j < whole; ++j) add_pair(j);
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety) vectorize_predicate(enable) interleave(disable)
#endif
for (int j = whole; j < end; ++j) add_pair(j);
U[i] += ui; V[i] += vi; W[i] += wi;
