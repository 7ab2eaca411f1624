"""Writes the record of a run, run.h5, so that a run that is killed or runs out of disk space leaves it readable.

A block of frames is written and flushed first, `step` after it: its length is the number of committed frames,
and a reader cuts everything else to it. Nothing is compressed: a compressed chunk that grows is moved, and
processes killed meanwhile left committed frames unreadable (10 of 120 that wrote without pause, against 0 of
380 uncompressed). The layout of the file is described in `warpflag.record.layout`.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag.base.output import DiskError
from warpflag.record.disk import DiskFile
from warpflag.record.layout import (
    CHECKSUMS,
    E1,
    FORM,
    POSITION,
    Frame,
    FrameRows,
    RecordError,
    checksums,
    one_line,
    parameters_checksum,
    summed_entries,
)
from warpflag.record.new_record import FORMAT, first_image, growth, values_of, with_new_parameters
from warpflag.record.record import Record
from warpflag.record.rows import Rows

__all__ = ["Recorder"]

MOST_KEPT = 1000  # frames: 0.2 MB of a cell with two flagella
_BLOCK_SECONDS = 2.0  # after which pending frames are committed: what a killed run loses at most


class Recorder:
    """Reporter that writes run.h5: start, write frame by frame, flush, close. Started again, it goes on with its file.

    Frames are committed in blocks, or once 2 s have passed since the last block; the first frame at once. After an
    exception (Ctrl-C) close() commits what is pending.

    Args:
        path: the file to write. It must not exist, unless `resume_step` is given.
        resume_step: continue an existing file: frames whose step is larger are cut off and new ones appended.
        block_frames: frames of a block.
        keep_open: whether the file stays open and locked between blocks. If not, only full blocks and calls of `flush`
            are committed, the first ones, too: thousands of records can then be written at once.
        expected: frames that the record will hold; it may get more.
        clock: seconds that pass, for tests.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        resume_step: int | None = None,
        block_frames: int = 10,
        keep_open: bool = True,
        expected: int = MOST_KEPT,
        most_kept: int = MOST_KEPT,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.path = Path(path)
        self._resume_step = resume_step
        self._block_frames, self._keep_open, self._most_kept = block_frames, keep_open, most_kept
        self._expected = expected
        self._clock = clock
        self._started = False  # the file is there, open or not
        self._first_rows: dict[str, NDArray[Any]] = {}  # all that is committed, while that is less than a block
        self._kept: dict[str, list[NDArray[Any]]] | None = {}
        self._file: Any = None
        self._disk: DiskFile | None = None
        self._parameters: dict[str, Any] = {}
        self._recorded = ""  # the scene of the frames that this recorder has taken
        self._datasets: dict[str, Rows] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._summed: list[str] = []  # entries in the order of their checksums
        self._committed, self._synced = 0, False
        self._pending: list[dict[str, NDArray[Any]]] = []
        self._last_commit = float("-inf")  # so that the first frame is late
        self._last_step, self._last_time = resume_step, -math.inf

    @property
    def frame_count(self) -> int:
        """Frames in the record so far, those not yet committed included: the index of the next frame."""
        return self._committed + sum(len(values["step"]) for values in self._pending)

    @property
    def scene_sha256(self) -> str:
        """SHA-256 of the scene text that /parameters holds, in hexadecimal digits; valid after `start`."""
        return self._parameters["scene_sha256"]

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
        """Takes what /parameters holds. A new file appears with its first frame; one to be continued is cut here.

        Args:
            scene_text: the scene as TOML.
            first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
            filament_radius: of the flagella [um].
            body_length: over the round ends [um].
            body_width: of the body [um].
            versions: of the program and the packages that it uses, by name.

        Raises:
            RecordError: a new file exists already; a resumed one is missing, damaged, has other flagella, or is being
                written by another run.
            DiskError: the file could not be written; it is as it was.
        """
        if self._recorded not in ("", scene_text):
            raise RecordError(f"{self.path}: holds frames of another scene, and a record is of one")
        self._parameters = {
            "scene": scene_text,
            "scene_sha256": hashlib.sha256(scene_text.encode()).hexdigest(),
            "first_node": np.asarray(first_node, dtype=np.int64),
            "filament_radius": float(filament_radius),
            "body_length": float(body_length),
            "body_width": float(body_width),
            "versions": {str(name): str(version) for name, version in (versions or {}).items()},
        }
        if self._resume_step is not None:
            self._reopen(self._resume_step)
        else:
            self._refuse_existing()

    def write(self, frame: Frame) -> None:
        """Appends a frame; as `write_rows`."""
        self.write_rows(FrameRows.of(frame))

    def write_rows(self, rows: FrameRows) -> None:
        """Appends frames; their arrays are copied.

        Raises:
            ValueError: their shapes or observables are not those of the record, or one does not come after the last.
            DiskError: a block of frames could not be written; all committed before stay readable.
        """
        values, first = values_of(rows), 0
        self._check(values)
        while first < len(rows):
            room = max(self._block_frames - (self.frame_count - self._committed), 1)
            part = slice(first, first + room)
            self._pending.append({name: value[part] for name, value in values.items()})
            self._last_step, self._recorded = int(values["step"][part][-1]), self._parameters["scene"]
            first += room
            late = self._keep_open and not (self._started and self._clock() - self._last_commit <= _BLOCK_SECONDS)
            if late or first <= len(rows):  # late, or a block is full
                self._commit()

    def _check(self, values: Mapping[str, NDArray[Any]]) -> None:
        """That frames come after those before them, with the same shapes and entries; the first begin a new file."""
        shapes = {name: value.shape[1:] for name, value in values.items()}
        if not (self._started or self._pending):
            self._refuse_existing()
        if not self._shapes:
            self._summed = list(values)
            self._shapes = {**shapes, CHECKSUMS: (len(values),)}
        expected = {name: shape for name, shape in self._shapes.items() if name != CHECKSUMS}
        if wrong := sorted({name for name, _ in shapes.items() ^ expected.items()}):
            raise ValueError(f"frame {self.frame_count} differs from the record in the shape or presence of {wrong}")
        last = float(self._pending[-1]["time"][-1]) if self._pending else self._last_time
        for at in values["time"].tolist():
            if not at > last:
                told = f"a frame of {at:g} s does not come after the last frame of {self.path}, {last:g} s"
                raise ValueError(f"{told}: a record is of one run")
            last = at

    def flush(self, sync: bool = True) -> None:
        """Commits the frames that are pending: from here on they survive the end of this process and a power cut.

        Args:
            sync: whether a power cut, too; if not, `mark_synced` tells that something else has seen to it.

        Raises:
            DiskError: they could not be written; all committed before stay readable.
        """
        if not (self._started or self._pending):
            return
        self._commit()
        if self._synced or not sync:
            return
        disk = self._disk or DiskFile(self.path)
        try:
            disk.sync()
        finally:
            if disk is not self._disk:
                disk.close()
        self._synced = True

    def mark_synced(self) -> None:
        """Tells that all that is committed would survive a power cut."""
        self._synced = True

    def close(self) -> None:
        """Commits what is pending and closes the file; calling it again does nothing.

        Raises:
            DiskError: what was pending could not be written; the file is closed, all committed before is readable.
        """
        try:
            self.flush()
        finally:
            if self._started:
                self._resume_step = self._last_step  # started once more, it goes on
            self._started, self._first_rows = False, {}
            self._release()

    def _commit(self) -> None:
        """Writes the pending frames and their checksums, flushes, and then writes `step`, the mark of the commit."""
        if not self._pending:
            return
        # Rows start at the committed count, not at a dataset's end: a commit that was interrupted is
        # repeated.
        count = self.frame_count
        rows = {name: np.concatenate([values[name] for values in self._pending]) for name in self._pending[0]}
        if CHECKSUMS in self._shapes:
            rows[CHECKSUMS] = np.stack([checksums(rows[name]) for name in self._summed], axis=1)
        if not self._started:
            self._create(rows)
            first = rows
        elif self._first_rows and count <= self._block_frames:  # is written anew sooner than it is opened
            first = {name: np.concatenate([self._first_rows[name], rows[name]]) for name in rows}
            self._create(first)
        else:
            self._append(rows, count)
            first = {}
        self._first_rows = first if not self._keep_open and count < self._block_frames else {}
        self._keep(rows, count)
        self._committed, self._pending, self._last_commit = count, [], self._clock()
        self._last_time = float(rows["time"][-1])
        if not self._keep_open:
            self._release()

    def _append(self, rows: Mapping[str, NDArray[Any]], count: int) -> None:
        """Adds rows to a file that exists, which has `count` frames then."""
        if self._file is None:
            self._open(DiskFile(self.path), list(self._shapes))
        assert self._disk is not None and self._file is not None
        self._disk.reserve(self._file.id.get_filesize() + growth(self._datasets.values(), self._committed, count))
        try:
            for group in ([name for name in self._shapes if name != "step"], ["step"]):
                for name in group:
                    self._datasets[name].write(self._committed, rows[name])
                self._file.flush()
        except (OSError, RuntimeError) as error:  # h5py raises either
            self._abandon()
            raise DiskError.of(self.path, error) from error
        self._synced = False

    def _keep(self, rows: Mapping[str, NDArray[Any]], count: int) -> None:
        """Keeps what is small of a record that is not long."""
        if count > self._most_kept or (self._committed and not self._kept):
            self._kept = None
        if self._kept is not None:
            for name in rows.keys() - {POSITION, E1, FORM, CHECKSUMS}:
                self._kept.setdefault(name, []).append(rows[name])

    def kept(self) -> dict[str, NDArray[Any]] | None:
        """All committed frames of the small entries by name, frames first, without a look at the file.

        Returns:
            All but positions, directors and forms; None of a record that is long or was continued.
        """
        if not self._kept:
            return None
        return {name: np.concatenate(parts) for name, parts in self._kept.items()}

    def _abandon(self) -> None:
        """Closes HDF5's file after a write that failed; what it still writes goes nowhere, and can't fail again."""
        self._started, self._pending = False, []
        with contextlib.suppress(Exception):
            size = self._file.id.get_filesize()
            nowhere = os.open(os.devnull, os.O_RDWR)
            os.dup2(nowhere, self._file.id.get_vfd_handle())
            os.close(nowhere)
            if self._disk is not None:
                self._disk.extend(size)
        with contextlib.suppress(Exception):
            self._release()

    def _release(self) -> None:
        file, disk = self._file, self._disk
        self._file = self._disk = None
        self._datasets = {}
        try:
            if file is not None:
                size = file.id.get_filesize()
                file.close()
                if disk is not None:
                    disk.trim(size)
        finally:
            if disk is not None:
                disk.close()

    def _refuse_existing(self) -> None:
        if self.path.exists():
            raise RecordError(
                f"{self.path}: exists already, and records are never overwritten; name another or remove it"
            )

    def _create(self, rows: Mapping[str, NDArray[Any]]) -> None:
        """Makes the file with its first frames, in memory and then under a temporary name: it is never there in part.

        Raises:
            RecordError: the file exists, and this recorder has not made it.
            DiskError: it could not be written; there is none then, or the one before.
        """
        pending, shapes = self._pending, self._shapes
        self._pending, self._shapes = [], {}  # nothing is kept of frames that can't be written
        if not self._started:
            self._refuse_existing()
        image = first_image(rows, self._parameters, self._expected)
        temporary = self.path.with_name(self.path.name + ".tmp")
        try:
            with open(temporary, "wb") as file:
                file.write(image)
                if self._keep_open:
                    file.flush()
                    os.fsync(file.fileno())
            os.replace(temporary, self.path)
        except OSError as error:
            with contextlib.suppress(OSError):
                temporary.unlink()
            raise DiskError.of(self.path, error) from error
        self._pending, self._shapes = pending, shapes
        if self._keep_open:
            self._open(DiskFile(self.path), list(self._shapes))
        self._started, self._synced = True, self._keep_open

    def _reopen(self, resume_step: int) -> None:
        """Opens an existing file and cuts it to the frames with step <= resume_step."""
        with Record(self.path) as record:
            present = record.parameters
            if not np.array_equal(present["first_node"], self._parameters["first_node"]):
                raise RecordError(f"{self.path}: has other flagella than the run that would continue it")
            self._committed = int(np.searchsorted(record.steps, resume_step, side="right"))
            self._last_time = record.times[self._committed - 1] if self._committed else -math.inf
            names = list(record.entries)
        disk = DiskFile(self.path)
        if parameters_checksum(present) != parameters_checksum(self._parameters):
            disk = with_new_parameters(disk, self._parameters)
        try:
            self._open(disk, names)
            for name in ["step", *(name for name in names if name != "step")]:  # at no moment is a dataset shorter
                self._datasets[name].cut(self._committed)
                self._file.flush()
        except (OSError, RuntimeError) as error:  # h5py raises either
            self._abandon()
            raise RecordError(f"{self.path}: can't be continued: {one_line(error)}") from error
        self._started, self._last_commit = True, self._clock()
        if not self._keep_open:
            self._release()

    def _open(self, disk: DiskFile, names: list[str]) -> None:
        """Opens the file for writing; `disk` holds its lock, so HDF5 needs none of its own."""
        import h5py

        self._disk = disk
        self._file = h5py.File(self.path, "r+", locking=False, libver=FORMAT)
        self._datasets = {name: Rows(self._file, name) for name in names}
        if self._shapes.keys() == self._datasets.keys():
            return  # opened once more
        self._shapes = {name: rows.shape for name, rows in self._datasets.items()}
        if CHECKSUMS in self._datasets:
            self._summed = summed_entries(self._file[CHECKSUMS])
