"""Chebyshev polynomials, and the coefficients of RKC's stages that are made of them."""

import functools
from types import SimpleNamespace

import warp as wp


@functools.cache
def functions() -> SimpleNamespace:
    """Device functions, all float64: the coefficients differ by little from one stage to the next."""
    module = wp.get_module("warpflag_kernels.chebyshev_functions")

    @wp.func(module=module)
    def chebyshev(j: wp.int32, theta: wp.float64):
        """T_j, T_j', T_j'' at cosh(theta)."""
        n = wp.float64(j)
        sh = wp.sinh(theta)
        value = wp.cosh(n * theta)
        slope = n * wp.sinh(n * theta) / sh
        return wp.vec3d(value, slope, (n * n * value - wp.cosh(theta) * slope) / (sh * sh))

    @wp.func(module=module)
    def weight(j: wp.int32, theta: wp.float64):
        """b_j; b_0 = b_1 = b_2."""
        c = chebyshev(wp.max(j, 2), theta)
        return c[2] / (c[1] * c[1])

    @wp.func(module=module)
    def coefficients(j: wp.int32, s: wp.int32, damping: wp.float64):
        """mu_j, nu_j, m_j, g_j of s stages, two or more, and the time of stage j over the step."""
        one = wp.float64(1.0)
        mu = wp.float64(0.0)
        nu = wp.float64(0.0)
        g = wp.float64(0.0)
        w0 = one + damping / wp.float64(s * s)
        theta = wp.log(w0 + wp.sqrt((w0 - one) * (w0 + one)))
        last = chebyshev(s, theta)
        w1 = last[1] / last[2]
        b = weight(j, theta)
        if j == 1:
            return mu, nu, b * w1, g, w1 / (wp.float64(4.0) * w0 * w0)
        b1 = weight(j - 1, theta)
        here = chebyshev(j, theta)
        mu = wp.float64(2.0) * b * w0 / b1
        nu = -b / weight(j - 2, theta)
        m = wp.float64(2.0) * b * w1 / b1
        g = -(one - b1 * chebyshev(j - 1, theta)[0]) * m
        return mu, nu, m, g, w1 * here[2] / here[1]

    return SimpleNamespace(coefficients=coefficients)
