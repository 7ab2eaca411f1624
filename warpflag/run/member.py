"""One run in its directory: the record that it writes, its checkpoints, and what it leaves at its end."""

from __future__ import annotations

import contextlib
import errno
import functools
import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from warpflag.record import RECORD_NAME, FrameRows, Record
from warpflag.record.recorder import Recorder
from warpflag.record.reporters import start_reporter, versions
from warpflag.run import checkpoint
from warpflag.run.faults import NumericalError
from warpflag.run.growth import Growth, growth_words
from warpflag.run.lock import Lock
from warpflag.run.run_directory import MOVIE_NAME, SUMMARY_NAME, settings_sha256, write_whole
from warpflag.run.stop import Ended
from warpflag.run.summary import digest, kept_words, plain
from warpflag.scene import Scene, dumps

__all__ = ["Member", "Outcome"]

# HDF5 leaves a file that can't be opened when a write of its own fails, so the disk is looked at before: room for a
# chunk of frames, twice, and for checkpoint and summary.
_LEAST_ROOM, _FRAMES_OF_ROOM = 1 << 18, 160  # bytes, and frames: more than two chunks of 64
_FRAMES_PER_COMMIT = 64  # of a member of a batch: a whole chunk of its record


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    Attributes:
        status: done; stopped, by a guard; interrupted, by Ctrl-C; terminated, by a signal or the wall time; failed,
            by the machine.
        message: one line for the user.
    """

    status: str
    message: str


class Member:
    """A run that writes its directory while a simulation advances its cell.

    Args:
        directory: of the run; it is locked.
        scene: of the run.
        lock: of the directory; released at the end.
        resumed: the meta of the checkpoint that the run goes on from; None for a new run.
        alone: whether it is the only run of its simulation: the file of its record then stays open.

    Attributes:
        outcome: how it ended; None while it goes on.
    """

    def __init__(
        self, directory: Path, scene: Scene, lock: Lock, resumed: Mapping[str, Any] | None = None, alone: bool = True
    ) -> None:
        self.directory, self.scene = directory, scene
        self.outcome: Outcome | None = None
        self._lock = lock
        self._saved_step = resumed["step"] if resumed else -1
        self._unnamed = False  # a checkpoint is written that has not its name yet
        self._began = monotonic() - (resumed["wall_time"] if resumed else 0.0)
        step = resumed["step"] if resumed else None
        options = {"block_frames": _FRAMES_PER_COMMIT, "keep_open": alone, "expected": scene.frames + 1}
        self.recorder = Recorder(directory / RECORD_NAME, resume_step=step, **options)

    @property
    def wall_time(self) -> float:
        """Time that the run has taken, that before it was resumed included [s]."""
        return monotonic() - self._began

    @functools.cached_property
    def _settings_sha256(self) -> str:
        return settings_sha256(self.scene, self.text)

    @functools.cached_property
    def text(self) -> str:
        """The scene as TOML."""
        return dumps(self.scene)

    def start(self, first_node: np.ndarray) -> None:
        """Opens the record; flagellum k has the nodes first_node[k] to first_node[k + 1] - 1."""
        start_reporter(self.recorder, self.scene, first_node, self.text)

    def write(self, frames: Sequence[FrameRows]) -> bool:
        """Records frames, one at least; returns whether the last of the scene was among them.

        Raises:
            OSError: the disk is all but full; what was recorded before still fits.
        """
        count = max(_FRAMES_OF_ROOM, sum(map(len, frames)) + _FRAMES_PER_COMMIT)
        needed = _LEAST_ROOM + count * (frames[0].positions[0].nbytes + frames[0].directors[0].nbytes)
        if shutil.disk_usage(self.directory).free < needed:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.directory))
        for rows in frames:
            self.recorder.write_rows(rows)
        return self.recorder.frame_count == self.scene.frames + 1

    def save(self, arrays: Mapping[str, np.ndarray], device: str, sync: bool = True) -> None:
        """Writes a checkpoint, the frames before it first; the one of the last checkpoint's step is there already.

        Args:
            arrays: the checkpoint of the cell when all frames up to its time were recorded.
            device: that it was computed on.
            sync: whether it is then safe from a power cut; if not, it takes its place with `saved`, once it is.
        """
        step, time = int(arrays["control.steps"][0]), float(arrays["frame.time"][0])
        if step == self._saved_step:
            return
        meta = {
            "step": step,
            "time": time,
            "wall_time": self.wall_time,
            "device": device,
            "settings_sha256": self._settings_sha256,
            "versions": versions(),
        }
        self.recorder.flush(sync)
        if sync:
            checkpoint.save(self.directory, arrays, meta)
        else:
            checkpoint.write(self.directory, arrays, meta, sync=False)
            self._unnamed = True
        self._saved_step = step

    def saved(self, synced: bool) -> None:
        """Gives a checkpoint that `save` has written without `sync` its place.

        Args:
            synced: whether all that was written so far is safe from a power cut; if not, it is afterwards.
        """
        if synced:
            self.recorder.mark_synced()
        else:
            self.recorder.flush()
        if self._unnamed:
            checkpoint.name(self.directory, sync=not synced)
            self._unnamed = False

    def finish(
        self,
        status: str,
        facts: Mapping[str, Any],
        fault: NumericalError | None = None,
        ended: Ended | None = None,
        movie: bool = True,
        follow: Callable[[Record], Growth | None] = lambda record: None,
    ) -> None:
        """Closes the record and writes summary and movie.

        Args:
            status: as in `Outcome`.
            facts: of the simulation, for the summary.
            fault: the guard that was violated.
            ended: what ended the run before its time.
            movie: whether the movie is wanted; a run that will be resumed gets none.
            follow: what tells from the record how the motion magnifies disturbances.
        """
        try:
            self.recorder.close()
            message = self._written(status, facts, fault, ended, movie, follow)
        finally:
            self._lock.release()
        self.outcome = Outcome(status, f"{self.scene.name}: {message}")

    def fail(self, error: Exception) -> None:
        """Ends the run after the machine refused to write; what was committed stays."""
        with contextlib.suppress(OSError, RuntimeError, ValueError):  # the same refusal once more
            self.recorder.close()
        self._lock.release()
        name = getattr(error, "filename", None)
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())
        where = f"{name or self.directory}: {reason}"
        self.outcome = Outcome("failed", f"{self.scene.name}: {where}; resumable with --resume {self.directory}")

    def _written(
        self,
        status: str,
        facts: Mapping[str, Any],
        fault: NumericalError | None,
        ended: Ended | None,
        movie: bool,
        follow: Callable[[Record], Growth | None],
    ) -> str:
        """Summary and movie of the record; returns what the user is told."""
        how = status + (f" ({ended.reason})" if ended and ended.reason else "")
        if self.recorder.frame_count == 0:
            if (self.directory / RECORD_NAME).exists():
                return f"{how} before a new frame, those of before are kept; resumable with --resume {self.directory}"
            return f"{how} before the first frame; start again with --resume {self.directory}"
        with Record(self.directory) as record:
            found, grown, taken = digest(record, self.scene, self.recorder.kept()), follow(record), self.wall_time
            growth = None
            if grown:
                growth = {"factor": grown.factor, "from": grown.start, "within": grown.within, "between": grown.between}
            ending = {"status": status, "message": str(fault) if fault else "", "wall_time": taken}
            summary = {**ending, "scene_sha256": self.recorder.scene_sha256, **facts, "growth": growth, **found}
            write_whole(self.directory / SUMMARY_NAME, json.dumps(plain(summary), indent=2) + "\n")
            left_out = "" if not movie or ended is None else "; movie left out"
            if movie and ended is None:
                left_out = _movie(record, self.directory / MOVIE_NAME)
        count = found["frames"]
        reached = f"{count} frame{'s' if count > 1 else ''} to {found['time'] * 1e3:.6g} ms"
        kept = "; ".join(filter(None, (kept_words(facts["accuracy"]), growth_words(grown))))
        if status == "done":
            said = f", {kept}" if kept else ""
            return f"{reached} in {taken:.1f} s{said}: {self.directory}{left_out}"
        if status == "stopped":
            said = f"; {kept}" if kept else ""
            return f"{fault}{said}; {reached} kept in {self.directory}{left_out}"
        return f"{how}, {reached} kept{left_out}; resumable with --resume {self.directory}"


def _movie(record: Record, path: Path) -> str:
    """Writes the movie; a signal meanwhile leaves it out, which is then said."""
    from warpflag.view.usd import write_movie

    try:
        write_movie(record, path)
    except KeyboardInterrupt:
        return "; movie left out: warpflag export makes it"
    return ""
