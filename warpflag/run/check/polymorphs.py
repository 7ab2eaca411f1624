"""Whether a motor of the scene can make its filament change form: told where polymorphs are on and none can."""

from __future__ import annotations

from warpflag.run.check.rigid import Turning
from warpflag.scene import FlagellumSpec, Scene

__all__ = ["of_polymorphs"]


def of_polymorphs(scene: Scene, stiff: Turning) -> list[str]:
    """A line where no motor's torque reaches `polymorphs.nucleation`, or only that of a motor that is held.

    A motor winds its filament up against the handedness in one sense alone: in reverse, for a left-handed filament that
    a positive torque drives. No moment of the filament about its axis is beyond the torque at its root. Motors of law
    "rate" take whatever torque their rate asks for, of which nothing is told.

    Args:
        scene: to look at.
        stiff: its longest flagellum, if it were stiff.
    """
    if not scene.polymorphs.enabled or not scene.body.enabled:
        return []
    flagella = scene.resolved_flagella()
    if any(spec.law == "rate" for spec in flagella):
        return []
    threshold = scene.polymorphs.nucleation
    none = "polymorphs: no filament will change its form; "
    reverses = [spec for spec in flagella if _winds_up(scene, spec)]
    if not reverses:
        return [none + "no motor turns against the handedness of its filament (motor.switching, negative motor.torque)"]
    held = max(_torque_held(scene, spec) for spec in reverses)
    if held < threshold:
        return [
            none + f"the largest torque of a motor in that sense is {held:.3g} pN um, below polymorphs.nucleation "
            f"{threshold:g}"
        ]
    turning = max(_torque_turning(scene, spec, stiff) for spec in reverses)
    if turning < threshold:
        return [
            "polymorphs: filaments change form only while motors switch, if at all; turning steadily in that sense they "
            f"exert about {turning:.2g} pN um, below polymorphs.nucleation {threshold:g}"
        ]
    return []


def _winds_up(scene: Scene, spec: FlagellumSpec) -> bool:
    """Whether the motor ever turns against the handedness of the filament at rest."""
    if spec.torque == 0.0:
        return False
    if not _in_reverse(scene, spec):
        return True
    switches = scene.motor.switching == "markov" and scene.motor.to_reverse > 0.0
    return switches or (scene.motor.switching == "schedule" and bool(spec.switch_times))


def _in_reverse(scene: Scene, spec: FlagellumSpec) -> bool:
    """Whether the sense that winds up is the motor's second."""
    return spec.torque * scene.flagella.intrinsic_curvature[2] <= 0.0


def _torque_held(scene: Scene, spec: FlagellumSpec) -> float:
    """Largest torque in the sense that winds up, of a motor that is held [pN um]."""
    own = scene.motor.reverse_torque
    return abs(spec.torque) if own is None or not _in_reverse(scene, spec) else own


def _torque_turning(scene: Scene, spec: FlagellumSpec, stiff: Turning) -> float:
    """Torque of a motor that turns the stiff flagellum in the sense that winds up [pN um].

    Its rate relative to the body is taken as that in the fluid.
    """
    held = _torque_held(scene, spec)
    if spec.law != "torque_speed":
        return held
    motor, second = scene.motor, _in_reverse(scene, spec)
    knee = motor.reverse_knee if second else spec.knee
    end = spec.no_load if not second or motor.reverse_no_load is None else motor.reverse_no_load
    slope = held / (end - knee)
    return held if held / stiff.drag <= knee else stiff.drag * slope * end / (stiff.drag + slope)
