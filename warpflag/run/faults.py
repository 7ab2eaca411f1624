"""What a violated guard tells the user: what happened, when, where, what in the scene may cause it, and what to try."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence

import numpy as np
from warpflag_kernels.base import clock
from warpflag_kernels.stepping import health
from warpflag_kernels.stepping.health import Fault

from warpflag.scene import Scene

__all__ = ["NumericalError", "found_faults", "likely_causes"]

# What happened; what to try beside the likely cause.
_ADVICE = {
    Fault.NOT_FINITE: ("a value is not finite", "take a start that is finite, or numerics.stepper = rkc"),
    Fault.CROSSING: (
        "its centre line touches or has passed through another flagellum's, or itself",
        "take hydrodynamics.mode other than as_printed, or a lower motor.torque",
    ),
    Fault.STRAIN: (
        "a segment is stretched or squeezed by more than 5 %",
        "take a lower motor.torque or a higher flagella.stretching_stiffness",
    ),
    Fault.TWIST: (
        "a joint is twisted by more than 90 degrees",
        "take a lower motor.torque or a shorter flagella.segment_length",
    ),
    Fault.FOLD: ("a joint is folded back on itself", "take a lower motor.torque"),
    Fault.TURN: ("its motor turns by more than 2 rad in one step", "take a lower motor.torque"),
    Fault.UNSOLVED: ("no step, however short, could be solved", "take numerics.stepper = rkc"),
    Fault.ACCURACY: (
        "the error estimate is beyond ten times numerics.accuracy",
        "ask for less accuracy, or go on with numerics.on_accuracy = warn",
    ),
    Fault.BALANCE: (
        "steps gain energy that nothing puts in, or lose more than the fluid takes: power balance violated",
        "compare with numerics.stepper = rkc; a new term whose force is not that of its energy does this, too",
    ),
    Fault.UNSTABLE: (
        "the fixed step is beyond what its stages keep stable",
        "take a shorter numerics.time_step, or leave it out",
    ),
    Fault.PRESSED: (
        "a contact is closer than noise or motors can press it: a step has missed it",
        "filaments that touch ask for a numerics.time_step of 1e-6 or less",
    ),
    Fault.CROWDED: ("more contacts at once than a step has room for", "take numerics.stepper = rkc"),
}
_OF_CELL = (Fault.UNSOLVED, Fault.ACCURACY, Fault.BALANCE, Fault.UNSTABLE, Fault.CROWDED)
"""Faults of a cell as a whole: no segment is to blame."""
_NOTABLE_VALUE = 3.0  # a value that is off its default by this factor is named: factors of two are ordinary choices
_EXTERNAL_WEIGHT = 1.0  # weight of an external force among the causes: that of a value e times its default
_CROWDED = 3.0  # anchors nearer than so many diameters are named


class NumericalError(RuntimeError):
    """A step violated a guard: what, when, where, what to try, in one line.

    Attributes:
        kind: which guard.
        time: of the step [s].
        cell: number in its batch.
        flagellum: number in its cell.
        segment: counted from the body; 0 is the motor joint.
    """

    def __init__(self, kind: Fault, time: float, cell: int, flagellum: int, segment: int, scene: Scene) -> None:
        self.kind, self.time, self.cell, self.flagellum, self.segment = kind, time, cell, flagellum, segment
        what, advice = _ADVICE[kind]
        where = "" if kind in _OF_CELL else f"flagellum {flagellum}, segment {segment}: "
        parts = [f"stopped at {time * 1e3:.6g} ms: {where}{what}"]
        if causes := likely_causes(scene):
            parts.append("likely cause: " + ", ".join(causes[:2]))
        if scene.numerics.time_step and kind != Fault.UNSTABLE:
            parts.append("take a shorter numerics.time_step, or leave it out")
        if advice:
            parts.append(advice)
        super().__init__("; ".join(parts))


def likely_causes(scene: Scene) -> list[str]:
    """What in a scene is far from the default, the farthest first, in words."""
    given, usual = _values(scene), _values(Scene(name="default"))
    found = []
    for key, value in given.items():
        ratio = value / usual[key]
        if ratio <= 0.0 or 1 / _NOTABLE_VALUE < ratio < _NOTABLE_VALUE:
            continue
        if key == "motor.torque" and ratio < 1.0:  # no motion is too hard to follow because its motors are weak
            continue
        much = f"{ratio:.3g} times" if ratio > 1 else f"1/{1 / ratio:.3g} of"
        found.append((abs(math.log(ratio)), f"{key} = {value:g}, {much} the default"))
    if (apart := _nearest_anchors(scene)) is not None:
        diameters = apart / (4 * scene.flagella.filament_radius)
        if diameters < _CROWDED:
            found.append((math.log(_CROWDED / diameters) + 1.0, f"anchors {apart:.3g} um apart crowd the flagella"))
    pulls = [(field.name, getattr(scene.external, field.name)) for field in dataclasses.fields(scene.external)]
    found += [(_EXTERNAL_WEIGHT, f"external.{name} = {value}") for name, value in pulls if np.any(np.asarray(value))]
    if scene.start.record is not None:
        found.append((0.0, "start.record, made with another scene"))
    return [words for _, words in sorted(found, key=lambda one: -one[0])]


def _values(scene: Scene) -> dict[str, float]:
    """Values that make a motion stiff, fast or crowded, by key."""
    flagella = scene.resolved_flagella()
    return {
        "motor.torque": max(abs(spec.torque) for spec in flagella),
        "flagella.bending_rigidity": scene.flagella.bending_rigidity,
        "flagella.twist_rigidity": scene.flagella.twist_rigidity,
        "flagella.stretching_stiffness": scene.flagella.stretching_stiffness,
        "flagella.segment_length": min(spec.segment_length for spec in flagella),
        "steric.strength": scene.steric.strength if scene.steric.enabled else 0.0,
        "fluid.viscosity": scene.fluid.viscosity,
        **{
            f"fluid.{name}": getattr(scene.fluid, name) or usual
            for name, usual in (("drag_parallel", 1.6e-3), ("drag_perpendicular", 2.8e-3), ("drag_rotation", 1.26e-6))
        },
    }


def _nearest_anchors(scene: Scene) -> float | None:
    """Distance of the two nearest anchors [um]; None of a single flagellum."""
    radius, places = scene.body.width / 2, []
    for spec in scene.resolved_flagella():
        around = math.radians(spec.azimuth)
        places.append((radius * math.cos(around), radius * math.sin(around), spec.anchor_offset))
    pairs = itertools.combinations(places[:_MOST_COMPARED], 2)
    return min((math.dist(a, b) for a, b in pairs), default=None)


_MOST_COMPARED = 500
"""Flagella whose anchors are compared: all pairs of them take some hundredths of a second."""


def found_faults(
    codes: np.ndarray, times: np.ndarray, first_node: np.ndarray, first_flagellum: np.ndarray, scenes: Sequence[Scene]
) -> dict[int, NumericalError]:
    """The violated guard of each cell that was stopped by one, by cell.

    Args:
        codes: fault of each cell, `NO_FAULT` where sound, shape [cell_count].
        times: that the cells have reached [s], same shape.
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1.
        first_flagellum: cell c has the flagella first_flagellum[c] to first_flagellum[c + 1] - 1.
        scenes: of the cells.
    """
    found = {}
    for cell, code in enumerate(codes):
        if code != clock.NO_FAULT:
            kind, element = health.decode(int(code))
            flagellum = int(np.searchsorted(first_node, element, side="right")) - 1
            own = flagellum - int(first_flagellum[cell])
            found[cell] = NumericalError(
                kind, float(times[cell]), cell, own, element - int(first_node[flagellum]), scenes[cell]
            )
    return found
