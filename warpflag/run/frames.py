"""From cells on a device to frames of their records: when they are due, and the observables of each.

Frames are taken on the device, inside steps (`warpflag_kernels.stepping.dense_output`), and read in blocks.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from warpflag_kernels.stepping import dense_output, frame_slots

from warpflag.model.switching import corners
from warpflag.observables.bundle import bundle_length
from warpflag.observables.motion import along_axis
from warpflag.observables.phase import phase_difference
from warpflag.record import Frame, FrameRows
from warpflag.run.cells import Cells, motor_torques
from warpflag.scene import Scene
from warpflag.stepping import Stepper, System

__all__ = ["Frames", "finite_time", "one_by_one"]

_FAR_FUTURE = 1e9  # [s]; finite, since fixed steps divide what is left of the time
_ROUNDING = 1e-6  # of a frame interval: times this close are the same
# What rates are differences of; it is kept of the last frame of every cell.
_MOTION = ("time", "body_position", "body_orientation", "body_angle", "motor_angle")


def finite_time(time: float) -> float:
    """A simulated time to reach [s]: one that is no number would end nothing, and one without end never comes.

    Raises:
        ValueError: the time is not finite.
    """
    if not math.isfinite(found := float(time)):
        raise ValueError(f"a time to reach is finite, not {time}")
    return found


@dataclass(frozen=True)
class _Block:
    """Frames of all cells, some after the other; arrays as in `Cells`, with the frames [m] before all other axes.

    Attributes:
        counts: how many of them each cell has, shape [cell_count].
        motor_torque: of the motors [pN um], shape [m, flagellum_count]; empty where torques are constant.
        forms: of the joints at the nodes, shape [m, node_count]; empty without polymorphs.
        before: the motion at the frame before each, entry [m] of every array.
    """

    counts: np.ndarray
    time: np.ndarray
    step: np.ndarray
    positions: np.ndarray
    directors: np.ndarray
    motor_angle: np.ndarray
    body_angle: np.ndarray
    body_position: np.ndarray
    body_orientation: np.ndarray
    elastic_energy: np.ndarray
    steric_force: np.ndarray
    motor_torque: np.ndarray
    forms: np.ndarray
    before: Mapping[str, np.ndarray]


class Frames:
    """The frames of every cell, each at multiples of its own scene's duration / frames.

    Args:
        system: what is advanced.
        scenes: one per cell.

    Attributes:
        index: number of the last frame that is behind each cell, -1 before the first, shape [cell_count].
        last: motion at the last frame of each cell, by name.
    """

    def __init__(self, system: System, scenes: Sequence[Scene]) -> None:
        self._system = system
        data = system.model.data
        self._first_flagellum, self._first_node = data.first_flagellum.numpy(), data.first_node.numpy()
        self._cell_of_node = data.cell_of.numpy()
        self._first_node_of_cell = self._first_node[self._first_flagellum[:-1]]
        self._durations = np.array([scene.duration for scene in scenes])
        self._counts = np.array([scene.frames for scene in scenes])
        self._lengths = [float(np.mean([spec.length for spec in scene.resolved_flagella()])) for scene in scenes]
        counts = np.diff(self._first_flagellum).tolist()
        self._drives: list[Any] = []  # corners of the drive of every motor, where torques are not constant
        if system.model.switches.has("motor law"):
            self._drives = [corners(s, k) for s, count in zip(scenes, counts, strict=True) for k in range(count)]
        self._polymorphs = system.model.switches.has("polymorphs")
        self._dense: frame_slots.DenseOutput | None = None
        self._end_steps = False  # at frames
        self._wanted = np.zeros((len(scenes), 0))
        self._unread: deque[dict[int, Frame]] = deque()
        cells = len(scenes)
        self.index = np.full(cells, -1, dtype=np.int64)
        self.last = {
            "time": np.zeros(cells),
            "body_position": np.zeros((cells, 3)),
            "body_orientation": np.zeros((cells, 4)),
            "body_angle": np.zeros(cells),
            "motor_angle": np.zeros(self._first_flagellum[-1]),
        }

    def take_from(self, stepper: Stepper) -> None:
        """Has the stepper take frames from inside its steps, from the next pass that is captured on."""
        self._end_steps = stepper.ends_at_frames
        stepper.dense = self._dense = frame_slots.allocate(self._system.model, self._system.state)

    @property
    def intervals(self) -> np.ndarray:
        """Time between two frames of each cell [s], shape [cell_count]."""
        return self._durations / self._counts

    @property
    def taken(self) -> bool:
        """Whether the stepper takes frames."""
        return self._dense is not None

    def memory(self) -> dict[str, np.ndarray]:
        """What the next frames need to come out with the same bits: of the last frame, and of the last step."""
        kept = {"index": self.index.copy(), **{name: values.copy() for name, values in self.last.items()}}
        before = self._dense.memory() if self._dense is not None else {}
        return kept | {f"before_{name}": array.numpy().copy() for name, array in before.items()}

    def recall(self, memory: Mapping[str, np.ndarray]) -> None:
        """Takes back what `memory` gave.

        Raises:
            KeyError: something is missing.
            ValueError: the shapes are of other cells.
        """
        self._unread.clear()
        self.index[:] = memory["index"]
        for name, values in self.last.items():
            values[...] = memory[name]
        if self._dense is not None:
            for name, array in self._dense.memory().items():
                array.assign(memory[f"before_{name}"])

    @property
    def unread(self) -> int:
        """How many frames `put` has got that nobody has taken; those of several cells at one time count once."""
        return len(self._unread)

    def put(self, block: Iterable[Mapping[int, FrameRows]]) -> None:
        """Keeps frames that were read until `take` hands them on one by one, to whoever asks."""
        self._unread.extend(one_by_one(block))

    def take(self, until: float | None) -> dict[int, Frame] | None:
        """The next frame of each cell that has one, by cell; None: all that were read up to a time [s] are taken."""
        latest = np.full(len(self.index), np.inf) if until is None else until + _ROUNDING * self.intervals
        for k, frames in enumerate(self._unread):
            due = {cell: frame for cell, frame in frames.items() if frame.time <= latest[cell]}
            if due:
                self._unread[k] = {cell: frame for cell, frame in frames.items() if cell not in due}
                if not self._unread[k]:
                    del self._unread[k]
                return due
        return None

    def pass_by(self, times: np.ndarray) -> None:
        """Counts frames up to these times [s] as past, though they were not recorded."""
        begun = self.index >= 0
        behind = np.floor(times / self._durations * self._counts + _ROUNDING).astype(np.int64)
        self.index = np.where(begun, np.maximum(self.index, behind), -1)

    def first(self, now: Cells) -> list[dict[int, FrameRows]]:
        """The first frame of every cell, at its present time; rates, differences between two frames, are NaN."""
        self.index[:] = 0
        self.pass_by(now.time)
        names = ("time", "step", "positions", "directors", "motor_angle", "body_angle", "body_position")
        arrays = {name: getattr(now, name)[None] for name in (*names, "body_orientation", "elastic_energy")}
        before = {name: np.full_like(arrays[name], np.nan) for name in _MOTION}
        counts = np.ones(len(now.time), dtype=np.int64)
        torque = motor_torques(self._system)[None]  # of the present state, which was evaluated last
        forms = self._system.state.optional.forms.form.numpy()[None].copy() if self._polymorphs else np.zeros((1, 0))
        further = {"motor_torque": torque, "forms": forms, "before": before}
        block = _Block(counts=counts, steric_force=now.steric_force[None], **further, **arrays)
        return self._measured(block)

    def schedule(self, until: float | None, waiting: np.ndarray) -> bool:
        """Tells the device the times of the next frames; returns whether there are any.

        Args:
            until: time that no frame is beyond [s]; None: the end of each scene.
            waiting: cells that go on, shape [cell_count].
        """
        assert self._dense is not None
        dense, slots = self._dense.data, self._dense.slots
        ends = self._durations if until is None else until
        last = np.floor(ends / self._durations * self._counts + _ROUNDING).astype(np.int64)
        counts = np.where(waiting, np.clip(last - self.index, 0, slots), 0)
        numbers = self.index[:, None] + 1 + np.arange(slots)
        self._wanted = self._durations[:, None] * numbers / self._counts[:, None]
        self._ends = self._durations * last / self._counts
        dense.time.assign(self._wanted.ravel())
        dense.count.assign(counts.astype(np.int32))
        dense.taken.zero_()
        self._scheduled = counts
        return bool(counts.any())

    def targets(self, until: float | None) -> Iterator[np.ndarray]:
        """Where steps of each cell end [s], one after the other, shape [cell_count]; 0: of a cell with no more frames.

        At `until`, and at every scheduled frame only if the stepper has to.
        """
        if self._end_steps:
            for k in range(int(self._scheduled.max(initial=0))):
                yield np.where(self._scheduled > k, self._wanted[:, k], 0.0)
            return
        beyond = np.full(len(self._ends), _FAR_FUTURE) if until is None else np.maximum(self._ends, until)
        yield np.where(self._scheduled > 0, beyond, 0.0)

    def collect(self, until: float | None, waiting: np.ndarray, times: np.ndarray) -> list[dict[int, FrameRows]]:
        """All frames up to the times that the cells have reached: the next one of each cell, by cell, and so on.

        Args:
            until, waiting: as in `schedule`.
            times: that the cells have reached [s].
        """
        assert self._dense is not None
        found = self._in_slots()
        # Those that fall into the last steps and found no slot before.
        while self.schedule(until, waiting) and ((self._scheduled > 0) & (self._wanted[:, 0] <= times)).any():
            dense_output.take_rest(self._system.model, self._system.control, self._dense)
            found += self._in_slots()
        return found

    def _in_slots(self) -> list[dict[int, FrameRows]]:
        assert self._dense is not None
        d, model = self._dense.data, self._system.model
        counts = d.taken.numpy().astype(np.int64)
        m, cells, elements = int(counts.max()), model.cell_count, model.element_count
        if m == 0:
            return []

        def read(array: Any, each: int) -> np.ndarray:
            return array[: m * each].numpy().reshape(m, each, *array.numpy().shape[1:])

        centres = read(d.body_position, cells).copy()
        arrays = {
            "time": self._wanted[:, :m].T,
            "body_position": centres,
            "body_orientation": read(d.body_orientation, cells).copy(),
            "body_angle": read(d.body_angle, cells).copy(),
            "motor_angle": read(d.motor_angle, model.flagellum_count).copy(),
        }
        before = {name: np.concatenate([self.last[name][None], arrays[name][:-1]]) for name in _MOTION}
        steric = np.zeros((m, cells))
        if model.switches.steric:
            steric = 0.5 * self._sums(read(d.steric, elements))
        torque = np.zeros((m, 0))
        if self._drives:
            torque = read(d.motor_torque, model.flagellum_count).astype(np.float64)
        block = _Block(
            counts=counts,
            motor_torque=torque,
            forms=read(d.form, elements).copy() if self._polymorphs else np.zeros((m, 0)),
            step=read(d.step, cells).copy(),
            positions=read(d.position, elements).astype(np.float64) + centres[:, self._cell_of_node],
            directors=read(d.director, elements).astype(np.float64),
            elastic_energy=self._sums(read(d.energy, elements)),
            steric_force=steric,
            before=before,
            **arrays,
        )
        self.index += counts
        return self._measured(block)

    def _sums(self, values: np.ndarray) -> np.ndarray:
        """The sum over the nodes of each cell, shape [m, cell_count, ...]; independent of other cells to the bit."""
        return np.add.reduceat(values.astype(np.float64), self._first_node_of_cell, axis=1)

    def _flagella(self, cell: int) -> slice:
        return slice(int(self._first_flagellum[cell]), int(self._first_flagellum[cell + 1]))

    def _measured(self, block: _Block) -> list[dict[int, FrameRows]]:
        """The frames of a block, by cell; observables of all cells of one structure are found at once."""
        found: dict[int, FrameRows] = {}
        for group in self._by_structure(block.counts):
            counts = block.counts[group]
            m = np.concatenate([np.arange(count) for count in counts])
            measured = self._observables(block, m, np.repeat(group, counts))
            for c, count, end in zip(group, counts.tolist(), np.cumsum(counts).tolist(), strict=True):
                observables = {name: values[end - count : end] for name, values in measured.items()}
                observables["steric_force_density"] = block.steric_force[:count, c] / self._lengths[c]
                flagella = self._flagella(c)
                nodes = slice(int(self._first_node[flagella.start]), int(self._first_node[flagella.stop]))
                found[c] = FrameRows(
                    time=block.time[:count, c],
                    step=block.step[:count, c],
                    positions=block.positions[:count, nodes],
                    directors=block.directors[:count, nodes],
                    motor_angle=block.motor_angle[:count, flagella],
                    body_position=block.body_position[:count, c],
                    body_orientation=block.body_orientation[:count, c],
                    observables=observables,
                    forms=block.forms[:count, nodes] if self._polymorphs else None,
                )
                for name, values in self.last.items():
                    own = flagella if name == "motor_angle" else c
                    values[own] = getattr(block, name)[count - 1, own]
        return [found] if found else []

    def _by_structure(self, counts: np.ndarray) -> list[list[int]]:
        """Cells that have frames, in groups whose flagella have the same numbers of nodes."""
        groups: dict[tuple[int, ...], list[int]] = {}
        for c in np.flatnonzero(counts):
            own = self._flagella(int(c))
            groups.setdefault(tuple(np.diff(self._first_node[own.start : own.stop + 1])), []).append(int(c))
        return list(groups.values())

    def _observables(self, block: _Block, m: np.ndarray, cells: np.ndarray) -> dict[str, np.ndarray]:
        """Observables of frames m of cells of one structure, by name, shape [row] or [row, flagellum_count]."""
        own = self._flagella(int(cells[0]))
        first_node = self._first_node[own.start : own.stop + 1] - self._first_node[own.start]
        flagella = self._first_flagellum[cells][:, None] + np.arange(len(first_node) - 1)
        nodes = self._first_node_of_cell[cells][:, None] + np.arange(first_node[-1])
        row = m[:, None]
        positions = block.positions[row, nodes]
        measured: dict[str, np.ndarray] = {}
        if len(first_node) > 2:
            measured["phase_difference"] = phase_difference(positions, block.directors[row, nodes], first_node)
        measured["bundle_length"] = bundle_length(positions, first_node)
        measured["elastic_energy"] = block.elastic_energy[m, cells].sum(axis=1)
        if self._drives:
            measured["motor_torque"] = block.motor_torque[row, flagella]
            pairs = zip(block.time[m, cells], flagella, strict=True)
            measured["motor_drive"] = np.array([[np.interp(t, *self._drives[k]) for k in own] for t, own in pairs])
        if self._polymorphs:
            changed = (block.forms[row, nodes] > 0).astype(np.float64)
            measured["target_form_share"] = np.add.reduceat(changed, first_node[:-1], axis=1) / (
                np.diff(first_node) - 2
            )
        before = block.before
        duration = block.time[m, cells] - before["time"][m, cells]
        at_ends = [before["body_position"][m, cells], block.body_position[m, cells]]
        at_ends += [before["body_orientation"][m, cells], block.body_orientation[m, cells]]
        turned = block.body_angle[m, cells] - before["body_angle"][m, cells]
        motors_turned = block.motor_angle[row, flagella] - before["motor_angle"][row, flagella]
        return measured | {
            "body_speed": -along_axis(*at_ends) / duration,
            "body_rate": turned / (2 * np.pi * duration),
            "motor_rate": motors_turned / (2 * np.pi * duration[:, None]),
        }


def one_by_one(block: Iterable[Mapping[int, FrameRows]]) -> Iterator[dict[int, Frame]]:
    """The next frame of each cell that has one, by cell, one after the other."""
    for rows in block:
        for k in range(max(map(len, rows.values()))):
            yield {cell: own.frame(k) for cell, own in rows.items() if k < len(own)}
