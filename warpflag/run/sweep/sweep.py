"""A sweep on one machine: workers that run its members in batches, what is done skipped, what was begun resumed."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from warpflag.base.device import cores, find_device, start_warp
from warpflag.base.forked import Starter
from warpflag.base.output import text_of_file
from warpflag.base.progress import Progress
from warpflag.base.streams import tell
from warpflag.model.starts import Starts
from warpflag.run.execute import LARGEST_ON_CPU
from warpflag.run.lock import SWEEP_NAME, Lock, LockedError
from warpflag.run.member import Outcome
from warpflag.run.run_directory import RunError, check_same_scene, claim_directory, write_whole
from warpflag.run.stop import Ended, Stop
from warpflag.run.sweep import batches, table
from warpflag.run.sweep.batches import Batch
from warpflag.run.sweep.plan import BASE_NAME, Member, Sweep, check_members, read
from warpflag.run.sweep.pool import HANDED_BACK, Pool
from warpflag.scene import SceneError
from warpflag.scene.resistance import filament_mobility

__all__ = ["FINISHED", "SweepRun", "resume", "resume_or_start", "start"]

FINISHED = ("done", "stopped")
"""Statuses of members that are not run again."""
# Members: what a worker that dies begins again. A GPU needs many to be full; on a CPU more lie outside its caches.
_LARGEST_BATCH = {"cpu": LARGEST_ON_CPU, "cuda": 512}
_SAMPLE_CELLS = 8  # members that are timed
_SECONDS_PER_TABLE = 10.0  # between two writings of the tables while members run, at least
_TABLE_SHARE = 0.02  # of the time at most goes into them: those of ten thousand members take a second
_SECONDS_FOR_LOCKS = 10.0  # for which members of a sweep that was killed may still be held by its workers


@dataclass
class SweepRun:
    """A sweep in its directory; made by `start` or `resume`.

    Attributes:
        directory: one numbered run directory per member, sweep.toml, base.toml and the tables.
        sweep: what is run.
        members: of the sweep, in order.
    """

    directory: Path
    sweep: Sweep
    members: list[Member]

    @functools.cached_property
    def names(self) -> list[str]:
        """Names of the members' directories."""
        width = max(4, len(str(len(self.members) - 1)))
        return [f"{member.number:0{width}d}" for member in self.members]

    def statuses(self) -> list[str]:
        """The status of every member: done, stopped, failed, interrupted, terminated, begun or missing."""
        return [table.status_of(self.directory / name) for name in self.names]

    def execute(
        self,
        workers: int | None = None,
        device: str | None = None,
        quiet: bool = False,
        stop: Stop | None = None,
        movies: bool = False,
        share: tuple[int, int] = (0, 1),
        checkpoint_seconds: float | None = None,
        starter: Starter | None = None,
    ) -> Outcome:
        """Runs what is not finished.

        Args:
            workers: processes; default: one per GPU, or one per core.
            device: of all workers; default: every GPU in turn, or the CPU.
            quiet: print nothing.
            stop: what may end the sweep before its time; default: signals.
            movies: whether each member gets a movie.
            share: (k, n): only the k-th of n equal shares of the members.
            checkpoint_seconds: wall time between two checkpoints [s]; None: as `Run` has it.
            starter: of workers on the CPU, where one was started before; it is ended, too.

        Returns:
            done; stopped, where guards stopped members; failed, where the machine failed some; interrupted or
            terminated.

        Raises:
            DeviceError: there is no such device.
            ValueError: there are no such shares or workers.
        """
        if stop is None:
            with Stop() as signals:
                return self.execute(workers, device, quiet, signals, movies, share, checkpoint_seconds, starter)
        began = monotonic()
        if not 0 <= share[0] < share[1]:
            raise ValueError(f"share = {share}: must be (k, n) with k from 0 to n - 1")
        if workers is not None and workers < 1:
            raise ValueError(f"workers = {workers}: must be a whole number from 1 on")
        own = range(len(self.members))[share[0] :: share[1]]
        pending = [k for k in own if table.status_of(self._directory(k)) not in FINISHED]
        ended: Ended | None = None
        failed: dict[int, str] = {}
        self._check_scenes(own)
        if pending:
            self._wait_for_locks(pending)
            options = {"movies": movies, "checkpoint_seconds": checkpoint_seconds}
            ended, failed = self._run(pending, workers, device, quiet, stop, options, starter)
        self._write_table()
        return self._outcome(own, ended, failed if quiet else dict.fromkeys(failed, ""), monotonic() - began)

    def _check_scenes(self, own: Sequence[int]) -> None:
        """That what is there, done or begun, is of this sweep, whose files may have been edited.

        Raises:
            RunError: a member's directory holds another scene.
        """
        for k in own:
            with contextlib.suppress(SceneError, OSError):  # what can't be read is told when the member is taken up
                check_same_scene(self._directory(k), self.members[k].scene)

    def _wait_for_locks(self, pending: Sequence[int]) -> None:
        """Waits for other processes to let go what was begun.

        Raises:
            LockedError: a member is being written by another process.
        """
        until = monotonic() + _SECONDS_FOR_LOCKS
        for k in pending:
            directory = self._directory(k)
            if not begun_in(directory):
                continue
            while True:  # workers of a sweep that was killed end a moment after it
                try:
                    Lock(directory).release()
                    break
                except LockedError:
                    if monotonic() > until:
                        raise
                    sleep(0.1)

    def _run(
        self,
        pending: list[int],
        workers: int | None,
        device: str | None,
        quiet: bool,
        stop: Stop,
        options: dict[str, Any],
        starter: Starter | None,
    ) -> tuple[Ended | None, dict[int, str]]:
        devices = [find_device(device).alias] if device else _devices()
        count = min(workers or (len(devices) if devices != ["cpu"] else cores()), len(pending))
        progress = Progress(sum(self.members[k].scene.duration for k in pending), quiet=quiet)
        failed: dict[int, str] = {}
        next_table = monotonic() + _SECONDS_PER_TABLE
        ended: Ended | None = None
        with Pool([devices[k % len(devices)] for k in range(count)], options, starter) as pool:
            try:
                pool.start(self.members[pending[0]].scene, stop, quiet)
                for batch in self.batches_for(pool, pending, quiet):
                    pool.submit(batch)
                progress.update(0.0)
                import h5py  # noqa: F401 (the table's, while this process has nothing else to do)

                while not pool.is_done:
                    pool.wait()
                    for batch, outcomes in pool.finished():
                        left = [k for k, own in zip(batch.members, outcomes, strict=True) if own.status == HANDED_BACK]
                        for part in self._cut(left, max(pool.idle, 1), pool.devices[0]):
                            pool.submit(part)
                        for k, outcome in zip(batch.members, outcomes, strict=True):
                            if outcome.status not in ("done", "interrupted", "terminated", HANDED_BACK):
                                if outcome.status == "failed":
                                    failed[k] = outcome.message
                                if not quiet:
                                    tell(f"{self.names[k]}: {outcome.message}")
                    pool.balance()
                    progress.update(pool.reached)
                    if (now := monotonic()) > next_table:
                        self._write_table()
                        next_table = monotonic() + max(_SECONDS_PER_TABLE, (monotonic() - now) / _TABLE_SHARE)
                    stop.check()
            except KeyboardInterrupt as error:
                ended = error if isinstance(error, Ended) else Ended("interrupted", "")
                pool.end(ended.status)
            finally:
                progress.close()
        return ended, failed

    def batches_for(self, pool: Pool, pending: list[int], quiet: bool) -> list[Batch]:
        """What the workers take: equal shares of the members that can advance together."""
        workers = len(pool.devices)
        cut = self._cut(pending, workers, pool.devices[0])
        if not quiet and len(pending) > 1:
            most = max(len(batch.members) for batch in cut)
            which = f"batches of {most}" if most > 1 else "one by one"
            on = f"{workers} worker{'s' if workers > 1 else ''} ({', '.join(dict.fromkeys(pool.devices))})"
            tell(f"{counted_members(len(pending))} on {on}, {which}")
        return cut

    def _cut(self, pending: list[int], workers: int, device: str) -> list[Batch]:
        """Equal shares of the members that can advance together, for so many workers."""
        largest = _LARGEST_BATCH["cuda" if device.startswith("cuda") else "cpu"]
        cut = [
            own
            for group in self._groups(pending)
            for own in batches.cut(group, batches.share(len(group), workers, largest))
        ]
        return [Batch(own, [self._directory(k) for k in own], [self.members[k].scene for k in own]) for own in cut]

    def seconds_per_member(self, pending: Sequence[int], device: str | None, stop: Stop) -> float:
        """Time of a member on one worker, measured on a batch of a few from all over the largest group [s]."""
        largest = max(self._groups(pending), key=len)
        sample = [self.members[k].scene for k in batches.cut(largest, min(_SAMPLE_CELLS, len(largest)))[0]]
        with Pool([device or _devices()[0]], {}) as pool:
            pool.start(sample[0], stop)
            return pool.measure(sample, stop)

    def _directory(self, member: int) -> Path:
        return self.directory / self.names[member]

    def _groups(self, pending: Sequence[int]) -> list[list[int]]:
        scenes = [member.scene for member in self.members]
        return batches.groups(scenes, [self.directory / name for name in self.names], pending)

    def _write_table(self) -> None:
        """Writes the tables, unless another process writes them now."""
        try:
            lock = Lock(self.directory)
        except LockedError:
            return
        try:
            table.write(self.directory, self.members, self.names)
        finally:
            lock.release()

    def _outcome(self, own: Sequence[int], ended: Ended | None, failed: dict[int, str], seconds: float) -> Outcome:
        found = [table.status_of(self._directory(k)) for k in own]
        counts = {status: found.count(status) for status in dict.fromkeys(found)}
        counted = ", ".join(f"{count} {status}" for status, count in counts.items())
        told = f"{self.sweep.name}: {counted_members(len(found))}: {counted}"
        if ended is not None:
            reason = f" ({ended.reason})" if ended.reason else ""
            return Outcome(ended.status, f"{told}; {ended.status}{reason}; resumable with --resume {self.directory}")
        told += f" in {seconds:.1f} s: {self.directory / table.TABLE_NAME}"
        if not any(member.point for member in self.members):  # repeats of one point: their mean is what was asked for
            done = [self._directory(k) for k, status in zip(own, found, strict=True) if status == "done"]
            mean = table.mean_speed(done)
            told += f"; {mean}" if mean else ""
        first = next((f"; {message}" for message in failed.values() if message), "")
        told += first + (f" (and {len(failed) - 1} more)" if first and len(failed) > 1 else "")
        if failed or set(counts) - set(FINISHED):
            return Outcome("failed", f"{told}; resumable with --resume {self.directory}")
        return Outcome("stopped" if "stopped" in counts else "done", told)


def start(sweep: Sweep, output: str | None = None) -> SweepRun:
    """A new sweep. Its directory is made once every member is known to be sound.

    Args:
        sweep: to run.
        output: its directory; None: runs/NAME, or runs/NAME-2, -3, ... when taken.

    Raises:
        BadMembers: some members can't be simulated.
        LockedError: another process has just taken the directory.
        RunError: `output` holds a run or can't be made.
        SceneError: the sweep itself is not sound.
    """
    members = sweep.members()
    _check_starts(members)
    directory, lock = claim_directory(sweep.name, output)
    write_whole(directory / BASE_NAME, sweep.base_text())
    write_whole(directory / SWEEP_NAME, sweep.dumps())
    lock.release()
    return SweepRun(directory, sweep, members)


def resume_or_start(sweep: Sweep, output: str) -> SweepRun:
    """The sweep of a directory, which must be the same, or a new one there.

    Raises:
        OutputError: its files can't be read.
        RunError: the directory holds another sweep.
        BadMembers, LockedError, SceneError: as in `start`.
    """
    path = Path(output)
    if not (path / SWEEP_NAME).exists():
        return start(sweep, output)
    if text_of_file(path / SWEEP_NAME) + text_of_file(path / BASE_NAME) != sweep.dumps() + sweep.base_text():
        raise RunError(f"-o {output}: holds another sweep")
    return resume(path)


def resume(directory: str | Path) -> SweepRun:
    """The sweep of a directory.

    Raises:
        RunError: there is no sweep, or its directory holds more members than it has.
        SceneError: its files can't be read.
    """
    path = Path(directory)
    if not (path / SWEEP_NAME).is_file():
        raise RunError(f"--resume {directory}: holds no sweep, there is no {SWEEP_NAME}")
    sweep = read(path / SWEEP_NAME)
    members = sweep.members()
    beyond = [own.name for own in path.iterdir() if own.name.isdecimal() and int(own.name) >= len(members)]
    if beyond:
        problem = f"{path / min(beyond, key=int)} was a member, which {SWEEP_NAME} has no longer"
        raise RunError(f"--resume {directory}: {problem}; values can only be added at the end of the first axis")
    return SweepRun(path, sweep, members)


def begun_in(directory: Path) -> bool:
    """Whether a member has a directory with a scene."""
    return table.status_of(directory) != "missing"


def _check_starts(members: Sequence[Member]) -> None:
    """That every member has a start.

    Raises:
        BadMembers: some have none.
    """
    bad, starts = {}, Starts()
    for member in members:
        try:
            starts.of(member.scene)
            for spec in member.scene.resolved_flagella():
                filament_mobility(member.scene, spec.segment_length)
        except SceneError as error:
            bad[member.scene.name] = error
    check_members(bad)


def counted_members(count: int) -> str:
    """So many members in words."""
    return f"{count} member{'s' if count != 1 else ''}"


def _devices() -> list[str]:
    return [device.alias for device in start_warp().get_cuda_devices()] or ["cpu"]
