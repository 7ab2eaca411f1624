"""Step control on the device: from an error estimate per step to the next step, per cell, one rule for every stepper.

The estimate of a second-order step goes as dt^3. A contact that opens or closes makes single estimates jump, though
what adds up over time is the level between the jumps: hence the control follows the fading mean of log(error/dt^3).
A step that follows every fluctuation is less accurate at the same cost.

How errors add up is the stepper's to say. Alike from step to step, they add up as their number, and one step may make
tolerance dt. As good as independent, they add up as the root of it, and one may make tolerance (dt SPAN)^1/2.
"""

import functools
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.clock import STEP_TOLERANCE
from warpflag_kernels.base.precision import Precision

SPAN = 1.0e-3  # over which independent errors add up to what may be made in it [s]
LARGEST_GROWTH = 2.0  # of the step from one to the next: about where two-step methods cease to be stable
REFUSED = 25.0  # a step whose estimate is this many times the tolerance is taken again
SAFETY = 0.8  # of the tolerance that the estimates' mean may reach
MEMORY = 5.0e-4  # of that mean [s]
FORGOTTEN = 0.02  # of that time: a mean of estimates that fade without new ones counts no longer
JUMP = 0.25  # of the error that is left after halving a refused step, when the velocity itself jumps (smooth: 1/8)
SHORTEST_STEP = 2.0e-8  # that an error estimate asks for [s]; only a step that can't be solved goes below
ROUND_OFF = {"float64": 1.0e-14, "float32": 3.0e-7}  # of an error estimate [um]
SMALLEST_STEP = 1.0e-13  # [s]; a step that can't be taken here ends the cell's run


@wp.struct
class StepControl:
    """Per cell [C]."""

    tolerance: wp.array(dtype=wp.float64)  # error per simulated time [um/s]; 0: fixed step
    wanted_step: wp.array(dtype=wp.float64)  # [s]
    error_sum: wp.array(dtype=wp.float64)  # fading sum of dt log(error/dt^3)
    error_time: wp.array(dtype=wp.float64)  # fading sum of dt [s]
    rejected: wp.array(dtype=wp.int32)  # steps taken again so far
    refused_error: wp.array(dtype=wp.float64)  # estimate of the last attempt, if it was refused for it; else 0 [um]


def allocate(accuracies: Sequence[float], device: Any) -> StepControl:
    """The struct `StepControl` of every cell.

    Args:
        accuracies: node error per simulated time [um/ms], one per cell; 0 for a fixed step.
        device: Warp's device.
    """
    cells, c = len(accuracies), StepControl()
    c.tolerance = wp.array([a * 1e3 for a in accuracies], dtype=wp.float64, device=device)
    c.wanted_step, c.error_sum, c.error_time, c.refused_error = (
        wp.zeros(cells, dtype=wp.float64, device=device) for _ in range(4)
    )
    c.rejected = wp.zeros(cells, dtype=wp.int32, device=device)
    return c


@functools.cache
def functions(p: Precision, independent: bool) -> SimpleNamespace:
    """Device functions of one precision, for errors that are independent from step to step, or alike."""
    module = p.module("step_control", "independent" if independent else "alike")
    power = 0.5 if independent else 1.0  # of dt in the error that a step may make
    scale = wp.constant(wp.float64(SPAN ** (1.0 - power)))
    power, root = wp.constant(wp.float64(power)), wp.constant(wp.float64(1.0 / (3.0 - power)))
    growth, smallest = wp.constant(wp.float64(LARGEST_GROWTH)), wp.constant(wp.float64(SMALLEST_STEP))
    refused, safety = wp.constant(wp.float64(REFUSED)), wp.constant(wp.float64(SAFETY))
    forgotten = wp.constant(wp.float64(FORGOTTEN * MEMORY))
    round_off, memory = wp.constant(wp.float64(ROUND_OFF[p.name])), wp.constant(wp.float64(MEMORY))
    nearly_all = wp.constant(wp.float64(1.0 - STEP_TOLERANCE))
    jump, shortest = (wp.constant(wp.float64(x)) for x in (JUMP, SHORTEST_STEP))

    @wp.func(module=module)
    def allowed(control: StepControl, c: wp.int32, dt: wp.float64):
        """Error that a step may make [um]."""
        return control.tolerance[c] * scale * wp.pow(dt, power)

    @wp.func(module=module)
    def accept(
        control: StepControl,
        c: wp.int32,
        dt: wp.float64,
        error: wp.float64,
        lost: wp.float64,
        sound: wp.bool,
        known: wp.bool,
    ):
        """Whether a step counts; sets the next one.

        Args:
            error: estimate of this step [um]; `known` says whether there is one.
            lost: an estimate below this is lost in round-off, and only says that it is below [um].
            sound: the step was solved and violates no guard.
        """
        one = wp.float64(1.0)
        factor = growth
        good = sound
        most = allowed(control, c, dt)
        if most > wp.float64(0.0) and known:
            # A shorter step is no better where the velocity jumps, as at contacts of parallel segments: go on.
            before = control.refused_error[c]
            jumps = before > wp.float64(0.0) and error > jump * before
            good = sound and (error < refused * most or jumps or dt <= shortest)
            if good and not jumps:
                bound = wp.max(error, wp.max(lost, round_off))
                level = wp.log(bound / (dt * dt * dt))
                fade = wp.exp(-dt / memory)
                seen = error >= bound
                # What is lost in round-off lowers the mean at most; longer steps will tell. But where round-off hides
                # all that is allowed, the mean of what was seen holds, until nothing has confirmed it for long.
                hidden = lost > most
                if seen or (not hidden and level * control.error_time[c] < control.error_sum[c]):
                    control.error_sum[c] = fade * control.error_sum[c] + level * dt
                    control.error_time[c] = fade * control.error_time[c] + dt
                elif hidden:
                    control.error_sum[c] = fade * control.error_sum[c]
                    control.error_time[c] = fade * control.error_time[c]
                    if control.error_time[c] < forgotten:
                        control.error_sum[c] = wp.float64(0.0)
                        control.error_time[c] = wp.float64(0.0)
                if (seen or hidden) and control.error_time[c] > wp.float64(0.0):
                    level = wp.exp(control.error_sum[c] / control.error_time[c])
                    best = wp.pow(safety * scale * control.tolerance[c] / level, root)
                    factor = wp.min(growth, wp.max(best, shortest) / dt)
        if good:
            control.refused_error[c] = wp.float64(0.0)
            # A step cut short to end on a target says nothing against the longer one wanted before.
            wanted = wp.max(factor * dt, wp.min(factor, one) * control.wanted_step[c])
            control.wanted_step[c] = wp.min(growth * dt, wanted)
            return True
        control.rejected[c] += 1
        control.wanted_step[c] = wp.float64(0.5) * dt
        if sound:
            control.refused_error[c] = error
        else:
            control.wanted_step[c] = wp.float64(0.25) * dt
        return False

    @wp.func(module=module)
    def next_step(control: StepControl, c: wp.int32, longest: wp.float64, left: wp.float64):
        """The wanted step, shortened so that steps end on the target and none before it is a sliver [s]."""
        dt = wp.min(control.wanted_step[c], longest)
        if dt > left * nearly_all:
            dt = left
        elif dt > wp.float64(0.5) * left:
            dt = wp.float64(0.5) * left
        return dt

    return SimpleNamespace(allowed=allowed, accept=accept, next_step=next_step, smallest=smallest)
