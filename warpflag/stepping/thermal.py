"""Stepping with thermal noise: `warpflag_kernels.thermal`, for scenes with a temperature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from warpflag_kernels.base import clock
from warpflag_kernels.base.types import DeviceModel, DeviceState
from warpflag_kernels.contact import contact_list, search
from warpflag_kernels.fluid import body, body_noise, lanczos, lanczos_space, node_velocity, noise
from warpflag_kernels.implicit import (
    block_band,
    collocation,
    contact_solve,
    delassus,
    krylov,
    linearised,
    motor_solve,
    quasi_newton,
    stability,
    step_flow,
)
from warpflag_kernels.rod import chain_chart, comoving_chart, forces, hessian, reconstruction
from warpflag_kernels.stepping import dense_output, evaluation_time, health, terms
from warpflag_kernels.stepping.frame_slots import DenseOutput
from warpflag_kernels.stepping.right_hand_side import launch_right_hand_side
from warpflag_kernels.thermal import (
    additive_chart,
    closing,
    end_strains,
    equilibrium,
    mean_drift,
    strain_gradients,
    turned_forces,
)

from warpflag.scene import Scene
from warpflag.scene.resistance import thermal_energy
from warpflag.stepping.rkc import euler_step
from warpflag.stepping.stepper import System

__all__ = ["THERMAL_STEP", "ThermalStepper", "thermal_step"]

THERMAL_STEP = 1.0e-6
"""Step of `implicit` with a temperature where `numerics.time_step` is absent [s]."""
EULER_SHARE = 0.05
"""The same of `euler`, over the longest sound step: the stiffest mode is then 5 % too warm, 1/(1 - z/2)."""
RKC_SHARE = 0.11
"""The same of `rkc`: the stiffest mode, z = 0.2, is then 1 % too cold, (1 - z/2)/(1 - z/2 + z^2/4)."""
RENEWALS = 1
"""How often closest points are found anew where the step leads, before the full mobility is solved with; two change
nothing beyond 1 %, none leaves contact energies of parallel filaments 30 % too large at 1e-6 s."""
GMRES_PRODUCTS = 8
"""Of GMRES: at 1e-5 s six leave the bends of two filaments 0.05 um apart 0.6 % colder than twelve, eight 0.2 %."""


def thermal_step(scene: Scene) -> float:
    """The fixed step of a scene with a temperature [s]."""
    numerics = scene.numerics
    if numerics.time_step or numerics.stepper == "implicit":
        return numerics.time_step or THERMAL_STEP
    return (EULER_SHARE if numerics.stepper == "euler" else RKC_SHARE) * euler_step(scene)


@dataclass(frozen=True)
class Parts:
    """What a step works on: structs `Control`, `Chart`, `Band`, `Contacts`, `ContactLaw`; empty where it needs none."""

    control: Any
    chart: Any
    band: Any
    contacts: Any
    law: Any


class ThermalStepper:
    """Fixed steps with thermal noise, linearly implicit with a random elastic force, or explicit: Euler-Maruyama, or
    RKC of two stages with the noise held over the step.

    Args:
        system: what to advance.
        scenes: one per cell, all with a temperature; `numerics.time_step` is the step.
        name: of the stepper.

    Attributes:
        noise: the struct `Noise`.
        lanczos: the process that draws the noise of the pair sum; None where there is none.
        motors: the struct `MotorSolve`; None where torques are constant.
        stiffness, band, flow: structs `Stiffness`, `Band`, `StepFlow`, of the start of the step; of an explicit stepper
            none.
    """

    def __init__(self, system: System, scenes: Sequence[Scene], name: str) -> None:
        explicit = name != "implicit"
        self._system, self._explicit, self._two_stages = system, explicit, name == "rkc"
        # Between its ends the path of a step is unknown: frames are ends of steps.
        self.dense: DenseOutput | None = None
        self.ends_at_frames = True
        model = system.model
        p, device = model.precision, model.device
        energies = [thermal_energy(scene) for scene in scenes]
        self.noise = noise.allocate(model, energies, [scene.fluid.seed for scene in scenes])
        self._flows = model.switches.pairs != "none"
        self.lanczos: Any = None
        if self._flows:
            self.lanczos = lanczos.allocate(model, [scene.fluid.noise_tolerance or 0.0 for scene in scenes])
        self._x, self._solved = chain_chart.allocate(model), None
        self._work = additive_chart.allocate(model)
        self._terms = tuple(term.within_step or term for term in model.terms)
        self._smooth_terms = tuple(term for term in self._terms if not term.contact)
        self.motors: Any = None
        self._touching = model.touching and not explicit
        self.stability: Any = None
        if self._two_stages:
            self._stage, self._solved = chain_chart.allocate(model), chain_chart.allocate(model)
        if explicit:
            band, contacts, law = block_band.types(p).Band(), contact_list.struct(p)(), delassus.struct(p)()
        else:
            band = block_band.allocate(model)
            contacts = contact_list.allocate(model, self._touching)
            law = delassus.allocate(model, contacts)
            quasi_newton.allocate(model, contacts, law)
            self.flow = step_flow.allocate(model)
            self.drift, self._turned = mean_drift.allocate(model), turned_forces.allocate(model)
            self.stiffness, self.strains = hessian.allocate(model), strain_gradients.allocate(model)
            self._solved, self._product = chain_chart.allocate(model), chain_chart.allocate(model)
            self._linear = chain_chart.allocate(model)
            self._magnitude = wp.zeros(len(contacts.gap), dtype=p.real, device=device)
            self._no_share = wp.zeros(model.cell_count, dtype=wp.float64, device=device)
            linearised.allocate(model, system.state)
            if model.switches.has("motor law"):
                self.motors = motor_solve.allocate(model)
                self.motors.time.assign([scene.motor.averaging_time for scene in scenes])
                # There is no earlier step: its ratio to this one is zero.
                self._data, self._none = collocation.allocate(model), chain_chart.allocate(model)
            if self._flows:
                self._krylov = krylov.allocate(model, GMRES_PRODUCTS)
                self.stability = stability.allocate(model)
                self._in_contact = stability.allocate(model)
                self._change, self._by_contacts = chain_chart.allocate(model), chain_chart.allocate(model)
                self.stability.strong.fill_(1)  # every cell is solved with the full mobility
        self.band = band
        self._parts = Parts(system.control, system.chart, band, contacts, law)
        system.control.longest_step.assign([thermal_step(scene) for scene in scenes])
        system.guard.interval.fill_(1)
        self.restart()

    def launch_pass(self) -> None:
        s, parts, explicit = self._system, self._parts, self._explicit
        model, state = s.model, s.state
        equilibrium.begin_step(model, state, parts, explicit)
        if model.timed:
            evaluation_time.within_step(state, s.control, self._data.one, model.device)
        reconstruction.go_back(model, state, s.chart)
        noise.draw_local(model, state, s.control, self.noise, drifting=explicit)
        if explicit:
            self.draw_flows(in_single=False)
            self._add_divergence()
            launch_right_hand_side(model, state)
        else:
            self._evaluate()
            strain_gradients.stiffness_without_prestress(model, state, self.strains, self.stiffness)
            linearised.factorise(model, state, self.stiffness, parts.band)
            if self.motors is not None:
                motor_solve.prepare(model, state, parts.band, self.motors)
            additive_chart.give_back(model, state, s.chart, self._work, s.control.step, self.noise)
        equilibrium.right_hand_side(model, state, parts, self.noise, self._x, explicit)
        if not explicit:
            self._remember_drift()
        x = self._second_stage() if self._two_stages else self._x if explicit else self._solve()
        additive_chart.retract(model, state, s.chart, x, self._work, restoring=not explicit)
        if not explicit:
            turned_forces.find(model, state, s.chart, self.strains, x, s.control.steps, self._turned)
        listed = parts.contacts if self._touching else None
        health.check(model, state, s.chart, s.guard, s.control, listed)
        equilibrium.decide(model, state, parts, explicit)
        if self.dense is not None:
            dense_output.take(model, state, s.chart, s.control, self.dense, counted=True)
        comoving_chart.commit(model, state, s.chart)
        health.remember(model, state, s.chart, s.guard, s.control)
        terms.after_step(model, state, s.chart, s.control, counted=True)
        equilibrium.finish_step(model, state, parts, explicit)
        clock.count_pass(s.control, model.device)

    def _second_stage(self) -> Any:
        """The increment of RKC of second order with two stages, undamped: dt [2 F(q + dt F/4) - F(q)], noise in F."""
        s, first, stage, found = self._system, self._x, self._stage, self._solved
        model, state = s.model, s.state
        equilibrium.right_hand_side(model, state, self._parts, self.noise, stage, True, share=0.25)
        additive_chart.retract(model, state, s.chart, stage, self._work, restoring=False)
        launch_right_hand_side(model, state)
        equilibrium.right_hand_side(model, state, self._parts, self.noise, stage, True)
        reconstruction.go_back(model, state, s.chart)
        closing.set_difference(model, state, stage, first, found)
        closing.add(model, state.data.active, stage, found)
        return found

    def draw_flows(self, in_single: bool) -> None:
        """Thermal velocities of the pair sum, and of the flow round the body, at the pose of the step's start.

        Args:
            in_single: whether products are made in single precision, with the coefficients stored for the step.
        """
        s = self._system
        model, state = s.model, s.state
        if not self._flows:
            return
        around = model.switches.flows.body
        pair = model.precision.single if in_single else model.plan.pair_precision
        shell = self.flow.shell if in_single else state.shell

        def velocities(model: DeviceModel, state: DeviceState) -> None:
            if around:
                body.obstruct(model, state, shell if in_single else None)
            if in_single:
                step_flow.single_velocities(model, state, self.flow)
            else:
                node_velocity.node_velocities(model, state)

        if around:
            body_noise.hold_bodies(model, state)
        lanczos.draw_pairs(model, state, s.control, self.noise, self.lanczos, velocities)
        if around:
            body_noise.carry(model, state, self.noise, shell, pair)

    def _add_divergence(self) -> None:
        """The drift by the flow round the body, of a step that resolves all modes."""
        s = self._system
        if s.model.switches.flows.body:
            body_noise.draw_probe(s.model, s.state, self.noise, s.control.steps)
            body_noise.add_divergence(s.model, s.state, s.chart, self.noise)

    def _evaluate(self) -> None:
        """Thermal velocities, contacts, forces with the random elastic ones, and velocities, where the step starts."""
        s, parts = self._system, self._parts
        model, state, share = s.model, s.state, (2.0 * equilibrium.IMPLICITNESS - 1.0) ** 0.5
        if self._touching:
            search.find(model, state, state.data.pose, parts.contacts)
            closing.check_gaps(model, state, parts.contacts, self.noise, s.control)
            contact_solve.warm_start(model, state, self._no_share, self._x, parts.contacts, parts.law)
            parts.law.force.zero_()  # velocities are found without contacts: their closest points are yet to change
        if self._flows:
            step_flow.build(model, state, self.flow, parts.contacts if self._touching else None)
        self.draw_flows(in_single=step_flow.stores_pairs(model))
        for term in self._smooth_terms:
            if term.launch is not None:
                term.launch(model, state)
        strain_gradients.find(model, state, self.strains)
        strain_gradients.add_random_moments(model, state, self.strains, self.noise, s.control.steps, share)
        turned_forces.add(model, state, self._turned)
        forces.total_forces(model, state, self._smooth_terms)
        if self._touching:
            equilibrium.random_contacts(model, state, parts, self.noise, share, self._magnitude)
            contact_list.act(model, state, parts.contacts, self._magnitude)
        mean_drift.add_forces(model, state, self.drift)
        body.body_motion(model, state, self._terms)
        mean_drift.add_velocities(model, state, self.drift, self.noise)
        node_velocity.node_velocities(model, state)

    def _remember_drift(self) -> None:
        s, shell = self._system, None
        if s.model.switches.flows.body and step_flow.stores_pairs(s.model):
            shell = self.flow.shell
        space = lanczos_space.struct(s.model.precision)() if self.lanczos is None else self.lanczos.data
        mean_drift.remember(s.model, s.state, s.control, self.noise, space, shell, self.drift)

    def _solve(self) -> Any:
        """The increment of the step, from the right side."""
        model, state, parts = self._system.model, self._system.state, self._parts
        linearised.solve(model, state, parts.band, self._x)
        found = self._x
        if self._touching:
            found = self._solved
            self._solve_contacts(self._x, found)
            for _ in range(RENEWALS):
                self._renew_contacts(found)
                self._solve_contacts(self._x, found)
            if self._flows:
                closing.set_difference(model, state, found, self._x, self._by_contacts)
                closing.mark(model, state, parts.contacts, parts.law, self._in_contact, anew=True)
        if self.motors is not None:
            self._solve_motors(found)
        if self._flows:
            self._solve_in_full(found, self.stability)
        room = self._linear, self._product
        end_strains.correct(model, state, self._system.chart, self.strains, parts.band, self._work, room, found)
        if self._flows and self._touching:
            self._close(found)
        if self.motors is not None:
            self._solve_motors(found)
        if self.motors is not None:
            motor_solve.average_rates(model, state, parts.band, self.motors, found)
        return found

    def _solve_contacts(self, start: Any, out: Any) -> None:
        model, state, parts = self._system.model, self._system.state, self._parts
        contact_solve.solve(model, state, parts.contacts, parts.band, self.flow, start, parts.law, out)

    def _renew_contacts(self, x: Any) -> None:
        s, parts = self._system, self._parts
        closing.renew(s.model, s.state, s.chart, x, self._work, parts.contacts, parts.law)

    def _solve_in_full(self, x: Any, which: Any) -> None:
        """With the full mobility, in the cells that the struct `Stability` calls strong."""
        model, state, parts = self._system.model, self._system.state, self._parts
        krylov.solve(
            model, state, self.stiffness, parts.band, parts.law.gain, which, self._krylov, self._product, x
        )  # fmt: skip

    def _close(self, x: Any) -> None:
        """Solves for contact forces at the pose that the full mobility leads to; adds the response to their change."""
        model, state, parts = self._system.model, self._system.state, self._parts
        self._renew_contacts(x)
        closing.set_difference(model, state, x, self._by_contacts, self._x)
        self._solve_contacts(self._x, self._change)
        closing.mark(model, state, parts.contacts, parts.law, self._in_contact, anew=False)
        closing.set_difference(model, state, self._change, x, self._change)
        wp.capture_if(self._in_contact.any_strong, self._add_change, x=x)

    def _add_change(self, x: Any) -> None:
        self._solve_in_full(self._change, self._in_contact)
        closing.add(self._system.model, self._in_contact.strong, self._change, x)

    def _solve_motors(self, x: Any) -> None:
        """Puts motors on their laws.

        This is done before and after the solution with the full mobility, which shifts their rates a little: the error
        left is of second order in that shift.
        """
        model, state, parts, none = self._system.model, self._system.state, self._parts, self._none
        motor_solve.solve(
            model, state, self._data, parts.band, parts.law.gain, self.motors, none, none, self._data.one, x
        )

    def _left_over(self) -> dict[str, wp.array]:
        """What an implicit step leaves to the next one."""
        if self._explicit:
            return {}
        left = {"owed": self._work.owed} | {f"drift_{name}": getattr(self.drift, name) for name in mean_drift.CARRIED}
        return left | {f"turned_{name}": getattr(self._turned, name) for name in turned_forces.CARRIED}

    def restart(self) -> None:
        """Nothing is left over from earlier steps."""
        for array in self._left_over().values():
            array.zero_()

    def memory(self) -> dict[str, np.ndarray]:
        kept = {"evaluations": self._system.control.steps.numpy().copy()}
        kept |= {name: array.numpy().copy() for name, array in self._left_over().items()}
        if self.lanczos is not None:
            kept["noise_products"] = self.lanczos.data.total.numpy().copy()
        if self.motors is not None:
            kept["held_torque"] = self._system.state.optional.motor.within_step.numpy().copy()
            kept["average_rate"] = self.motors.average.numpy().copy()
        return kept

    def recall(self, memory: dict[str, np.ndarray]) -> None:
        for name, array in self._left_over().items():
            if name in memory:  # not in checkpoints of versions that did not have it
                array.assign(memory[name])
        if self.lanczos is not None:
            self.lanczos.data.total.assign(memory["noise_products"])
        if self.motors is not None:
            self._system.state.optional.motor.within_step.assign(memory["held_torque"])
            self.motors.average.assign(memory["average_rate"])
