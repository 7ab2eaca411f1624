"""The record of a run, run.h5 (H5MD 1.1): its layout, its frames, and how to read it.

Units um, pN, s, rad. Every entry but the parameters is a group of value, step and time, frames first:

    /particles/flagella/position   [frame, node, 3]: lab axes [um], flagellum after flagellum, r_0..r_N each
    /particles/flagella/e1         [frame, node, 3]: director e1 of motor tripod and segments, same order
    /cell/motor_angle              [frame, flagellum]: tripod about m relative to the body, accumulated [rad]
    /cell/body_position            [frame, 3]: centre of the body [um]
    /cell/body_orientation         [frame, 4]: quaternion (x, y, z, w) from body to lab axes
    /observables/NAME              [frame] or [frame, flagellum]
    /parameters/scene, scene_sha256                          the scene text and its hash
    /parameters/first_node                                   [flagellum_count + 1]: flagellum k has the nodes
                                                             first_node[k] to first_node[k + 1] - 1
    /parameters/filament_radius, body_length, body_width     [um]
    /parameters/versions                                     attributes by name

/cell and /parameters stay out of /particles, where readers of H5MD expect one group with per-node entries.
All entries share one step and one time dataset (hard links). `step` is written last: its length is the number
of committed frames, and everything else is cut to it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.base.above import method_from

__all__ = ["ENTRIES", "RECORD_NAME", "Frame", "FrameArray", "Record", "RecordError"]

RECORD_NAME = "run.h5"
POSITION = "particles/flagella/position"
E1 = "particles/flagella/e1"
MOTOR_ANGLE = "cell/motor_angle"
BODY_POSITION = "cell/body_position"
BODY_ORIENTATION = "cell/body_orientation"
ENTRIES = (POSITION, E1, MOTOR_ANGLE, BODY_POSITION, BODY_ORIENTATION)


class RecordError(ValueError):
    """A record that can't be read, written or continued; the message is one line that names the file."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a run, in lab coordinates.

    time: [s]. step: number of steps taken when the frame was made. positions: nodes [um], shape [node_count,
    3], flagellum after flagellum. directors: e1 of tripod and segments, shape [node_count, 3]. motor_angle:
    of each tripod about its axis m relative to the body, accumulated [rad], shape [flagellum_count].
    body_position: [um], shape [3]. body_orientation: quaternion (x, y, z, w) from body to lab axes, shape
    [4]. observables: by name, a number or an array [flagellum_count] each.
    """

    time: float
    step: int
    positions: NDArray[np.floating]
    directors: NDArray[np.floating]
    motor_angle: NDArray[np.floating]
    body_position: NDArray[np.floating]
    body_orientation: NDArray[np.floating]
    observables: dict[str, float | NDArray[np.floating]] = field(default_factory=dict)


def dataset_path(name: str) -> str:
    """Where the values of an entry lie; "step" and "time" are the datasets that all entries share."""
    return f"{POSITION}/{name}" if name in ("step", "time") else f"{name}/value"


def one_line(error: Exception) -> str:
    """The message of an error of HDF5 on one line."""
    return " ".join(str(error).split())


class FrameArray:
    """Frames of one quantity, read as they are indexed: a[i], a[10:20, :3], or np.asarray(a) for all.

    shape: [frame_count, ...], the committed frames only.
    """

    def __init__(self, dataset: Any, frame_count: int, path: Path):
        self._dataset = dataset
        self._path = path
        self.shape: tuple[int, ...] = (frame_count, *dataset.shape[1:])

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> NDArray[np.float64]:
        first, *rest = key if isinstance(key, tuple) else (key,)
        if first is Ellipsis:
            first, rest = slice(None), [Ellipsis, *rest]
        rows = np.arange(len(self))[first]  # IndexError and negative steps as in any array
        if rows.size == 0:
            return np.empty(self.shape)[key]
        low = int(rows.min())
        try:
            block = self._dataset[low : int(rows.max()) + 1]
        except OSError as error:
            raise RecordError(f"{self._path}: frames can't be read: {one_line(error)}") from error
        return block[rows - low][(slice(None),) * rows.ndim + tuple(rest)]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[:], dtype=dtype)


class Record:
    """Reads run.h5, also while a run writes it or after one was killed: the frames committed by then.

    path: the file, or the run directory that holds it. It is opened at the first access and stays open until
    close() or the end of a `with` block. Raises RecordError where it is missing, damaged, or no record of
    this program.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if self.path.is_dir():
            self.path = self.path / RECORD_NAME
        if not self.path.is_file():
            raise RecordError(f"{self.path}: no such record")

    def __repr__(self) -> str:
        try:
            times, count = self.times, len(self.first_node) - 1
        except RecordError:
            return f"<Record {self.path}: not readable>"
        until = f" to {1e3 * times[-1]:g} ms" if len(times) else ""
        return f"<Record {self.path}: {count} flagell{'a' if count > 1 else 'um'}, {self.frame_count} frames{until}>"

    to_xarray = method_from(
        "warpflag.view.tables", "dataset", "The record as an xarray.Dataset in memory; needs the extra `notebook`."
    )
    _repr_html_ = method_from("warpflag.view.page", "notebook_frame", "The page of the record, as a notebook shows it.")

    def __enter__(self) -> Record:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the file, if it was opened."""
        if "_file" in self.__dict__:
            self.__dict__.pop("_file").close()

    @cached_property
    def _file(self) -> Any:
        import h5py

        try:
            # Without a lock, or a run that is still writing would keep its readers out.
            file = h5py.File(self.path, "r", locking=False)
        except OSError as error:
            # A file that this very process writes must be opened as it was, locked. Any other must not: the lock would
            # keep its writer from opening it.
            if "locking" not in str(error):
                raise RecordError(f"{self.path}: not a readable HDF5 file: {one_line(error)}") from error
            file = h5py.File(self.path, "r")
        missing = [entry for entry in (*ENTRIES, "parameters/first_node") if entry not in file]
        if missing:
            file.close()
            raise RecordError(f"{self.path}: not a record of warpflag, it has no /{missing[0]}")
        return file

    @cached_property
    def frame_count(self) -> int:
        """Number of committed frames when the record was first looked at."""
        return len(self._file[dataset_path("step")])

    def _frames(self, name: str) -> FrameArray:
        return FrameArray(self._file[dataset_path(name)], self.frame_count, self.path)

    @property
    def times(self) -> NDArray[np.float64]:
        """Times of the frames [s], shape [frame_count]."""
        return self._frames("time")[:]

    @property
    def steps(self) -> NDArray[np.int64]:
        """Steps taken when each frame was made, shape [frame_count]."""
        return self._frames("step")[:].astype(np.int64)

    @property
    def positions(self) -> FrameArray:
        """Nodes in lab coordinates [um], shape [frame_count, node_count, 3], flagellum after flagellum."""
        return self._frames(POSITION)

    @property
    def directors(self) -> FrameArray:
        """Directors e1 of tripod and segments, shape [frame_count, node_count, 3]."""
        return self._frames(E1)

    @property
    def motor_angle(self) -> NDArray[np.float64]:
        """Accumulated angles of the tripods relative to the body [rad], shape [frame_count,
        flagellum_count]."""
        return self._frames(MOTOR_ANGLE)[:]

    @property
    def body_position(self) -> NDArray[np.float64]:
        """Centre of the body [um], shape [frame_count, 3]."""
        return self._frames(BODY_POSITION)[:]

    @property
    def body_orientation(self) -> NDArray[np.float64]:
        """Quaternions (x, y, z, w) from body to lab axes, shape [frame_count, 4]."""
        return self._frames(BODY_ORIENTATION)[:]

    @property
    def observables(self) -> dict[str, NDArray[np.float64]]:
        """Observables by name, shape [frame_count] or [frame_count, flagellum_count]."""
        names = self._file.get("observables", ())
        return {name: self._frames(f"observables/{name}")[:] for name in names}

    @property
    def first_node(self) -> NDArray[np.int64]:
        """Flagellum k has the nodes first_node[k] to first_node[k + 1] - 1; shape [flagellum_count + 1]."""
        return self._parameter("first_node")

    @property
    def scene_text(self) -> str:
        """The scene as TOML, every value written out."""
        return self._parameter("scene").decode()

    @property
    def scene_sha256(self) -> str:
        """Hash of the scene text, hexadecimal."""
        return self._parameter("scene_sha256").decode()

    @property
    def filament_radius(self) -> float:
        """Radius of the flagella [um]."""
        return float(self._parameter("filament_radius"))

    @property
    def body_length(self) -> float:
        """Length of the body over its round ends [um]."""
        return float(self._parameter("body_length"))

    @property
    def body_width(self) -> float:
        """Width of the body [um]."""
        return float(self._parameter("body_width"))

    @property
    def versions(self) -> dict[str, str]:
        """Versions that were given for the run, by name."""
        return dict(self._file["parameters/versions"].attrs)

    def _parameter(self, name: str) -> Any:
        return self._file["parameters"][name][()]

    def frame(self, index: int) -> Frame:
        """One frame; a negative index counts from the end. Raises RecordError where there is no such
        frame."""
        if not -self.frame_count <= index < self.frame_count:
            raise RecordError(f"{self.path}: has no frame {index}, only {self.frame_count} frames")
        at = {name: self._frames(name)[index] for name in ("step", "time", *ENTRIES)}
        return Frame(
            time=float(at["time"]),
            step=int(at["step"]),
            positions=at[POSITION],
            directors=at[E1],
            motor_angle=at[MOTOR_ANGLE],
            body_position=at[BODY_POSITION],
            body_orientation=at[BODY_ORIENTATION],
            observables={
                name: self._frames(f"observables/{name}")[index] for name in self._file.get("observables", ())
            },
        )
