"""A sweep on one machine: workers that run its members in batches, what is done skipped, what was begun resumed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import Any

from warpflag.base.device import cores, start_warp
from warpflag.base.forked import Starter
from warpflag.base.progress import Progress
from warpflag.base.streams import tell
from warpflag.model.build import switches_of
from warpflag.model.starts import Starts
from warpflag.run.lock import SWEEP_NAME, Lock, LockedError
from warpflag.run.member import Outcome
from warpflag.run.run import begun_at_checkpoint
from warpflag.run.run_directory import RunError, check_same_scene, claim_directory, write_whole
from warpflag.run.stop import Ended, Stop
from warpflag.run.sweep import table
from warpflag.run.sweep.plan import BASE_NAME, Member, Sweep, check_members, read
from warpflag.run.sweep.pool import Batch, Pool, best_size
from warpflag.scene import SceneError
from warpflag.scene.resistance import filament_mobility

__all__ = ["FINISHED", "SweepRun", "resume", "resume_or_start", "start"]

FINISHED = ("done", "stopped")
"""Statuses of members that are not run again."""
_LARGEST_BATCH = {"cpu": 64, "cuda": 512}  # members: what a worker that dies begins again; a GPU needs many to be full
_SAMPLE_CELLS = 8  # members on which batch and single runs are timed
_SECONDS_PER_TABLE = 10.0  # between two writings of the tables while members run
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

    @property
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
        """
        if stop is None:
            with Stop() as signals:
                return self.execute(workers, device, quiet, signals, movies, share, checkpoint_seconds, starter)
        began = monotonic()
        own = range(len(self.members))[share[0] :: share[1]]
        pending = [k for k in own if table.status_of(self.directory / self.names[k]) not in FINISHED]
        ended: Ended | None = None
        failed: dict[int, str] = {}
        if pending:
            self._check_begun(pending)
            options = {"movies": movies, "checkpoint_seconds": checkpoint_seconds}
            ended, failed = self._run(pending, workers, device, quiet, stop, options, starter)
        self._write_table()
        return self._outcome(own, ended, failed, monotonic() - began)

    def _check_begun(self, pending: Sequence[int]) -> None:
        """That what was begun is of this sweep, and that no other process is at it any more.

        Raises:
            LockedError: a member is being written by another process.
            RunError: a member's directory holds another scene.
        """
        until = monotonic() + _SECONDS_FOR_LOCKS
        for k in pending:
            directory = self.directory / self.names[k]
            if not begun_in(directory):
                continue
            check_same_scene(directory, self.members[k].scene)
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
        devices = [device] if device else _devices()
        count = min(workers or (len(devices) if devices != ["cpu"] else cores()), len(pending))
        progress = Progress(sum(self.members[k].scene.duration for k in pending), quiet=quiet)
        failed: dict[int, str] = {}
        written = monotonic()
        ended: Ended | None = None
        with Pool([devices[k % len(devices)] for k in range(count)], options, starter) as pool:
            try:
                pool.start(self.members[pending[0]].scene, stop, quiet)
                size = self._batch_size(pool, pending, count, quiet, stop)
                for batch in self._batches(pending, size):
                    pool.submit(batch)
                progress.update(0.0)
                while not pool.is_done:
                    for batch, outcomes in pool.finished():
                        for k, outcome in zip(batch.members, outcomes, strict=True):
                            if outcome.status not in ("done", "interrupted", "terminated"):
                                if outcome.status == "failed":
                                    failed[k] = outcome.message
                                if not quiet:
                                    tell(f"{self.names[k]}: {outcome.message}")
                    progress.update(pool.reached)
                    if monotonic() - written > _SECONDS_PER_TABLE:
                        self._write_table()
                        written = monotonic()
                    stop.check()
                    pool.wait()
            except KeyboardInterrupt as error:
                ended = error if isinstance(error, Ended) else Ended("interrupted", "")
                pool.end(ended.status)
            finally:
                progress.close()
        return ended, failed

    def _batch_size(self, pool: Pool, pending: list[int], workers: int, quiet: bool, stop: Stop) -> int:
        """Members of a batch, by what a few of them cost alone and together."""
        group = max(self._groups(pending), key=len)[:_SAMPLE_CELLS]
        if len(group) < 2:
            return 1
        scenes = [self.members[k].scene for k in group]
        alone, together = pool.measure([scenes[:1], scenes], stop, quiet)
        kind = "cuda" if pool.devices[0].startswith("cuda") else "cpu"
        size, seconds = best_size(len(pending), workers, alone, together, len(group), _LARGEST_BATCH[kind])
        if not quiet:
            idle = ", since batches would leave workers idle" if together < alone else ""
            which = f"batches of {size}" if size > 1 else f"one by one{idle}"
            tell(
                f"{len(pending)} members on {workers} worker{'s' if workers > 1 else ''} "
                f"({', '.join(dict.fromkeys(pool.devices))}), {which}, about {seconds:.2g} s: a member takes "
                f"{alone:.2g} s alone, {together:.2g} s in a batch of {len(group)}"
            )
        return size

    def seconds_per_member(self, pending: Sequence[int], device: str | None, stop: Stop) -> float:
        """Wall time of a member on one worker, the lesser of alone and in a batch, measured on a few of them [s]."""
        group = max(self._groups(pending), key=len)[:_SAMPLE_CELLS]
        scenes = [self.members[k].scene for k in group]
        with Pool([device or _devices()[0]], {}) as pool:
            pool.start(scenes[0], stop)
            return min(pool.measure([scenes[:1], scenes], stop))

    def _groups(self, pending: Sequence[int]) -> list[list[int]]:
        """Members that one simulation can advance: the same terms, precision and stepper, all begun or none."""
        groups: dict[object, list[int]] = {}
        for k in pending:
            scene = self.members[k].scene
            numerics = scene.numerics
            begun = begun_in(self.directory / self.names[k])
            at_checkpoint = begun and begun_at_checkpoint(self.directory / self.names[k])
            key = (switches_of(scene), numerics.precision, numerics.stepper, begun, at_checkpoint)
            groups.setdefault(key, []).append(k)
        return list(groups.values())

    def _batches(self, pending: Sequence[int], size: int) -> list[Batch]:
        batches = []
        for group in self._groups(pending):
            for first in range(0, len(group), size):
                own = group[first : first + size]
                directories = [self.directory / self.names[k] for k in own]
                scenes = [self.members[k].scene for k in own]
                batches.append(Batch(own, directories, scenes))
        return batches

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
        found = [table.status_of(self.directory / self.names[k]) for k in own]
        counts = {status: found.count(status) for status in dict.fromkeys(found)}
        counted = ", ".join(f"{count} {status}" for status, count in counts.items())
        told = f"{self.sweep.name}: {len(found)} members: {counted}"
        if ended is not None:
            reason = f" ({ended.reason})" if ended.reason else ""
            return Outcome(ended.status, f"{told}; {ended.status}{reason}; resumable with --resume {self.directory}")
        told += f" in {seconds:.1f} s: {self.directory / table.TABLE_NAME}"
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
    directory, lock = claim_directory(sweep.name or sweep.base.name, output)
    write_whole(directory / BASE_NAME, sweep.base_text())
    write_whole(directory / SWEEP_NAME, sweep.dumps())
    lock.release()
    return SweepRun(directory, sweep, members)


def resume_or_start(sweep: Sweep, output: str) -> SweepRun:
    """The sweep of a directory, which must be the same, or a new one there.

    Raises:
        RunError: the directory holds another sweep.
        BadMembers, LockedError, SceneError: as in `start`.
    """
    path = Path(output)
    if not (path / SWEEP_NAME).exists():
        return start(sweep, output)
    text = (path / SWEEP_NAME).read_text(encoding="utf-8") + (path / BASE_NAME).read_text(encoding="utf-8")
    if text != sweep.dumps() + sweep.base_text():
        raise RunError(f"-o {output}: holds another sweep")
    return resume(path)


def resume(directory: str | Path) -> SweepRun:
    """The sweep of a directory.

    Raises:
        RunError: there is no sweep.
        SceneError: its files can't be read.
    """
    path = Path(directory)
    if not (path / SWEEP_NAME).is_file():
        raise RunError(f"--resume {directory}: holds no sweep, there is no {SWEEP_NAME}")
    sweep = read(path / SWEEP_NAME)
    return SweepRun(path, sweep, sweep.members())


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


def _devices() -> list[str]:
    return [device.alias for device in start_warp().get_cuda_devices()] or ["cpu"]
