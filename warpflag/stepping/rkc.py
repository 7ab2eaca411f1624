"""Runge-Kutta-Chebyshev stepping (and Euler, its one-stage case) of every cell of a system."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp
from warpflag_kernels.base import clock
from warpflag_kernels.rod import comoving_chart, reconstruction
from warpflag_kernels.stepping import dense_output, evaluation_time, health, rkc, rkc_arrays, rkc_estimate, terms
from warpflag_kernels.stepping.frame_slots import DenseOutput
from warpflag_kernels.stepping.right_hand_side import launch_right_hand_side

from warpflag.scene import Scene
from warpflag.scene.resistance import filament_mobility
from warpflag.stepping.stepper import System, allocated_control, recalled, restart_step_control, step_memory

__all__ = ["EULER_STEPS_PER_CHECK", "RkcStepper", "euler_step"]

LONGEST_STEP = 1.0e-4
"""Longest step of RKC under accuracy control [s]."""
EULER_STEPS_PER_CHECK = 100
"""Steps of Euler between two checks by the guards."""


def euler_step(scene: Scene) -> float:
    """Largest sound step of explicit Euler [s]: 0.9 of the limit set by the hook's and the filament's twist."""
    rate = 0.0
    for spec in scene.resolved_flagella():
        h, group = spec.segment_length, scene.flagella
        spin = filament_mobility(scene, h).spin
        # Gershgorin bound of the twist chain: tripod - hook - filament.
        hook = group.hook_twist_factor * group.twist_rigidity / h
        twist = spin * (2 * hook + 2 * group.twist_rigidity / h)
        along, across = filament_mobility(scene, h).along, filament_mobility(scene, h).across
        stretch = 4 * group.stretching_stiffness / h * (along + across)
        rate = max(rate, twist + stretch + 16 * group.bending_rigidity / h**3 * across)
    return 0.9 * 2.0 / rate


class RkcStepper:
    """RKC2, its spectral radius measured by a nonlinear power method; explicit Euler has one stage and measures none.

    Args:
        system: what to advance.
        scenes: one per cell; `numerics.time_step` fixes the step, else `numerics.accuracy` controls it.
        euler: explicit Euler in place of RKC2.
    """

    def __init__(self, system: System, scenes: Sequence[Scene], euler: bool) -> None:
        self._system, self._euler = system, euler
        device = system.model.device
        self.data = rkc_arrays.allocate(system.model)
        fixed = [bool(s.numerics.time_step) or euler for s in scenes]
        self.steps = allocated_control(scenes, fixed, device)
        longest = [s.numerics.time_step or (euler_step(s) if euler else LONGEST_STEP) for s in scenes]
        system.control.longest_step.assign(longest)
        system.guard.interval.fill_(EULER_STEPS_PER_CHECK if euler else 1)
        self.dense: DenseOutput | None = None
        self.ends_at_frames = euler  # which is checked at targets, and not after every step
        self._seed_probe()
        self.restart()

    def launch_pass(self) -> None:
        s = self._system
        rkc.begin_pass(s.model, s.state, s.chart, s.control, self.steps, self.data, self._euler)
        reconstruction.reconstruct(s.model, s.state, s.chart)
        if s.model.timed:
            evaluation_time.of_stage(s.state, s.control, s.chart, s.model.device)
        launch_right_hand_side(s.model, s.state)
        # Most passes are stages inside a step: what happens between steps is not even launched there.
        wp.capture_if(s.control.between_steps, self._launch_between_steps)
        comoving_chart.increment_rates(s.model, s.state, s.chart)
        rkc.end_pass(s.model, s.state, s.chart, s.control, self.data, self._euler)
        clock.count_pass(s.control, s.model.device)

    def _launch_between_steps(self) -> None:
        s = self._system
        health.check(s.model, s.state, s.chart, s.guard, s.control)
        if not self._euler:
            comoving_chart.increment_rates(s.model, s.state, s.chart)
            rkc_estimate.judge(s.model, s.state, s.chart, s.control, self.steps, self.data)
        if self.dense is not None:
            dense_output.take(s.model, s.state, s.chart, s.control, self.dense, counted=False)
        comoving_chart.commit(s.model, s.state, s.chart)
        health.remember(s.model, s.state, s.chart, s.guard, s.control)
        terms.after_step(s.model, s.state, s.chart, s.control, counted=False)
        if any(term.jumps for term in s.model.terms):  # the next step begins with other forces
            launch_right_hand_side(s.model, s.state)
        if not self._euler:
            comoving_chart.fit_flagellum_spin(s.model, s.state, s.chart)

    def restart(self) -> None:
        restart_step_control(self.steps, np.zeros(len(self.steps.error_rate)))
        self.data.stage.fill_(-1)
        self.data.stages.fill_(1)
        self.data.probes_left.fill_(rkc.FIRST_PROBES)

    def memory(self) -> dict[str, np.ndarray]:
        names = ("stage", "start_rate", "body_start_rate", "evaluations")
        names += ("probe", "probe_norm", "probes_left", "spectral_radius")
        kept = {name: getattr(self.data, name).numpy().copy() for name in names}
        return kept | step_memory(self.steps)

    def recall(self, memory: dict[str, np.ndarray]) -> None:
        for name, values in recalled(self.steps, memory).items():
            getattr(self.data, name).assign(values)

    def _seed_probe(self) -> None:
        """A direction with a share of every mode: random, but the same in every run and every cell."""
        model = self._system.model
        first = model.data.first_node.numpy()
        cell_first = first[model.data.first_flagellum.numpy()]
        probe = np.zeros((model.element_count, 4))
        norms = np.zeros(model.cell_count)
        h = np.repeat(model.data.rod.segment_length.numpy().astype(np.float64), np.diff(first))
        for c in range(model.cell_count):
            cell = slice(cell_first[c], cell_first[c + 1])
            random = np.random.default_rng(0).standard_normal((cell.stop - cell.start, 4))
            norms[c] = np.linalg.norm(random)
            probe[cell] = random
        probe[:, :3] *= h[:, None]
        probe[first[:-1], :3] = 0.0
        self.data.probe.assign(probe)
        self.data.probe_norm.assign(norms)
