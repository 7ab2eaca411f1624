"""Linearly implicit stepping of every cell of a system, with exact contacts: `warpflag_kernels.implicit`."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from warpflag_kernels.base import clock
from warpflag_kernels.contact import contact_list, search
from warpflag_kernels.fluid import body, node_velocity
from warpflag_kernels.implicit import (
    block_band,
    block_band_simd,
    collocation,
    contact_solve,
    delassus,
    frozen_flow,
    predictor_velocity,
    quasi_newton,
    stability,
)
from warpflag_kernels.rod import chain_chart, comoving_chart, elastic, forces, hessian
from warpflag_kernels.stepping import health

from warpflag.scene import Scene
from warpflag.stepping.stepper import (
    DEFAULT_ACCURACY,
    STEP_MEMORY,
    System,
    build_step_control,
    restart_step_control,
)

__all__ = ["ImplicitStepper"]

LONGEST_STEP = 3.0e-5
"""Longest step that the accuracy control takes [s]."""
ROUGH = 2.0
"""How many times their tolerance is enough for the gaps of the first iteration."""
OVER_IMPLICIT_CROWD = 3.0
"""Over-implicitness with which three flagella or more begin, until it has been measured."""


class ImplicitStepper:
    """Linearly implicit collocation; `numerics.time_step` fixes the step, else `numerics.accuracy` controls it.

    Args:
        system: what to advance.
        scenes: one per cell.
    """

    def __init__(self, system: System, scenes: Sequence[Scene]) -> None:
        self._system = system
        model = system.model
        self._contactless = dataclasses.replace(
            model, switches=dataclasses.replace(model.switches, steric=False, body_contact=False)
        )
        self._touches = model.switches.steric or model.switches.body_contact
        p, device = model.precision, model.device
        cells, flagella, elements = model.cell_count, model.flagellum_count, model.element_count

        def zeros(count: int, dtype: Any) -> wp.array:
            return wp.zeros(max(count, 1), dtype=dtype, device=device)

        # Poses that share the arrays of the state and of the start of the step.
        t, now, base = chain_chart.types(p), system.state.data, system.chart
        self._now, self._base = t.Pose(), t.Pose()
        for name in t.Pose.vars:
            setattr(self._now, name, getattr(now, name))
        self._base.position, self._base.tangent = base.base_position, base.base_tangent
        self._base.director = base.base_director
        self._base.body_position, self._base.body_orientation = base.base_body_position, base.base_body_orientation

        def increment() -> Any:
            x = t.Increment()
            x.node, x.body = zeros(elements, p.vec4), zeros(cells, t.vec6)
            return x

        self._last, self._before, self._next_last, self._next_before = (increment() for _ in range(4))
        self._predicted, self._expected, self._found, self._nothing = (increment() for _ in range(4))
        self._carried, self._carried_on, self._free, self._step = (increment() for _ in range(4))
        self._total, self._rest = increment(), increment()

        k = hessian.struct(p)()
        k.ee, k.ff, k.fe, k.stretch = (zeros(elements, p.mat33) for _ in range(4))
        k.e_first, k.e_second, k.f_first, k.f_second, k.spins = (zeros(elements, p.vec3) for _ in range(5))
        self._stiffness = k

        bt = block_band.types(p)
        b = bt.Band()
        b.step, b.weight = zeros(cells, wp.float64), zeros(cells, wp.float64)
        b.diagonal, b.lower1, b.lower2 = (zeros(elements, bt.mat44) for _ in range(3))
        b.tangent = zeros(elements, p.vec3)
        b.drag_across, b.drag_excess = zeros(elements, p.real), zeros(elements, p.real)
        b.to_body, b.from_body = zeros(3 * flagella, bt.mat46), zeros(3 * flagella, bt.mat46)
        b.body_block, b.body_columns = zeros(flagella, bt.mat66), zeros(6 * elements, p.vec4)
        b.body_inverse, b.singular = zeros(cells, bt.mat66), zeros(cells, wp.int32)
        b.groups = model.groups
        if model.one_thread_per_cell:
            b.factors = block_band_simd.build(p, model.groups)
        self._band = b

        self._contacts = contact_list.allocate(model, self._touches)
        self._law, self._flow = delassus.allocate(model, self._contacts), frozen_flow.allocate(model)
        quasi_newton.allocate(p, cells, len(self._contacts.gap), device, self._law)
        i = collocation.struct(p)()
        i.over_implicit = zeros(cells, wp.float64)
        i.last_step, i.step_before, i.ratio, i.theta, i.reach = (zeros(cells, wp.float64) for _ in range(5))
        i.curved, i.ratio_before = zeros(cells, wp.float64), zeros(cells, wp.float64)
        i.one = wp.ones(cells, dtype=wp.float64, device=device)
        i.history, i.accepted, i.evaluations = (zeros(cells, wp.int32) for _ in range(3))
        i.missed, i.predicted = zeros(flagella, p.real), zeros(flagella, p.real)
        i.trust, i.ahead = zeros(cells, wp.float64), zeros(cells, wp.float64)
        self.data = i
        fixed = [scene.numerics.time_step for scene in scenes]
        accuracies = [0.0 if f else s.numerics.accuracy or DEFAULT_ACCURACY for f, s in zip(fixed, scenes, strict=True)]
        self.steps = build_step_control(accuracies, device)
        # Three flagella or more need their over-implicitness measured.
        self.stability: Any = None
        if model.switches.pairs != "none" and max(len(s.resolved_flagella()) for s in scenes) > 2:
            self.stability = self._stability_arrays(increment())
        system.control.longest_step.assign([f or LONGEST_STEP for f in fixed])
        system.guard.interval.fill_(1)
        self.restart()

    def launch_pass(self) -> None:
        s, i, band = self._system, self.data, self._band
        model, state, device = s.model, s.state, s.model.device
        k = collocation.kernels(model.precision)
        law = self._contacts, self._law
        inputs = [model.data, state.data, s.control, self.steps, i, band, *law]
        wp.launch(k.begin, model.cell_count, inputs=inputs, device=device)
        # The first iteration, where the last steps lead.
        inputs = [model.data, state.data, i, self._last, self._before, self._predicted]
        wp.launch(k.predict, model.element_count, inputs=inputs, device=device)
        carry = (self._last, self._predicted, self._carried, self._expected)
        chain_chart.retract(model, state, self._base, i.ahead, self._last, self._now, carry)
        if self._touches:
            search.find(model, state, self._now, self._contacts)
            contact_solve.press(model, state, i.trust, self._expected, self._contacts, self._law)
        if model.switches.pairs != "none":
            frozen_flow.build(model, state, self._flow, self._contacts if self._touches else None)
        self._right_hand_side(predictor_velocity.serves(model))
        hessian.joint_stiffness(model, state, self._stiffness)
        block_band.factorise(model, state, self._stiffness, band)
        x = self._solve(self._carried, self._nothing, first=True)
        # The second, where the first one led.
        carry = (self._carried, x, self._carried_on, self._found)
        chain_chart.retract(model, state, self._now, i.one, x, self._now, carry)
        if self._touches:
            search.renew(model, state, self._now, self._contacts)
        self._right_hand_side()
        x = self._solve(self._carried_on, self._found, first=False)
        inputs = [model.data, state.data, i, self._carried_on, self._found, self._expected, x]
        inputs += [self._total, self._rest, s.chart]
        wp.launch(k.complete, model.flagellum_count, inputs=inputs, device=device)
        carry = (self._total, self._carried_on, self._next_last, self._next_before)
        chain_chart.retract(model, state, self._now, i.one, self._rest, self._now, carry)
        health.check(model, state, s.chart, s.guard, s.control, self._contacts if self._touches else None)
        inputs = [model.data, state.data, band, *law, s.chart, s.control, self.steps, i]
        wp.launch(k.decide, model.cell_count, inputs=inputs, device=device)
        moved = [self._next_last, self._next_before]
        inputs = [model.data, state.data, i, *moved, self._last, self._before]
        wp.launch(k.keep_elements, model.element_count, inputs=inputs, device=device)
        comoving_chart.commit(model, state, s.chart)
        health.remember(model, state, s.chart, s.guard, s.control)
        inputs = [state.data, *moved, i, self._last, self._before, s.control]
        if self.stability is not None:
            stability.schedule(model, state, i.evaluations, i.accepted, self.stability)
            wp.capture_if(self.stability.due, self._measure_stability)
        wp.launch(k.keep_bodies, model.cell_count, inputs=inputs, device=device)
        clock.count_pass(s.control, device)

    def _right_hand_side(self, rough: bool = False) -> None:
        """Velocities at the present pose, with the contact forces found so far."""
        model, state = self._system.model, self._system.state
        elastic.joint_gradients(model, state)
        forces.total_forces(self._contactless, state)
        if self._touches:
            contact_list.act(model, state, self._contacts, self._law.force)
        body.body_motion(model, state)
        if rough:
            predictor_velocity.node_velocities(model, state, self._flow)
        else:
            node_velocity.node_velocities(model, state)

    def _solve(self, last: Any, found: Any, first: bool) -> Any:
        """The increment that is still missing at the present pose.

        Args:
            last, found: the last increment, and what has been found of this one, carried to it.
            first: whether this is the first iteration, whose gaps need not be as fine.
        """
        model, state, law = self._system.model, self._system.state, self._law
        inputs = [model.data, state.data, self.data, self._band, law, last, found, self._free]
        kernel = collocation.kernels(model.precision).right_hand_side
        wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)
        block_band.solve(model, state, self._band, self._free)
        if not self._touches:
            return self._free
        coarse = ROUGH if first else 1.0
        contact_solve.solve(
            model, state, self._contacts, self._band, self._flow, self._free, law, self._step, coarse, first
        )
        return self._step

    def _measure_stability(self) -> None:
        model, state = self._system.model, self._system.state
        stability.measure(
            model, state, self._stiffness, self._band, self._flow, self._law.gain, self._rest,
            self.stability, self.data.over_implicit,
        )  # fmt: skip

    def restart(self) -> None:
        counts = np.diff(self._system.model.data.first_flagellum.numpy())
        self.data.over_implicit.assign(np.where(counts > 2, OVER_IMPLICIT_CROWD, stability.LEAST))
        self.data.history.zero_()
        self.data.trust.zero_()
        restart_step_control(self.steps, self._system.control.longest_step.numpy() / 64)

    def memory(self) -> dict[str, np.ndarray]:
        names = ("last_step", "step_before", "history", "evaluations", "over_implicit", "trust")
        kept = {name: getattr(self.data, name).numpy().copy() for name in names}
        kept |= {name: getattr(self.steps, name).numpy().copy() for name in STEP_MEMORY}
        for name, x in self._increments_kept().items():
            kept |= {f"{name}_node": x.node.numpy().copy(), f"{name}_body": x.body.numpy().copy()}
        return kept

    def recall(self, memory: dict[str, np.ndarray]) -> None:
        carried = self._increments_kept()
        for name, values in memory.items():
            whose, _, part = name.partition("_")
            if part in ("node", "body"):
                getattr(carried[whose], part).assign(values)
            else:
                getattr(self.steps if name in STEP_MEMORY else self.data, name).assign(values)

    def _increments_kept(self) -> dict[str, Any]:
        """Increments that a resumed run needs."""
        kept = {"last": self._last, "before": self._before}
        return kept if self.stability is None else {**kept, "probe": self.stability.probe}

    def _stability_arrays(self, probe: Any) -> Any:
        """What the measurement keeps.

        probe: an increment, filled here with a direction that has a share of every mode: random, but the same in every
        run and every cell.
        """
        model = self._system.model
        cells, device = model.cell_count, model.device
        s = stability.struct(model.precision)()
        s.kappa = wp.zeros(cells, dtype=wp.float64, device=device)
        s.size = wp.zeros(model.flagellum_count, dtype=wp.float64, device=device)
        s.look, s.active = (wp.zeros(cells, dtype=wp.int32, device=device) for _ in range(2))
        s.due = wp.ones(1, dtype=wp.int32, device=device)  # its kernels load in the first pass, which takes no step
        nodes = np.diff(model.data.first_node.numpy()[model.data.first_flagellum.numpy()])
        probe.node.assign(
            np.concatenate([np.random.default_rng(0).standard_normal((n, 4)) / np.sqrt(n) for n in nodes])
        )
        s.probe = probe
        return s
