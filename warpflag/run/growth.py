"""Whether a motion magnifies disturbances: two copies of a cell, one of them disturbed, for a tenth of a millisecond.

No step control keeps a promise per millisecond where neighbouring trajectories part: flagella pressed together buckle
this way or that. An error estimate knows what a step adds, not what becomes of it. So a run whose estimates are high,
or that a guard has stopped, is followed from some of its states by a pair of cells, to tell such a motion from a
stepper that fails.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from warpflag.model.geometry import InitialState
from warpflag.record.cell_state import CellState
from warpflag.run.faults import NumericalError
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, SceneError, with_values

__all__ = ["SPAN", "UNSTABLE", "States", "growth", "growth_words"]

SPAN = 1.0e-4
"""Simulated time for which a disturbance is followed [s]."""
UNSTABLE = 100.0
"""Growth in that time from which a motion is called unstable; that of a bundle that zips is below ten."""
_DISTURBANCE = 1.0e-6  # um, far above round-off and far below what an accuracy asks for
_LOOKS = 5
_KEPT = 8
_FOLLOWED = 3


class States:
    """Some states of a run in which it may be looked at again, spread over its time."""

    def __init__(self) -> None:
        self._kept: list[CellState] = []
        self._stride, self._seen = 1, 0

    def add(self, state: CellState) -> None:
        """Offers a state; every second of those kept is dropped when they are too many."""
        if self._seen % self._stride == 0:
            self._kept.append(state)
        self._seen += 1
        if len(self._kept) > _KEPT:
            self._kept, self._stride = self._kept[::2], 2 * self._stride

    def chosen(self) -> list[CellState]:
        """The first, one from the middle, and the last."""
        picked = np.unique(np.linspace(0, len(self._kept) - 1, _FOLLOWED).round().astype(int))
        return [self._kept[i] for i in picked] if self._kept else []


def growth(
    scene: Scene, states: Sequence[CellState], first_node: np.ndarray, device: str
) -> tuple[float, float] | None:
    """The largest growth of a disturbance within `SPAN` of one of some states, and the time of that state [s].

    Args:
        scene: of the cell.
        states: to start from.
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1.
        device: to compute on.

    Returns:
        None where no state could be followed.
    """
    found: list[tuple[float, float]] = []
    followed = with_values(scene, {"numerics.on_accuracy": "warn"})
    for state in states:
        start = InitialState(
            tuple(np.split(state.positions, first_node[1:-1])),
            tuple(np.split(state.directors, first_node[1:-1])),
            state.body_position,
            state.body_orientation,
        )
        noise = np.random.default_rng(0)
        moved = []
        for nodes in start.positions:
            other = nodes.copy()
            other[1:] += _DISTURBANCE / 3**0.5 * noise.standard_normal(other[1:].shape)
            moved.append(other)
        largest = 0.0
        try:
            pair = Simulation(
                [followed, followed], device=device, starts=[start, dataclasses.replace(start, positions=tuple(moved))]
            )
            for k in range(_LOOKS):
                pair.advance(SPAN * (k + 1) / _LOOKS)
                one, two = np.split(pair.cells().positions, 2)
                largest = max(largest, float(np.linalg.norm(one - two, axis=1).max()) / _DISTURBANCE)
        except (NumericalError, SceneError):
            pass
        if largest > 0.0:
            found.append((largest, state.time))
    return max(found, default=None)


def growth_words(found: tuple[float, float] | None) -> str:
    """What `growth` found, for the last line of a run; empty where the motion is no more than lively."""
    if found is None or found[0] < UNSTABLE:
        return ""
    when = f"in {1e3 * SPAN:g} ms from {1e3 * found[1]:.4g} ms on"
    return f"unstable motion: a disturbance grows {found[0]:.2g} times {when}, so that no step keeps an error small"
