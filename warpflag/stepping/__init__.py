"""Time steppers behind one small interface."""

from __future__ import annotations

from typing import TYPE_CHECKING

from warpflag.scene import Scene, SceneError
from warpflag.stepping.stepper import Stepper, System

if TYPE_CHECKING:
    from collections.abc import Sequence

__all__ = ["Stepper", "System", "make_stepper"]


def make_stepper(system: System, scenes: Sequence[Scene]) -> Stepper:
    """The stepper that the scenes ask for.

    Errors:
        SceneError: the scenes of a batch ask for different ones.
    """
    from warpflag.stepping.implicit import ImplicitStepper
    from warpflag.stepping.rkc import RkcStepper

    names = {scene.numerics.stepper for scene in scenes}
    if len(names) != 1:
        raise SceneError("numerics.stepper", sorted(names), "must be the same in every scene of a batch")
    if system.model.switches.noise:
        from warpflag.stepping.thermal import ThermalStepper

        return ThermalStepper(system, scenes, name=names.pop())
    if names == {"implicit"}:
        return ImplicitStepper(system, scenes)
    return RkcStepper(system, scenes, euler=names == {"euler"})
