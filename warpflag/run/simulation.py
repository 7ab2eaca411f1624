"""The driver: scenes in, frames out. It has a stepper advance the cells, and watches the guards."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from warpflag_kernels.base import clock as control_stage
from warpflag_kernels.base.plan import Plan
from warpflag_kernels.rod import reconstruction
from warpflag_kernels.stepping import evaluation_time, health
from warpflag_kernels.stepping.dense_output import take_rest
from warpflag_kernels.stepping.right_hand_side import launch_right_hand_side

from warpflag.base.device import LAUNCHING, alone, find_device
from warpflag.base.kernels import load_kernels
from warpflag.base.progress import watching
from warpflag.model.build import begin_forms, build_chart, build_control, build_model, build_state, plan_of
from warpflag.model.geometry import InitialState
from warpflag.model.start import check_outside
from warpflag.model.starts import starting_states
from warpflag.record import Frame, FrameRows
from warpflag.record.cell_state import CellState, Evaluation
from warpflag.record.reporters import Reporter, hand_over
from warpflag.run.carried_values import check_shapes, check_values
from warpflag.run.cells import Cells, CellsReader, evaluation_of
from warpflag.run.faults import NumericalError, found_faults
from warpflag.run.frames import Frames, finite_time
from warpflag.scene import Scene
from warpflag.stepping import System, make_stepper
from warpflag.stepping.replay import Replay

__all__ = ["CellState", "Evaluation", "NumericalError", "Simulation"]

_SECONDS_PER_BLOCK = 0.25  # of frames: what an interrupted run loses of its last frames
_MOST_SECONDS_PER_BLOCK = 2.0  # where handing frames over takes long, as it does of a thousand cells
_SHARE_OF_BLOCKS = 0.1  # of the time that then goes into handing over


class Simulation:
    """Cells on one device, advanced together; each has its own clock, step and guards.

    Args:
        scenes: one scene, or one per cell of a batch. All of a batch share precision, stepper and switches.
        device: "cpu", "cuda:0", ...; default: Warp's preferred one.
        starts: initial shapes, one per scene; default: from the scenes.
        reporters: take the frames of every `run` of a single scene, and are closed at the end of each.
        capture: replay a captured pass (the default) or launch every kernel from Python; same numbers.
        strict: kernels built without reassociation, for comparisons to the last bit.
        plan: how kernels are executed, in place of what is chosen for the device; then neither `device` nor `strict`.

    Raises:
        SceneError: a scene can't be simulated.
        DeviceError: there is no such device.
        NumericalError: from `advance`, `frames` and `run`, when a guard is violated.
    """

    @alone
    def __init__(
        self,
        scenes: Scene | Sequence[Scene],
        *,
        device: Any = None,
        starts: InitialState | Sequence[InitialState] | None = None,
        reporters: Sequence[Reporter] = (),
        capture: bool = True,
        strict: bool = False,
        plan: Plan | None = None,
    ) -> None:
        self.scenes = [scenes] if isinstance(scenes, Scene) else list(scenes)
        if starts is None:
            starts = starting_states(self.scenes)
        else:
            starts = [starts] if isinstance(starts, InitialState) else list(starts)
            for scene, start in zip(self.scenes, starts, strict=True):
                check_outside(scene, start)
        self.notes = [start.notes for start in starts]
        model = build_model(self.scenes, plan or plan_of(self.scenes, find_device(device), strict))
        self.device = model.device
        state = build_state(model)
        chart = build_chart(model, starts)
        begin_forms(model, state, starts)
        self.system = System(model, state, chart, build_control(model, starts), health.allocate(model, chart))
        self.stepper = make_stepper(self.system, self.scenes)
        self.first_node = model.data.first_node.numpy()
        self._first_flagellum = model.data.first_flagellum.numpy()
        self.reporters = list(reporters)
        self._replay = Replay(self.system.control, self.stepper, self.device, capture)
        self._checked, self._loaded = False, False
        self._frames = Frames(self.system, self.scenes)
        self._reader = CellsReader(self.system)
        self._excluded = np.zeros(len(self.scenes), dtype=bool)

    def __repr__(self) -> str:
        scene, count = self.scenes[0], len(self.scenes)
        cells = scene.name if count == 1 else f"{count} cells"
        time = f"{1e3 * float(self.times.min()):g} of {1e3 * scene.duration:g} ms"
        return f"<Simulation of {cells} on {self.device}: {time}, stepper {scene.numerics.stepper}>"

    @property
    def times(self) -> np.ndarray:
        """Simulated time of every cell [s], shape [cell_count]."""
        return self.system.control.time.numpy().copy()

    @property
    def steps(self) -> np.ndarray:
        """Steps taken by every cell, shape [cell_count]."""
        return self.system.control.steps.numpy().copy()

    @property
    def state(self) -> CellState:
        """The first cell on the host, at the time it has reached."""
        return self.cell_state()

    def run(self, duration: float | None = None, *, progress: bool = False) -> None:
        """Advances by a simulated time [s], by default to the end of the scene, and hands frames to the reporters.

        Frames fall on the multiples of the scene's duration / frames; the first run begins with the present state. A
        further run goes on recording: reporters are started again and get the frames that follow.

        Args:
            duration: by which to advance [s].
            progress: shows a bar, in a notebook or on a terminal; nothing in a log.

        Raises:
            NumericalError: a guard was violated.
            ValueError: the duration is negative or not finite.
        """
        if duration is not None and not 0.0 <= duration < float("inf"):
            raise ValueError(f"a run takes a time from 0 on, not {duration}")
        until = self.scenes[0].duration if duration is None else float(self.times[0]) + duration
        with watching(progress, lambda: float(self.times.min()), until) as watch:
            frames = self.frames(until, watch) if self.reporters else ()
            hand_over(self.reporters, self.scenes[0], self.first_node, frames)
            self.advance(until, watch)

    def frames(self, until: float, watch: Callable[[], None] | None = None) -> Iterator[Frame]:
        """Advances one scene to a time and yields a frame at each multiple of its duration / frames on the way.

        The scene has one stream of frames: where an iterator was left, the next one goes on.

        Args:
            until: simulated time to reach [s].
            watch: as in `advance`.

        Raises:
            NumericalError: a guard was violated.
            ValueError: several scenes; `cell_frames` yields theirs.
        """
        if len(self.scenes) > 1:
            raise ValueError("frames and reporters are of a single scene; a batch has cell_frames")
        for frames in self.cell_frames(until, watch):
            yield from frames.values()
        self._raise_fault()

    def cell_frames(
        self, until: float | None = None, watch: Callable[[], None] | None = None
    ) -> Iterator[dict[int, Frame]]:
        """The frames of `frame_blocks` one after the other: the next frame of each cell that has one, by cell.

        A simulation has one stream of frames: a further iterator goes on with the first frame that nobody has taken.
        """
        blocks = self.frame_blocks(until, watch)
        while True:
            while (frames := self._frames.take(until)) is not None:
                yield frames
            if (block := next(blocks, None)) is None:
                return
            self._frames.put(block)

    def frame_blocks(
        self, until: float | None = None, watch: Callable[[], None] | None = None
    ) -> Iterator[list[dict[int, FrameRows]]]:
        """Advances every cell, and yields frames of each at multiples of its own scene's duration / frames.

        Frames are taken inside steps and handed over in blocks, so cells are ahead of them: after a block, up to the
        end of the step into which its last frame falls, or of one of the next. Only `until` ends steps. A cell that
        violates a guard, and one that was excluded, has no further frames; the others go on.

        Args:
            until: simulated time that no frame is beyond [s]; default: the end of each scene, which steps may pass.
            watch: as in `advance`.

        Returns:
            An iterator over blocks: the next frames of each cell that has any, by cell; then those after them; and so
            on. A block may be empty, since the host also reads the slots a few times a second.
        """
        until = None if until is None else finite_time(until)
        self.prepare(recording=True)
        if (self._frames.index < 0).all():
            yield self._frames.first(self._present_state())
        seconds = _SECONDS_PER_BLOCK
        while self._schedule(until):
            began = clock.perf_counter()
            for targets in self._frames.targets(until):
                left = seconds - (clock.perf_counter() - began)
                if left <= 0.0:
                    break
                self._advance(targets, watch, left)
            began = clock.perf_counter()
            yield self._collect(until)
            taken = clock.perf_counter() - began
            seconds = min(max(taken / _SHARE_OF_BLOCKS, _SECONDS_PER_BLOCK), _MOST_SECONDS_PER_BLOCK)

    def _going_on(self) -> np.ndarray:
        """Cells that no guard has stopped and nobody has excluded, shape [cell_count]."""
        return ~self._excluded & (self.system.control.fault.numpy() == control_stage.NO_FAULT)

    @alone
    def _schedule(self, until: float | None) -> bool:
        return self._frames.schedule(until, self._going_on())

    @alone
    def _collect(self, until: float | None) -> list[dict[int, FrameRows]]:
        return self._frames.collect(until, self._going_on(), self.times)

    def exclude(self, cell: int) -> None:
        """Advances a cell no further: `frame_blocks` goes on with the others."""
        self._excluded[cell] = True

    @alone
    def prepare(self, recording: bool = False, quiet: bool = False) -> None:
        """Loads every kernel, checks the start and captures the pass; otherwise the first `advance` does.

        Args:
            recording: frames will be taken.
            quiet: say nothing while kernels are compiled.
        """
        self.load(recording, quiet)
        if not self._checked:
            self._check_start()
        self._replay.prepare()

    @alone
    def load(self, recording: bool = False, quiet: bool = False) -> float:
        """Loads every kernel, the first part of `prepare`; arguments as there. Returns what compiling took [s]."""
        if recording and not self._frames.taken:
            self.take_frames()
        compiling = 0.0 if self._loaded else load_kernels(self._launch_all, self.device, quiet)
        self._loaded = True
        return compiling

    def take_frames(self) -> None:
        """Has the stepper take frames; a pass that was captured without is captured anew."""
        self._frames.take_from(self.stepper)
        self._replay.forget()
        self._loaded = False

    def _launch_all(self) -> None:
        """Launches whatever a run launches, to find its kernels."""
        self._present_state()
        self._check_start()
        self._replay.launch_once()
        if self.stepper.dense is not None:
            take_rest(self.system.model, self.system.control, self.stepper.dense)
        self._checked = False

    def advance(self, until: float, watch: Callable[[], None] | None = None) -> None:
        """Advances every cell to one time.

        Args:
            until: simulated time to reach [s].
            watch: called a few times a second; what it raises ends the advance.

        Raises:
            NumericalError: a guard was violated; the device holds the offending state, frames taken before are sound.
            ValueError: the time is not finite.
        """
        self._advance(np.full(len(self.scenes), finite_time(until)), watch)
        self._frames.pass_by(self.times)
        self._raise_fault()

    def _advance(self, until: np.ndarray, watch: Callable[[], None] | None = None, seconds: float = math.inf) -> None:
        """Advances every sound cell to its own time [s], shape [cell_count]; past times leave a cell where it is.

        After so many seconds of wall time cells rest at the ends of their steps.
        """
        control, state = self.system.control, self.system.state.data
        self.prepare()
        waiting = (self.times < until) & (control.fault.numpy() == control_stage.NO_FAULT)
        with LAUNCHING:
            control.target.assign(until)
            state.active.assign(waiting.astype(np.int32))
            control.rest.zero_()
            control.unfinished.fill_(int(waiting.sum()))
        self._replay.advance(watch, seconds)

    @property
    def faults(self) -> dict[int, NumericalError]:
        """The violated guard of each cell that was stopped by one, by cell."""
        codes = self.system.control.fault.numpy()
        return found_faults(codes, self.times, self.first_node, self._first_flagellum, self.scenes)

    def _raise_fault(self) -> None:
        for error in self.faults.values():
            raise error

    @alone
    def cells(self) -> Cells:
        """All cells on the host, each at the time it has reached; valid after `advance`."""
        return self._reader.read()

    def cell_state(self, cell: int = 0) -> CellState:
        """One cell on the host, at the time it has reached; valid after `advance`."""
        return self.cells().cell(cell)

    @alone
    def checkpoint(self) -> dict[str, np.ndarray]:
        """What `restore` needs to go on from here with the same bits; valid after `advance`. Arrays by name.

        Raises:
            ValueError: frames were read that nobody has taken from `frames`; they would be lost.
        """
        if self._frames.unread:
            raise ValueError(f"{self._frames.unread} frames that were not taken yet would be lost: take them first")
        return self._memory()

    def _memory(self) -> dict[str, np.ndarray]:
        own = {name: array.numpy().copy() for name, array in self.system.carried().items()}
        own |= {f"frame.{name}": values for name, values in self._frames.memory().items()}
        return {**own, **{f"stepper.{name}": values.copy() for name, values in self.stepper.memory().items()}}

    @alone
    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes back what `checkpoint` gave, in a simulation of the same scenes.

        Raises:
            ValueError: the arrays are of another simulation, or of no state that one can be in.
        """
        parts: dict[str, dict[str, np.ndarray]] = {"stepper": {}, "frame": {}}
        for name, x in arrays.items():
            parts.get(name.partition(".")[0], {})[name.partition(".")[2]] = x
        if "before_position" in parts["frame"] and not self._frames.taken:
            self.take_frames()
        check_shapes(arrays, self._memory())
        check_values(arrays, self._frames.intervals, self.first_node[:-1])
        for name, array in self.system.carried().items():
            array.assign(arrays[name])
        self.stepper.restart()
        self.stepper.recall(parts["stepper"])
        self._frames.recall(parts["frame"])
        self.system.control.step.zero_()  # the last step taken here did not lead to the restored state
        self._reconstruct()
        self.system.state.data.active.zero_()

    def part(self, arrays: Mapping[str, np.ndarray], cell: int) -> dict[str, np.ndarray]:
        """The part of a checkpoint that belongs to one cell: the checkpoint of that cell alone."""
        flagella, nodes = self._own(cell)
        sizes = (len(self.scenes), self._first_flagellum[-1], self.first_node[-1])
        # Where two of the sizes are equal, each cell has one flagellum, and the parts are equal too.
        rows = dict(zip(sizes, (slice(k := range(sizes[0])[cell], k + 1), flagella, nodes), strict=True))
        return {name: values[rows[len(values)]] for name, values in arrays.items()}

    @alone
    def evaluate(self, cell: int = 0) -> Evaluation:
        """Forces and velocities of one cell at its present state; advances nothing."""
        model, s = self.system.model, self.system.state
        self._reconstruct()
        launch_right_hand_side(model, s)
        s.data.active.zero_()
        return evaluation_of(self.system, self.scenes[cell], *self._own(cell))

    def _own(self, cell: int) -> tuple[slice, slice]:
        """The flagella and the nodes of one cell; a negative index counts from the end."""
        cell = range(len(self.scenes))[cell]
        flagella = slice(self._first_flagellum[cell], self._first_flagellum[cell + 1])
        return flagella, slice(self.first_node[flagella.start], self.first_node[flagella.stop])

    def _reconstruct(self) -> None:
        """Puts the evaluation point on the present state; every cell is active afterwards."""
        s, chart = self.system.state, self.system.chart
        s.data.active.fill_(1)
        for array in (chart.increment, chart.body_increment, chart.elapsed, chart.commit):
            array.zero_()
        reconstruction.reconstruct(self.system.model, s, chart)
        if self.system.model.timed:
            evaluation_time.of_stage(s, self.system.control, chart, self.device)

    @alone
    def _present_state(self) -> Cells:
        """The cells before any step, or after a state was set from outside."""
        self._reconstruct()
        if self.system.model.switches.has("motor law"):
            launch_right_hand_side(self.system.model, self.system.state)  # finds the torques of the motors
        self.system.state.data.active.zero_()
        return self.cells()

    def _check_start(self) -> None:
        """The guards look at the state that the first step starts from."""
        model, s, chart = self.system.model, self.system.state, self.system.chart
        self._reconstruct()
        launch_right_hand_side(model, s)
        chart.at_start.fill_(1)
        health.check(model, s, chart, self.system.guard, self.system.control)
        chart.at_start.zero_()
        s.data.active.zero_()
        self._checked = True
