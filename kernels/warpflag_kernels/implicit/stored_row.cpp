// A row of the symmetric sum over stored coefficients, the flow c f + q (q . f): pairs (i, j) for j in [begin, end).
const float* __restrict__ C = s.c.data + row; const float* __restrict__ A = s.qx.data + row;
const float* __restrict__ B = s.qy.data + row; const float* __restrict__ D = s.qz.data + row;
const float* __restrict__ F = s.sum.fx.data; const float* __restrict__ G = s.sum.fy.data;
const float* __restrict__ H = s.sum.fz.data;
float* __restrict__ U = s.sum.ux.data; float* __restrict__ V = s.sum.uy.data; float* __restrict__ W = s.sum.uz.data;
const float fi = F[i], gi = G[i], hi = H[i];
float ui = 0, vi = 0, wi = 0;
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int j = begin; j < end; ++j) {
    const float a = A[j], b = B[j], d = D[j], c = C[j];
    const float from_j = a * F[j] + b * G[j] + d * H[j], from_i = a * fi + b * gi + d * hi;
    ui += c * F[j] + from_j * a; vi += c * G[j] + from_j * b; wi += c * H[j] + from_j * d;
    U[j] += c * fi + from_i * a; V[j] += c * gi + from_i * b; W[j] += c * hi + from_i * d;
}
U[i] += ui; V[i] += vi; W[i] += wi;
