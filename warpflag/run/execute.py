"""What advances runs: one loop from frame to frame over the cells of a simulation, a run directory each.

A batch too large for the caches of a CPU is advanced in parts, each with a simulation of its own, one after the other.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from time import monotonic, process_time
from typing import Any, TypeVar

import numpy as np
from warpflag_kernels.stepping.health import Fault

from warpflag.base.device import find_device
from warpflag.base.output import sync_file_systems
from warpflag.base.progress import Progress
from warpflag.base.streams import tell
from warpflag.record import FrameRows, Record, RecordError
from warpflag.record.reporters import versions
from warpflag.run.faults import NumericalError
from warpflag.run.growth import Growth, chosen, growth, wanted
from warpflag.run.member import Member, Outcome
from warpflag.run.simulation import Simulation
from warpflag.run.stop import Ended, Stop
from warpflag.run.summary import accuracy_kept

__all__ = ["LARGEST_ON_CPU", "Run", "RunInParts", "in_parts", "parts"]

LARGEST_ON_CPU = 16
"""Cells that a CPU advances together: the states of more do not fit into a core's caches, and a step of each takes up
to a third more; fewer share less of what begins and ends a batch (docs/sweeps.md)."""
_T = TypeVar("_T")

_CHECKPOINT_SECONDS = 5.0  # wall time between two checkpoints: what a killed run computes again
_CHECKPOINT_SHARE = 0.05  # of the wall time at most goes into checkpoints
_SECONDS_PER_COPY = 0.05  # wall time between two copies of all cells, a hundredth of that between checkpoints
_WRITERS = 2  # threads that write files: one computes while the other waits for the disk; more wait for each other


class Run:
    """A simulation whose cells write a run directory each; made by `start`, `resume` and their batch forms.

    Args:
        simulation: None where there is nothing left to do.
        members: the run of each cell.
        movies: whether each run gets a movie at its end.
        checkpoint_seconds: wall time between two checkpoints [s]; None: 5 s, more where they take long to write.
    """

    def __init__(
        self,
        simulation: Simulation | None,
        members: Sequence[Member],
        movies: bool = True,
        checkpoint_seconds: float | None = None,
    ) -> None:
        self.members, self.movies = list(members), movies
        self._given_interval = checkpoint_seconds
        self._simulation = simulation
        # The last copy of all cells after a block of frames, and when it was taken: what a checkpoint is written from.
        self._copy: dict[str, np.ndarray] = {}
        self._copied_at = -math.inf
        self._following = 0.0  # computing time that has gone into following disturbances [s]
        self._check: Callable[[], None] = lambda: None

    @property
    def simulation(self) -> Simulation:
        """What advances the cells."""
        assert self._simulation is not None
        return self._simulation

    def notes(self) -> list[tuple[str, str]]:
        """What is to be told of the starts of members: name of the scene and a sentence each."""
        if self._simulation is None:
            return []
        own = zip(self.members, self.simulation.notes, strict=True)
        return [(member.scene.name, note) for member, notes in own for note in notes]

    def execute(self, quiet: bool = False, stop: Stop | None = None) -> Outcome:
        """Runs a single scene to its end, or until a guard or a signal stops it; see `execute_all`."""
        return self.execute_all(quiet, stop)[0]

    def execute_all(
        self,
        quiet: bool = False,
        stop: Stop | None = None,
        watch: Callable[[float], None] | None = None,
    ) -> list[Outcome]:
        """Runs every member to the end of its scene; the directories are complete afterwards.

        Args:
            quiet: print nothing.
            stop: what may end the run before its time; default: signals.
            watch: called a few times a second with the simulated time that all members together have reached [s].

        Returns:
            How each member ended.
        """
        if stop is None:
            with Stop() as own:
                return self.execute_all(quiet, own, watch)
        if self._simulation is not None:
            self._execute(quiet, stop, watch)
        return [member.outcome or Outcome("failed", "never ran") for member in self.members]

    def _execute(self, quiet: bool, stop: Stop, watch: Callable[[float], None] | None) -> None:
        durations = [member.scene.duration for member in self.members]
        progress = Progress(sum(durations), quiet=quiet)
        ended: Ended | None = None

        def look() -> None:
            reached = float(np.minimum(self.simulation.times, durations).sum())
            progress.update(reached)
            if watch is not None:
                watch(reached)
            stop.check()

        for name, note in () if quiet else self.notes():
            tell(f"{name}: {note}")
        self._check = stop.check
        try:
            stop.check()
            self._prepare(quiet, stop)
            look()
            for cell, member in enumerate(self.members):
                self._guarded(cell, lambda c=cell, m=member: m.start(self._first_node(c)))
            self._record(look)
        except KeyboardInterrupt as error:
            ended = error if isinstance(error, Ended) else Ended("interrupted", "")
        finally:
            stop.at_once = False
            progress.close()
        if ended is not None:
            self._end(ended)

    def _prepare(self, quiet: bool, stop: Stop) -> None:
        stop.at_once = True
        try:
            self.simulation.prepare(recording=True, quiet=quiet)
        except Exception:
            stop.check()  # what a signal raises amid other code may come out as another error
            raise
        finally:
            stop.at_once = False

    def _record(self, look: Callable[[], None]) -> None:
        given = self._given_interval
        saved, interval = monotonic(), _CHECKPOINT_SECONDS if given is None else given
        for block in self.simulation.frame_blocks(watch=look):
            at_end = self._write(block)
            faults = {c: e for c, e in self.simulation.faults.items() if self.members[c].outcome is None}
            if at_end or faults or monotonic() - self._copied_at > min(_SECONDS_PER_COPY, interval):
                self._copy, self._copied_at = self.simulation.checkpoint(), monotonic()
            self._complete(sorted(at_end))
            self._stop(faults)
            if monotonic() - saved > interval:
                began = monotonic()
                self._save(range(len(self.members)))
                saved = monotonic()
                if given is None:
                    interval = max(_CHECKPOINT_SECONDS, (saved - began) / _CHECKPOINT_SHARE)
            look()
        # Cells whose start violates a guard, and runs that were resumed at their end, have had no frame above.
        self._copy = self.simulation.checkpoint()
        faults = self.simulation.faults
        self._stop(faults)
        self._complete([c for c, member in enumerate(self.members) if member.outcome is None and c not in faults])

    def _write(self, block: Sequence[Mapping[int, FrameRows]]) -> set[int]:
        """Records frames; returns the cells whose last ones were among them."""

        def write(cell: int) -> bool:
            own = [frames[cell] for frames in block if cell in frames]
            return bool(self._guarded(cell, lambda: self.members[cell].write(own)))

        return {c for c, at_end in self._of_each({c for frames in block for c in frames}, write) if at_end}

    def _of_each(self, cells: Collection[int], action: Callable[[int], Any]) -> list[tuple[int, Any]]:
        """What an action on the files of each cell gives, by cell; disks take many at once faster than one by one."""
        if len(cells) == 1:
            return [(cell, action(cell)) for cell in cells]
        with ThreadPoolExecutor(_WRITERS) as pool:
            return list(zip(cells, pool.map(action, cells), strict=True))

    def _complete(self, cells: Sequence[int]) -> None:
        """Ends members that have reached the end of their scenes."""
        self._save(cells)
        for cell in cells:
            facts, scene = self._facts(cell), self.members[cell].scene
            fault = None
            if facts["accuracy"]["beyond"] and scene.numerics.on_accuracy == "stop" and not scene.numerics.time_step:
                fault = NumericalError(Fault.ACCURACY, float(self._copied_times()[cell]), cell, 0, 0, scene)
                facts = self._facts(cell, fault)
            self._finish(cell, "stopped" if fault else "done", facts, fault)

    def _finish(self, cell: int, status: str, facts: Mapping[str, Any], fault: NumericalError | None) -> None:
        """Ends a member; where its estimates are doubtful, or a guard has stopped it, disturbed copies are followed."""
        member, kept = self.members[cell], facts["accuracy"]
        flagella = len(member.scene.resolved_flagella())
        doubtful = wanted(kept, int(facts["steps"]), flagella, stopped=fault is not None)

        def follow(record: Record) -> Growth | None:
            # Members of a batch share the time that one run may take.
            if doubtful is None or (patience := doubtful.patience - self._following) <= 0.0:
                return None
            began, device = process_time(), self.simulation.device.alias
            followed = doubtful.within
            frames = chosen(record, kept["worst_window_end"], followed, doubtful.frames)
            step = 0.5 * self._copied_times()[cell] / max(int(facts["steps"]), 1)
            found = growth(member.scene, frames, record.first_node, device, step, patience, followed, self._check)
            self._following += process_time() - began
            return found

        self._guarded(cell, functools.partial(member.finish, status, facts, fault, movie=self.movies, follow=follow))

    def _copied_times(self) -> np.ndarray:
        """Time of every cell at the last copy [s], shape [cell_count]."""
        return self._copy["control.time"]

    def _guarded(self, cell: int, action: Callable[[], Any]) -> Any:
        """What a member does with its files; where the machine refuses, the member ends and the others go on."""
        member = self.members[cell]
        if member.outcome is not None:
            return None
        try:
            return action()
        except (OSError, RuntimeError, RecordError) as error:  # HDF5 raises all three
            if isinstance(error, RecordError) and len(self.members) == 1:
                raise
            member.fail(error)
            self.simulation.exclude(cell)
            return None

    def _stop(self, faults: Mapping[int, NumericalError]) -> None:
        """Ends the members whose cells have violated a guard."""
        for c, fault in faults.items():
            self._finish(c, "stopped", self._facts(c, fault), fault)

    def _end(self, ended: Ended) -> None:
        """Ends every member that still goes on, with a checkpoint to resume from."""
        if self._copy:
            self._save(range(len(self.members)))
        for cell, member in enumerate(self.members):

            def close(cell: int = cell, member: Member = member) -> None:
                facts = self._facts(cell) if member.recorder.frame_count else {}
                member.finish(ended.status, facts, ended=ended, movie=self.movies)

            self._guarded(cell, close)

    def _save(self, cells: Sequence[int]) -> None:
        """Writes the checkpoints of members that still go on."""

        def save(cell: int) -> None:
            copied = self.simulation.part(self._copy, cell)
            device = self.simulation.device.alias
            self._guarded(cell, lambda: self.members[cell].save(copied, device, sync=alone))

        alone = len(self.members) == 1
        self._of_each(cells, save)
        going_on = [cell for cell in cells if self.members[cell].outcome is None]
        if alone or not going_on:
            return
        try:
            sync_file_systems(self.members[cell].directory for cell in going_on)
            synced = True
        except OSError:  # perhaps of a file that is none of these
            synced = False
        self._of_each(going_on, lambda cell: self._guarded(cell, lambda: self.members[cell].saved(synced)))

    def _first_node(self, cell: int) -> np.ndarray:
        """Where each flagellum of a cell begins in its record, shape [flagellum_count + 1]."""
        first = self.simulation.system.model.data.first_flagellum.numpy()
        own = self.simulation.first_node[first[cell] : first[cell + 1] + 1]
        return own - own[0]

    def _facts(self, cell: int, fault: NumericalError | None = None) -> dict[str, Any]:
        """What the summary says of the simulation, as of the last copy."""
        simulation, scene = self.simulation, self.members[cell].scene
        copied = simulation.part(self._copy or simulation.checkpoint(), cell)
        violated = None
        if fault:
            place = {"flagellum": fault.flagellum, "segment": fault.segment}
            violated = {"kind": fault.kind.name.lower(), "time": fault.time, **place}
        return {
            "scene": scene.name,
            "duration": scene.duration,
            "steps": copied["control.steps"][0],
            "rejected_steps": copied["stepper.rejected"][0] if "stepper.rejected" in copied else 0,
            # Of the implicit stepper: steps attempted, each of two evaluations; of the others: right-hand sides.
            "evaluations": copied["stepper.evaluations"][0],
            # Of thermal noise: products with the pair sum that its root took.
            "noise_products": copied["stepper.noise_products"][0] if "stepper.noise_products" in copied else 0,
            "accuracy": accuracy_kept(scene, copied),
            "growth": None,
            "balance": {
                "judged": "stepper.balance_refused" in copied,
                "violations": copied["stepper.balance_refused"][0] if "stepper.balance_refused" in copied else 0,
            },
            "batch": len(self.members),
            "start": list(simulation.notes[cell]),
            "guards": {"steps_between_checks": simulation.system.guard.interval.numpy()[cell], "violated": violated},
            "precision": scene.numerics.precision,
            "stepper": scene.numerics.stepper,
            "device": simulation.device.alias,
            "device_name": simulation.device.name,
            "kernel_flags": simulation.system.model.precision.cpu_flags if simulation.device.is_cpu else "",
            "versions": versions(),
        }


def parts(batch: Sequence[_T], device: str | None) -> list[list[_T]]:
    """A batch in parts that are advanced together, as equal as they can be and in order; on a GPU it is one.

    Args:
        batch: scenes, or whatever there is one of per cell.
        device: "cpu", "cuda:0", ...; None: the preferred one.
    """
    count = max(math.ceil(len(batch) / LARGEST_ON_CPU), 1) if find_device(device).is_cpu else 1
    ends = [len(batch) * k // count for k in range(count + 1)]
    return [list(batch[first:last]) for first, last in itertools.pairwise(ends)]


class RunInParts(Run):
    """Runs of cells that are advanced one after the other, seen from outside as one.

    Args:
        runs: of the parts.
    """

    def __init__(self, runs: Sequence[Run]) -> None:
        super().__init__(None, [member for run in runs for member in run.members])
        self._runs, self._at_work = list(runs), runs[0]

    @property
    def simulation(self) -> Simulation:
        """What advances the part that is at work."""
        return self._at_work.simulation

    def execute_all(
        self,
        quiet: bool = False,
        stop: Stop | None = None,
        watch: Callable[[float], None] | None = None,
    ) -> list[Outcome]:
        """As of a `Run`; once a signal has come, the parts that have not begun are resumable from their scenes."""
        if stop is None:
            with Stop() as own:
                return self.execute_all(quiet, own, watch)
        progress = Progress(sum(member.scene.duration for member in self.members), quiet=quiet)
        outcomes: list[Outcome] = []
        behind = 0.0  # simulated time of the parts that are through [s]
        try:
            for run in self._runs:
                self._at_work = run

                def look(reached: float, behind: float = behind) -> None:
                    progress.update(behind + reached)
                    if watch is not None:
                        watch(behind + reached)

                for name, note in () if quiet else run.notes():
                    tell(f"{name}: {note}")
                outcomes += run.execute_all(quiet=True, stop=stop, watch=look)
                behind += sum(member.scene.duration for member in run.members)
        finally:
            progress.close()
        return outcomes


def in_parts(runs: Sequence[Run]) -> Run:
    """One run of those of the parts of a batch."""
    return runs[0] if len(runs) == 1 else RunInParts(runs)
