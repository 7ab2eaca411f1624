// Gaussian elimination with row pivoting of a system that lies row by row, its right-hand side last, which becomes the
// solution.
REAL* a = law.small.data + first;
const int width = n + 1;
for (int k = 0; k < n; ++k) {
    int best = k;
    for (int r = k + 1; r < n; ++r)
        if (wp::abs(a[r * width + k]) > wp::abs(a[best * width + k])) best = r;
    for (int j = k; j < width; ++j) {
        const REAL swap = a[k * width + j];
        a[k * width + j] = a[best * width + j];
        a[best * width + j] = swap;
    }
    const REAL scale = (REAL)1 / a[k * width + k];
    for (int r = k + 1; r < n; ++r) {
        const REAL f = scale * a[r * width + k];
        for (int j = k + 1; j < width; ++j) a[r * width + j] -= f * a[k * width + j];
    }
}
for (int k = n - 1; k >= 0; --k) {
    REAL value = a[k * width + n];
    for (int j = k + 1; j < n; ++j) value -= a[k * width + j] * a[j * width + n];
    a[k * width + n] = value / a[k * width + k];
}
