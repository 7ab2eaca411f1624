"""Stabilised explicit stepping: Runge-Kutta-Chebyshev of second order (RKC2), and Euler as its one-stage case.

Sommeijer, Shampine, Verwer, J. Comput. Appl. Math. 88, 315 (1997). With increments since the start of the step:

    Y_1 = m_1 dt F_0,     Y_j = mu_j Y_(j-1) + nu_j Y_(j-2) + m_j dt F_(j-1) + g_j dt F_0,     s stages.

Every cell has a stage counter of its own and evaluates one right-hand side per pass, so cells of a batch need not agree
on step or number of stages. Its `stage` says what this pass evaluates:

    -1       the state itself, after a start or a change from outside
     0       a point near it, the probe: one iteration of the power method for the spectral radius, which sets s
     1..s    Y_j; the last one is the new state, and its right-hand side is the F_0 of the next step
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import clock
from warpflag_kernels.base.clock import NO_FAULT, STEP_TOLERANCE, Control
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.motor import laws as motor_laws
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.rod.comoving_chart import vec6d
from warpflag_kernels.stepping import chebyshev, step_control
from warpflag_kernels.stepping.health import Fault, encode
from warpflag_kernels.stepping.rkc_arrays import struct
from warpflag_kernels.stepping.step_control import StepControl

DAMPING = 2.0 / 13.0  # of the stability polynomial, as in the paper above
STAGE_FACTOR = 1.54  # stages: 1 + (1 + 1.54 dt spectral radius)^1/2, as in the paper above
# Norm of the probe, spins in rad, displacements in segment lengths: well above the root of
# the unit round-off, at which truncation and round-off of a difference are alike; measured (docs/numerics.md).
PROBE_SIZE = {"float64": 1.0e-6, "float32": 1.0e-3}
# The power method approaches the spectral radius from below; the margin also covers its growth within a step.
RADIUS_MARGIN = 1.15
FIRST_PROBES = 40  # iterations of the power method after a start, from a random vector
MOST_STAGES = 1.0e4  # a stiffer state is not resolved: the step is taken, unstable, and the guards stop the cell


@functools.cache
def _kernels(p: Precision, euler: bool, motor_law: bool = False, by_cells: bool = False) -> SimpleNamespace:
    real, vec4 = p.real, p.vec4
    Model, State = structs(p).Model, structs(p).State
    Chart, Rkc = chart_stage.struct(p), struct(p)
    next_step = step_control.functions(p, independent=False).next_step
    advanced, coefficients = clock.functions().advanced, chebyshev.functions().coefficients
    module = p.module("euler" if euler else "rkc", "_".join([*["motor_law"] * motor_law, *["cells"] * by_cells]))
    damping, radius_margin, probe_size = (
        wp.constant(wp.float64(x)) for x in (DAMPING, RADIUS_MARGIN, PROBE_SIZE[p.name])
    )
    stage_factor, most_stages = wp.constant(wp.float64(STAGE_FACTOR)), wp.constant(wp.float64(MOST_STAGES))
    tolerance = wp.constant(wp.float64(STEP_TOLERANCE))
    no_fault, unstable = wp.constant(wp.int32(NO_FAULT)), wp.constant(wp.int32(encode(Fault.UNSTABLE)))
    twist_bound, next_corner = motor_laws.curves(p).twist_bound, motor_laws.curves(p).next_corner

    @wp.func(module=module)
    def outgrown(control: Control, rkc: Rkc, c: wp.int32):
        """Whether fixed steps are unstable: the last one had too few stages for the spectral radius at its end, or the
        next one would take more than MOST_STAGES."""
        s = wp.float64(rkc.stages[c])
        ended = rkc.spectral_radius[c] * control.step[c] > (s * s - wp.float64(1.0)) / stage_factor
        next = stage_factor * radius_margin * rkc.spectral_radius[c] * control.longest_step[c]
        return (control.steps[c] > 0 and ended) or next > most_stages * most_stages

    @wp.func(module=module)
    def schedule_cell(
        model: Model, steps: StepControl, state: State, control: Control, rkc: Rkc, chart: Chart, c: wp.int32
    ):
        """What this pass evaluates in cell c, and the increment of its body."""
        zero = wp.float64(0.0)
        one = wp.float64(1.0)
        j = rkc.stage[c]
        if j == 1:
            if wp.static(not euler) and steps.error_rate[c] <= zero and outgrown(control, rkc, c):
                control.fault[c] = unstable
                state.active[c] = 0
                wp.atomic_sub(control.unfinished, 0, 1)
                return
            end = control.target[c]
            if wp.static(motor_law):  # no estimate sees one within a step
                end = next_corner(model, c, control.time[c], end)
            left = end - control.time[c]
            if steps.error_rate[c] > zero:
                control.step[c] = next_step(steps, c, control.longest_step[c], left)
            else:
                count = wp.max(wp.ceil(left / control.longest_step[c] - tolerance), one)
                control.step[c] = left / count
            if wp.static(euler):
                rkc.stages[c] = 1
            else:
                radius = rkc.spectral_radius[c]
                if wp.static(motor_law):  # a motor on its plateau no longer holds the tripod
                    radius = wp.max(radius, twist_bound(model, c))
                stiffness = radius_margin * radius * control.step[c]
                wanted = wp.min(wp.sqrt(one + stage_factor * stiffness), most_stages)
                rkc.stages[c] = 1 + wp.max(wp.int32(wanted), 1)
        s = rkc.stages[c]
        dt = control.step[c]
        chart.commit[c] = wp.where(j == s, 1, 0)
        chart.at_start[c] = wp.where(j == s or j == -1, 1, 0)
        if j == s or j == -1:
            control.between_steps[0] = 1
        if j <= 0:
            chart.elapsed[c] = zero
            chart.body_increment[c] = vec6d(zero)
            return
        mu = zero
        nu = zero
        m = one
        g = zero
        node = one  # stage time over dt
        if s > 1:
            mu, nu, m, g, node = coefficients(j, s, damping)
        rkc.coefficients[c] = wp.vec4d(mu, nu, m * dt, g * dt)
        chart.elapsed[c] = node * dt
        if j == 1:
            rkc.body_previous[c] = vec6d(zero)
            rkc.body_before_previous[c] = vec6d(zero)
        previous = rkc.body_previous[c]
        rate = chart.body_rate[c]
        if j == 1:
            rate = rkc.body_start_rate[c]
        y = mu * previous + nu * rkc.body_before_previous[c] + (m * dt) * rate + (g * dt) * rkc.body_start_rate[c]
        rkc.body_before_previous[c] = previous
        rkc.body_previous[c] = y
        chart.body_increment[c] = y

    @wp.func(module=module)
    def combine_element(rkc: Rkc, chart: Chart, e: wp.int32, c: wp.int32):
        """Increment of element e at the point that this pass evaluates."""
        j = rkc.stage[c]
        if j == -1:
            chart.increment[e] = vec4(real(0.0))
            return
        if j == 0:
            chart.increment[e] = real(probe_size / rkc.probe_norm[c]) * rkc.probe[e]
            return
        a = rkc.coefficients[c]
        if j == 1:
            first = real(a[2]) * rkc.start_rate[e]
            rkc.before_previous[e] = vec4(real(0.0))
            rkc.previous[e] = first
            chart.increment[e] = first
            return
        previous = rkc.previous[e]
        y = real(a[0]) * previous + real(a[1]) * rkc.before_previous[e] + real(a[2]) * chart.rate[e]
        y += real(a[3]) * rkc.start_rate[e]
        rkc.before_previous[e] = previous
        rkc.previous[e] = y
        chart.increment[e] = y

    @wp.kernel(module=module)
    def schedule(
        # Model:
        model: Model,
        # State:
        steps: StepControl,
        # Out:
        state: State,
        control: Control,
        rkc: Rkc,
        chart: Chart,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        schedule_cell(model, steps, state, control, rkc, chart, c)
        if wp.static(by_cells) and state.active[c] != 0:
            e = model.first_node[model.first_flagellum[c]]
            while e < model.first_node[model.first_flagellum[c + 1]]:
                combine_element(rkc, chart, e, c)
                e += 1

    @wp.kernel(module=module)
    def combine(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        rkc: Rkc,
        chart: Chart,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] != 0:
            combine_element(rkc, chart, e, c)

    @wp.func(module=module)
    def keep_flagellum(model: Model, chart: Chart, rkc: Rkc, k: wp.int32, c: wp.int32):
        """Rates of flagellum k that later passes need."""
        e = model.first_node[k]
        end = model.first_node[k + 1]
        if chart.at_start[c] != 0:
            while e < end:
                rkc.start_rate[e] = chart.rate[e]
                e += 1
        elif rkc.stage[c] == 0:
            scale = real(1.0) / model.rod.segment_length[k]
            total = wp.float64(0.0)
            while e < end:
                d = chart.rate[e] - rkc.start_rate[e]
                rkc.probe[e] = d
                x = scale * scale * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
                total += wp.float64(x + d[3] * d[3])
                e += 1
            rkc.probe_sum[k] = total

    @wp.kernel(module=module)
    def keep(
        # Model:
        model: Model,
        # State:
        state: State,
        chart: Chart,
        # Out:
        rkc: Rkc,
    ):
        k = wp.tid()
        c = model.cell_of[model.first_node[k]]
        if state.active[c] != 0:
            keep_flagellum(model, chart, rkc, k, c)

    @wp.kernel(module=module)
    def turn_over(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        # Out:
        state: State,
        control: Control,
        rkc: Rkc,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        if wp.static(by_cells):
            k = model.first_flagellum[c]
            while k < model.first_flagellum[c + 1]:
                keep_flagellum(model, chart, rkc, k, c)
                k += 1
        rkc.evaluations[c] += 1
        j = rkc.stage[c]
        if chart.at_start[c] != 0:
            rkc.body_start_rate[c] = chart.body_rate[c]
            if chart.commit[c] != 0:
                control.steps[c] += 1
                control.time[c] = advanced(control, c)
            ends = control.time[c] >= control.target[c] or control.fault[c] != no_fault
            if ends or control.rest[c] != 0:
                state.active[c] = 0
                wp.atomic_sub(control.unfinished, 0, 1)
            rkc.stage[c] = wp.static(1 if euler else 0)
        elif j == 0:
            total = wp.float64(0.0)
            k = model.first_flagellum[c]
            while k < model.first_flagellum[c + 1]:
                total += rkc.probe_sum[k]
                k += 1
            norm = wp.sqrt(total)
            rkc.probe_norm[c] = norm
            rkc.spectral_radius[c] = norm / probe_size
            rkc.probes_left[c] -= 1
            if rkc.probes_left[c] <= 0:
                rkc.probes_left[c] = 1
                rkc.stage[c] = 1
        elif j == rkc.stages[c]:
            rkc.stage[c] = 1  # rejected: again, shorter, from the same F_0
        else:
            rkc.stage[c] = j + 1

    return SimpleNamespace(
        schedule=schedule,
        combine=combine,
        keep=keep,
        turn_over=turn_over,
    )


def _kernels_of(model: DeviceModel, euler: bool) -> SimpleNamespace:
    return _kernels(model.precision, euler, not euler and model.switches.has("motor law"), model.plan.by_cells)


def begin_pass(
    model: DeviceModel, state: DeviceState, chart: Any, control: Control, steps: StepControl, rkc: Any, euler: bool
) -> None:
    """Increments of this pass' evaluation point, per cell the state itself, a probe or the next stage."""
    kernels = _kernels_of(model, euler)
    inputs = [model.data, steps, state.data, control, rkc, chart]
    wp.launch(kernels.schedule, model.cell_count, inputs=inputs, device=model.device)
    if not model.plan.by_cells:
        inputs = [model.data, state.data, rkc, chart]
        wp.launch(kernels.combine, model.element_count, inputs=inputs, device=model.device)


def end_pass(model: DeviceModel, state: DeviceState, chart: Any, control: Control, rkc: Any, euler: bool) -> None:
    """Stores what later stages need and advances the stage counter of every cell."""
    kernels = _kernels_of(model, euler)
    if not model.plan.by_cells:
        inputs = [model.data, state.data, chart, rkc]
        wp.launch(kernels.keep, model.flagellum_count, inputs=inputs, device=model.device)
    inputs = [model.data, chart, state.data, control, rkc]
    wp.launch(kernels.turn_over, model.cell_count, inputs=inputs, device=model.device)
