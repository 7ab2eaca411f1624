"""Windows of a scene's own course, and its shape there on other meshes."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpflag.base import rotations
from warpflag.base.output import whole
from warpflag.model.geometry import InitialState
from warpflag.observables import ZIPPED
from warpflag.observables.arrays import Array, unit
from warpflag.record import Frame, Record
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, attachment, with_values

__all__ = ["Course", "Window", "found_by_run", "found_in_record", "load", "on_mesh", "save"]

_AFTER_START = 2e-5  # s after the motors start: the wound-up filaments, not the switching on
_BEFORE_ZIP = 0.3  # of a window's length before the first zip
# How the coarse run is stepped: at a fifth of the default's accuracy, which places a window well enough.
_COARSE = {"numerics.accuracy": 2e-2, "numerics.time_step": None, "numerics.stepper": "implicit"}
_LENGTH = 1e-3  # s, what an accuracy refers to
_COURSE_FRAMES = 400  # of the coarse run: a window's beginning is found to a part in four hundred


@dataclass(frozen=True)
class Window:
    """A stretch of the course.

    Attributes:
        name: start, contact, zip or late.
        time: when it begins in the course [s].
        shape: of the cell then, its time 0.
    """

    name: str
    time: float
    shape: InitialState


@dataclass(frozen=True)
class Course:
    """What was found of a scene's course.

    Attributes:
        windows: in the order of time.
        length: of each window [s].
        until: how far the course was followed [s].
        rates: over the frames of its last third, by name: mean, and standard deviation of the means over spans of
            `span` seconds.
        span: [s].
    """

    windows: list[Window]
    length: float
    until: float
    rates: dict[str, tuple[float, float]]
    span: float


def found_by_run(scene: Scene, device: str | None, late: Callable[[], bool], told: Callable[[float], None]) -> Course:
    """The course by a coarse run, as far as time allows.

    Args:
        scene: of the user.
        device: to run on.
        late: whether the time for it is over.
        told: is told the share of the course that is known.

    Raises:
        NumericalError: a guard is violated before any frame.
        SceneError: the scene can't be simulated.
    """
    coarse = with_values(scene, {**_COARSE, "frames": _COURSE_FRAMES})
    simulation = Simulation(coarse, device=device)
    frames: list[Frame] = []
    for block in simulation.frame_blocks():
        frames += [rows.frame(k) for found in block for rows in found.values() for k in range(len(rows))]
        told(len(frames) / (_COURSE_FRAMES + 1))
        if late() and len(frames) > 1:
            break
    return _course(scene, frames, simulation.first_node)


def found_in_record(scene: Scene, record: Record) -> Course:
    """The course from the frames of a record of the same cell."""
    return _course(scene, [record.frame(k) for k in range(record.frame_count)], record.first_node)


def _course(scene: Scene, frames: list[Frame], first_node: np.ndarray) -> Course:
    times = np.array([frame.time for frame in frames])
    length = min(_LENGTH, times[-1] / 4)
    touching = np.array([frame.observables["steric_force_density"] > 0 for frame in frames])
    zipped = np.array([frame.observables["bundle_length"] >= ZIPPED for frame in frames])
    wanted = {"start": min(_AFTER_START, length), "late": times[-1] - length}
    if touching.any():
        wanted["contact"] = max(times[touching.argmax()] - length / 2, wanted["start"])
    if zipped.any():
        wanted["zip"] = times[zipped.argmax()] - _BEFORE_ZIP * length
    windows: list[Window] = []
    for name in sorted(wanted, key=wanted.__getitem__):
        k = int(np.searchsorted(times, wanted[name]))
        if (windows and times[k] < windows[-1].time + length / 2) or (name != "start" and k == 0):
            continue
        frame = frames[max(k, 1) if name == "start" else k]
        shape = InitialState(
            tuple(np.split(frame.positions, first_node[1:-1])),
            tuple(np.split(frame.directors, first_node[1:-1])),
            frame.body_position,
            frame.body_orientation,
        )
        windows.append(Window(name, float(frame.time), shape))
    rates, span = _spread(frames)
    return Course(windows, float(length), float(times[-1]), rates, span)


def _spread(frames: list[Frame]) -> tuple[dict[str, tuple[float, float]], float]:
    """Mean rates over the last third, and how much they differ between eight parts of it."""
    last = frames[-max(len(frames) // 3, 2) :]
    count = max(1, len(last) // 8)
    parts = [last[k : k + count] for k in range(0, len(last) - count + 1, count)]
    found = {}
    for name in ("body_speed", "body_rate", "motor_rate"):
        means = [np.mean([np.mean(frame.observables[name]) for frame in part]) for part in parts]
        found[name] = (float(np.mean(means)), float(np.std(means, ddof=1)) if len(means) > 1 else float("nan"))
    return found, float(count * (last[-1].time - last[0].time) / max(len(last) - 1, 1))


def save(course: Course, path: Path) -> None:
    """Writes a course into a file, whole or not at all."""
    arrays = {}
    for k, window in enumerate(course.windows):
        shape = window.shape
        arrays[f"{k}.counts"] = np.array([len(x) for x in shape.positions])
        arrays[f"{k}.positions"] = np.concatenate(shape.positions)
        arrays[f"{k}.directors"] = np.concatenate(shape.directors)
        arrays[f"{k}.body"] = np.concatenate([shape.body_position, shape.body_orientation])
    said = {
        "windows": [(window.name, window.time) for window in course.windows],
        "length": course.length,
        "until": course.until,
        "rates": course.rates,
        "span": course.span,
    }
    with whole(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, said=np.array(json.dumps(said)), **arrays)  # pyright: ignore[reportArgumentType]


def load(path: Path) -> Course:
    """What `save` wrote."""
    with np.load(path) as kept:
        said = json.loads(str(kept["said"]))
        windows = []
        for k, (name, time) in enumerate(said["windows"]):
            ends = np.cumsum(kept[f"{k}.counts"])[:-1]
            body = kept[f"{k}.body"]
            positions, directors = (tuple(np.split(kept[f"{k}.{x}"], ends)) for x in ("positions", "directors"))
            windows.append(Window(name, time, InitialState(positions, directors, body[:3], body[3:])))
    rates = {name: (mean, spread) for name, (mean, spread) in said["rates"].items()}
    return Course(windows, said["length"], said["until"], rates, said["span"])


def on_mesh(shape: InitialState, scene: Scene) -> InitialState:
    """A shape with the segments and anchors of another scene of the same contours; it relaxes within microseconds.

    On other segments, tangents and directors are interpolated between their middles, and segments of rest length are
    chained from the anchor.
    """
    to_lab = rotations.matrix(shape.body_orientation)
    positions, directors = [], []
    for spec, nodes, e1 in zip(scene.resolved_flagella(), shape.positions, shape.directors, strict=True):
        anchor = shape.body_position + to_lab @ np.array(attachment.anchor(scene, spec))
        count = spec.segment_count
        if count == len(nodes) - 1:
            positions.append(nodes + (anchor - nodes[0]))
            directors.append(e1)
            continue
        old, new = (np.arange(n) + 0.5 for n in (len(nodes) - 1, count))
        at = new / count * len(old)
        t = unit(_between(old, unit(np.diff(nodes, axis=0)), at))
        a = _between(old, e1[1:], at)
        a = unit(a - np.vecdot(a, t)[:, None] * t)
        positions.append(anchor + np.vstack([np.zeros(3), np.cumsum(spec.segment_length * t, axis=0)]))
        directors.append(np.vstack([e1[:1], a]))
    return InitialState(tuple(positions), tuple(directors), shape.body_position, shape.body_orientation)


def _between(at: Array, values: Array, wanted: Array) -> Array:
    """Vectors interpolated linearly, and beyond the ends as at the ends."""
    return np.stack([np.interp(wanted, at, values[:, k]) for k in range(3)], axis=1)
