"""Chebyshev polynomials and the weights that RKC's coefficients are made of."""

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

    return SimpleNamespace(chebyshev=chebyshev, weight=weight)
