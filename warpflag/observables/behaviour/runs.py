"""Runs and tumbles of a swimming cell, from the path of its body alone."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag.observables.arrays import Array, elapsed

__all__ = [
    "DIRECTION_TIME",
    "SHORTEST_RUN",
    "SHORTEST_TUMBLE",
    "SLOW",
    "SMOOTHING",
    "TURNING",
    "RunsAndTumbles",
    "exponential_mean",
    "runs_and_tumbles",
]

SMOOTHING = 0.05
"""Time over which the path is averaged [s]: longer than a turn of the body, at whose rate the path coils."""
SLOW = 0.5
"""A cell slower than this part of its speed in runs tumbles. One half puts the edge of a stop where it is: averaging
over a window widens an edge to both sides alike."""
TURNING = 6.0
"""A cell whose direction turns faster tumbles [rad/s]: four times what rotational diffusion of a cell of 10 um with its
bundle (0.03 rad^2/s) leaves of rms turning, sqrt(4 D/SMOOTHING)."""
SHORTEST_RUN = 0.05
"""A run shorter than this between two tumbles is part of one tumble [s]."""
SHORTEST_TUMBLE = 0.02
"""A tumble shorter than this is part of a run [s]."""
DIRECTION_TIME = 0.1
"""Time of a run next to a tumble that gives the run's direction there [s]."""


@dataclass(frozen=True, eq=False)
class RunsAndTumbles:
    """A path cut into runs and tumbles. The first and the last piece are cut off by the ends of the path.

    Attributes:
        times: of the frames [s], shape [frame_count].
        tumbling: whether the cell tumbles, shape [frame_count].
        speed: of the averaged path [um/s], shape [frame_count].
        turning: rate at which its direction turns [rad/s], shape [frame_count].
        runs: begin and end of each run [s], shape [run_count, 2].
        run_speeds: mean of `speed` in each run [um/s], shape [run_count].
        tumbles: begin and end of each tumble [s], shape [tumble_count, 2].
        tumble_angles: between the directions of the runs before and after each tumble [rad], shape [tumble_count]; NaN
            where there is no run on one side.
    """

    times: Array
    tumbling: NDArray[np.bool_]
    speed: Array
    turning: Array
    runs: Array
    run_speeds: Array
    tumbles: Array
    tumble_angles: Array

    def __repr__(self) -> str:
        return f"<RunsAndTumbles: {len(self.runs)} runs, {len(self.tumbles)} tumbles>"

    @property
    def run_durations(self) -> Array:
        """Durations of the runs that the path shows from begin to end [s]."""
        return self._whole(self.runs)

    @property
    def tumble_durations(self) -> Array:
        """Durations of the tumbles that the path shows from begin to end [s]."""
        return self._whole(self.tumbles)

    @property
    def run_ended(self) -> NDArray[np.bool_]:
        """Whether the path shows the end of each run, shape [run_count]; see `exponential_mean`."""
        return self.runs[:, 1] < self.times[-1]

    @property
    def tumble_ended(self) -> NDArray[np.bool_]:
        """Whether the path shows the end of each tumble, shape [tumble_count]."""
        return self.tumbles[:, 1] < self.times[-1]

    @property
    def run_length(self) -> tuple[float, float]:
        """Mean duration of a run and its standard error [s], those cut off by the ends of the path counted."""
        return exponential_mean(np.diff(self.runs, axis=1)[:, 0], self.run_ended)

    @property
    def run_speed(self) -> float:
        """Mean speed in runs, weighted with their durations [um/s]; NaN without a run."""
        lengths = np.diff(self.runs, axis=1)[:, 0]
        return float(np.average(self.run_speeds, weights=lengths)) if len(lengths) else float("nan")

    @property
    def tumbling_fraction(self) -> float:
        """Part of the time that the cell tumbles."""
        return float(np.diff(self.tumbles, axis=1).sum() / (self.times[-1] - self.times[0]))

    def _whole(self, pieces: Array) -> Array:
        inside = (pieces[:, 0] > self.times[0]) & (pieces[:, 1] < self.times[-1])
        return np.diff(pieces[inside], axis=1)[:, 0]


def exponential_mean(durations: ArrayLike, ended: ArrayLike) -> tuple[float, float]:
    """Mean of exponentially distributed durations of which some were cut off, and its standard error.

    The maximum-likelihood estimate: all time over the number of ends, with the relative error of that number,
    1/sqrt(ends). The mean of the durations seen whole is too small, since long ones are cut off more often. Beginnings
    need not be seen, as the rate of ending does not depend on the time that has passed.

    Args:
        durations: seen of each piece, whole or not; of one path or many [s].
        ended: whether its end was seen.

    Returns:
        mean and standard error [s]; NaN where no end was seen.

    Source:
        Lawless, Statistical Models and Methods for Lifetime Data, 2nd ed. (2003), section 4.1.
    """
    durations, ends = np.asarray(durations, float), int(np.sum(ended))
    if not ends:
        return float("nan"), float("nan")
    mean = float(durations.sum() / ends)
    return mean, mean / ends**0.5


def runs_and_tumbles(
    times: ArrayLike,
    body_positions: ArrayLike,
    *,
    smoothing: float = SMOOTHING,
    slow: float = SLOW,
    turning: float = TURNING,
    shortest_run: float = SHORTEST_RUN,
    shortest_tumble: float = SHORTEST_TUMBLE,
    reach: float = DIRECTION_TIME,
) -> RunsAndTumbles:
    """Cuts a path into runs and tumbles: a cell tumbles where it is slow, or where its direction turns fast.

    The velocity is that of the path averaged over `smoothing`, which takes out the coils that a wobbling body swims:
    the difference of two adjacent averages over the time between them. The speed in runs, to which `slow` refers, is
    the median of the frames found to be running, from the fourth fifth of all on by repetition.

    Args:
        times: of the frames [s], shape [frame_count].
        body_positions: centres of the body [um], shape [frame_count, 3].
        smoothing: averaging time [s].
        slow: as a part of the speed in runs, below which a cell tumbles.
        turning: of the direction of the averaged path [rad/s], above which a cell tumbles.
        shortest_run: runs shorter than this between two tumbles belong to the tumble [s].
        shortest_tumble: tumbles shorter than this belong to the run [s].
        reach: time of a run next to a tumble that gives the run's direction [s].

    Raises:
        ValueError: the path is shorter than three averaging times, or its times do not increase.
    """
    times, positions = np.asarray(times, float), np.asarray(body_positions, float)
    if elapsed(times) < 3 * smoothing:
        raise ValueError(
            f"a path of {1e3 * elapsed(times):.4g} ms is too short for runs and tumbles: it must be three times the "
            f"smoothing, {1e3 * smoothing:.4g} ms, long"
        )
    path = _Path(times, positions, smoothing)
    velocity = path.velocity(times)
    speed = np.linalg.norm(velocity, axis=1)
    inside = np.clip(times, times[0] + 1.5 * smoothing, times[-1] - 1.5 * smoothing)
    before, after = path.velocity(inside - smoothing / 2), path.velocity(inside + smoothing / 2)
    rate = np.arctan2(np.linalg.norm(np.cross(before, after), axis=1), np.vecdot(before, after)) / smoothing
    tumbling = _tumbling(speed, rate, slow, turning)
    pieces = _pieces(times, tumbling, shortest_run, shortest_tumble)
    bounds = {kind: np.array([[a, b] for a, b, k in pieces if k is kind]).reshape(-1, 2) for kind in (False, True)}
    for begin, end, kind in pieces:
        tumbling[(times > begin) & (times < end)] = kind
    return RunsAndTumbles(
        times=times,
        tumbling=tumbling,
        speed=speed,
        turning=rate,
        runs=bounds[False],
        run_speeds=np.array([speed[(times >= a) & (times <= b)].mean() for a, b in bounds[False]]),
        tumbles=bounds[True],
        tumble_angles=np.array([
            _angle(path, pieces, k, reach) for k, (_, _, tumble) in enumerate(pieces) if tumble
        ]),
    )  # fmt: skip


class _Path:
    """A path of straight pieces between its frames, averaged over a window."""

    def __init__(self, times: Array, positions: Array, window: float) -> None:
        self._times, self._positions, self._window = times, positions, window
        steps = np.diff(times)[:, None]
        sums = np.cumsum(steps * (positions[1:] + positions[:-1]) / 2, axis=0)
        self._integral = np.vstack([np.zeros(3), sums])  # of the path from its begin to each frame [um s]

    def mean(self, at: ArrayLike) -> Array:
        """Average position over a window around each time [um]; at the ends, that of the nearest whole window."""
        half = self._window / 2
        at = np.clip(np.asarray(at, float), self._times[0] + half, self._times[-1] - half)
        return (self._to(at + half) - self._to(at - half)) / self._window

    def velocity(self, at: Array) -> Array:
        """Velocity of the averaged path [um/s]; at the ends, that of the nearest two whole windows."""
        half = self._window / 2
        at = np.clip(at, self._times[0] + self._window, self._times[-1] - self._window)
        return (self.mean(at + half) - self.mean(at - half)) / self._window

    def _to(self, at: Array) -> Array:
        k = np.clip(np.searchsorted(self._times, at, side="right") - 1, 0, len(self._times) - 2)
        passed = (at - self._times[k])[..., None]
        slope = (self._positions[k + 1] - self._positions[k]) / (self._times[k + 1] - self._times[k])[..., None]
        return self._integral[k] + passed * (self._positions[k] + passed * slope / 2)


def _tumbling(speed: Array, rate: Array, slow: float, turning: float) -> NDArray[np.bool_]:
    """Where the cell is slow against its own speed in runs, or turns fast."""
    in_runs = float(np.quantile(speed, 0.8))
    tumbling = (speed < slow * in_runs) | (rate > turning)
    for _ in range(5):  # two or three settle it
        if tumbling.all():
            break
        in_runs = float(np.median(speed[~tumbling]))
        tumbling = (speed < slow * in_runs) | (rate > turning)
    return tumbling


def _pieces(
    times: Array, tumbling: NDArray[np.bool_], shortest_run: float, shortest_tumble: float
) -> list[tuple[float, float, bool]]:
    """Begin, end [s] and kind of each piece, edges in the middle between frames, what is too short merged."""
    edges = np.flatnonzero(tumbling[1:] != tumbling[:-1])
    bounds = [times[0], *((times[edges] + times[edges + 1]) / 2), times[-1]]
    first = bool(tumbling[0])
    pieces = [(float(a), float(b), first ^ bool(k % 2)) for k, (a, b) in enumerate(pairwise(bounds))]
    for kind, shortest in ((False, shortest_run), (True, shortest_tumble)):
        # A piece that an end of the path cuts off may be longer than it looks.
        inner = [
            (a, b, k if k is not kind or b - a >= shortest or i in (0, len(pieces) - 1) else not kind)
            for i, (a, b, k) in enumerate(pieces)
        ]
        pieces = inner[:1]
        for a, b, k in inner[1:]:
            if k is pieces[-1][2]:
                pieces[-1] = (pieces[-1][0], b, k)
            else:
                pieces.append((a, b, k))
    return pieces


def _angle(path: _Path, pieces: list[tuple[float, float, bool]], k: int, reach: float) -> float:
    """Angle between the directions of the runs next to piece k [rad]; NaN at the ends of the path."""
    if k in (0, len(pieces) - 1):
        return float("nan")
    (begin, stop, _), (start, end, _) = pieces[k - 1], pieces[k + 1]
    directions = []
    for edge, sign, length in ((stop, -1.0, stop - begin), (start, 1.0, end - start)):
        margin = min(path._window / 2, length / 4)  # the averaged path begins to bend half a window before the tumble
        near, far = edge + sign * margin, edge + sign * min(margin + reach, length)
        directions.append(sign * (path.mean(far) - path.mean(near)))
    before, after = directions
    return float(np.arctan2(np.linalg.norm(np.cross(before, after)), before @ after))
