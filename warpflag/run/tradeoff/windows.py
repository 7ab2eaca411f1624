"""Windows of a scene's own course, and its shape there on other meshes."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpflag.base import rotations
from warpflag.base.output import whole
from warpflag.model.geometry import InitialState
from warpflag.model.start import shape_of_frame
from warpflag.observables import ZIPPED
from warpflag.observables.arrays import Array, unit
from warpflag.record import Frame, Record
from warpflag.record.layout import one_line
from warpflag.run.run_directory import RunError, settings_of
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, SceneError, attachment, loads, with_values

__all__ = ["Course", "Window", "arrays_of", "found_by_run", "found_in_record", "load", "on_mesh", "save"]

_AFTER_START = 2e-5  # s after the motors start: the wound-up filaments, not the switching on
_BEFORE_ZIP = 0.3  # of a window's length before the first zip
# How the coarse run is stepped: at a fifth of the default's accuracy, which places a window well enough.
_COARSE = {"numerics.accuracy": 2e-2, "numerics.time_step": None, "numerics.stepper": "implicit"}
_LENGTH = 1e-3  # s, what an accuracy refers to
_COURSE_FRAMES = 400  # of the coarse run: a window's beginning is found to a part in four hundred
_NOT_OF_THE_COURSE = ("name", "duration", "frames", "behaviour", "format")  # in which a record's scene may differ
_NOR_SECTIONS = ("numerics.", "start.")
_ROUNDING = 1e-6  # of the duration: times this close are the same


@dataclass(frozen=True)
class Window:
    """A stretch of the course.

    Attributes:
        name: start, contact, zip or late.
        time: when it begins in the course [s].
        shape: of the cell then, with the forms of its joints; its time is 0, or, where motors switch, that of the
            window, so that they stand as they do in the course.
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
        cut: why the course ends before the scene does; empty where it doesn't.
    """

    windows: list[Window]
    length: float
    until: float
    rates: dict[str, tuple[float, float]]
    span: float
    cut: str = ""


def found_by_run(scene: Scene, device: str | None, late: Callable[[], bool], told: Callable[[float], None]) -> Course:
    """The course by a coarse run, as far as time allows.

    Args:
        scene: of the user.
        device: to run on.
        late: whether the time for it is over.
        told: is told the share of the course that is known.

    Raises:
        NumericalError: a guard is violated before the second frame, a four hundredth of the scene.
        SceneError: the scene can't be simulated.
    """
    coarse = with_values(scene, {**_COARSE, "frames": _COURSE_FRAMES})
    simulation = Simulation(coarse, device=device)
    frames: list[Frame] = []
    cut = ""
    for block in simulation.frame_blocks():
        frames += [rows.frame(k) for found in block for rows in found.values() for k in range(len(rows))]
        told(len(frames) / (_COURSE_FRAMES + 1))
        if late() and len(frames) <= _COURSE_FRAMES and simulation.times[0] > 0.0:
            cut = "its share of the budget was over"
            break
    if stopped := list(simulation.faults.values()):
        if len(frames) < 2:
            raise stopped[0]
        cut = str(stopped[0])
    elif len(frames) < 2:  # as far as it came, in as many frames
        shorter = with_values(scene, {"duration": float(simulation.times[0])})
        return replace(found_by_run(shorter, device, lambda: False, told), cut=cut)
    return _course(scene, frames, simulation.first_node, cut)


def found_in_record(scene: Scene, record: Record) -> Course:
    """The course from the frames of a record of the same cell.

    Raises:
        RunError: the record is of another cell, or has a single frame.
    """
    try:
        own, there = settings_of(scene), settings_of(loads(record.scene_text))
    except SceneError as error:
        raise RunError(f"--record {record.path}: its scene can't be read: {error}") from None
    for key in dict.fromkeys([*own, *there]):
        if key in _NOT_OF_THE_COURSE or key.startswith(_NOR_SECTIONS) or own.get(key) == there.get(key):
            continue
        problem = f"{key} = {own.get(key, 'none')}, recorded with {there.get(key, 'none')}"
        raise RunError(f"--record {record.path}: is of another scene: {problem}")
    if record.frame_count < 2:
        raise RunError(f"--record {record.path}: has {record.frame_count} frame; a course takes two or more")
    frames = [record.frame(k) for k in range(record.frame_count)]
    return _course(scene, frames, record.first_node, "the record ends there")


def _course(scene: Scene, frames: list[Frame], first_node: np.ndarray, cut: str) -> Course:
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
        begun = float(frame.time) if scene.motor.switching != "none" else 0.0
        windows.append(Window(name, float(frame.time), replace(shape_of_frame(frame, first_node), time=begun)))
    # Rates are differences between frames, which the first has not; a filament without a body has no motor.
    names = ("body_speed", "body_rate", "motor_rate") if scene.body.enabled else ("body_speed",)
    rates, span = _spread(frames[1:], names)
    whole_course = times[-1] >= (1.0 - _ROUNDING) * scene.duration
    return Course(windows, float(length), float(times[-1]), rates, span, "" if whole_course else cut)


def _spread(frames: list[Frame], names: tuple[str, ...]) -> tuple[dict[str, tuple[float, float]], float]:
    """Mean rates over the last third, and how much they differ between eight parts of it."""
    last = frames[-max(len(frames) // 3, 2) :]
    count = max(1, len(last) // 8)
    parts = [last[k : k + count] for k in range(0, len(last) - count + 1, count)]
    found = {}
    for name in names:
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
        arrays[f"{k}.time"] = np.array(shape.time)
        if shape.forms is not None:
            arrays[f"{k}.forms"] = shape.forms
    said = {
        "windows": [(window.name, window.time) for window in course.windows],
        "length": course.length,
        "until": course.until,
        "rates": course.rates,
        "span": course.span,
        "cut": course.cut,
    }
    with whole(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, said=np.array(json.dumps(said)), **arrays)  # pyright: ignore[reportArgumentType]


def arrays_of(path: Path) -> dict[str, Any]:
    """What a file of arrays holds, by name.

    Raises:
        ValueError: the file is damaged.
    """
    content = path.read_bytes()
    try:
        with np.load(io.BytesIO(content)) as kept:
            return dict(kept)
    except Exception as error:  # whatever zip, compression and headers of NumPy make of other bytes
        raise ValueError(one_line(error) or "it holds nothing") from None


def load(path: Path) -> Course:
    """What `save` wrote.

    Raises:
        RunError: the file is damaged.
    """
    try:
        return _loaded(arrays_of(path))
    except (KeyError, TypeError, ValueError) as error:
        problem = f"can't be read: {one_line(error)}; remove {path.parent}, or name another -o"
        raise RunError(f"{path}: {problem}") from None


def _loaded(kept: Mapping[str, Any]) -> Course:
    said = json.loads(str(kept["said"]))
    windows = []
    for k, (name, time) in enumerate(said["windows"]):
        ends = np.cumsum(kept[f"{k}.counts"])[:-1]
        body = kept[f"{k}.body"]
        positions, directors = (tuple(np.split(kept[f"{k}.{x}"], ends)) for x in ("positions", "directors"))
        begun = float(kept.get(f"{k}.time", 0.0))
        shape = InitialState(positions, directors, body[:3], body[3:], begun, forms=kept.get(f"{k}.forms"))
        windows.append(Window(name, time, shape))
    rates = {name: (mean, spread) for name, (mean, spread) in said["rates"].items()}
    return Course(windows, said["length"], said["until"], rates, said["span"], said.get("cut", ""))


def on_mesh(shape: InitialState, scene: Scene) -> InitialState:
    """A shape with the segments and anchors of another scene of the same contours; it relaxes within microseconds.

    On other segments, tangents and directors are interpolated between their middles, and segments of rest length are
    chained from the anchor; a joint has the form of the nearest one.
    """
    to_lab = rotations.matrix(shape.body_orientation)
    positions, directors, forms = [], [], []
    ends = np.cumsum([len(nodes) for nodes in shape.positions])[:-1]
    given = np.split(np.zeros(0) if shape.forms is None else shape.forms, ends)
    for spec, nodes, e1, own in zip(scene.resolved_flagella(), shape.positions, shape.directors, given, strict=True):
        anchor = shape.body_position + to_lab @ np.array(attachment.anchor(scene, spec))
        count = spec.segment_count
        if shape.forms is not None:
            forms.append(_on_joints(own, count))
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
    carried = None if shape.forms is None else np.concatenate(forms)
    return replace(shape, positions=tuple(positions), directors=tuple(directors), forms=carried)


def _on_joints(forms: np.ndarray, count: int) -> np.ndarray:
    """Forms at the nodes of a filament of `count` segments, of which the ends have none."""
    found, old = np.zeros(count + 1, forms.dtype), len(forms) - 1
    nearest = np.rint(np.arange(1, count) * old / count).astype(int)
    found[1:-1] = forms[np.clip(nearest, 1, max(old - 1, 1))]
    return found


def _between(at: Array, values: Array, wanted: Array) -> Array:
    """Vectors interpolated linearly, and beyond the ends as at the ends."""
    return np.stack([np.interp(wanted, at, values[:, k]) for k in range(3)], axis=1)
