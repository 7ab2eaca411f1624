"""From the states of cells to frames of their records: observables of one moment and of the interval before it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpflag.observables.cells import body_speeds, bundle_lengths, phase_differences
from warpflag.record import Frame
from warpflag.run.cells import Cells

__all__ = ["frames_of"]


def frames_of(
    now: Cells, before: Cells | None, lengths: Sequence[float], wanted: Sequence[int] | np.ndarray
) -> dict[int, Frame]:
    """The frames of the wanted cells, by cell; observables are measured for all cells of one structure at once.

    Rates are differences between two frames, so the first one has none: NaN there.

    Args:
        now: the cells at this frame.
        before: the cells at the frame before it; None at the first.
        lengths: contour length of a flagellum of each cell, over which the steric force is distributed [um].
        wanted: numbers of the cells whose frames are asked for.
    """
    frames: dict[int, Frame] = {}
    for cells in _by_structure(now, wanted):
        measured = _measured(now, before, np.array(cells))
        for row, c in enumerate(cells):
            observables = {name: values[row] for name, values in measured.items()}
            observables["steric_force_density"] = now.steric_force[c] / lengths[c]
            flagella, nodes = now.flagella(c), now.nodes(c)
            frames[c] = Frame(
                time=float(now.time[c]),
                step=int(now.step[c]),
                positions=now.positions[nodes],
                directors=now.directors[nodes],
                motor_angle=now.motor_angle[flagella],
                body_position=now.body_position[c],
                body_orientation=now.body_orientation[c],
                observables=observables,
            )
    return frames


def _by_structure(cells: Cells, wanted: Sequence[int] | np.ndarray) -> list[list[int]]:
    """The wanted cells in groups whose flagella have the same numbers of nodes."""
    groups: dict[tuple[int, ...], list[int]] = {}
    for c in (int(c) for c in wanted):
        own = cells.flagella(c)
        groups.setdefault(tuple(np.diff(cells.first_node[own.start : own.stop + 1])), []).append(c)
    return list(groups.values())


def _measured(now: Cells, before: Cells | None, cells: np.ndarray) -> dict[str, np.ndarray]:
    """Observables of cells of one structure by name, shape [cell_count] or [cell_count, flagellum_count]."""
    own = now.flagella(cells[0])
    first_node = now.first_node[own.start : own.stop + 1] - now.first_node[own.start]
    flagella = now.first_flagellum[cells][:, None] + np.arange(len(first_node) - 1)
    nodes = now.first_node[now.first_flagellum[cells]][:, None] + np.arange(first_node[-1])
    positions = now.positions[nodes]
    measured: dict[str, np.ndarray] = {}
    if len(first_node) > 2:
        measured["phase_difference"] = phase_differences(positions, now.directors[nodes], first_node)
    measured["bundle_length"] = bundle_lengths(positions, first_node)
    measured["elastic_energy"] = now.elastic_energy[cells].sum(axis=1)
    if before is None:
        nothing = np.full(len(cells), np.nan)
        return measured | {
            "body_speed": nothing,
            "body_rate": nothing,
            "motor_rate": np.full(flagella.shape, np.nan),
        }
    duration = now.time[cells] - before.time[cells]
    at_ends = [before.body_position[cells], now.body_position[cells]]
    at_ends += [before.body_orientation[cells], now.body_orientation[cells]]
    return measured | {
        "body_speed": body_speeds(duration, *at_ends),
        "body_rate": (now.body_angle[cells] - before.body_angle[cells]) / (2 * np.pi * duration),
        "motor_rate": (now.motor_angle[flagella] - before.motor_angle[flagella]) / (2 * np.pi * duration[:, None]),
    }
