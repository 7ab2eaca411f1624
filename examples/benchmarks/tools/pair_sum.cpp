// Rotne-Prager pair sum over all nodes of a cell, one thread: the yardstick of pair_sum.py, which compiles it.
//
// Velocities v_i = sum over j != i of the Rotne-Prager tensor of radius a at x_i - x_j times the force f_j, in units of
// 1/(8 pi eta); the overlapping form within 2a. Coordinates apart (x[n], y[n], z[n]), so that loops become vector code.

#include <cmath>

namespace {

template <class Real> struct Vectors {
    const Real *__restrict x, *__restrict y, *__restrict z;
};

template <class Real> struct Sums {
    Real *__restrict x, *__restrict y, *__restrict z;
};

// Coefficients of the force and of d (d . force), without a branch: both forms are cheap, a jump is not.
template <class Real> struct RotnePrager {
    Real a2, near, contact, slope;

    explicit RotnePrager(Real a)
        : a2(a * a), near(4 * a * a), contact(4 / (3 * a)), slope(3 / (8 * a * a)) {}

    void coefficients(Real r2, Real &isotropic, Real &along) const {
        const Real inverse = 1 / std::sqrt(r2);
        const Real q = a2 * inverse * inverse;
        const Real far_isotropic = inverse * (1 + Real(2) / 3 * q);
        const Real far_along = inverse * inverse * inverse * (1 - 2 * q);
        const Real near_isotropic = contact - slope * r2 * inverse;
        const Real near_along = slope / 3 * inverse;
        isotropic = r2 > near ? far_isotropic : near_isotropic;
        along = r2 > near ? far_along : near_along;
    }
};

// Every ordered pair, each node gathers its own sum. Before and after the node itself: a mask for it would cost more.
template <class Real> void all_pairs(int n, Vectors<Real> p, Vectors<Real> f, Sums<Real> v, Real a) {
    const RotnePrager<Real> tensor(a);
    for (int i = 0; i < n; ++i) {
        Real vx = 0, vy = 0, vz = 0;
        for (int part = 0; part < 2; ++part) {
            const int begin = part == 0 ? 0 : i + 1, end = part == 0 ? i : n;
            for (int j = begin; j < end; ++j) {
                const Real dx = p.x[i] - p.x[j], dy = p.y[i] - p.y[j], dz = p.z[i] - p.z[j];
                Real isotropic, along;
                tensor.coefficients(dx * dx + dy * dy + dz * dz, isotropic, along);
                along *= dx * f.x[j] + dy * f.y[j] + dz * f.z[j];
                vx += isotropic * f.x[j] + along * dx;
                vy += isotropic * f.y[j] + along * dy;
                vz += isotropic * f.z[j] + along * dz;
            }
        }
        v.x[i] = vx;
        v.y[i] = vy;
        v.z[i] = vz;
    }
}

// Every unordered pair once: the tensor is symmetric, so both nodes get their share.
template <class Real> void half_pairs(int n, Vectors<Real> p, Vectors<Real> f, Sums<Real> v, Real a) {
    const RotnePrager<Real> tensor(a);
    for (int i = 0; i < n; ++i) v.x[i] = v.y[i] = v.z[i] = 0;
    for (int i = 0; i < n; ++i) {
        Real vx = 0, vy = 0, vz = 0;
        for (int j = i + 1; j < n; ++j) {
            const Real dx = p.x[i] - p.x[j], dy = p.y[i] - p.y[j], dz = p.z[i] - p.z[j];
            Real isotropic, along;
            tensor.coefficients(dx * dx + dy * dy + dz * dz, isotropic, along);
            const Real from_j = along * (dx * f.x[j] + dy * f.y[j] + dz * f.z[j]);
            const Real from_i = along * (dx * f.x[i] + dy * f.y[i] + dz * f.z[i]);
            vx += isotropic * f.x[j] + from_j * dx;
            vy += isotropic * f.y[j] + from_j * dy;
            vz += isotropic * f.z[j] + from_j * dz;
            v.x[j] += isotropic * f.x[i] + from_i * dx;
            v.y[j] += isotropic * f.y[i] + from_i * dy;
            v.z[j] += isotropic * f.z[i] + from_i * dz;
        }
        v.x[i] += vx;
        v.y[i] += vy;
        v.z[i] += vz;
    }
}

// x, f, v: three rows of n numbers. Repeated inside, so that a call from Python costs nothing per sum.
template <class Real> void repeated(int symmetric, int repeats, int n, const Real *x, const Real *f, Real *v, Real a) {
    const Vectors<Real> p{x, x + n, x + 2 * n}, force{f, f + n, f + 2 * n};
    const Sums<Real> sums{v, v + n, v + 2 * n};
    for (int k = 0; k < repeats; ++k) {
        if (symmetric) half_pairs(n, p, force, sums, a);
        else all_pairs(n, p, force, sums, a);
        asm volatile("" ::: "memory"); // no repetition may be left out
    }
}

} // namespace

extern "C" void pair_sum_float64(
    int symmetric, int repeats, int n, const double *x, const double *f, double *v, double a) {
    repeated(symmetric, repeats, n, x, f, v, a);
}

extern "C" void pair_sum_float32(
    int symmetric, int repeats, int n, const float *x, const float *f, float *v, float a) {
    repeated(symmetric, repeats, n, x, f, v, a);
}
