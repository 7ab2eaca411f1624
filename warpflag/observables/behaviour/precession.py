"""Wobble of an axis about a direction: precession turns it about the direction, nutation sways the angle between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from warpflag.observables.arrays import Array, elapsed, unit

__all__ = ["Wobble", "wobble"]

_STILL = 1e-6  # rad: an angle below has no azimuth, a sway below no frequency


@dataclass(frozen=True)
class Wobble:
    """How an axis moves about a direction, over a window of frames.

    Attributes:
        angle: mean angle between them [rad].
        precession_rate: turns of the axis about the direction, right-handed about it positive [Hz]; NaN where the axis
            lies along the direction all the time.
        nutation: amplitude by which the angle sways, sqrt(2) times its standard deviation [rad].
        nutation_rate: frequency of its strongest sway [Hz]; NaN where the angle is constant.
    """

    angle: float
    precession_rate: float
    nutation: float
    nutation_rate: float


def wobble(times: ArrayLike, axes: ArrayLike, about: ArrayLike) -> Wobble:
    """Precession and nutation of an axis.

    Args:
        times: of the frames [s], shape [frame_count], at least two; the axis must turn by less than half a turn about
            the direction from one frame to the next.
        axes: along the axis in each frame, of any length, shape [frame_count, 3].
        about: the direction, of any length, shape [3]; or that of each frame, shape [frame_count, 3], such as the
            direction of swimming.

    Raises:
        ValueError: fewer than two frames, or times that do not increase.
    """
    duration, times, axes = elapsed(times), np.asarray(times, float), unit(axes)
    about = np.broadcast_to(unit(about), axes.shape)
    along = np.vecdot(axes, about)
    across = axes - along[:, None] * about
    sine = np.linalg.norm(across, axis=1)
    angles = np.arctan2(sine, along)
    # Azimuths are counted from a direction that the minimal rotation of the direction carries along.
    before, after, start, end = across[:-1], across[1:], about[:-1], about[1:]
    before = before - (np.vecdot(end, before) / (1.0 + np.vecdot(start, end)))[:, None] * (start + end)
    turned = np.arctan2(np.vecdot(np.cross(before, after), end), np.vecdot(before, after))
    still = angles.max() < _STILL
    nutation = float(np.sqrt(2.0) * angles.std())
    return Wobble(
        angle=float(angles.mean()),
        precession_rate=float("nan") if still else float(turned.sum() / (2 * np.pi * duration)),
        nutation=nutation,
        nutation_rate=float("nan") if nutation < _STILL else _strongest(times, angles),
    )


def _strongest(times: Array, values: Array) -> float:
    """Frequency of the highest peak of the power spectrum [Hz], between its bins by the parabola through it."""
    even = np.linspace(times[0], times[-1], len(times))
    values = np.interp(even, times, values)
    values = (values - values.mean()) * np.hanning(len(values))
    power = np.log(np.abs(np.fft.rfft(values)) ** 2 + np.finfo(float).tiny)
    k = 1 + int(power[1:].argmax()) if len(power) > 1 else 0
    shift = 0.0
    if 1 < k < len(power) - 1:
        left, here, right = power[k - 1 : k + 2]
        shift = 0.5 * (left - right) / (left - 2 * here + right)
    return float((k + shift) / (len(values) * (even[1] - even[0])))
