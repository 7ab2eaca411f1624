"""The space of Lanczos' process of a cell: its arrays, and the root of the small matrix in it.

T^1/2 e_1 comes from the eigenvalues and eigenvectors of T by Jacobi's rotations, by one thread of a cell.
"""

import functools
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision

MOST_PRODUCTS = 20  # products at most: a condition of 100 then leaves less than 1e-3
JACOBI_SWEEPS = 10  # of Jacobi's rotations at most; they converge quadratically, in four or five


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Lanczos`; vectors one after the other."""
    vec3 = p.vec3

    @wp.struct
    class Lanczos:
        basis: wp.array(dtype=vec3)  # [(MOST_PRODUCTS + 1) * E]
        alpha: wp.array(dtype=wp.float64)  # [C * MOST_PRODUCTS], diagonal of T [um/(s pN)]
        beta: wp.array(dtype=wp.float64)  # [C * MOST_PRODUCTS], beside it
        size: wp.array(dtype=wp.float64)  # [C], |z|
        weight: wp.array(dtype=wp.float64)  # [C * MOST_PRODUCTS], T^1/2 e_1 [(um/(s pN))^1/2]
        inverse: wp.array(dtype=wp.float64)  # [C * MOST_PRODUCTS], T^-1/2 e_1 [(pN s/um)^1/2]
        matrix: wp.array(dtype=wp.float64)  # [C * MOST_PRODUCTS * MOST_PRODUCTS], work space
        vectors: wp.array(dtype=wp.float64)  # [C * MOST_PRODUCTS * MOST_PRODUCTS], eigenvectors of T
        tolerance: wp.array(dtype=wp.float64)  # [C], relative; 0: PRODUCTS products
        error: wp.array(dtype=wp.float64)  # [C], last change of the result, relative
        products: wp.array(dtype=wp.int32)  # [C], in this draw
        total: wp.array(dtype=wp.int64)  # [C], products so far in the run
        running: wp.array(dtype=wp.int32)  # [C], 1: another product is wanted
        going: wp.array(dtype=wp.int32)  # [1], 1: some cell wants one

    return Lanczos


@functools.cache
def root_function(p: Precision) -> Any:
    """Device function `root`: the first column of T^1/2, and how much the last product has changed it."""
    Lanczos, most, sweeps = struct(p), wp.constant(MOST_PRODUCTS), wp.constant(JACOBI_SWEEPS)
    module = p.module("lanczos_root")

    @wp.func(module=module)
    def rotate(
        a: wp.array(dtype=wp.float64),
        v: wp.array(dtype=wp.float64),
        at: wp.int32,
        n: wp.int32,
        i: wp.int32,
        j: wp.int32,
    ):
        """One rotation of Jacobi, which makes the entry (i, j) of the symmetric matrix a vanish."""
        one, two = wp.float64(1.0), wp.float64(2.0)
        off = a[at + i * most + j]
        if off == wp.float64(0.0):
            return
        x = (a[at + j * most + j] - a[at + i * most + i]) / (two * off)
        t = one / (wp.abs(x) + wp.sqrt(x * x + one))
        if x < wp.float64(0.0):
            t = -t
        c = one / wp.sqrt(t * t + one)
        s = t * c
        for k in range(n):
            f = a[at + k * most + i]
            g = a[at + k * most + j]
            a[at + k * most + i] = c * f - s * g
            a[at + k * most + j] = s * f + c * g
        for k in range(n):
            f = a[at + i * most + k]
            g = a[at + j * most + k]
            a[at + i * most + k] = c * f - s * g
            a[at + j * most + k] = s * f + c * g
            f = v[at + k * most + i]
            g = v[at + k * most + j]
            v[at + k * most + i] = c * f - s * g
            v[at + k * most + j] = s * f + c * g

    @wp.func(module=module)
    def root(z: Lanczos, c: wp.int32, n: wp.int32):
        """Sets `weight` to T^1/2 e_1 and `inverse` to T^-1/2 e_1 after n products; returns the relative change of
        the first since one product less."""
        zero = wp.float64(0.0)
        at = c * most * most
        for i in range(n):
            for j in range(n):
                z.matrix[at + i * most + j] = zero
                z.vectors[at + i * most + j] = zero
            z.matrix[at + i * most + i] = z.alpha[c * most + i]
            z.vectors[at + i * most + i] = wp.float64(1.0)
            if i > 0:
                z.matrix[at + i * most + i - 1] = z.beta[c * most + i - 1]
                z.matrix[at + (i - 1) * most + i] = z.beta[c * most + i - 1]
        for _sweep in range(sweeps):
            for i in range(n - 1):
                for j in range(i + 1, n):
                    rotate(z.matrix, z.vectors, at, n, i, j)
        changed = zero
        size = zero
        for i in range(n):
            value = zero
            inverse = zero
            for j in range(n):
                eigenvalue = wp.sqrt(wp.max(z.matrix[at + j * most + j], zero))
                value += z.vectors[at + i * most + j] * eigenvalue * z.vectors[at + j]
                if eigenvalue > zero:
                    inverse += z.vectors[at + i * most + j] / eigenvalue * z.vectors[at + j]
            z.inverse[c * most + i] = inverse
            before = zero
            if i + 1 < n:
                before = z.weight[c * most + i]
            changed += (value - before) * (value - before)
            size += value * value
            z.weight[c * most + i] = value
        return wp.sqrt(changed / size)

    return root
