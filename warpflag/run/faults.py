"""What a violated guard tells the user: what happened, when, on which flagellum, and what to try."""

from __future__ import annotations

from warpflag_kernels.stepping.health import Fault

__all__ = ["NumericalError"]

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
