// Adds the float32 sums of nodes [begin, end) to the float64 ones and begins them anew.
float* __restrict__ U = s.ux.data; float* __restrict__ V = s.uy.data; float* __restrict__ W = s.uz.data;
double* __restrict__ X = s.total_x.data; double* __restrict__ Y = s.total_y.data; double* __restrict__ Z = s.total_z.data;
for (int j = begin; j < end; ++j) {
    X[j] += U[j]; Y[j] += V[j]; Z[j] += W[j];
    U[j] = 0; V[j] = 0; W[j] = 0;
}
