"""Clocks and switches of every cell on the device, so that a captured pass needs nothing from the host.

Times, steps, faults and the loop condition lie in device arrays: every cell of a batch has its own clock and its own
step, and stops by itself when it is done or a guard has found a fault.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

NO_FAULT = 2**31 - 1
# Fraction of a step: a time closer to the target than this counts as the target. Far above the round-off of a sum of
# steps, far below what any observable resolves.
STEP_TOLERANCE = 1.0e-6


@wp.struct
class Control:
    """Clock of every cell and the state of the captured loop; per cell [C] unless said otherwise."""

    time: wp.array(dtype=wp.float64)  # [s]
    target: wp.array(dtype=wp.float64)  # time at which this advance ends [s]
    longest_step: wp.array(dtype=wp.float64)  # [s]
    step: wp.array(dtype=wp.float64)  # the current one [s]
    steps: wp.array(dtype=wp.int32)  # taken so far
    rest: wp.array(dtype=wp.int32)  # 1: the cell stops at the end of this step until the next advance
    fault: wp.array(dtype=wp.int32)  # kind and element of the first violated guard, NO_FAULT while sound
    unfinished: wp.array(dtype=wp.int32)  # [1], cells short of their target
    between_steps: wp.array(dtype=wp.int32)  # [1], 1: some cell is at a start or an end of a step in this pass
    budget: wp.array(dtype=wp.int32)  # [1], passes left before the host reads the clocks
    proceed: wp.array(dtype=wp.int32)  # [1], the loop condition


@functools.cache
def functions() -> SimpleNamespace:
    """Device function `advanced`: the time at the end of a step, which is the target itself where that is close."""
    tolerance = wp.constant(wp.float64(STEP_TOLERANCE))

    @wp.func(module=wp.get_module("warpflag_kernels.clock_functions"))
    def advanced(control: Control, c: wp.int32):
        """Time of cell c after its current step [s]."""
        t = control.time[c] + control.step[c]
        if control.target[c] - t < tolerance * control.step[c]:
            return control.target[c]
        return t

    return SimpleNamespace(advanced=advanced)


def allocate(cell_count: int, device: Any) -> Control:
    """Clocks at time zero, no cell at work."""
    c = Control()
    c.time, c.target, c.longest_step, c.step = (wp.zeros(cell_count, dtype=wp.float64, device=device) for _ in range(4))
    c.steps, c.rest = (wp.zeros(cell_count, dtype=wp.int32, device=device) for _ in range(2))
    c.fault = wp.full(cell_count, NO_FAULT, dtype=wp.int32, device=device)
    c.unfinished, c.between_steps, c.budget, c.proceed = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(4))
    return c


@functools.cache
def _kernels() -> SimpleNamespace:
    module = wp.get_module("warpflag_kernels.clock")
    module.options["enable_backward"] = False

    @wp.kernel(module=module)
    def count_pass(
        # Out:
        control: Control,
    ):
        control.between_steps[0] = 0
        control.budget[0] = control.budget[0] - 1
        control.proceed[0] = wp.where(control.unfinished[0] > 0 and control.budget[0] > 0, 1, 0)

    return SimpleNamespace(count_pass=count_pass)


def count_pass(control: Control, device: Any) -> None:
    """Counts one pass of the captured loop and decides whether another follows."""
    wp.launch(_kernels().count_pass, 1, inputs=[control], device=device)
