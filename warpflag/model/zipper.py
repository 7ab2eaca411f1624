"""The analytic zipper: a bundle that grows at its front while the flow folds the free flagella onto it.

The paper (Adhyapak & Stark, Phys. Rev. E 92, 052701 (2015), eq. 3), with l_r in um:

    dl_r/dt = v_e + omega_c R/cos(psi),     dpsi/dt = v_c cos(psi)/(L_ax - l_r),     psi(0) = 90 deg - Phi/2

cos(psi) goes to 0 and the rate of psi to infinity as the zip closes. With s = ln[(L_ax - l_r(0))/(L_ax - l_r)] in place
of time and y = arsinh(tan(psi)) in place of the angle, so that cosh(y) = 1/cos(psi), nothing is singular:

    dy/ds = v_c/(v_e + omega_c R cosh(y)),     dt/ds = (L_ax - l_r)/(v_e + omega_c R cosh(y))
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag import observables
from warpflag.model.geometry import ground_state
from warpflag.observables import recorded
from warpflag.record import Record
from warpflag.scene import FlagellumSpec, loads

__all__ = ["PAPER", "Fit", "Zipper", "bundle_length", "fit", "measured", "zipping"]

Array = NDArray[np.floating]

_LAST_S = 12.0  # the open rest is then e^-12 of what it was: closed
_STEPS = 240  # of Runge-Kutta in s, 0.05 each: its error is 2e-6 of the length
_LARGEST = 700.0  # of y: its cosh is still finite
_GRID = 13  # values of each parameter per round of the fit
_FIT_ROUNDS = 30  # each halves the ranges: the valley of good fits is narrow and slanted
_BOUNDS = {"radius": (0.0, 5.0), "phase_velocity": (1.0, 1e4)}  # um, um/s: far beyond any bundle


@dataclass(frozen=True)
class Zipper:
    """Parameters of the model.

    Attributes:
        opening_angle: Phi, between the free flagella [deg], 0 to 180, 0 excluded.
        axial_length: L_ax of a flagellum [um].
        phase_velocity: v_e = lambda_f nu_f of the helical wave [um/s].
        body_speed: v_c, flow along the body axis in its frame [um/s].
        body_rate: omega_c/2 pi, turns of that flow about the axis [Hz], positive.
        radius: R, effective radius of the bundle [um].
        start: l_r at time 0 [um].
    """

    opening_angle: float
    axial_length: float
    phase_velocity: float
    body_speed: float
    body_rate: float
    radius: float = 0.0
    start: float = 0.0


PAPER = Zipper(
    opening_angle=90.0,
    axial_length=8.0 * 0.8432,
    phase_velocity=2.5 * 83.3,
    body_speed=22.5,
    body_rate=11.4,
    radius=0.30,
)
"""What the paper fitted: v_c, omega_c, lambda_f, nu_f and R of its Fig. 3. It prints neither l_r(0) nor L_ax; here that
of flagella of 8 um."""


def zipping(record: Record, onset: float = 0.2) -> tuple[Array, Array]:
    """Times [s] and l_r while the zip closes: from where l_r last rises above `onset` to where it is complete.

    Before, l_r jumps between 0 and short stretches that touch and part again. Complete means l_r >= 0.98 for 0.25 ms.
    l_r passes over gaps of `observables.STRAY`.

    Args:
        record: of the run.
        onset: l_r at which the zip begins.

    Returns:
        Times from the frame at the onset on [s], shape [count], and l_r, same shape.

    Raises:
        ValueError: the zip is never complete.
    """
    times, lengths = record.times, recorded.bundle_lengths(record, gap=observables.STRAY)
    stop = observables.zip_time(times, lengths, hold=2.5e-4)
    if math.isnan(stop):
        raise ValueError(f"{record.path}: the zip is never complete")
    last = int(np.searchsorted(times, stop))
    below = np.flatnonzero(lengths[:last] <= onset)
    frames = slice(int(below[-1]) + 1 if below.size else 0, last + 1)
    return times[frames], lengths[frames]


def measured(record: Record, start: float, stop: float) -> Zipper:
    """The model with the parameters of a run, measured over a window; R and l_r(0) are 0.

    L_ax is that of the flagella at rest, v_e pitch times rate of the helices in the lab, v_c the speed along the body
    axis.

    Args:
        record: of the run.
        start: of the window [s].
        stop: of the window [s].
    """
    scene = loads(record.scene_text)
    swimming = recorded.swimming(record, start, stop)
    specs = scene.resolved_flagella()
    rises = [
        ground_state(scene.flagella.strain_at_rest(spec.segment_length), spec.segment_length).rise for spec in specs
    ]
    return Zipper(
        opening_angle=_angle_between_axes(*specs[:2]),
        axial_length=float(np.mean([spec.segment_count * rise for spec, rise in zip(specs, rises, strict=True)])),
        phase_velocity=swimming.phase_velocity,
        body_speed=swimming.body_speed,
        body_rate=abs(swimming.body_rate),
    )


def _angle_between_axes(a: FlagellumSpec, b: FlagellumSpec) -> float:
    """Angle between the helix axes of two flagella at rest [deg]."""
    tilts, turn = (math.radians(a.tilt), math.radians(b.tilt)), math.radians(a.azimuth - b.azimuth)
    sines, cosines = math.prod(map(math.sin, tilts)), math.prod(map(math.cos, tilts))
    return math.degrees(math.acos(max(-1.0, min(1.0, cosines + sines * math.cos(turn)))))


def bundle_length(zipper: Zipper, times: Array) -> Array:
    """l_r over L_ax at the given times [s], shape [count]; 1 once the zip is closed.

    Raises:
        ValueError: the front does not move forward, or starts beyond the tips.
    """
    times_of_front, front = _solved(zipper, zipper.phase_velocity, zipper.radius, zipper.start)
    return np.interp(times, times_of_front[0], front[0]) / zipper.axial_length


@dataclass(frozen=True)
class Fit:
    """The model fitted to a bundle length.

    Attributes:
        zipper: with the adjusted parameters.
        residual: root mean square of the difference in l_r/L_ax over the fitted times.
    """

    zipper: Zipper
    residual: float


def fit(
    zipper: Zipper,
    times: ArrayLike,
    lengths: ArrayLike,
    adjust: Literal["radius", "phase_velocity"] = "radius",
) -> Fit:
    """Adjusts R and l_r(0) by least squares, as the paper does, or v_e and l_r(0); all else stays as given.

    A grid over both parameters is narrowed about its best point round by round. R is sought from 0 to 5 um, v_e from 1
    to 1e4 um/s; a result on a bound means that the model has no better one inside.

    Args:
        zipper: the parameters that stay.
        times: from the moment at which the model starts [s], shape [count].
        lengths: l_r over L_ax, same shape.
        adjust: which parameter is adjusted beside l_r(0).

    Raises:
        ValueError: the front can't move forward.
    """
    times, lengths = np.asarray(times, float), np.asarray(lengths, float)
    least = low = np.array([_BOUNDS[adjust][0], 0.0])
    most = high = np.array([_BOUNDS[adjust][1], 0.999 * zipper.axial_length])
    best, residual = low, math.inf
    for _ in range(_FIT_ROUNDS):
        first, start = (axis.ravel() for axis in np.meshgrid(*np.linspace(low, high, _GRID).T))
        velocity, radius = (first, zipper.radius) if adjust == "phase_velocity" else (zipper.phase_velocity, first)
        curves = zip(*_solved(zipper, velocity, radius, start), strict=True)
        errors = np.array([np.interp(times, t, l) for t, l in curves]) / zipper.axial_length - lengths
        residuals = np.sqrt((errors**2).mean(axis=1))
        i = int(residuals.argmin())
        best, residual = np.array([first[i], start[i]]), float(residuals[i])
        quarter = (high - low) / 4.0
        low, high = np.maximum(best - quarter, least), np.minimum(best + quarter, most)
    return Fit(replace(zipper, **{adjust: float(best[0]), "start": float(best[1])}), residual)


def _solved(zipper: Zipper, velocity: ArrayLike, radius: ArrayLike, start: ArrayLike) -> tuple[Array, Array]:
    """Times [s] and front positions [um] along s for many v_e, R and l_r(0), shape [count, steps + 1]."""
    velocity, radius, start = (np.atleast_1d(each) for each in np.broadcast_arrays(velocity, radius, start))
    if not 0.0 < zipper.opening_angle <= 180.0:
        raise ValueError(f"an opening angle of {zipper.opening_angle:g} deg leaves nothing to zip")
    if not (start < zipper.axial_length).all():
        raise ValueError("the bundle starts beyond the tips of the flagella")
    wrapping = 2.0 * math.pi * zipper.body_rate * radius
    if (velocity < 0.0).any() or (wrapping < 0.0).any() or not (velocity + wrapping > 0.0).all():
        raise ValueError("the front does not move forward: v_e and omega_c R must not be negative, nor both 0")

    def slopes(s: float, y: Array) -> tuple[Array, Array]:
        speed = velocity + wrapping * np.cosh(np.minimum(y, _LARGEST))
        return zipper.body_speed / speed, (zipper.axial_length - start) * math.exp(-s) / speed

    ds = _LAST_S / _STEPS
    y = np.full(start.shape, math.asinh(1.0 / math.tan(math.radians(zipper.opening_angle) / 2)))
    times = [np.zeros(start.shape)]
    for s in ds * np.arange(_STEPS):  # classical Runge-Kutta
        k1, t1 = slopes(s, y)
        k2, t2 = slopes(s + ds / 2, y + ds / 2 * k1)
        k3, t3 = slopes(s + ds / 2, y + ds / 2 * k2)
        k4, t4 = slopes(s + ds, y + ds * k3)
        y = y + ds / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        times.append(times[-1] + ds / 6 * (t1 + 2 * t2 + 2 * t3 + t4))
    still_open = np.exp(-ds * np.arange(_STEPS + 1))
    return np.stack(times, axis=1), zipper.axial_length - (zipper.axial_length - start)[:, None] * still_open
