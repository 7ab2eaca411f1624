"""Whether a motion magnifies disturbances: two copies of a cell, one of them disturbed, for a tenth of a millisecond.

No step control keeps a promise per millisecond where neighbouring trajectories part. An error estimate knows what a
step adds, not what becomes of it. So a run whose estimates are high, or that a guard has stopped, is followed from some
of its frames by a pair of cells, to tell such a motion from a stepper that fails. Both take the same fixed steps: steps
under control would differ, and so would the errors that they make, by far more than the disturbance.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from warpflag_kernels.stepping import accuracy

from warpflag.model.geometry import InitialState
from warpflag.record import Record
from warpflag.record.reporters import Frame
from warpflag.run.faults import NumericalError
from warpflag.run.simulation import Simulation
from warpflag.run.stop import Ended
from warpflag.scene import Scene, SceneError, with_values

__all__ = [
    "FOLLOWED",
    "FOLLOWED_IN_CROWDS",
    "LIVELY",
    "PATIENCE",
    "UNSTABLE",
    "Growth",
    "State",
    "chosen",
    "growth",
    "growth_words",
    "wanted",
]

FOLLOWED = 1.0e-4
"""Simulated time for which a disturbance is followed [s]."""
FOLLOWED_IN_CROWDS = 2.5e-4
"""The same of many flagella, where what magnifies errors is an event: one slips past another [s]."""
UNSTABLE = 100.0
"""Growth in `FOLLOWED` from which a motion is called unstable; that of a bundle that zips is below ten."""
LIVELY = 5.0
"""Growth from one look at the pair to a later one from which a motion is called lively. What a disturbance of single
nodes does at first, while it relaxes, is no part of it. In a bundle of twenty it is 1.2 to 2.2, and 16 to 100 where
flagella slip past each other."""
SUSPECT = 5.0
"""Estimate of the worst window over the accuracy from which on a run is followed; those of sound runs reach four."""
SUSPECT_SHARE = 0.01
"""A run is followed as well if at least this share of its steps has the shortest length that an estimate may ask for:
filaments whip as fast as steps follow."""
SUSPECT_OF_CROWDS, _FEW_FLAGELLA = 2.0, 3
"""As `SUSPECT`, of more flagella than that, which slip past each other: from the frame before that window only."""
_MOST_FRAMES = 10  # to follow a run from
PATIENCE = 20.0
"""Computing time that may go into following a run [s]."""
_DISTURBANCE = {"float64": 1.0e-6, "float32": 1.0e-4}  # um, above round-off and far below contact distances
_LOOKS = 10  # at the pair while it is followed: growth is told at the first that shows it


@dataclass(frozen=True)
class Growth:
    """How a disturbance has grown.

    Attributes:
        factor: largest displacement of a node over the disturbance.
        start: simulated time from which it was followed [s].
        within: time that it took [s].
        between: largest growth from one look at the pair to a later one.
    """

    factor: float
    start: float
    within: float
    between: float = 1.0

    @property
    def unstable(self) -> bool:
        """Whether no step keeps an error small in such a motion."""
        return self.factor >= UNSTABLE and self.within <= FOLLOWED * (1 + 1e-9)

    @property
    def lively(self) -> bool:
        """Whether errors of steps are magnified by far more than estimates know of."""
        return self.between >= LIVELY


class State(Protocol):
    """What a pair of cells starts from: a `CellState` or a `Frame`."""

    @property
    def time(self) -> float: ...
    @property
    def positions(self) -> np.ndarray: ...
    @property
    def directors(self) -> np.ndarray: ...
    @property
    def body_position(self) -> np.ndarray: ...
    @property
    def body_orientation(self) -> np.ndarray: ...


class Following(NamedTuple):
    """How a run is to be followed."""

    within: float  # for how long, from each frame [s]
    frames: int  # how many, at most
    patience: float  # computing time, at most [s]


def wanted(kept: Mapping[str, Any], steps: int, flagella: int, stopped: bool) -> Following | None:
    """How a run is to be followed; None where its estimates are not in doubt.

    Args:
        kept: what its estimates add up to, of `summary.accuracy_kept`.
        steps: how many it has taken.
        flagella: of the cell.
        stopped: whether a guard has stopped it.
    """
    worst = (kept["worst_window"] or 0.0) / kept["asked"]
    if stopped or worst > SUSPECT:
        return Following(FOLLOWED, _MOST_FRAMES, PATIENCE)
    if worst > SUSPECT_OF_CROWDS and flagella > _FEW_FLAGELLA:
        return Following(FOLLOWED_IN_CROWDS, 1, PATIENCE)
    if kept["steps_at_shortest"] > accuracy.UNCOUNTED_STEPS + SUSPECT_SHARE * steps:
        # A stiff start has such steps, too: not for longer than the run has taken.
        return Following(FOLLOWED, _MOST_FRAMES, min(PATIENCE, time.process_time()))
    return None


def chosen(record: Record, worst_end: float | None, followed: float, most: int) -> Iterable[Frame]:
    """Frames to follow a run from: before its worst estimates, the last, the first, the middle one, others between.

    Args:
        record: of the run.
        worst_end: end of the window with its worst estimate [s]; None: there is none.
        followed: for how long [s].
        most: how many.
    """
    last = record.frame_count - 1
    begin = np.searchsorted(record.times, (worst_end or 0.0) - followed, side="right") - 1
    between = np.linspace(0, last, _MOST_FRAMES).astype(int)
    for index in list(dict.fromkeys((max(int(begin), 0), last, 0, last // 2, *between.tolist())))[:most]:
        yield record.frame(index)


def growth(
    scene: Scene,
    states: Iterable[State],
    first_node: np.ndarray,
    device: str,
    step: float,
    patience: float = PATIENCE,
    followed: float = FOLLOWED,
    check: Callable[[], None] = lambda: None,
) -> Growth | None:
    """The first growth of a disturbance from one of some states that is unstable, else the liveliest, else the largest.

    Args:
        scene: of the cell.
        states: to start from.
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1.
        device: to compute on.
        step: of the pair [s]; that of the run, or less.
        patience: computing time after which no further look is taken [s].
        followed: simulated time [s].
        check: called a few times a second; where it raises Ended, no further look is taken.

    Returns:
        None where no state could be followed.
    """
    found: list[Growth] = []
    until = time.process_time() + patience

    def watch() -> None:
        check()
        if time.process_time() > until:
            raise Ended("late", "")

    with contextlib.suppress(Ended):
        for state in states:
            watch()
            for own in _looks(scene, state, first_node, device, step, followed, watch):
                found.append(own)
                if own.unstable:
                    return own
    return max(found, key=lambda own: (own.between if own.lively else 0.0, own.factor), default=None)


def _looks(
    scene: Scene,
    state: State,
    first_node: np.ndarray,
    device: str,
    step: float,
    followed: float,
    watch: Callable[[], None],
) -> Iterator[Growth]:
    """The growth from one state at `_LOOKS` times, until a guard stops the pair or `watch` raises."""
    size = _DISTURBANCE[scene.numerics.precision]
    begun = state.time if scene.motor.switching != "none" else 0.0  # motors stand as they did then
    start = InitialState(
        tuple(np.split(state.positions, first_node[1:-1])),
        tuple(np.split(state.directors, first_node[1:-1])),
        state.body_position,
        state.body_orientation,
        begun,
        forms=getattr(state, "forms", None),
    )
    noise = np.random.default_rng(0)
    moved = [nodes.copy() for nodes in start.positions]
    for nodes in moved:
        nodes[1:] += size / 3**0.5 * noise.standard_normal(nodes[1:].shape)
    with contextlib.suppress(NumericalError, SceneError):
        taken = scene.numerics.time_step or step
        steps = {"numerics.time_step": taken, "numerics.accuracy": None}
        own = with_values(scene, {"numerics.on_accuracy": "warn", **steps})
        starts = [start, dataclasses.replace(start, positions=tuple(moved))]
        pair = Simulation([own, own], device=device, starts=starts)
        least, between = np.inf, 1.0
        for k in range(_LOOKS):
            within = followed * (k + 1) / _LOOKS
            pair.advance(begun + within, watch)
            one, two = np.split(pair.cells().positions, 2)
            factor = float(np.linalg.norm(one - two, axis=1).max()) / size
            least = min(least, factor)
            between = max(between, factor / max(least, np.finfo(float).tiny))
            yield Growth(factor, state.time, within, between)


def growth_words(found: Growth | None) -> str:
    """What `growth` found, for the last line of a run; empty where the motion magnifies little."""
    if found is None or not (found.unstable or found.lively):
        return ""
    when = f"in {1e3 * found.within:g} ms from {1e3 * found.start:.4g} ms on"
    if found.unstable:
        grown = f"a disturbance grows {found.factor:.2g} times {when}"
        return f"unstable motion: {grown}, so that no step keeps an error small"
    return (
        f"lively motion: a disturbance grows {found.between:.2g} times {when}, so positions after that may err by as "
        "many times more than estimates know"
    )
