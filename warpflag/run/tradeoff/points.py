"""One point: a window run in one way, what it cost, and what came out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warpflag.base.output import whole
from warpflag.observables.arrays import Array
from warpflag.run.faults import NumericalError
from warpflag.run.simulation import Simulation
from warpflag.run.tradeoff.choices import Choice
from warpflag.run.tradeoff.windows import Course, Window, arrays_of, on_mesh
from warpflag.scene import Scene, with_values

__all__ = ["MEASURES", "Point", "load", "measured", "save"]

MEASURES = ("theta", "l_r", "f_c", "motor_rate", "body_rate", "speed")
"""What is compared beside node positions: means over the second half of a window."""
_OF_FRAMES = ("phase_difference", "bundle_length", "steric_force_density", "motor_rate", "body_rate", "body_speed")
_WINDOW_FRAMES = 40  # of a window: means over its second half have twenty
_SHORT_RUN = 0.5  # s of computing: below, the cost is the least of two runs


@dataclass(frozen=True)
class Point:
    """What one run of a window gave.

    Attributes:
        window: its name.
        choice: its name.
        source: as in `Choice`.
        status: "done", or why it was stopped.
        cost: computing per simulated time [ms/ms].
        steps: taken.
        measures: `MEASURES` by name; NaN where there is none.
        settings: values of [numerics] by key.
        positions: nodes at the frames of the window [um], shape [frame, node, 3].
    """

    window: str
    choice: str
    source: str
    status: str
    cost: float
    steps: int
    measures: dict[str, float]
    settings: dict[str, Any]
    positions: Array = field(repr=False)


def measured(
    scene: Scene, course: Course, window: Window, choice: Choice, device: str | None, watch: Callable[[], None]
) -> Point:
    """Runs a window in one way.

    Args:
        scene: of the user.
        course: that the window belongs to.
        window: to be run.
        choice: how.
        device: of choices that name none.
        watch: as in `Simulation.advance`.

    Raises:
        SceneError: the scene can't be run in this way from this shape.
    """
    until = window.shape.time + course.length
    frames_until = round(_WINDOW_FRAMES * until / course.length)
    own = with_values(choice.scene(scene), {"duration": until, "frames": frames_until, "start.record": None})
    start = on_mesh(window.shape, own)
    cost = np.inf
    while True:
        simulation = Simulation(own, device=choice.device or device, starts=start, strict=choice.strict)
        simulation.prepare(recording=True)
        frames, status = [], "done"
        began = time.process_time()
        try:
            frames += simulation.frames(until, watch)
        except NumericalError as error:
            status = f"stopped: {error.kind.name.lower()}"
        taken = time.process_time() - began
        repeated = np.isfinite(cost)
        cost = min(cost, taken)
        if repeated or taken > _SHORT_RUN or status != "done":
            break
    half = frames[len(frames) // 2 :]
    measures = {
        name: float(np.mean([np.mean(frame.observables.get(key, np.nan)) for frame in half])) if half else float("nan")
        for name, key in zip(MEASURES, _OF_FRAMES, strict=True)
    }
    settings = {key.partition(".")[2]: x for key, x in choice.values.items() if key.startswith("numerics.")}
    cost = cost / course.length if status == "done" else float("nan")
    positions = np.array([frame.positions for frame in frames])
    steps = int(simulation.steps[0])
    return Point(window.name, choice.name, choice.source, status, cost, steps, measures, settings, positions)


def save(point: Point, path: Path) -> None:
    """Writes a point into a file, whole or not at all."""
    said = {name: value for name, value in asdict(point).items() if name != "positions"}
    with whole(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, said=np.array(json.dumps(said)), positions=point.positions)


def load(path: Path) -> Point | None:
    """What `save` wrote; None where the file is damaged."""
    try:
        kept = arrays_of(path)
        return Point(**json.loads(str(kept["said"])), positions=kept["positions"])
    except (KeyError, TypeError, ValueError):
        return None
