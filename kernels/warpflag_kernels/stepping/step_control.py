"""Step control on the device: from the error estimate of a step to the next step, per cell, one rule for every stepper.

The estimate of a second-order step is proportional to dt^3. Contacts that open or close make single estimates jump, but
what adds up over time is the level between the jumps. So the control follows an exponentially weighted mean of
log(error/dt^3) over some steps; a step that followed every fluctuation would be less accurate at the same cost. Where a
motion quickens within less than that, as a filament that snaps, steps are rejected until the mean has followed.

Errors of equal sign from step to step add up in proportion to the number of steps n, so one step may make the error
error_rate dt. Independent ones add up as n^1/2, and one step may make error_rate (dt SPAN)^1/2. Which of the two holds
is a property of the stepper, and of the step (`accuracy.CORRELATION`).

Errors of equal sign add up with the jumps, and to more than the mean logarithm says where estimates fluctuate. So the
rate that steps aim at is lowered for as long as they make more than the rate that was asked for (`lowered`).
"""

import functools
import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.clock import STEP_TOLERANCE
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.stepping import accuracy
from warpflag_kernels.stepping.accuracy import Achieved

# Of one step over the one before. BDF2 is stable up to 1 + 2^1/2 = 2.41.
LARGEST_GROWTH = 2.0
REJECTED = 5.0  # a step is repeated if its estimate exceeds what it may make by this factor; see docs/numerics.md
# The same for errors of equal sign, those of RKC. In float32 they may be round-off that shorter steps don't lower.
REJECTED_SYSTEMATIC = {"float64": 5.0, "float32": 25.0}
SAFETY = 0.8  # fraction of the allowed error at which the weighted mean of the estimates is kept
FADING_STEPS = 20.0  # over how many steps that mean fades
# Time constant of the mean for errors of equal sign [s]: in float32 it spans the last estimates above round-off.
FADING_TIME = 5.0e-4
# Time, in shortest steps, in which the rate that steps aim at falls to 1/e where they err by twice what was asked: in
# water as long as FADING_TIME, in thinner fluids shorter.
LOWERING = 25000.0
LOWEST = 1.0e-2  # of that rate, over what was asked: steps are then a tenth as long
FORGOTTEN = 0.02  # the mean is dropped when its total weight has fallen below this fraction of its memory
# If halving a rejected step leaves more than this fraction of its error, the velocity itself jumps (smooth: 1/8), and
# shorter steps do not help.
JUMP = 0.25
# Shortest step that an error estimate asks for, in water [s]; only one that can't be solved goes below. Thinner fluids,
# in which everything is faster, have a shorter one.
SHORTEST_STEP = 2.0e-8
# An estimate e above its round-off r stands for an error of e - r^2/e, at least this share of r: what fluctuates about
# r does not shorten steps that no shorter step would improve.
LEAST_APART = 0.1
ROUND_OFF = {"float64": 1.0e-14, "float32": 3.0e-7}  # least error estimate [um]: round-off of a position of some um
SMALLEST_STEP = 1.0e-13  # [s]; a step that can't be solved here ends the cell's run


@wp.struct
class StepControl:
    """Settings and memory of step control, per cell [C]."""

    error_rate: wp.array(dtype=wp.float64)  # allowed error per simulated time [um/s]; 0: fixed step
    wanted_step: wp.array(dtype=wp.float64)  # [s]
    error_sum: wp.array(dtype=wp.float64)  # exponentially weighted sum of dt log(error/dt^3)
    error_time: wp.array(dtype=wp.float64)  # the same of dt, the total weight [s]
    lowered: wp.array(dtype=wp.float64)  # rate that steps aim at over error_rate, for errors of equal sign
    rejected: wp.array(dtype=wp.int32)  # steps rejected so far
    rejected_error: wp.array(dtype=wp.float64)  # estimate of the last attempt if that was rejected for it, else 0 [um]
    shortest: wp.array(dtype=wp.float64)  # that an estimate asks for [s]
    achieved: Achieved


def allocate(
    accuracies: Sequence[float], fixed: Sequence[bool], stopping: Sequence[bool], pace: Sequence[float], device: Any
) -> StepControl:
    """The struct `StepControl` of every cell.

    Args:
        accuracies: node error per simulated time [um/ms], one per cell.
        fixed: whether a cell's steps are fixed, and the accuracy is only what its estimates are compared with.
        stopping: whether a cell with controlled steps is stopped where its estimates are far above the accuracy.
        pace: of the scene's motion, over that in water; above 1 steps may be shorter.
        device: Warp's device.
    """
    cells, c = len(accuracies), StepControl()
    rates = [0.0 if f else a * 1e3 for a, f in zip(accuracies, fixed, strict=True)]
    c.error_rate = wp.array(rates, dtype=wp.float64, device=device)
    c.shortest = wp.array([SHORTEST_STEP / max(x, 1.0) for x in pace], dtype=wp.float64, device=device)
    c.achieved = accuracy.allocate(accuracies, [s and not f for s, f in zip(stopping, fixed, strict=True)], device)
    c.wanted_step, c.error_sum, c.error_time, c.rejected_error = (
        wp.zeros(cells, dtype=wp.float64, device=device) for _ in range(4)
    )
    c.lowered = wp.ones(cells, dtype=wp.float64, device=device)
    c.rejected = wp.zeros(cells, dtype=wp.int32, device=device)
    return c


@functools.cache
def functions(p: Precision, independent: bool) -> SimpleNamespace:
    """Device functions of one precision, for errors that are independent from step to step, or of equal sign."""
    module = p.module("step_control", "independent" if independent else "systematic")
    may_make, longest_step = accuracy.functions(independent).may_make, accuracy.functions(independent).longest
    growth, smallest = wp.constant(wp.float64(LARGEST_GROWTH)), wp.constant(wp.float64(SMALLEST_STEP))
    rejection = wp.constant(wp.float64(REJECTED if independent else REJECTED_SYSTEMATIC[p.name]))
    safety = wp.constant(wp.float64(SAFETY))
    memory = wp.constant(wp.float64(FADING_STEPS if independent else FADING_TIME))
    forgotten, per_step = wp.constant(wp.float64(FORGOTTEN)), wp.constant(wp.float64(math.exp(-1.0 / FADING_STEPS)))
    round_off, least_apart = wp.constant(wp.float64(ROUND_OFF[p.name])), wp.constant(wp.float64(LEAST_APART))
    nearly_all = wp.constant(wp.float64(1.0 - STEP_TOLERANCE))
    jump = wp.constant(wp.float64(JUMP))
    lowering, lowest = wp.constant(wp.float64(LOWERING)), wp.constant(wp.float64(LOWEST))

    @wp.func(module=module)
    def allowed(control: StepControl, c: wp.int32, dt: wp.float64):
        """Error that a step may make [um]."""
        return may_make(control.error_rate[c], dt)

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
        """Whether a step is accepted; sets the next one.

        Args:
            error: estimate of this step [um]; `known` says whether there is one.
            lost: an estimate below this is round-off, and says only that the error is below it [um].
            sound: the step was solved and violates no guard.
        """
        one = wp.float64(1.0)
        factor = growth
        good = sound
        most = allowed(control, c, dt)
        if most > wp.float64(0.0) and known:
            # A shorter step is no better where the velocity jumps, as at contacts of parallel segments: accept.
            before = control.rejected_error[c]
            jumps = before > wp.float64(0.0) and error > jump * before
            good = sound and (error < rejection * most or jumps or dt <= control.shortest[c])
            if good and dt <= control.shortest[c] and error > most:
                control.achieved.at_shortest[c] += 1
            aim = control.error_rate[c]
            if wp.static(not independent):
                if good and dt > control.shortest[c]:
                    share = wp.clamp((error - lost) / most, wp.float64(0.0), rejection)
                    lowered = control.lowered[c] * wp.exp((one - share) * dt / (lowering * control.shortest[c]))
                    control.lowered[c] = wp.clamp(lowered, lowest, one)
                aim *= control.lowered[c]
            if good and not jumps:
                bound = wp.max(error, wp.max(lost, round_off))
                apart = bound
                if error > lost and error > round_off:
                    apart = wp.max(error - lost * lost / error, least_apart * lost)
                level = wp.log(apart / (dt * dt * dt))
                fading = per_step
                kept = memory * dt
                if wp.static(not independent):
                    fading = wp.exp(-dt / memory)
                    kept = memory
                seen = error >= bound
                # An estimate that is round-off can only lower the mean. But where round-off exceeds all that is
                # allowed, the mean of earlier estimates stays, until its weight has faded.
                hidden = lost > most
                if seen or (not hidden and level * control.error_time[c] < control.error_sum[c]):
                    control.error_sum[c] = fading * control.error_sum[c] + level * dt
                    control.error_time[c] = fading * control.error_time[c] + dt
                elif hidden:
                    control.error_sum[c] = fading * control.error_sum[c]
                    control.error_time[c] = fading * control.error_time[c]
                    if control.error_time[c] < forgotten * kept:
                        control.error_sum[c] = wp.float64(0.0)
                        control.error_time[c] = wp.float64(0.0)
                if (seen or hidden) and control.error_time[c] > wp.float64(0.0):
                    level = wp.exp(control.error_sum[c] / control.error_time[c])
                    best = longest_step(safety * aim, level)
                    factor = wp.min(growth, wp.max(best, control.shortest[c]) / dt)
        if good:
            control.rejected_error[c] = wp.float64(0.0)
            # A step shortened to end on the target does not shorten the one wanted after it.
            wanted = wp.max(factor * dt, wp.min(factor, one) * control.wanted_step[c])
            control.wanted_step[c] = wp.min(growth * dt, wanted)
            return True
        control.rejected[c] += 1
        control.wanted_step[c] = wp.float64(0.5) * dt
        if sound:
            control.rejected_error[c] = error
        else:
            control.wanted_step[c] = wp.float64(0.25) * dt
        return False

    @wp.func(module=module)
    def next_step(control: StepControl, c: wp.int32, longest: wp.float64, left: wp.float64):
        """The wanted step, shortened so that steps end on the target and the last two are of equal length [s]."""
        dt = wp.min(control.wanted_step[c], longest)
        if dt > left * nearly_all:
            dt = left
        elif dt > wp.float64(0.5) * left:
            dt = wp.float64(0.5) * left
        return dt

    return SimpleNamespace(allowed=allowed, accept=accept, next_step=next_step, smallest=smallest)
