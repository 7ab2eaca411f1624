"""The time at which forces are evaluated, for terms that depend on it: of a stage, or of a collocation point."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.types import DeviceState


@functools.cache
def _kernels() -> SimpleNamespace:
    module = wp.get_module("warpflag_kernels.evaluation_time")
    module.options["enable_backward"] = False

    @wp.kernel(module=module)
    def of_stage(
        # State:
        time: wp.array(dtype=wp.float64),
        elapsed: wp.array(dtype=wp.float64),
        # Out:
        evaluated: wp.array(dtype=wp.float64),
    ):
        c = wp.tid()
        evaluated[c] = time[c] + elapsed[c]

    @wp.kernel(module=module)
    def within_step(
        # State:
        time: wp.array(dtype=wp.float64),
        step: wp.array(dtype=wp.float64),
        theta: wp.array(dtype=wp.float64),
        # Out:
        evaluated: wp.array(dtype=wp.float64),
    ):
        c = wp.tid()
        evaluated[c] = time[c] + theta[c] * step[c]

    return SimpleNamespace(of_stage=of_stage, within_step=within_step)


def of_stage(state: DeviceState, control: Any, chart: Any, device: Any) -> None:
    """Sets `State.time` to that of the present stage of every cell: start of the step plus the stage's elapsed time."""
    inputs = [control.time, chart.elapsed, state.data.time]
    wp.launch(_kernels().of_stage, len(control.time), inputs=inputs, device=device)


def within_step(state: DeviceState, control: Any, theta: wp.array, device: Any) -> None:
    """Sets `State.time` to that of the collocation point of every cell, the fraction theta of its step."""
    inputs = [control.time, control.step, theta, state.data.time]
    wp.launch(_kernels().within_step, len(control.time), inputs=inputs, device=device)
