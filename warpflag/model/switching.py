"""When motors switch: a table of corners per motor, known before the run begins.

The drive of a motor, 1 forward and -1 in reverse, is linear between corners. It is a function of scene, motor and time
alone: the same on every device, in a batch of any size, whatever steps are taken, and after a resumed run.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterable

import numpy as np

from warpflag.scene import Scene

__all__ = ["corners", "second_intervals", "switch_times"]

_SECOND_STREAMS = 1 << 40  # offset of the random streams of second forms: motor k has stream k plus this
_DRAWN_DURATIONS = 2.0  # scene durations for which switches are drawn, for a run that is advanced beyond its end


def corners(scene: Scene, motor: int) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and drives of the corners of a motor's drive, at least one; constant before the first, after the last.

    A motor that switches again within its ramp turns back from where it is.
    """
    times, drives, drive, goal = [0.0], [1.0], 1.0, 1.0
    speed = 2.0 / scene.motor.switch_ramp
    for time in switch_times(scene, motor):
        passed = (time - times[-1]) * speed
        if abs(goal - drive) > passed:  # still on the way
            drive += np.copysign(passed, goal - drive)
        elif drive != goal:
            times.append(times[-1] + abs(goal - drive) / speed)
            drives.append(goal)
            drive = goal
        goal = -goal
        if time > times[-1]:
            times.append(time)
            drives.append(drive)
    if drive != goal:
        times.append(times[-1] + abs(goal - drive) / speed)
        drives.append(goal)
    return np.array(times), np.array(drives)


def switch_times(scene: Scene, motor: int) -> tuple[float, ...]:
    """When a motor reverses, beginning with a switch to reverse [s]."""
    if scene.motor.switching == "none":
        return ()
    if scene.motor.switching == "schedule":
        return scene.resolved_flagella()[motor].switch_times
    m = scene.motor
    return _markov(m.seed, motor, m.to_reverse, m.to_forward, m.coupling, _DRAWN_DURATIONS * scene.duration)


def second_intervals(scene: Scene, motor: int) -> tuple[tuple[float, float], ...]:
    """When joints of a flagellum go on to its second form: beginnings and ends [s].

    In every interval in which the motor winds the filament up against its handedness, from an exponential delay on.
    """
    forms = scene.polymorphs
    if forms.second == "none" or forms.second_rate <= 0.0:
        return ()
    winds_up = scene.resolved_flagella()[motor].forward * scene.flagella.ground_strain[2] > 0.0
    ends = [0.0, *switch_times(scene, motor), math.inf]
    delays = _ticks(scene.motor.seed, _SECOND_STREAMS + motor, forms.second_rate, 0, math.inf)
    found, last = [], 0.0
    for begin, end in itertools.islice(itertools.pairwise(ends), 0 if winds_up else 1, None, 2):
        tick = next(iter(delays))[0]
        begin, last = begin + tick - last, tick
        if begin < end:
            found.append((begin, end))
    return tuple(found)


@functools.lru_cache(maxsize=4096)
def _markov(
    seed: int, motor: int, to_reverse: float, to_forward: float, coupling: float, until: float
) -> tuple[float, ...]:
    """Switches of a two-state Markov process that is forward at time 0.

    Each direction has a Poisson clock at its switching rate. A tick switches the motor only if it is in the state that
    this direction leaves; other ticks are ignored, which changes nothing, since the clock has no memory. With coupling
    c a share c of each rate is of clocks of the cell, the rest of the motor's own, so that each motor's own law does
    not depend on c.
    """
    clocks = [
        (to_reverse * (1 - coupling), 2 * motor + 2, -1),
        (to_forward * (1 - coupling), 2 * motor + 3, 1),
        (to_reverse * coupling, 0, -1),
        (to_forward * coupling, 1, 1),
    ]
    found, state = [], 1
    ticks = [tick for rate, stream, leads_to in clocks for tick in _ticks(seed, stream, rate, leads_to, until)]
    for time, goal in sorted(ticks):
        if goal != state:
            found.append(time)
            state = goal
    return tuple(found)


def _ticks(seed: int, stream: int, rate: float, goal: int, until: float) -> Iterable[tuple[float, int]]:
    """Ticks of a Poisson clock [s] from a counter-based generator, each with the state that it leads to."""
    if rate <= 0.0:
        return
    generator = np.random.Philox(key=np.array([seed, stream], dtype=np.uint64))
    time = 0.0
    while True:
        # 53 bits of the raw stream, which NumPy guarantees not to change, in (0, 1].
        time -= np.log((float(int(generator.random_raw()) >> 11) + 1.0) / 2.0**53) / rate
        if time > until:
            return
        yield float(time), goal
