"""Frames whose numbers tell which they are, and records made of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpflag.record import Frame, Record
from warpflag.record.recorder import Recorder

FIRST_NODE = np.array([0, 4, 9])  # two flagella, of 3 and 4 segments
SCENE = 'name = "two"  # \u03a6 = 90\n'
ENTRIES = [
    "particles/flagella/position",
    "particles/flagella/e1",
    "cell/motor_angle",
    "cell/body_position",
    "cell/body_orientation",
    "observables/bundle_length",
    "observables/motor_rate",
]


def frame(index: int) -> Frame:
    """A frame whose every number tells the frame it belongs to."""
    nodes = np.arange(27.0).reshape(9, 3)
    return Frame(
        time=index * 1e-4,
        step=10 * index,
        positions=index + nodes / 100,
        directors=-index - nodes / 100,
        motor_angle=np.array([index, -index], float),
        body_position=np.array([index, 0.0, -index]) / 7,
        body_orientation=np.array([0.0, 0.0, np.sin(index), np.cos(index)]),
        observables={"bundle_length": index / 3, "motor_rate": np.array([index, 2.0 * index])},
    )


def started(path: Path, **options) -> Recorder:
    recorder = Recorder(path, **options)
    recorder.start(
        SCENE, FIRST_NODE, filament_radius=0.01, body_length=2.5, body_width=0.8, versions={"warpflag": "1.2.3"}
    )
    return recorder


def written(path: Path, count: int) -> Path:
    recorder = started(path)
    for index in range(count):
        recorder.write(frame(index))
    recorder.close()
    return path


def assert_holds_frames(record: Record, indices) -> None:
    """Every dataset of the record holds exactly these frames, to the last bit."""
    expected = [frame(index) for index in indices]
    assert record.frame_count == len(expected)
    np.testing.assert_array_equal(record.times, [f.time for f in expected])
    np.testing.assert_array_equal(record.steps, [f.step for f in expected])
    for name in ("positions", "directors", "motor_angle", "body_position", "body_orientation"):
        np.testing.assert_array_equal(np.asarray(getattr(record, name)), [getattr(f, name) for f in expected])
    assert set(record.observables) == {"bundle_length", "motor_rate"}
    for name, values in record.observables.items():
        np.testing.assert_array_equal(values, [f.observables[name] for f in expected])
