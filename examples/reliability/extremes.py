"""Attacks with extremes: one thing about a cell of two flagella is changed by far."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from examples.reliability.attempt import Found, found
from examples.reliability.scenes import against_finer
from warpflag.model.geometry import InitialState, initial_state
from warpflag.scene import FlagellumOverride, Scene, SceneError, with_values

CUT_OFF = 10.0
"""Computing time of a run and of its reference [s]."""
_STIFF = ("flagella.bending_rigidity", "flagella.twist_rigidity")
_WATER = {"fluid.drag_parallel": 1.6e-3, "fluid.drag_perpendicular": 2.8e-3, "fluid.drag_rotation": 1.26e-6}


def _rows() -> dict[str, tuple[dict[str, Any], float]]:
    """Changed values and simulated time [s] of each row."""
    rows: dict[str, tuple[dict[str, Any], float]] = {"as it is": ({}, 1e-3)}
    for factor in (2, 10, 100, 1000):
        rows[f"fixed step x {factor}"] = ({"numerics.time_step": 1e-5 * factor}, max(3e-4, 1e-5 * factor))
    for factor in (3, 10, 100):
        rows[f"T x {factor}"] = ({"motor.torque": 3.4 * factor}, 1e-3 / factor)
    rows["F_0 x 100"] = ({"steric.strength": 80.0}, 1e-3)
    for power in (-3, -2, -1, 1, 2, 3, 4):
        rows[f"A, C x 1e{power}"] = (dict.fromkeys(_STIFF, 3.5 * 10.0**power), 2e-4)
        rows[f"K x 1e{power}"] = ({"flagella.stretching_stiffness": 1e3 * 10.0**power}, 2e-4)
    for factor in (0.01, 0.1, 10, 100):
        rows[f"eta x {factor:g}"] = ({"fluid.viscosity": 1e-3 * factor}, 1e-3 * factor**0.7)
        kept = {"fluid.viscosity": 1e-3 * factor, **_WATER}
        rows[f"eta x {factor:g}, drag kept"] = (kept, 2e-4)
    for h in (0.05, 0.1, 0.4, 1.0):
        rows[f"h = {h:g}"] = ({"flagella.segment_length": h}, 3e-4)
    rows["one segment"] = ({"flagella.length": 0.2}, 1e-4)
    rows["two segments"] = ({"flagella.length": 0.4}, 1e-4)
    rows["100 um"] = ({"flagella.length": 100.0, "flagella.opening_angle": 120.0}, 1e-4)
    rows["tiny body"] = ({"body.length": 0.2, "body.width": 0.1}, 2e-4)
    rows["huge body"] = ({"body.length": 50.0, "body.width": 20.0}, 2e-4)
    for start in STARTS:
        rows[start] = ({"body.contact": False} if start != "1 mm off" else {}, 1e-4)
    return rows


def _hairpin(scene: Scene, start: InitialState) -> InitialState:
    """The outer half of every flagellum bent back along the inner one, over five joints."""
    shapes, directors = [], []
    for nodes, e1 in zip(start.positions, start.directors, strict=True):
        segments, own = np.diff(nodes, axis=0), e1.copy()
        axis = np.cross(nodes[-1] - nodes[0], [0.3, 0.5, 1.0])
        cross = np.cross(np.eye(3), axis / np.linalg.norm(axis))
        angle = np.radians(32.0)
        turn = np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        for joint in range(len(segments) // 2, len(segments) // 2 + 5):
            segments[joint:] = segments[joint:] @ turn.T
            own[joint + 1 :] = own[joint + 1 :] @ turn.T  # element 0 is the motor's
        shapes.append(np.vstack([nodes[0], nodes[0] + np.cumsum(segments, axis=0)]))
        directors.append(own)
    return InitialState(tuple(shapes), tuple(directors), start.body_position, start.body_orientation)


def _near(distance: float) -> Any:
    """Flagellum 1 turned as a whole until its nearest point is so far from flagellum 0."""

    def placed(scene: Scene, start: InitialState) -> InitialState:
        first, second = start.positions
        gaps = np.linalg.norm(first[5:, None] - second[None, 5:], axis=-1)
        i, j = np.unravel_index(gaps.argmin(), gaps.shape)
        own, goal = second[5 + j] - second[0], first[5 + i] - second[0]
        apart = np.cross(own, goal)
        apart /= np.linalg.norm(apart)
        goal = goal / np.linalg.norm(goal) * np.linalg.norm(own) + distance * apart
        axis = np.cross(own, goal)
        sine, cosine = np.linalg.norm(axis), own @ goal
        axis, angle = axis / sine, np.arctan2(sine, cosine)
        cross = np.cross(np.eye(3), axis)
        turn = np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        positions = (first, second[0] + (second - second[0]) @ turn.T)
        return dataclasses.replace(
            start, positions=positions, directors=(start.directors[0], start.directors[1] @ turn.T)
        )

    return placed


def _zero_segment(scene: Scene, start: InitialState) -> InitialState:
    nodes = start.positions[0].copy()
    nodes[6:] -= nodes[6] - nodes[5]
    return dataclasses.replace(start, positions=(nodes, start.positions[1]))


def _far(scene: Scene, start: InitialState) -> InitialState:
    away = np.array([1000.0, 0.0, 0.0])
    moved = tuple(nodes + away for nodes in start.positions)
    return dataclasses.replace(start, positions=moved, body_position=start.body_position + away)


STARTS = {
    "hairpin": _hairpin,
    "crossed": _near(0.0),
    "overlap 1e-3 sigma": _near(4e-5),
    "overlap 0.1 sigma": _near(4e-3),
    "overlap 0.9 sigma": _near(3.6e-2),
    "zero-length segment": _zero_segment,
    "1 mm off": _far,
}
ROWS = _rows()
FORMS = [
    (stepper, precision, mode, held)
    for stepper in ("implicit", "rkc")
    for precision in ("float64", "float32")
    for mode in ("all", "consistent")
    for held in (False, True)
]
COUNT = len(ROWS) * len(FORMS)


def extreme(index: int, folder: Path) -> Found:
    """One row in one form, against the other stepper at a thirtieth of the accuracy."""
    row, (stepper, precision, mode, held) = list(ROWS)[index % len(ROWS)], FORMS[index // len(ROWS)]
    values, duration = ROWS[row]
    form = f"{row}: {stepper}, {precision}, {mode}, {'held' if held else 'free'}"
    own = {
        "numerics.stepper": stepper,
        "numerics.precision": precision,
        "hydrodynamics.mode": mode,
        "body.anchored": held,
        "duration": duration,
        "frames": 1,
    }
    phases = (FlagellumOverride(phase=180.0), FlagellumOverride(phase=280.0))
    numbers = {"row": row, "form": [stepper, precision, mode, held], "ms": duration * 1e3}
    try:
        scene = with_values(Scene(name="extreme", flagellum=phases), {**values, **own})
        start = STARTS[row](scene, initial_state(scene)) if row in STARTS else None
        fixed = {"numerics.time_step": None} if scene.numerics.time_step else {}
        one = against_finer(scene, start, "implicit" if stepper == "rkc" else "rkc", CUT_OFF, fixed)
    except SceneError as error:
        return found("refused", f"{form}: {error}", **numbers)
    except Exception as error:
        return found("traceback", f"{form}: {type(error).__name__}: {error}", **numbers)
    return found(one.outcome, f"{form}: {one.note}", **numbers, **one.numbers)
