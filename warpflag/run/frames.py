"""From the state of a cell to a frame of its record: the observables of one moment and of the interval before it."""

from __future__ import annotations

import numpy as np

from warpflag import observables
from warpflag.record import Frame
from warpflag.record.cell_state import CellState

__all__ = ["frame_of"]


def frame_of(state: CellState, before: CellState | None, first_node: np.ndarray, length: float) -> Frame:
    """The frame of a state.

    Rates are differences between two frames, so the first one has none: NaN there.

    state, before: of this frame and of the one before it. first_node: shape [flagellum_count + 1]. length: contour
    length of one flagellum, over which the steric force is distributed [um].
    """
    measured: dict[str, float | np.ndarray] = {}
    if len(first_node) > 2:
        measured["phase_difference"] = observables.phase_difference(state.positions, state.directors, first_node)
    measured["bundle_length"] = observables.bundle_length(state.positions, first_node)
    measured["steric_force_density"] = state.steric_force / length
    measured["elastic_energy"] = float(state.elastic_energy.sum())
    measured |= _rates(before, state)
    return Frame(
        time=state.time,
        step=state.step,
        positions=state.positions,
        directors=state.directors,
        motor_angle=state.motor_angle,
        body_position=state.body_position,
        body_orientation=state.body_orientation,
        observables=measured,
    )


def _rates(before: CellState | None, now: CellState) -> dict[str, float | np.ndarray]:
    """Speed along the body axis [um/s], turns of the body about it and of the motors in the body [Hz]."""
    if before is None:
        return {"body_speed": np.nan, "body_rate": np.nan, "motor_rate": np.full(len(now.motor_angle), np.nan)}
    duration = now.time - before.time
    times = np.array([before.time, now.time])
    positions = np.stack([before.body_position, now.body_position])
    orientations = np.stack([before.body_orientation, now.body_orientation])
    return {
        "body_speed": observables.body_speed(times, positions, orientations),
        "body_rate": (now.body_angle - before.body_angle) / (2 * np.pi * duration),
        "motor_rate": (now.motor_angle - before.motor_angle) / (2 * np.pi * duration),
    }
