"""What a violated guard tells the user: what happened, when, on which flagellum, and what to try."""

from __future__ import annotations

import numpy as np
from warpflag_kernels.base import clock
from warpflag_kernels.stepping import health
from warpflag_kernels.stepping.health import Fault

__all__ = ["NumericalError", "found_faults"]

_ADVICE = {
    Fault.NOT_FINITE: ("a value is not finite", "take a shorter numerics.time_step"),
    Fault.CROSSING: (
        "its centre line has passed through another flagellum's",
        "take a shorter numerics.time_step, hydrodynamics.mode other than as_printed, or a lower motor.torque",
    ),
    Fault.STRAIN: (
        "a segment is stretched or squeezed by more than 5 %",
        "take a shorter numerics.time_step, a lower motor.torque or a higher flagella.stretching_stiffness",
    ),
    Fault.TWIST: (
        "a joint is twisted by more than 90 degrees",
        "take a lower motor.torque, or a shorter flagella.segment_length or numerics.time_step",
    ),
    Fault.FOLD: (
        "a joint is folded back on itself",
        "take a shorter numerics.time_step or a lower motor.torque",
    ),
    Fault.TURN: (
        "its motor turns by more than 2 rad in one step",
        "take a shorter numerics.time_step or a lower motor.torque",
    ),
    Fault.UNSOLVED: (
        "no step, however short, could be solved",
        "take a lower steric.strength or motor.torque, or numerics.stepper = rkc",
    ),
}


class NumericalError(RuntimeError):
    """A step violated a guard: what, when, which flagellum, what to try, in one line.

    Attributes:
        kind: which guard.
        time: of the step [s].
        cell: number in its batch.
        flagellum: number in its cell.
        segment: counted from the body; 0 is the motor joint.
    """

    def __init__(self, kind: Fault, time: float, cell: int, flagellum: int, segment: int) -> None:
        self.kind, self.time, self.cell, self.flagellum, self.segment = kind, time, cell, flagellum, segment
        what, advice = _ADVICE[kind]
        where = f"flagellum {flagellum}, segment {segment}"
        super().__init__(f"stopped at {time * 1e3:.6g} ms: {where}: {what}; {advice}")


def found_faults(
    codes: np.ndarray, times: np.ndarray, first_node: np.ndarray, first_flagellum: np.ndarray
) -> dict[int, NumericalError]:
    """The violated guard of each cell that was stopped by one, by cell.

    Args:
        codes: fault of each cell, `NO_FAULT` where sound, shape [cell_count].
        times: that the cells have reached [s], same shape.
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1.
        first_flagellum: cell c has the flagella first_flagellum[c] to first_flagellum[c + 1] - 1.
    """
    found = {}
    for cell, code in enumerate(codes):
        if code != clock.NO_FAULT:
            kind, element = health.decode(int(code))
            flagellum = int(np.searchsorted(first_node, element, side="right")) - 1
            own = flagellum - int(first_flagellum[cell])
            found[cell] = NumericalError(kind, float(times[cell]), cell, own, element - int(first_node[flagellum]))
    return found
