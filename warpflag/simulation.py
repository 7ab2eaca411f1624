"""The driver: scenes in, frames out. It captures one pass of the stepper, replays it, and watches the guards."""

from __future__ import annotations

import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from warpflag_kernels import chart as chart_stage
from warpflag_kernels import control as control_stage
from warpflag_kernels import elastic, guard, steric
from warpflag_kernels.types import Precision

from warpflag.geometry import InitialState, initial_state
from warpflag.integrators import System, make_stepper
from warpflag.model import build_chart, build_model, build_state
from warpflag.scene import Scene
from warpflag.stages import launch_right_hand_side

__all__ = ["CellState", "Evaluation", "NumericalError", "Simulation"]

_SECONDS_PER_REPLAY = 0.2

_ADVICE = {
    guard.Fault.NOT_FINITE: ("a value is not finite", "take a shorter numerics.time_step"),
    guard.Fault.CROSSING: (
        "its centre line has passed through another flagellum's",
        "take a shorter numerics.time_step, hydrodynamics.mode other than as_printed, or a lower motor.torque",
    ),
    guard.Fault.STRAIN: (
        "a segment is stretched or squeezed by more than 5 %",
        "take a shorter numerics.time_step, a lower motor.torque or a higher flagella.stretching_stiffness",
    ),
    guard.Fault.TWIST: (
        "a joint is twisted by more than 90 degrees",
        "take a shorter flagella.segment_length or a lower motor.torque",
    ),
    guard.Fault.FOLD: (
        "a joint is folded back on itself",
        "take a shorter numerics.time_step or a lower motor.torque",
    ),
}


class NumericalError(RuntimeError):
    """The run has lost its numerical footing: what, when, which flagellum, what to try, in one line.

    Attributes:
        time: of the step that violated a guard [s].
        cell, flagellum, segment: where; segment counts from the body, 0 is the motor joint.
        kind: which guard.
    """

    def __init__(self, kind: guard.Fault, time: float, cell: int, flagellum: int, segment: int) -> None:
        self.kind, self.time, self.cell, self.flagellum, self.segment = kind, time, cell, flagellum, segment
        what, advice = _ADVICE[kind]
        where = f"flagellum {flagellum}, segment {segment}"
        super().__init__(f"stopped at {time * 1e3:.6g} ms: {where}: {what}; {advice}")


@dataclass(frozen=True)
class CellState:
    """One cell at one time, on the host, in lab coordinates.

    Attributes:
        time: [s].
        step: steps taken.
        positions: nodes [um], shape [node_count, 3], flagellum after flagellum, r_0..r_N each.
        directors: e1 of the tripod and the segments, shape [node_count, 3].
        tangents: e3 of the tripod (the motor axis) and the segments, shape [node_count, 3].
        motor_angle: accumulated turn of each motor relative to the body [rad], shape [flagellum_count].
        body_angle: accumulated turn of the body about its axis e_b3 [rad].
        body_position: [um], shape [3].
        body_orientation: quaternion (x, y, z, w), shape [4].
        elastic_energy: bending, twist, stretching [pN um], shape [3].
        steric_force: sum of the contact forces between flagella, each pair once [pN].
    """

    time: float
    step: int
    positions: np.ndarray
    directors: np.ndarray
    tangents: np.ndarray
    motor_angle: np.ndarray
    body_angle: float
    body_position: np.ndarray
    body_orientation: np.ndarray
    elastic_energy: np.ndarray
    steric_force: float


@dataclass(frozen=True)
class Evaluation:
    """Forces and velocities of one cell at its present state.

    Attributes:
        forces: on the nodes [pN], shape [node_count, 3]; on r_0: what the anchor hands to the body.
        torques: on the spins about the tangents [pN um], shape [node_count].
        velocities: of the nodes in the lab [um/s], shape [node_count, 3].
        spins: of the segments about their tangents [rad/s], shape [node_count].
        body_force, body_torque: on the body, all shares [pN], [pN um], shape [3]; torque about its centre.
        body_velocity, body_spin: of the body [um/s], [rad/s], shape [3].
    """

    forces: np.ndarray
    torques: np.ndarray
    velocities: np.ndarray
    spins: np.ndarray
    body_force: np.ndarray
    body_torque: np.ndarray
    body_velocity: np.ndarray
    body_spin: np.ndarray


class Simulation:
    """Cells on one device, advanced together; each has its own clock, step and guards.

    Args:
        scenes: one scene, or one per cell of a batch. All of a batch share precision, stepper and switches.
        device: "cpu", "cuda:0", ...; default: Warp's preferred one.
        starts: initial shapes, one per scene; default: from the scenes.
        capture: replay a captured pass (the default) or launch every kernel from Python; same numbers.
        strict: kernels built without reassociation, for comparisons to the last bit.

    Errors:
        SceneError: a scene can't be simulated.
        NumericalError: from `advance`, when a guard is violated.
    """

    def __init__(
        self,
        scenes: Scene | Sequence[Scene],
        *,
        device: Any = None,
        starts: InitialState | Sequence[InitialState] | None = None,
        capture: bool = True,
        strict: bool = False,
    ) -> None:
        self.scenes = [scenes] if isinstance(scenes, Scene) else list(scenes)
        if starts is None:
            starts = [initial_state(scene) for scene in self.scenes]
        elif isinstance(starts, InitialState):
            starts = [starts]
        precision = Precision(self.scenes[0].numerics.precision, strict)
        model = build_model(self.scenes, device, precision)
        self.device = model.device
        state = build_state(model)
        chart = build_chart(model, starts)
        self.system = System(model, state, chart, _control(model.cell_count, starts, self.device), _guard(model))
        self.system.guard.position.assign(chart.base_position)
        self.stepper = make_stepper(self.system, self.scenes)
        self._first_node = model.data.first_node.numpy()
        self._first_flagellum = model.data.first_flagellum.numpy()
        self._capture, self._graph = capture, None
        self._passes_per_replay = 200
        self._energy = wp.zeros(model.element_count, dtype=precision.vec3, device=self.device)
        self._steric = wp.zeros(model.element_count, dtype=precision.real, device=self.device)

    @property
    def times(self) -> np.ndarray:
        """Simulated time of every cell [s], shape [cell_count]."""
        return self.system.control.time.numpy()

    @property
    def steps(self) -> np.ndarray:
        """Steps taken by every cell, shape [cell_count]."""
        return self.system.control.steps.numpy()

    def advance(self, until: float, watch: Callable[[float], None] | None = None) -> None:
        """Advances every cell to one time.

        Args:
            until: simulated time to reach [s].
            watch: called a few times a second with the time reached by the slowest cell [s].

        Errors:
            NumericalError: a guard was violated; the device holds the offending state, frames taken before are sound.
        """
        control, state = self.system.control, self.system.state.data
        waiting = (self.times < until) & (control.fault.numpy() == control_stage.NO_FAULT)
        if not waiting.any():
            return
        control.target.fill_(until)
        state.active.assign(waiting.astype(np.int32))
        control.unfinished.fill_(int(waiting.sum()))
        while control.unfinished.numpy()[0] > 0:
            control.budget.fill_(self._passes_per_replay)
            control.proceed.fill_(1)
            started = clock.perf_counter()
            self._replay()
            done = control.budget.numpy()[0] <= 0
            if done:  # a full replay: aim at a fixed wall time between two looks from the host
                per_pass = (clock.perf_counter() - started) / self._passes_per_replay
                self._passes_per_replay = int(np.clip(_SECONDS_PER_REPLAY / per_pass, 20, 1_000_000))
            if watch is not None:
                watch(float(self.times.min()))
        self._raise_fault()

    def cell_state(self, cell: int = 0) -> CellState:
        """One cell on the host, at the time it has reached; valid after `advance`."""
        s, chart, model = self.system.state, self.system.chart, self.system.model
        flagella, nodes = self._own(cell)
        centre = chart.base_body_position.numpy()[cell]
        elastic.elastic_energy(model, s, self._energy)
        steric_force = 0.0
        if model.switches.steric:
            steric.steric_magnitudes(model, s, self._steric)
            steric_force = 0.5 * float(self._steric.numpy()[nodes].sum(dtype=np.float64))
        return CellState(
            time=float(self.times[cell]),
            step=int(self.steps[cell]),
            positions=chart.base_position.numpy()[nodes].astype(np.float64) + centre,
            directors=chart.base_director.numpy()[nodes].astype(np.float64),
            tangents=chart.base_tangent.numpy()[nodes].astype(np.float64),
            motor_angle=chart.motor_angle.numpy()[flagella].copy(),
            body_angle=float(chart.body_angle.numpy()[cell]),
            body_position=centre.copy(),
            body_orientation=chart.base_body_orientation.numpy()[cell].copy(),
            elastic_energy=self._energy.numpy()[nodes].sum(axis=0, dtype=np.float64),
            steric_force=steric_force,
        )

    def evaluate(self, cell: int = 0) -> Evaluation:
        """Forces and velocities of one cell at its present state; advances nothing."""
        model, s, chart = self.system.model, self.system.state, self.system.chart
        s.data.active.fill_(1)
        for array in (chart.increment, chart.body_increment, chart.elapsed, chart.commit):
            array.zero_()
        chart_stage.place(model, s, chart)
        launch_right_hand_side(model, s)
        s.data.active.zero_()
        flagella, nodes = self._own(cell)

        def host(array: Any, part: Any) -> np.ndarray:
            return array.numpy()[part].astype(np.float64)

        torques = host(s.data.spin_torque, nodes)
        mobility = np.repeat(model.data.spin_mobility.numpy(), np.diff(self._first_node))[nodes]
        return Evaluation(
            forces=host(s.data.force, nodes),
            torques=torques,
            velocities=host(s.data.velocity, nodes),
            spins=mobility * torques,
            body_force=host(s.data.flagellum_force, flagella).sum(axis=0),
            body_torque=host(s.data.flagellum_torque, flagella).sum(axis=0),
            body_velocity=host(s.data.body_velocity, cell),
            body_spin=host(s.data.body_spin, cell),
        )

    def _own(self, cell: int) -> tuple[slice, slice]:
        """The flagella and the nodes of one cell."""
        flagella = slice(self._first_flagellum[cell], self._first_flagellum[cell + 1])
        return flagella, slice(self._first_node[flagella.start], self._first_node[flagella.stop])

    def _replay(self) -> None:
        control = self.system.control
        if not self._capture:
            while control.proceed.numpy()[0] > 0:
                self.stepper.launch_pass()
            return
        if self._graph is None:
            # Compile and load every kernel before the capture, with no cell taking part.
            active = self.system.state.data.active
            waiting = active.numpy().copy()
            active.zero_()
            self.stepper.launch_pass()
            active.assign(waiting)
            control.proceed.fill_(1)
            with wp.ScopedCapture(device=self.device) as captured:
                wp.capture_while(control.proceed, self.stepper.launch_pass)
            self._graph = captured.graph
        wp.capture_launch(self._graph)

    def _raise_fault(self) -> None:
        faults = self.system.control.fault.numpy()
        for cell in np.flatnonzero(faults != control_stage.NO_FAULT):
            kind, element = guard.decode(int(faults[cell]))
            flagellum = int(np.searchsorted(self._first_node, element, side="right")) - 1
            segment = element - int(self._first_node[flagellum])
            own = flagellum - int(self._first_flagellum[cell])
            raise NumericalError(kind, float(self.times[cell]), int(cell), own, segment)


def _control(cells: int, starts: Sequence[InitialState], device: Any) -> Any:
    c = control_stage.Control()
    c.time = wp.array([start.time for start in starts], dtype=wp.float64, device=device)
    c.target, c.longest_step, c.step = (wp.zeros(cells, dtype=wp.float64, device=device) for _ in range(3))
    c.steps = wp.zeros(cells, dtype=wp.int32, device=device)
    c.fault = wp.full(cells, control_stage.NO_FAULT, dtype=wp.int32, device=device)
    c.unfinished, c.budget, c.proceed = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(3))
    return c


def _guard(model: Any) -> Any:
    g = guard.struct(model.precision)()
    g.interval = wp.ones(model.cell_count, dtype=wp.int32, device=model.device)
    g.position = wp.zeros(model.element_count, dtype=model.precision.vec3, device=model.device)
    return g
