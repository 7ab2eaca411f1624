// The coefficients c and q of a row of pairs, q the vector between the nodes times the root of the tensor's second one.
TENSOR
float* __restrict__ C = s.c.data + row; float* __restrict__ A = s.qx.data + row;
float* __restrict__ B = s.qy.data + row; float* __restrict__ D = s.qz.data + row;
const float* __restrict__ X = s.sum.x.data; const float* __restrict__ Y = s.sum.y.data;
const float* __restrict__ Z = s.sum.z.data;
const float xi = X[i], yi = Y[i], zi = Z[i];
#ifndef __CUDACC__
#pragma clang loop vectorize(assume_safety)
#endif
for (int j = begin; j < i; ++j) {
    const float dx = xi - X[j], dy = yi - Y[j], dz = zi - Z[j];
    float c, d;
    tensor(dx * dx + dy * dy + dz * dz, j, c, d);
    const float along = wp::sqrt(d);
    C[j] = c;
    A[j] = along * dx; B[j] = along * dy; D[j] = along * dz;
}
