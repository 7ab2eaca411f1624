"""Short runs for the tests of the driver, and what they have recorded."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import numpy as np

from warpflag.record import Record
from warpflag.run import run
from warpflag.scene import Scene, with_values


def small(values=None) -> Scene:
    """Two short flagella, eight frames."""
    return with_values(Scene(name="small"), {"duration": 8e-5, "frames": 8, "flagella.length": 2.0, **(values or {})})


def executed(scene: Scene, directory: Path) -> Path:
    outcome = run.start(scene, str(directory), "cpu").execute(quiet=True)
    assert outcome.status == "done", outcome.message
    return directory


def summary(directory: Path) -> dict:
    return json.loads((directory / "summary.json").read_text())


def ended_at(started: run.Run, frame: int, number: int = signal.SIGINT) -> run.Outcome:
    """How a run ends that gets a signal once it has advanced to a frame, which is not recorded yet."""
    scene = started.simulation.scenes[0]

    def watch(reached: float) -> None:
        if reached > scene.duration * (frame - 0.5) / scene.frames:
            signal.raise_signal(number)

    return started.execute_all(quiet=True, watch=watch)[0]


def arrays(directory: Path) -> dict[str, np.ndarray]:
    """Everything that is recorded of the frames."""
    with Record(directory) as record:
        names = ("times", "steps", "positions", "directors", "motor_angle", "body_position", "body_orientation")
        return {name: np.asarray(getattr(record, name)) for name in names} | record.observables


def assert_same_frames(a: Path, b: Path) -> None:
    """To the last bit."""
    first, second = arrays(a), arrays(b)
    assert first.keys() == second.keys()
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name], err_msg=name)
