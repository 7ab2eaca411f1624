"""Writes the record of a run, run.h5 (layout: see warpflag.record), so that a killed run leaves it readable.

A block of frames is written and flushed first, `step` after it: its length is the number of committed frames,
and a reader cuts everything else to it. Nothing is compressed: a compressed chunk that grows is moved, and
processes killed meanwhile left committed frames unreadable (10 of 120 that wrote without pause, against 0 of
380 uncompressed).
"""

from __future__ import annotations

import functools
import hashlib
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from warpflag.record.record import (
    BODY_ORIENTATION,
    BODY_POSITION,
    E1,
    ENTRIES,
    MOTOR_ANGLE,
    POSITION,
    Frame,
    Record,
    RecordError,
    dataset_path,
    one_line,
)

__all__ = ["Recorder"]

_BLOCK_SECONDS = 2.0
_CHUNK_BYTES = 1 << 20


class Recorder:
    """Reporter that writes run.h5: start, write frame by frame, flush, close.

    Frames are committed in blocks, or once 2 s have passed since the last block; the first frame at once. After an
    exception (Ctrl-C) close() commits what is pending.

    Args:
        path: the file to write. It must not exist, unless resume_step is given.
        resume_step: frames of a larger step are cut off the existing file, and new ones appended.
        block_frames: frames of a block.
        keep_open: whether the file stays open between blocks. If not, only full blocks and calls of flush are
            committed: thousands of records can then be written at once.
    """

    def __init__(
        self, path: str | Path, *, resume_step: int | None = None, block_frames: int = 10, keep_open: bool = True
    ):
        self.path = Path(path)
        self._resume_step = resume_step
        self._block_frames, self._keep_open = block_frames, keep_open
        self._file: Any = None
        self._between_blocks = False  # there is a file, closed between two blocks
        self._parameters: dict[str, Any] = {}
        self._datasets: dict[str, Any] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._committed = 0
        self._pending: list[dict[str, Any]] = []
        self._last_commit = float("-inf")  # so that the first frame is late

    @property
    def frame_count(self) -> int:
        """Frames in the record so far, those not yet committed included: the index of the next frame."""
        return self._committed + len(self._pending)

    def start(
        self,
        scene_text: str,
        first_node: ArrayLike,
        *,
        filament_radius: float,
        body_length: float,
        body_width: float,
        versions: Mapping[str, str] | None = None,
    ) -> None:
        """Takes what /parameters holds, lengths in um.

        A new file appears with its first frame; a file to be continued is cut here. Raises RecordError where
        a new file exists already, or where a resumed one is missing or has other flagella.
        """
        self._parameters = {
            "scene": scene_text,
            "scene_sha256": hashlib.sha256(scene_text.encode()).hexdigest(),
            "first_node": np.asarray(first_node, dtype=np.int64),
            "filament_radius": float(filament_radius),
            "body_length": float(body_length),
            "body_width": float(body_width),
            "versions": dict(versions or {}),
        }
        if self._resume_step is not None:
            self._reopen(self._resume_step)
        else:
            self._refuse_existing()

    def write(self, frame: Frame) -> None:
        """Appends a frame; its arrays are copied.

        Raises ValueError where its shapes or observables are not those of the record.
        """
        values = _values(frame)
        if self._file is None and not self._between_blocks:
            self._create(values)
        shapes = {name: value.shape for name, value in values.items()}
        if shapes != self._shapes:
            wrong = sorted(name for name, _ in shapes.items() ^ self._shapes.items())
            raise ValueError(f"frame {self.frame_count} differs from the record in the shape or presence of {wrong}")
        self._pending.append(values)
        late = time.monotonic() - self._last_commit > _BLOCK_SECONDS and (self._keep_open or self._committed == 0)
        if late or len(self._pending) >= self._block_frames:
            self.flush()

    def flush(self) -> None:
        """Commits the frames that are pending: from here on they survive the end of this process."""
        if not self._pending:
            return
        file = self._open(list(self._shapes)) if self._file is None else self._file
        # Rows start at the committed count, not at a dataset's end: a commit that was interrupted is
        # repeated.
        count = self._committed + len(self._pending)
        for names in ([name for name in self._shapes if name != "step"], ["step"]):
            for name in names:
                dataset = self._datasets[name]
                dataset.resize(count, axis=0)
                dataset[self._committed :] = np.stack([values[name] for values in self._pending])
            file.flush()
        self._committed = count
        self._pending = []
        self._last_commit = time.monotonic()
        if not self._keep_open:
            self._close_file()

    def close(self) -> None:
        """Commits what is pending and closes the file; calling it again does nothing."""
        try:
            self.flush()
        finally:
            self._close_file()
            self._between_blocks = False

    def _close_file(self) -> None:
        """Closes the file; `flush` opens it again."""
        if self._file is not None:
            self._datasets = {}
            self._file.close()
            self._file, self._between_blocks = None, True

    def _open(self, names: list[str]) -> Any:
        """Opens the file that is there for writing, and returns it."""
        import h5py

        try:
            self._file = h5py.File(self.path, "r+")
        except OSError as error:
            raise RecordError(f"{self.path}: can't be continued: {one_line(error)}") from error
        # Datasets by their identifiers: looking each up as a member of its groups takes many times as long.
        paths = {name: dataset_path(name).encode() for name in names}
        self._datasets = {name: h5py.Dataset(h5py.h5d.open(self._file.id, path)) for name, path in paths.items()}
        return self._file

    def _refuse_existing(self) -> None:
        if self.path.exists():
            raise RecordError(f"{self.path}: exists already")

    def _create(self, values: dict[str, Any]) -> None:
        """Makes the file, datasets empty, under a temporary name: it is whole as soon as it is there."""
        import h5py

        self._refuse_existing()
        first_node = self._parameters["first_node"]
        expected = {
            POSITION: (int(first_node[-1]), 3),
            E1: (int(first_node[-1]), 3),
            MOTOR_ANGLE: (len(first_node) - 1,),
        }
        for name, shape in expected.items():
            if np.shape(values[name]) != shape:
                raise ValueError(f"{name} of a frame has shape {np.shape(values[name])}, the scene's is {shape}")
        temporary = self.path.with_name(self.path.name + ".tmp")
        shapes = tuple((name, np.shape(value)) for name, value in values.items())
        temporary.write_bytes(_empty_file(shapes, self._parameters["versions"].get("warpflag", "unknown")))
        with h5py.File(temporary, "r+") as file:
            self._write_parameters(file)
        os.replace(temporary, self.path)
        self._open(list(values))
        self._shapes = {name: value.shape for name, value in values.items()}

    def _reopen(self, resume_step: int) -> None:
        """Opens the file again and cuts it to the frames with step <= resume_step."""
        with Record(self.path) as record:
            if not np.array_equal(record.first_node, self._parameters["first_node"]):
                raise RecordError(f"{self.path}: has other flagella than the run that would continue it")
            self._committed = int(np.searchsorted(record.steps, resume_step, side="right"))
            names = ["step", "time", *ENTRIES, *(f"observables/{name}" for name in record.observables)]
        self._open(names)
        for name in names:  # step first: at any moment no dataset is shorter
            dataset = self._datasets[name]
            dataset.resize(self._committed, axis=0)
            self._file.flush()
            self._shapes[name] = dataset.shape[1:]
        del self._file["parameters"]
        self._write_parameters(self._file)
        self._file.flush()
        self._last_commit = time.monotonic()
        if not self._keep_open:
            self._close_file()

    def _write_parameters(self, file: Any) -> None:
        group = file.create_group("parameters")
        for name, value in self._parameters.items():
            if name == "versions":
                group.create_group(name).attrs.update(value)
            else:
                group[name] = value


@functools.lru_cache(maxsize=16)
def _empty_file(shapes: tuple[tuple[str, tuple[int, ...]], ...], version: str) -> bytes:
    """A record without frames and parameters, as the bytes of its file: records of equal structure begin alike.

    Args:
        shapes: name and shape of the values of a frame.
        version: of this program.
    """
    import h5py

    with h5py.File("empty", "w", driver="core", backing_store=False) as file:
        file.create_group("h5md").attrs["version"] = np.array([1, 1], dtype=np.int32)
        file.create_group("h5md/author").attrs["name"] = "unknown"
        creator = file.create_group("h5md/creator")
        creator.attrs["name"] = "warpflag"
        creator.attrs["version"] = version
        box = file.create_group("particles/flagella/box")
        box.attrs["dimension"] = np.int32(3)
        box.attrs["boundary"] = ["none"] * 3
        shape_of = dict(shapes)
        # The shared datasets first, under the entry that every record has.
        for name in ("step", "time", *(name for name in shape_of if name not in ("step", "time"))):
            shape, dtype = shape_of[name], np.int64 if name == "step" else np.float64
            chunk = int(np.clip(_CHUNK_BYTES // (8 * max(1, np.prod(shape, dtype=int))), 16, 64))
            file.create_dataset(dataset_path(name), (0, *shape), dtype, maxshape=(None, *shape), chunks=(chunk, *shape))
        for name in shape_of.keys() - {"step", "time", POSITION}:
            file[f"{name}/step"] = file[dataset_path("step")]
            file[f"{name}/time"] = file[dataset_path("time")]
        file.flush()
        return bytes(file.id.get_file_image())


def _values(frame: Frame) -> dict[str, Any]:
    """A copy of a frame by the names of its entries in the file."""
    values = {
        POSITION: frame.positions,
        E1: frame.directors,
        MOTOR_ANGLE: frame.motor_angle,
        BODY_POSITION: frame.body_position,
        BODY_ORIENTATION: frame.body_orientation,
        "time": frame.time,
        **{f"observables/{name}": value for name, value in frame.observables.items()},
    }
    return {"step": np.int64(frame.step), **{name: np.array(v, dtype=np.float64) for name, v in values.items()}}
