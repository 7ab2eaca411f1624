"""Block Cholesky factors of the band of one flagellum, and solutions with them: a thread to a flagellum or a column.

Row i has the blocks `diagonal`, to itself, `lower1`, to row i - 1, and `lower2`, to row i - 2. Their factors take their
place: C_ii^-1, C_(i,i-1), C_(i,i-2). `block_band_simd` does the same for several flagella at once.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of rows [first, end)."""
    real, vec4 = p.real, p.vec4
    mat44, mat46 = wp.types.matrix((4, 4), real), wp.types.matrix((4, 6), real)
    module = p.module("cholesky")

    @wp.func(module=module)
    def inverse_cholesky(a: mat44):
        """Inverse of the lower Cholesky factor; all zero where a pivot is not positive."""
        zero, one = real(0.0), real(1.0)
        p0 = a[0, 0]
        i0 = one / wp.sqrt(p0)
        c10 = a[1, 0] * i0
        c20 = a[2, 0] * i0
        c30 = a[3, 0] * i0
        p1 = a[1, 1] - c10 * c10
        i1 = one / wp.sqrt(p1)
        c21 = (a[2, 1] - c20 * c10) * i1
        c31 = (a[3, 1] - c30 * c10) * i1
        p2 = a[2, 2] - c20 * c20 - c21 * c21
        i2 = one / wp.sqrt(p2)
        c32 = (a[3, 2] - c30 * c20 - c31 * c21) * i2
        p3 = a[3, 3] - c30 * c30 - c31 * c31 - c32 * c32
        i3 = one / wp.sqrt(p3)
        if not (p0 > zero and p1 > zero and p2 > zero and p3 > zero):  # NaN fails this, too
            return mat44(zero)
        x10 = -c10 * i0 * i1
        x21 = -c21 * i1 * i2
        x32 = -c32 * i2 * i3
        x20 = -(c20 * i0 + c21 * x10) * i2
        x31 = -(c31 * i1 + c32 * x21) * i3
        x30 = -(c30 * i0 + c31 * x10 + c32 * x20) * i3
        return mat44(
            i0, zero, zero, zero,
            x10, i1, zero, zero,
            x20, x21, i2, zero,
            x30, x31, x32, i3,
        )  # fmt: skip

    @wp.func(module=module)
    def factorise(
        first: wp.int32,
        end: wp.int32,
        diagonal: wp.array(dtype=mat44),
        lower1: wp.array(dtype=mat44),
        lower2: wp.array(dtype=mat44),
    ):
        """In place; whether all pivots were positive."""
        positive = bool(True)
        c1_before = mat44(real(0.0))  # C_(i-1,i-2)
        inverse1 = mat44(real(0.0))
        inverse2 = mat44(real(0.0))
        i = first
        while i < end:
            d = diagonal[i]
            c1 = mat44(real(0.0))
            if i > first:
                c1 = lower1[i]
                if i > first + 1:
                    c2 = lower2[i] * wp.transpose(inverse2)
                    c1 -= c2 * wp.transpose(c1_before)
                    d -= c2 * wp.transpose(c2)
                    lower2[i] = c2
                c1 = c1 * wp.transpose(inverse1)
                d -= c1 * wp.transpose(c1)
                lower1[i] = c1
            inverse2 = inverse1
            inverse1 = inverse_cholesky(d)
            if inverse1[0, 0] == real(0.0):
                positive = bool(False)
            diagonal[i] = inverse1
            c1_before = c1
            i += 1
        return positive

    @wp.func(module=module)
    def solve(
        first: wp.int32,
        end: wp.int32,
        diagonal: wp.array(dtype=mat44),
        lower1: wp.array(dtype=mat44),
        lower2: wp.array(dtype=mat44),
        x: wp.array(dtype=vec4),
    ):
        """From the right-hand side to the solution, in place."""
        y1 = vec4(real(0.0))
        y2 = vec4(real(0.0))
        i = first
        while i < end:
            y = x[i]
            if i > first:
                y -= lower1[i] * y1
            if i > first + 1:
                y -= lower2[i] * y2
            y = diagonal[i] * y
            x[i] = y
            y2 = y1
            y1 = y
            i += 1
        y1 = vec4(real(0.0))
        y2 = vec4(real(0.0))
        i = end - 1
        while i >= first:
            y = x[i]
            if i + 1 < end:
                y -= wp.transpose(lower1[i + 1]) * y1
            if i + 2 < end:
                y -= wp.transpose(lower2[i + 2]) * y2
            y = wp.transpose(diagonal[i]) * y
            x[i] = y
            y2 = y1
            y1 = y
            i -= 1

    # Warp would copy the whole block to the stack to index it with a run-time index.
    @wp.func_native("return blocks.data[i].data[row][column];")
    def component(blocks: wp.array(dtype=mat46), i: wp.int32, row: wp.int32, column: wp.int32) -> real: ...

    @wp.func(module=module)
    def column_of(blocks: wp.array(dtype=mat46), i: wp.int32, column: wp.int32):
        return vec4(
            component(blocks, i, 0, column),
            component(blocks, i, 1, column),
            component(blocks, i, 2, column),
            component(blocks, i, 3, column),
        )

    @wp.func(module=module)
    def solve_column(
        first: wp.int32,
        end: wp.int32,
        diagonal: wp.array(dtype=mat44),
        lower1: wp.array(dtype=mat44),
        lower2: wp.array(dtype=mat44),
        scale: real,
        right: wp.array(dtype=mat46),
        at: wp.int32,
        column: wp.int32,
        x: wp.array(dtype=vec4),
    ):
        """The solution for one column, which has right-hand sides in the first three rows alone: from right[at] on.

        All six columns in one thread would spill the registers of a GPU.
        """
        y1 = vec4(real(0.0))
        y2 = vec4(real(0.0))
        i = first
        while i < end:
            y = vec4(real(0.0))
            if i < first + 3:
                y = scale * column_of(right, at + i - first, column)
            if i > first:
                y -= lower1[i] * y1
            if i > first + 1:
                y -= lower2[i] * y2
            y = diagonal[i] * y
            x[6 * i + column] = y
            y2 = y1
            y1 = y
            i += 1
        y1 = vec4(real(0.0))
        y2 = vec4(real(0.0))
        i = end - 1
        while i >= first:
            y = x[6 * i + column]
            if i + 1 < end:
                y -= wp.transpose(lower1[i + 1]) * y1
            if i + 2 < end:
                y -= wp.transpose(lower2[i + 2]) * y2
            y = wp.transpose(diagonal[i]) * y
            x[6 * i + column] = y
            y2 = y1
            y1 = y
            i -= 1

    return SimpleNamespace(factorise=factorise, solve=solve, solve_column=solve_column)
