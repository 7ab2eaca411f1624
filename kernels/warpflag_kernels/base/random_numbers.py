"""Counter-based random numbers: Philox4x32 with ten rounds (Salmon et al., SC 11 (2011)), and normal deviates.

A number depends on nothing but the seed of its cell, the element within the cell, the step and what it is for. So it is
the same on every device, in every batch and after a resume, and there is no state to keep.
"""

import functools
import math
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision

PHILOX_ROUNDS = 10
_MULTIPLIERS, _WEYL = (0xD2511F53, 0xCD9E8D57), (0x9E3779B9, 0xBB67AE85)  # of the paper above
# What a number is for: fourth word of the counter.
FOR_NODE, FOR_PAIRS, FOR_STRAIN, FOR_BODY_SHIFT, FOR_BODY_TURN = range(5)
FOR_CONTACT, FOR_HOOK, FOR_PROBE, FOR_PROBE_SHIFT, FOR_PROBE_TURN = range(5, 10)


@functools.cache
def counters() -> SimpleNamespace:
    """Device function `philox`: four random words."""
    module = wp.get_module("warpflag_kernels.random_numbers")
    first, second = (wp.constant(wp.uint64(x)) for x in _MULTIPLIERS)
    step_first, step_second = (wp.constant(wp.uint32(x)) for x in _WEYL)

    @wp.func(module=module)
    def philox(c0: wp.uint32, c1: wp.uint32, c2: wp.uint32, c3: wp.uint32, k0: wp.uint32, k1: wp.uint32):
        """Four words of 32 random bits each, of a counter of four words and a key of two."""
        for _round in range(wp.static(PHILOX_ROUNDS)):
            a = first * wp.uint64(c0)
            b = second * wp.uint64(c2)
            high_a = wp.uint32(a >> wp.uint64(32))
            high_b = wp.uint32(b >> wp.uint64(32))
            c0 = high_b ^ c1 ^ k0
            c1 = wp.uint32(b & wp.uint64(0xFFFFFFFF))
            c2 = high_a ^ c3 ^ k1
            c3 = wp.uint32(a & wp.uint64(0xFFFFFFFF))
            k0 += step_first
            k1 += step_second
        return c0, c1, c2, c3

    return SimpleNamespace(philox=philox)


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device function `normals`: four independent normal deviates."""
    real, vec4 = p.real, p.vec4
    philox = counters().philox
    unit, turn = wp.constant(wp.float64(2.0**-32)), wp.constant(wp.float64(2.0 * math.pi * 2.0**-32))

    @wp.func(module=p.module("normal_deviates"))
    def normals(seed: wp.uint64, element: wp.int32, step: wp.int32, purpose: wp.int32):
        """Four normal deviates of variance 1, by the transformation of Box & Muller.

        Args:
            seed: of the cell.
            element: counted within the cell.
            step: number of the step.
            purpose: one of the constants of this file.
        """
        k0 = wp.uint32(seed & wp.uint64(0xFFFFFFFF))
        k1 = wp.uint32(seed >> wp.uint64(32))
        a, b, c, d = philox(wp.uint32(element), wp.uint32(step), wp.uint32(0), wp.uint32(purpose), k0, k1)
        half = wp.float64(0.5)
        r = wp.sqrt(wp.float64(-2.0) * wp.log(unit * (wp.float64(a) + half)))
        s = wp.sqrt(wp.float64(-2.0) * wp.log(unit * (wp.float64(c) + half)))
        x = turn * (wp.float64(b) + half)
        y = turn * (wp.float64(d) + half)
        return vec4(real(r * wp.cos(x)), real(r * wp.sin(x)), real(s * wp.cos(y)), real(s * wp.sin(y)))

    return SimpleNamespace(normals=normals)
