"""Short runs for the tests of the driver, and what they have recorded."""

from __future__ import annotations

import contextlib
import json
import signal
from pathlib import Path

import numpy as np
import pytest
from warpflag_kernels.stepping import frame_slots

from warpflag.record import Record
from warpflag.run import run
from warpflag.scene import Scene, paper_scene, with_values


def small(values=None) -> Scene:
    """Two short flagella, eight frames."""
    return with_values(
        paper_scene(name="small"), {"duration": 8e-5, "frames": 8, "flagella.length": 2.0, **(values or {})}
    )


def executed(scene: Scene, directory: Path) -> Path:
    outcome = run.start(scene, str(directory), "cpu").execute(quiet=True)
    assert outcome.status == "done", outcome.message
    return directory


def summary(directory: Path) -> dict:
    return json.loads((directory / "summary.json").read_text())


@contextlib.contextmanager
def frame_by_frame():
    """Simulations made within hand over every frame by itself, and not in blocks."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frame_slots, "MOST_SLOTS", 1)
        yield


def ended_at(started: run.Run, frames: int, number: int = signal.SIGINT) -> run.Outcome:
    """How a run ends that gets a signal once it has recorded so many frames."""
    recorder = started.members[0].recorder

    def watch(_reached: float) -> None:
        if recorder.frame_count >= frames:
            signal.raise_signal(number)

    with frame_by_frame():
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
