"""Records made without a simulation, for the tests of what is made of a record."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tests.helpers import rotation
from warpflag.model.geometry import initial_state
from warpflag.record import Frame, Record
from warpflag.record.recorder import Recorder
from warpflag.scene import Scene, dumps, paper_scene, with_values

FRAME_INTERVAL = 5e-5
THREE = with_values(
    paper_scene(name="three"),
    {
        "flagella.count": 3,
        "flagella.opening_angle": 50.0,
        "flagellum.0.length": 6.0,
        "flagellum.1.length": 4.0,
        "flagellum.2.length": 6.0,
    },
)
FIRST_NODE = [0, 31, 52, 83]


def quaternion(vector: Any) -> np.ndarray:
    """(x, y, z, w) of the rotation by |vector| about it."""
    angle = float(np.linalg.norm(vector))
    return np.array([*(np.sin(angle / 2) / (angle or 1.0) * np.asarray(vector)), np.cos(angle / 2)])


def motor_axes(scene: Scene) -> np.ndarray:
    """m in body axes, shape [flagellum_count, 3]."""
    angles = [np.radians([spec.motor_axis_angle, spec.azimuth]) for spec in scene.resolved_flagella()]
    return np.array([(np.sin(a) * np.cos(b), np.sin(a) * np.sin(b), np.cos(a)) for a, b in angles])


def made_record(
    directory: Path, frame_count: int = 12, *, scene: Scene = THREE, offset: Any = (0.0, 0.0, 0.0), speed: float = 0.2
) -> Record:
    """The cell of a scene, stiff, that swims along -z, spins and wobbles; its motors turn, the first from 0.4 rad on.

    speed: [um per frame].
    """
    directory.mkdir(exist_ok=True)
    start = initial_state(scene)
    nodes, e1 = np.concatenate(start.positions), np.concatenate(start.directors)
    first_node = np.cumsum([0, *map(len, start.positions)])
    recorder = Recorder(directory / "run.h5")
    recorder.start(
        dumps(scene),
        first_node,
        filament_radius=scene.flagella.filament_radius,
        body_length=scene.body.length,
        body_width=scene.body.width,
        versions={"warpflag": "9.8"},
    )
    for i in range(frame_count):
        turn = rotation([0.0, 0.05 * np.sin(i), 0.0]) @ rotation([0.0, 0.0, -0.3 * i])
        centre = np.array([0.1 * np.sin(0.4 * i), 0.0, -speed * i]) + offset
        motor_angle = 0.4 + 0.9 * i * np.arange(1, len(first_node))
        directors = e1.copy()
        for k, (axis, angle) in enumerate(zip(motor_axes(scene), motor_angle, strict=True)):
            directors[first_node[k]] = rotation(angle * axis) @ e1[first_node[k]]
        recorder.write(
            Frame(
                time=i * FRAME_INTERVAL,
                step=7 * i,
                positions=nodes @ turn.T + centre,
                directors=directors @ turn.T,
                motor_angle=motor_angle,
                body_position=centre,
                body_orientation=_quaternion_of(turn),
                observables={
                    "bundle_length": 0.1 * i,
                    "motor_rate": np.full(len(motor_angle), np.nan if i == 0 else i),
                },
                forms=made_forms(first_node, i),
            )
        )
    recorder.close()
    return Record(directory)


def made_forms(first_node: np.ndarray, frame: int) -> np.ndarray:
    """A front that runs from the root of every flagellum, two joints a frame."""
    forms = np.concatenate([np.arange(count) <= 2 * frame for count in np.diff(first_node)]).astype(int)
    forms[[*first_node[:-1], *(first_node[1:] - 1)]] = 0
    return forms


def _quaternion_of(turn: np.ndarray) -> np.ndarray:
    """(x, y, z, w) of a rotation matrix that turns by less than half a turn."""
    w = 0.5 * np.sqrt(max(1.0 + np.trace(turn), 0.0))
    if w > 1e-3:
        cross = turn - turn.T
        return np.array([cross[2, 1], cross[0, 2], cross[1, 0], 4 * w * w]) / (4 * w)
    values, vectors = np.linalg.eigh(turn + turn.T)
    axis = vectors[:, values.argmax()]
    return np.array([*axis, 0.0])
