"""Layout of the record of a run, run.h5 (H5MD 1.1), and one frame of it.

Units um, pN, s, rad. Every entry but the parameters and checksums is a group of value, step and time, frames first:

    /particles/flagella/position   [frame, node, 3]: lab axes [um], flagellum after flagellum, r_0 to r_N each
    /particles/flagella/e1         [frame, node, 3]: director e1 of motor tripod and segments, same order
    /particles/flagella/form       [frame, node]: form of the joint at a node, 0: ground state; only with polymorphs
    /cell/motor_angle              [frame, flagellum]: tripod about m relative to the body, accumulated [rad]
    /cell/body_position            [frame, 3]: centre of the body [um]
    /cell/body_orientation         [frame, 4]: quaternion (x, y, z, w) from body to lab axes
    /observables/NAME              [frame] or [frame, flagellum]
    /checksums                     [frame, entry]: CRC-32 of each frame's values; attribute entries: which, in order
    /parameters/scene, scene_sha256                          the scene text and its hash
    /parameters/first_node                                   [flagellum_count + 1]: flagellum k has the nodes
                                                             first_node[k] to first_node[k + 1] - 1
    /parameters/filament_radius, body_length, body_width     [um]
    /parameters/versions                                     attributes by name
    /parameters                                              attribute checksum: CRC-32 of all of the above

/cell and /parameters stay out of /particles, where readers of H5MD expect one group with per-node entries.
All entries share one step and one time dataset (hard links); time is a dimension scale of HDF5, attached to all others.
`step` is written last: its length is the number of committed frames, and everything else is cut to it.

Checksums are kept by frame rather than by HDF5's filter by chunk, because a chunk is written again with every block of
frames that goes into it: a process killed in the middle would leave frames that were good before with a wrong checksum.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "BODY_ORIENTATION",
    "BODY_POSITION",
    "CHECKSUMS",
    "E1",
    "ENTRIES",
    "FORM",
    "MOTOR_ANGLE",
    "PARAMETERS",
    "POSITION",
    "RECORD_NAME",
    "UNITS",
    "Frame",
    "FrameRows",
    "RecordError",
    "checksums",
    "dataset_path",
    "one_line",
    "parameters_checksum",
    "summed_entries",
    "text_of",
]

RECORD_NAME = "run.h5"
POSITION = "particles/flagella/position"
E1 = "particles/flagella/e1"
FORM = "particles/flagella/form"
MOTOR_ANGLE = "cell/motor_angle"
BODY_POSITION = "cell/body_position"
BODY_ORIENTATION = "cell/body_orientation"
ENTRIES = (POSITION, E1, MOTOR_ANGLE, BODY_POSITION, BODY_ORIENTATION)
CHECKSUMS = "checksums"
PARAMETERS = ("scene", "scene_sha256", "first_node", "filament_radius", "body_length", "body_width")

UNITS = {
    "time": "s",
    POSITION: "um",
    MOTOR_ANGLE: "rad",
    BODY_POSITION: "um",
    "observables/steric_force_density": "pN um-1",
    "observables/elastic_energy": "pN um",
    "observables/body_speed": "um s-1",
    "observables/body_rate": "Hz",
    "observables/motor_rate": "Hz",
    "observables/motor_torque": "pN um",
}
"""Units by entry, as H5MD writes them; what is not here is a pure number. They are in the file as the attribute `units`
of the values, which xarray and others show, and as `unit`, which H5MD asks for: of all but the positions, since
MDAnalysis refuses a file whose positions have a unit that it doesn't know, such as um."""


class RecordError(ValueError):
    """A record that can't be read or continued; the message is one line that names the file."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a run, in lab coordinates.

    Attributes:
        time: simulated time [s].
        step: number of steps taken when the frame was made.
        positions: nodes [um], shape [node_count, 3], flagellum after flagellum.
        directors: e1 of tripod and segments, shape [node_count, 3].
        motor_angle: of each tripod about its axis m relative to the body, accumulated [rad], shape [flagellum_count].
        body_position: centre of the body [um], shape [3].
        body_orientation: quaternion (x, y, z, w) from body to lab axes, shape [4].
        observables: by name, a number or an array of shape [flagellum_count] each.
        forms: of the joints at the nodes, 0: the ground state, 1: the target, 2: the second form; 0 at the ends, which
            have none; shape [node_count]. None without polymorphs.
    """

    time: float
    step: int
    positions: NDArray[np.floating]
    directors: NDArray[np.floating]
    motor_angle: NDArray[np.floating]
    body_position: NDArray[np.floating]
    body_orientation: NDArray[np.floating]
    observables: dict[str, float | NDArray[np.floating]] = field(default_factory=dict)
    forms: NDArray[np.integer] | None = None


@dataclass(frozen=True, eq=False)
class FrameRows:
    """Frames of one cell that follow each other: arrays of the numbers that a `Frame` has, frames first.

    Attributes:
        time, step: of each frame, shape [frame].
        positions, directors, motor_angle, body_position, body_orientation, forms: as in `Frame`, shape [frame, ...].
        observables: by name, shape [frame] or [frame, flagellum_count].
    """

    time: NDArray[np.floating]
    step: NDArray[np.integer]
    positions: NDArray[np.floating]
    directors: NDArray[np.floating]
    motor_angle: NDArray[np.floating]
    body_position: NDArray[np.floating]
    body_orientation: NDArray[np.floating]
    observables: dict[str, NDArray[np.floating]]
    forms: NDArray[np.integer] | None = None

    @classmethod
    def of(cls, frame: Frame) -> FrameRows:
        """A frame alone."""
        return cls(
            time=np.array([frame.time]),
            step=np.array([frame.step]),
            positions=np.asarray(frame.positions)[None],
            directors=np.asarray(frame.directors)[None],
            motor_angle=np.asarray(frame.motor_angle)[None],
            body_position=np.asarray(frame.body_position)[None],
            body_orientation=np.asarray(frame.body_orientation)[None],
            observables={name: np.asarray(value)[None] for name, value in frame.observables.items()},
            forms=None if frame.forms is None else np.asarray(frame.forms)[None],
        )

    def __len__(self) -> int:
        return len(self.time)

    def frame(self, row: int) -> Frame:
        """One of them; its arrays are views."""
        return Frame(
            time=float(self.time[row]),
            step=int(self.step[row]),
            positions=self.positions[row],
            directors=self.directors[row],
            motor_angle=self.motor_angle[row],
            body_position=self.body_position[row],
            body_orientation=self.body_orientation[row],
            observables={name: values[row] for name, values in self.observables.items()},
            forms=None if self.forms is None else self.forms[row],
        )


def dataset_path(name: str) -> str:
    """Where the values of an entry lie; step and time are the datasets that all entries share."""
    if name in ("step", "time"):
        return f"{POSITION}/{name}"
    return name if name == CHECKSUMS else f"{name}/value"


def checksums(frames: ArrayLike) -> NDArray[np.uint32]:
    """CRC-32 of each frame's values of one entry, taken of their bytes as little-endian 8-byte numbers.

    Args:
        frames: values of the entry, frames first.
    """
    frames = np.asarray(frames)
    kind = "<i8" if frames.dtype.kind in "iu" else "<f8"
    content = memoryview(np.ascontiguousarray(frames, dtype=kind).tobytes())
    size = len(content) // max(1, len(frames))
    return np.array([zlib.crc32(content[k * size : (k + 1) * size]) for k in range(len(frames))], dtype=np.uint32)


def parameters_checksum(parameters: Mapping[str, Any]) -> int:
    """CRC-32 of what /parameters holds; `parameters` has the keys PARAMETERS and versions."""
    plain = {name: np.asarray(parameters[name]).tolist() for name in PARAMETERS}
    plain["versions"] = {str(name): str(value) for name, value in parameters["versions"].items()}
    return zlib.crc32(json.dumps(plain, sort_keys=True).encode())


def summed_entries(checksums: Any) -> list[str]:
    """The entries whose checksums the columns of the dataset /checksums hold."""
    return [text_of(name) for name in checksums.attrs["entries"]]


def text_of(value: Any) -> str:
    """A text from HDF5, where it is bytes or, in attributes of variable length, a text already."""
    return value.decode() if isinstance(value, bytes) else str(value)


def one_line(error: BaseException) -> str:
    """The message of an error of HDF5 on one line of at most 300 characters."""
    line = " ".join(str(error).split())
    return line if len(line) <= 300 else line[:297] + "..."
