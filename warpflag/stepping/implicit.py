"""Linearly implicit stepping of every cell of a system, with exact contacts: `warpflag_kernels.implicit`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from warpflag_kernels.base import clock
from warpflag_kernels.base.types import DeviceModel
from warpflag_kernels.contact import contact_list, search
from warpflag_kernels.fluid import node_velocity
from warpflag_kernels.implicit import (
    block_band,
    collocation,
    contact_solve,
    delassus,
    krylov,
    linearised,
    motor_solve,
    prediction,
    quasi_newton,
    stability,
    step_flow,
)
from warpflag_kernels.rod import chain_chart, comoving_chart, hessian
from warpflag_kernels.stepping import balance, dense_output, evaluation_time, health, terms
from warpflag_kernels.stepping.frame_slots import DenseOutput
from warpflag_kernels.stepping.right_hand_side import launch_with_contacts

from warpflag.scene import Scene
from warpflag.stepping.stepper import System, allocated_control, recalled, restart_step_control, step_memory

__all__ = ["History", "ImplicitStepper", "Scratch"]

LONGEST_STEP = 7.0e-5
"""Longest step that the accuracy control takes [s]."""
FIRST_TOLERANCE = 2.0
"""Tolerance of the gaps in the first iteration over that in the second."""
_STABILITY_MEMORY = ("kappa", "strong")
OVER_IMPLICIT_CROWD = 3.0
"""Over-implicitness with which three flagella or more begin, until it has been measured."""


@dataclass(frozen=True)
class History:
    """Increments of the last two steps, in the tangent space of one pose; structs `Increment`."""

    last: Any
    before: Any

    @staticmethod
    def allocate(model: DeviceModel) -> History:
        """Increments of zero."""
        return History(chain_chart.allocate(model), chain_chart.allocate(model))


@dataclass(frozen=True)
class Scratch:
    """Increments that live within one pass, structs `Increment`.

    Attributes:
        predicted: e of the quadratic path through the last two steps, at the start of the step.
        expected: the same, transported to the first pose.
        last_at_first, last_at_second: the last step's increment, transported to the first and the second pose.
        start: the increment to the first pose.
        joined: e as the first iteration left it.
        found: the same, transported to the second pose.
        free: solution of an iteration before the contact forces are solved for.
        solved: the same with the contact forces.
        total: the whole step.
        remaining: increment from the second pose to the end of the step.
    """

    predicted: Any
    expected: Any
    last_at_first: Any
    last_at_second: Any
    start: Any
    joined: Any
    found: Any
    free: Any
    solved: Any
    total: Any
    remaining: Any

    @staticmethod
    def allocate(model: DeviceModel) -> Scratch:
        """Increments of zero."""
        return Scratch(*(chain_chart.allocate(model) for _ in range(11)))


class ImplicitStepper:
    """Linearly implicit collocation; `numerics.time_step` fixes the step, else `numerics.accuracy` controls it.

    Args:
        system: what to advance.
        scenes: one per cell.

    Attributes:
        data: the struct `Implicit`.
        steps: the struct `StepControl`.
        balance: the struct `Balance`: the power balance that every step must keep.
        stability: the struct `Stability`; None where nodes cause no flows.
        history: increments of the last two steps.
        stiffness, band, flow: structs `Stiffness`, `Band`, `StepFlow`, of the pose that was linearised last.
        contacts, law: structs `Contacts` and `ContactLaw`.
        motors: the struct `MotorSolve`.
    """

    def __init__(self, system: System, scenes: Sequence[Scene]) -> None:
        self._system = system
        model = system.model
        self._terms = tuple(term.within_step or term for term in model.terms)
        self._touching = model.touching
        self.history, self._moved_history = History.allocate(model), History.allocate(model)
        self._scratch = Scratch.allocate(model)
        self.stiffness = hessian.allocate(model)
        self.band = block_band.allocate(model)
        self.contacts = contact_list.allocate(model, self._touching)
        self.law, self.flow = delassus.allocate(model, self.contacts), step_flow.allocate(model)
        quasi_newton.allocate(model, self.contacts, self.law)
        self.data, self.balance = collocation.allocate(model), balance.allocate(model)
        self._motor_law, self.motors = model.switches.has("motor law"), motor_solve.allocate(model)
        fixed = [scene.numerics.time_step for scene in scenes]
        self.steps = allocated_control(scenes, [bool(f) for f in fixed], model.device)
        # Without flows between nodes the matrix is the whole of the linearised equations.
        self.stability: Any = None
        if model.switches.pairs != "none":
            self.stability = stability.allocate(model)
            linearised.allocate(model, system.state)
            around = krylov.DIMENSION_AROUND_BODIES if model.switches.flows.body else krylov.DIMENSION
            self._krylov = krylov.allocate(model, around)
        system.control.longest_step.assign([f or LONGEST_STEP for f in fixed])
        system.guard.interval.fill_(1)
        self.dense: DenseOutput | None = None
        self.ends_at_frames = False
        self.restart()

    def launch_pass(self) -> None:
        s, i, band, x = self._system, self.data, self.band, self._scratch
        model, state, pose, device = s.model, s.state, s.state.data.pose, s.model.device
        last, before = self.history.last, self.history.before
        k = collocation.kernels(model.precision)
        inputs = [model.data, state.data, self.steps, s.control, i, band, self.contacts, self.law]
        wp.launch(k.begin, model.cell_count, inputs=inputs, device=device)
        if model.timed:
            evaluation_time.within_step(state, s.control, i.theta, device)
        # The first iteration, where the last steps lead.
        prediction.predict(model, state, i, last, before, x.predicted, x.start)
        transported = (last, x.predicted, x.last_at_first, x.expected)
        chain_chart.retract(model, state, s.chart.base, i.one, x.start, pose, transported)
        if self._touching:
            search.find(model, state, pose, self.contacts)
            contact_solve.warm_start(model, state, i.awaited, x.expected, self.contacts, self.law)
        if model.switches.pairs != "none":
            step_flow.build(model, state, self.flow, self.contacts if self._touching else None)
        self._evaluate(in_single=step_flow.stores_pairs(model))
        linearised.set_stiffness(model, state, self.stiffness)
        linearised.factorise(model, state, self.stiffness, band)
        if self._motor_law:
            motor_solve.prepare(model, state, band, self.motors)
        solution = self._solve(x.last_at_first, x.expected, i.begun, first=True)
        prediction.join(model, state, i, x.expected, solution, x.joined)
        # The second, where the first one led.
        transported = (x.last_at_first, x.joined, x.last_at_second, x.found)
        chain_chart.retract(model, state, pose, i.one, solution, pose, transported)
        if self._touching:
            search.renew(model, state, pose, self.contacts)
        self._evaluate()
        balance.gather(model, state, self.balance)
        solution = self._solve(x.last_at_second, x.found, i.one, first=False)
        inputs = [model.data, state.data, x.last_at_second, x.found, x.expected, solution]
        inputs += [i, x.total, x.remaining, s.chart]
        wp.launch(k.complete, model.flagellum_count, inputs=inputs, device=device)
        moved = self._moved_history
        transported = (x.total, x.last_at_second, moved.last, moved.before)
        chain_chart.retract(model, state, pose, i.one, x.remaining, pose, transported)
        balance.weigh(model, state, x.total, self.balance)
        balance.add_up_ramps(model, state, s.chart, s.control, self.balance)
        # What was found is judged, and kept or dropped.
        prediction.assess(model, state, s.control.step, self.steps.achieved.asked, i, self.balance)
        health.check(model, state, s.chart, s.guard, s.control, self.contacts if self._touching else None)
        inputs = [band, self.contacts, self.law, state.data.active, s.chart, s.control, self.steps, i, self.balance]
        wp.launch(k.decide, model.cell_count, inputs=inputs, device=device)
        if self.dense is not None:
            dense_output.take(model, state, s.chart, s.control, self.dense, counted=True)
        inputs = [model.data, state.data, i, moved.last, moved.before, last, before]
        wp.launch(k.keep_elements, model.element_count, inputs=inputs, device=device)
        comoving_chart.commit(model, state, s.chart)
        health.remember(model, state, s.chart, s.guard, s.control)
        terms.after_step(model, state, s.chart, s.control, counted=True)
        if self.stability is not None:
            stability.schedule(model, state, i.evaluations, i.accepted, s.control.longest_step, self.stability)
            wp.capture_if(self.stability.due, self._measure_stability)
        inputs = [moved.last, moved.before, i, state.data, last, before, s.control]
        wp.launch(k.keep_bodies, model.cell_count, inputs=inputs, device=device)
        clock.count_pass(s.control, device)

    def _evaluate(self, in_single: bool = False) -> None:
        """Velocities at the present pose, with the contact forces found so far."""
        model, state = self._system.model, self._system.state
        shell = self.flow.shell if in_single else None
        launch_with_contacts(model, state, self._terms, self.contacts, self.law.force, shell)
        if in_single:
            step_flow.single_velocities(model, state, self.flow)
        else:
            node_velocity.node_velocities(model, state)

    def _solve(self, last: Any, found: Any, weight: Any, first: bool) -> Any:
        """The increment that is still missing at the present pose.

        Args:
            last, found: the last increment, and what has been found of this one, both at the present pose.
            weight: share of `found` that counts, shape [cell_count].
            first: whether this is the first iteration, whose gaps need not be as fine.
        """
        model, state, x = self._system.model, self._system.state, self._scratch
        inputs = [model.data, state.data, self.data, self.band, self.law, last, found, weight, x.free]
        kernel = collocation.kernels(model.precision).right_hand_side
        wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)
        linearised.solve(model, state, self.band, x.free)
        if self._touching:
            contact_solve.solve(
                model, state, self.contacts, self.band, self.flow, x.free, self.law, x.solved,
                coarse=FIRST_TOLERANCE if first else 1.0, anew=first,
            )  # fmt: skip
        if self.stability is not None:
            wp.capture_if(self.stability.any_strong, self._solve_in_full)
        if self._motor_law:
            motor_solve.solve(
                model, state, self.data, self.band, self.law.gain, self.motors, last, found, weight, self._solution
            )
        return self._solution

    @property
    def _solution(self) -> Any:
        """Where an iteration leaves its increment."""
        return self._scratch.solved if self._touching else self._scratch.free

    def _solve_in_full(self) -> None:
        """With the full mobility, and the contact forces found, in cells that are strongly coupled."""
        model, state = self._system.model, self._system.state
        krylov.solve(
            model, state, self.stiffness, self.band, self.law.gain, self.stability, self._krylov,
            self._scratch.remaining, self._solution,
        )  # fmt: skip

    def _measure_stability(self) -> None:
        model, state = self._system.model, self._system.state
        stability.measure(
            model, state, self.stiffness, self.band, self.law.gain, self._scratch.remaining,
            self.stability, self.data.over_implicit, self._system.control.longest_step,
        )  # fmt: skip

    def restart(self) -> None:
        counts = np.diff(self._system.model.data.first_flagellum.numpy())
        few = stability.LEAST_OVER_IMPLICIT if self.stability is None else self.stability.least.numpy()
        self.data.over_implicit.assign(np.where(counts > 2, OVER_IMPLICIT_CROWD, few))
        self.data.history.zero_()
        self.data.share.zero_()
        self.balance.known.zero_()
        self.balance.lasting.zero_()
        if self.stability is not None:
            self.stability.kappa.zero_()
            self.stability.strong.zero_()
        restart_step_control(self.steps, self._system.control.longest_step.numpy() / 64)

    def memory(self) -> dict[str, np.ndarray]:
        names = ("last_step", "step_before", "history", "evaluations", "over_implicit", "share")
        kept = {name: getattr(self.data, name).numpy().copy() for name in names}
        kept |= step_memory(self.steps)
        kept |= {f"balance_{name}": getattr(self.balance, name).numpy().copy() for name in balance.CARRIED}
        if self.stability is not None:
            kept |= {name: getattr(self.stability, name).numpy().copy() for name in _STABILITY_MEMORY}
        if self._motor_law:
            kept["held_torque"] = self._system.state.optional.motor.within_step.numpy().copy()
        for name, x in self._increments_kept().items():
            kept |= {f"{name}_node": x.node.numpy().copy(), f"{name}_body": x.body.numpy().copy()}
        return kept

    def recall(self, memory: dict[str, np.ndarray]) -> None:
        kept = self._increments_kept()
        for name, values in recalled(self.steps, memory).items():
            whose, _, part = name.partition("_")
            if name == "held_torque":
                self._system.state.optional.motor.within_step.assign(values)
            elif part in ("node", "body"):
                getattr(kept[whose], part).assign(values)
            elif whose == "balance":
                getattr(self.balance, part).assign(values)
            elif name in _STABILITY_MEMORY:
                getattr(self.stability, name).assign(values)
                self.stability.any_strong.fill_(1)  # found anew in the first pass
            else:
                getattr(self.data, name).assign(values)

    def _increments_kept(self) -> dict[str, Any]:
        """Increments that a resumed run needs."""
        kept = {"last": self.history.last, "before": self.history.before}
        return kept if self.stability is None else {**kept, "probe": self.stability.probe}
