"""The accuracy that a run has kept: the error estimates of its steps, added up per cell on the device.

A step of dt may err by `may_make`, which grows as dt^p, p = 1 for errors of equal sign and 1/2 for independent ones.
Errors are independent where they lie farther apart than `CORRELATION`: within that time they have equal sign, so a
shorter step may err in proportion to dt. With r the estimate over what a step may make, the errors of steps add up to
the share

    [sum of dt r^(1/p) / time]^p

of what was asked for the same time: the mean of r for p = 1, its root mean square for p = 1/2. It is kept for the whole
run, for windows of `WINDOW`, of which the worst is remembered, and for the present millisecond, in which a run that has
erred by `LARGEST_EXCESS` times what a whole millisecond may is stopped, unless its scene says otherwise.
"""

import functools
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

SPAN = 1.0e-3  # time that the accuracy refers to: errors of steps may add up to it in this time [s]
CORRELATION = 5.0e-6  # time within which errors of steps have equal sign where they are otherwise independent [s]
WINDOW = 1.0e-4  # time over which the worst estimate is taken [s]: some ten steps and more
# Shortest steps after the start of a scene that are not counted, 1 us in water: what the start leaves stretched or in
# contact relaxes in them, which the estimates take for error.
UNCOUNTED_STEPS = 50.0
LARGEST_EXCESS = 10.0  # estimate over what was asked at which a run is stopped


@wp.struct
class Achieved:
    """Per cell [C]; sums are of dt r^(1/p) [s]."""

    asked: wp.array(dtype=wp.float64)  # error per simulated time [um/s]
    limit: wp.array(dtype=wp.float64)  # estimate over asked at which the cell is stopped; 0: never
    total: wp.array(dtype=wp.float64)  # sum since the start
    total_time: wp.array(dtype=wp.float64)  # time of the steps in it [s]
    window: wp.array(dtype=wp.float64)  # sum of the present window
    window_time: wp.array(dtype=wp.float64)  # [s]
    worst: wp.array(dtype=wp.float64)  # estimate over asked of the worst window
    worst_end: wp.array(dtype=wp.float64)  # its end [s]
    span: wp.array(dtype=wp.float64)  # sum of the present `SPAN`
    span_time: wp.array(dtype=wp.float64)  # [s]
    at_shortest: wp.array(dtype=wp.int32)  # steps of the shortest length whose estimate exceeds what they may make


SUMS = ("total", "total_time", "window", "window_time", "worst", "worst_end", "span", "span_time")
"""Names of the sums, which checkpoints carry on beside `at_shortest`."""


def allocate(accuracies: Sequence[float], stopping: Sequence[bool], device: Any) -> Achieved:
    """The struct `Achieved`, nothing added up yet.

    Args:
        accuracies: asked for [um/ms], one per cell.
        stopping: whether a cell is stopped where its estimate is beyond the limit.
        device: Warp's device.
    """
    a = Achieved()
    a.asked = wp.array(np.array(accuracies) * 1e3, dtype=wp.float64, device=device)
    a.limit = wp.array(np.where(stopping, LARGEST_EXCESS, 0.0), dtype=wp.float64, device=device)
    for name in SUMS:
        setattr(a, name, wp.zeros(len(accuracies), dtype=wp.float64, device=device))
    a.at_shortest = wp.zeros(len(accuracies), dtype=wp.int32, device=device)
    return a


@functools.cache
def functions(independent: bool) -> SimpleNamespace:
    """Device functions of errors that are independent from step to step, or of equal sign.

    `may_make` is the error that a step may make, `longest` the step whose estimate, level dt^3, is that error, and
    `add` counts an estimate.
    """
    name = "independent" if independent else "systematic"
    module = wp.get_module(f"warpflag_kernels.accuracy_{name}")
    scale, root = (wp.constant(wp.float64(x)) for x in ((SPAN**0.5, 1.0 / 2.5) if independent else (1.0, 0.5)))
    alike = wp.constant(wp.float64((SPAN / CORRELATION) ** 0.5))
    span, window, begin = (wp.constant(wp.float64(x)) for x in (SPAN, WINDOW, UNCOUNTED_STEPS))

    @wp.func(module=module)
    def rooted(x: wp.float64):
        """x to the power p."""
        if wp.static(independent):
            x = wp.sqrt(x)
        return x

    @wp.func(module=module)
    def may_make(rate: wp.float64, dt: wp.float64):
        """Error that a step may make where `rate` [um/s] is asked for [um]."""
        most = rate * scale * rooted(dt)
        if wp.static(independent):
            most = wp.min(most, rate * alike * dt)
        return most

    @wp.func(module=module)
    def longest(rate: wp.float64, level: wp.float64):
        """Step whose error, level dt^3 [um], is what it may make at this rate [s]."""
        if wp.static(not independent):
            return wp.sqrt(rate / level)
        return wp.min(wp.pow(rate * scale / level, root), wp.sqrt(rate * alike / level))

    @wp.func(module=module)
    def add(a: Achieved, c: wp.int32, dt: wp.float64, error: wp.float64, time: wp.float64, shortest: wp.float64):
        """Counts the estimate of an accepted step, `error` [um]; returns whether that goes beyond the limit.

        Args:
            time: at the end of the step [s].
            shortest: step that an estimate asks for [s].
        """
        zero = wp.float64(0.0)
        if time < begin * shortest:
            return False
        share = error / may_make(a.asked[c], dt)
        sum = dt * share
        if wp.static(independent):
            sum = dt * share * share
        a.total[c] += sum
        a.total_time[c] += dt
        a.window[c] += sum
        a.window_time[c] += dt
        if a.window_time[c] >= window:
            found = rooted(a.window[c] / a.window_time[c])
            if found > a.worst[c]:
                a.worst[c] = found
                a.worst_end[c] = time
            a.window[c] = zero
            a.window_time[c] = zero
        a.span[c] += sum
        a.span_time[c] += dt
        beyond = a.limit[c] > zero and rooted(a.span[c] / span) > a.limit[c]
        if a.span_time[c] >= span:
            a.span[c] = zero
            a.span_time[c] = zero
        return beyond

    return SimpleNamespace(add=add, may_make=may_make, longest=longest)


def estimates(sums: Mapping[str, float], independent: bool) -> tuple[float, float] | None:
    """Estimates over what was asked: of the whole run, and of its worst window, the present one included.

    Args:
        sums: of a cell by name, as in `Achieved`.
        independent: as in `functions`.

    Returns:
        The two; None where no step has an estimate.
    """
    power = 0.5 if independent else 1.0
    if sums["total_time"] <= 0.0:
        return None
    worst = sums["worst"]
    # A window that has just begun says little; a run shorter than one has no other.
    if sums["window_time"] > 0.5 * WINDOW or (worst == 0.0 and sums["window_time"] > 0.0):
        worst = max(worst, (sums["window"] / sums["window_time"]) ** power)
    return (sums["total"] / sums["total_time"]) ** power, worst


def last_span(sums: Mapping[str, float], independent: bool) -> float:
    """Estimate over what was asked of the present millisecond, as far as it goes but no less than `WINDOW` of it."""
    power = 0.5 if independent else 1.0
    return (sums["span"] / max(sums["span_time"], WINDOW)) ** power
