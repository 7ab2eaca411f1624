"""Whether two segments pass through each other while their ends move linearly."""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.contact import steric


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions: the distance of two segments, and whether they cross."""
    real, vec3 = p.real, p.vec3
    closest_parameters = steric.functions(p).closest_parameters
    module = p.module("crossing_functions")

    @wp.func(module=module)
    def distance(p1: vec3, d1: vec3, p2: vec3, d2: vec3):
        """Distance of segments p1 + s d1 and p2 + t d2 [um]."""
        st = closest_parameters(p1, d1, p2, d2)
        return wp.length(p1 + st[0] * d1 - p2 - st[1] * d2)

    @wp.func(module=module)
    def crossed(p1: vec3, q1: vec3, p2: vec3, q2: vec3, p1n: vec3, q1n: vec3, p2n: vec3, q2n: vec3, touch: real):
        """Whether two segments pass through each other while their ends move linearly to new positions."""
        zero, one = real(0.0), real(1.0)
        # The volume spanned by the four ends is a cubic in time. Between its extrema it vanishes once at most; its sign
        # before and after alone would miss nearly parallel segments, which turn past parallel as they cross.
        a, b, r = q1 - p1, q2 - p2, p2 - p1
        da, db, dr = q1n - p1n - a, q2n - p2n - b, p2n - p1n - r
        mixed = wp.cross(a, db) + wp.cross(da, b)
        c0 = wp.dot(wp.cross(a, b), r)
        c1 = wp.dot(mixed, r) + wp.dot(wp.cross(a, b), dr)
        c2 = wp.dot(wp.cross(da, db), r) + wp.dot(mixed, dr)
        c3 = wp.dot(wp.cross(da, db), dr)
        first, second = one, one
        discriminant = c2 * c2 - real(3.0) * c3 * c1
        if discriminant > zero:
            root = wp.where(c2 < zero, wp.sqrt(discriminant) - c2, -wp.sqrt(discriminant) - c2)
            if root != zero:
                first = wp.clamp(c1 / root, zero, one)
                if c3 != zero:
                    second = wp.clamp(root / (real(3.0) * c3), zero, one)
        begin = zero
        for bracket in range(3):
            end = one
            if bracket == 0:
                end = wp.min(first, second)
            elif bracket == 1:
                end = wp.max(first, second)
            low, high = begin, end
            before = c0 + low * (c1 + low * (c2 + low * c3))
            after = c0 + high * (c1 + high * (c2 + high * c3))
            if (before > zero) != (after > zero):
                for _step in range(24):
                    x = real(0.5) * (low + high)
                    v = c0 + x * (c1 + x * (c2 + x * c3))
                    if (v > zero) == (before > zero):
                        low = x
                    else:
                        high = x
                x = real(0.5) * (low + high)
                if distance(p1 + x * (p1n - p1), a + x * da, p2 + x * (p2n - p2), b + x * db) < touch:
                    return True
            begin = end
        return False

    return SimpleNamespace(distance=distance, crossed=crossed)
