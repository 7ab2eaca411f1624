"""The error of a step of RKC2, by the estimate embedded in the method, and whether the step is taken.

Sommeijer, Shampine, Verwer, J. Comput. Appl. Math. 88, 315 (1997). From increments Y and rates F at the start (0) and
the end (s) of a step:

    error = 4/5 (Y_0 - Y_s) + 2/5 dt (F_0 + F_s)
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import clock
from warpflag_kernels.base.clock import NO_FAULT, Control
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.stepping import accuracy, step_control
from warpflag_kernels.stepping.health import Fault, encode
from warpflag_kernels.stepping.rkc_arrays import struct
from warpflag_kernels.stepping.step_control import StepControl

EPSILON = {"float64": 1.1e-16, "float32": 6.0e-8}  # half a unit in the last place of 1
# Share of the embedded estimate that counts: errors of runs are then 0.02 to 0.6 of what the accuracy allows
# (docs/numerics.md).
ESTIMATE_SHARE = 0.1
# Displacement of nodes per angle of spin [um]: the radius of the helix of a flagellum of E. coli. Spins count where a
# motor's torque depends on its rate: a wrong turn of the tripod is not undone there.
SPIN_LEVER = 0.2
# Where a motor is let go or caught, its tripod's velocity jumps by hundreds of turns per second. A step across that is
# accepted once its estimate is below what the accuracy allows in this time [s].
LONGEST_JUMP = 2.0e-5
ROUND_OFF_FACTOR = 5.0  # an estimate below this times its usual round-off is taken to be round-off


@functools.cache
def _kernels(p: Precision, motor_law: bool) -> SimpleNamespace:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Chart, Rkc = chart_stage.struct(p), struct(p)
    f = step_control.functions(p, independent=False)
    accept, smallest = f.accept, f.smallest
    add_estimate = accuracy.functions(independent=False).add
    advanced = clock.functions().advanced
    module = p.module("rkc_estimate", "motor_law" * motor_law)
    weights = (round(x * ESTIMATE_SHARE, 12) for x in (0.4, 0.8, 0.4 * ROUND_OFF_FACTOR))
    rate_weight, increment_weight, round_off_weight = (wp.constant(real(x)) for x in weights)
    epsilon, lever = wp.constant(real(EPSILON[p.name])), wp.constant(real(SPIN_LEVER))
    longest_jump = wp.constant(wp.float64(LONGEST_JUMP))
    no_fault, inaccurate = wp.constant(wp.int32(NO_FAULT)), wp.constant(wp.int32(encode(Fault.ACCURACY)))

    @wp.kernel(module=module)
    def estimate(
        # Model:
        model: Model,
        # State:
        state: State,
        control: Control,
        chart: Chart,
        # Out:
        rkc: Rkc,
    ):
        k = wp.tid()
        e = model.first_node[k]
        c = model.cell_of[e]
        if state.active[c] == 0 or chart.commit[c] == 0:
            return
        # ESTIMATE_SHARE of the embedded estimate, in the chart of this step, in which Y_0 is 0.
        dt = real(control.step[c])
        last = model.first_node[k + 1] - 1
        worst = real(0.0)
        while e <= last:
            d = rate_weight * dt * (rkc.start_rate[e] + chart.rate[e]) - increment_weight * chart.increment[e]
            worst = wp.max(worst, wp.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2]))
            if wp.static(motor_law):
                worst = wp.max(worst, lever * wp.abs(d[3]))
            e += 1
        # Rates carry the round-off of positions times the stiffness of the stretch; an estimate below ROUND_OFF_FACTOR
        # times that is taken to be round-off.
        reach = real(last - model.first_node[k]) * model.rod.segment_length[k]
        force = epsilon * reach * model.rod.stretching_stiffness[k] / model.rod.segment_length[k]
        rkc.round_off[k] = round_off_weight * dt * model.drag.mobility_along[last] * force
        rkc.error[k] = worst

    @wp.kernel(module=module)
    def decide(
        # Model:
        model: Model,
        # State:
        state: State,
        rkc: Rkc,
        # Out:
        control: Control,
        steps: StepControl,
        chart: Chart,
    ):
        c = wp.tid()
        if state.active[c] == 0 or chart.commit[c] == 0:
            return
        error = wp.float64(0.0)
        round_off = wp.float64(0.0)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            error = wp.max(error, wp.float64(rkc.error[k]))
            round_off = wp.max(round_off, wp.float64(rkc.round_off[k]))
            k += 1
        sound = control.fault[c] == no_fault and wp.isfinite(error)
        fixed = steps.error_rate[c] <= wp.float64(0.0)
        if wp.static(motor_law) and error > longest_jump * steps.error_rate[c]:
            steps.rejected_error[c] = wp.float64(0.0)  # shorter steps do help where a tripod's velocity jumps
        if accept(steps, c, control.step[c], error, round_off, sound, True):
            if add_estimate(steps.achieved, c, control.step[c], error, advanced(control, c), steps.shortest[c]):
                control.fault[c] = inaccurate
        elif not fixed and control.step[c] > smallest:
            control.fault[c] = no_fault
            chart.commit[c] = 0
            chart.at_start[c] = 0

    return SimpleNamespace(estimate=estimate, decide=decide)


def judge(model: DeviceModel, state: DeviceState, chart: Any, control: Control, steps: StepControl, rkc: Any) -> None:
    """Estimates the error of every completed step and clears `commit` where the step is rejected.

    Args:
        model, state: of the batch.
        chart: struct `Chart` of `comoving_chart`; `commit` is 1 where a step is complete.
        control: the cells' clocks.
        steps: step control of the cells.
        rkc: struct `Rkc`; `error` [um] and `round_off` [um] are written, per flagellum.
    """
    kernels = _kernels(model.precision, model.switches.has("motor law"))
    inputs = [model.data, state.data, control, chart, rkc]
    wp.launch(kernels.estimate, model.flagellum_count, inputs=inputs, device=model.device)
    inputs = [model.data, state.data, rkc, control, steps, chart]
    wp.launch(kernels.decide, model.cell_count, inputs=inputs, device=model.device)
