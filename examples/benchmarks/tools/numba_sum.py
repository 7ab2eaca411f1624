"""The pair sum of pair_sum.cpp in numba, twice: as one writes it, and as numba has to have it to rival C++.

Plain: @njit(fastmath=True), arrays of shape [N, 3], two loops, the tensor as it stands in print. numba checks every
division for a zero, and the arrays have a stride of three: either keeps the loop scalar. The literals are float64 and
turn float32 arithmetic into that.

Tuned: one array per component, no literals, no checks, no branch, the loop split at the node itself.
"""

from __future__ import annotations

import functools
import importlib.util
from typing import Any

import numpy as np


def available() -> bool:
    """Whether numba is installed."""
    return importlib.util.find_spec("numba") is not None


@functools.cache
def _plain() -> Any:
    import numba

    @numba.njit(fastmath=True)
    def pair_sum(x, f, v, a):
        n = x.shape[0]
        for i in range(n):
            vx, vy, vz = 0.0, 0.0, 0.0
            for j in range(n):
                if i != j:
                    dx = x[i, 0] - x[j, 0]
                    dy = x[i, 1] - x[j, 1]
                    dz = x[i, 2] - x[j, 2]
                    r2 = dx * dx + dy * dy + dz * dz
                    r = np.sqrt(r2)
                    if r > 2.0 * a:
                        isotropic = (1.0 + 2.0 * a * a / (3.0 * r2)) / r
                        along = (1.0 - 2.0 * a * a / r2) / (r * r2)
                    else:
                        isotropic = (4.0 / 3.0 - 3.0 * r / (8.0 * a)) / a
                        along = 1.0 / (8.0 * a * a * r)
                    df = along * (dx * f[j, 0] + dy * f[j, 1] + dz * f[j, 2])
                    vx += isotropic * f[j, 0] + df * dx
                    vy += isotropic * f[j, 1] + df * dy
                    vz += isotropic * f[j, 2] + df * dz
            v[i, 0] = vx
            v[i, 1] = vy
            v[i, 2] = vz

    @numba.njit
    def repeated(repeats, x, f, v, a):
        for _ in range(repeats):
            pair_sum(x, f, v, a)

    return repeated


@functools.cache
def _tuned() -> Any:
    import numba

    compiled = numba.njit(fastmath=True, error_model="numpy")

    @compiled
    def part(xi, yi, zi, x, y, z, fx, fy, fz, radius, one, two, third):
        """Flow of some nodes at a point; constants come in, since a literal would turn float32 into float64."""
        a2 = radius * radius
        near = two * two * a2
        contact = two * two * third / radius
        slope = (one + one / two) / (two * two) / a2
        vx = vy = vz = one - one
        for j in range(len(x)):  # whole arrays: an index that starts anywhere would be checked for its sign
            dx, dy, dz = xi - x[j], yi - y[j], zi - z[j]
            r2 = dx * dx + dy * dy + dz * dz
            inverse = one / np.sqrt(r2)
            q = a2 * inverse * inverse
            far_isotropic = inverse * (one + two * third * q)
            far_along = inverse * inverse * inverse * (one - two * q)
            isotropic = far_isotropic if r2 > near else contact - slope * r2 * inverse
            along = far_along if r2 > near else slope * third * inverse
            along *= dx * fx[j] + dy * fy[j] + dz * fz[j]
            vx += isotropic * fx[j] + along * dx
            vy += isotropic * fy[j] + along * dy
            vz += isotropic * fz[j] + along * dz
        return vx, vy, vz

    @compiled
    def repeated(repeats, x, y, z, fx, fy, fz, v, a):
        one, two, third = a.dtype.type(1), a.dtype.type(2), a.dtype.type(1 / 3)
        for _ in range(repeats):
            for i in range(len(x)):
                at = (x[i], y[i], z[i])
                before = part(*at, x[:i], y[:i], z[:i], fx[:i], fy[:i], fz[:i], a[0], one, two, third)
                k = i + 1
                after = part(*at, x[k:], y[k:], z[k:], fx[k:], fy[k:], fz[k:], a[0], one, two, third)
                for axis in range(3):
                    v[axis, i] = before[axis] + after[axis]

    return repeated


class PlainPairSum:
    """As `NativePairSum`, in plain numba; arrays and radius have the precision asked for."""

    def __init__(self, positions: np.ndarray, forces: np.ndarray, radius: float, precision: str) -> None:
        x, f = (np.ascontiguousarray(a, dtype=precision) for a in (positions, forces))
        self._v = np.zeros_like(x)
        self._arguments = [x, f, self._v, x.dtype.type(radius)]

    def __call__(self, repeats: int) -> None:
        """Sums so many times over."""
        _plain()(repeats, *self._arguments)

    @property
    def velocities(self) -> np.ndarray:
        return self._v.astype(np.float64)


class TunedPairSum:
    """As `NativePairSum`, in tuned numba."""

    def __init__(self, positions: np.ndarray, forces: np.ndarray, radius: float, precision: str) -> None:
        rows = [np.ascontiguousarray(a.T, dtype=precision) for a in (positions, forces)]
        self._v = np.zeros_like(rows[0])
        # The radius as an array, so that its type is known inside.
        self._arguments = [*rows[0], *rows[1], self._v, np.array([radius], dtype=precision)]

    def __call__(self, repeats: int) -> None:
        """Sums so many times over."""
        _tuned()(repeats, *self._arguments)

    @property
    def velocities(self) -> np.ndarray:
        return self._v.T.astype(np.float64)
