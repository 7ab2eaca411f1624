"""Whether filaments of the scene can change their form at all, and not too fast: told where polymorphs are on."""

from __future__ import annotations

from warpflag.model.switching import switch_times
from warpflag.run.check.rigid import Turning
from warpflag.scene import FlagellumSpec, Scene

__all__ = ["of_polymorphs"]

# Speed of a front beyond which joints change faster than a filament can turn [um/s]. Of one of 6 um under 1.26 pN um
# 93, 37 and 84 % change at 1e4 and h = 0.2, 0.1, 0.05, in steps that violate the power balance up to hundreds of times.
FASTEST_FRONT = 1000.0


def of_polymorphs(scene: Scene, stiff: Turning) -> list[str]:
    """Lines where no filament can change its form, or where fronts travel faster than filaments turn.

    Args:
        scene: to look at.
        stiff: its longest flagellum, if it were stiff.
    """
    if not scene.polymorphs.enabled:
        return []
    return [*_out_of_reach(scene, stiff), *_too_fast(scene)]


def _too_fast(scene: Scene) -> list[str]:
    """A line where joints change faster than the filament beyond can turn: what they release then decides."""
    ramp = scene.polymorphs.ramp
    longest = max(spec.segment_length for spec in scene.resolved_flagella())
    speed = scene.polymorphs.front_speed if ramp is None else longest / ramp
    if speed <= FASTEST_FRONT:
        return []
    said = f"front_speed {speed:g}" if ramp is None else f"ramp {ramp:g} s, a front of {speed:.4g}"
    return [
        f"polymorphs.{said} um/s: beyond {FASTEST_FRONT:g} um/s joints change faster than the filament can turn, and "
        "how far a front runs depends on the segment length"
    ]


def _out_of_reach(scene: Scene, stiff: Turning) -> list[str]:
    """A line where no filament can change its form: no motor winds one up, or none beyond `polymorphs.nucleation`.

    A motor winds its filament up against the handedness in one sense alone: in reverse, for a left-handed filament that
    a positive torque drives. The filament's moment about its axis is at most the torque at its root, but bending adds
    to the moment that nucleation looks at: with a threshold of 1.1 pN um free cells have been seen to flip under 0.8,
    not under 0.6. Motors of law "rate" take whatever torque their rate asks for: of them only the sense is told.
    """
    if not scene.body.enabled:
        return ["polymorphs: without a body no motor winds filaments up, which changes their form"]
    forms, flagella = scene.polymorphs, scene.resolved_flagella()
    if getattr(forms, forms.target) == scene.flagella.ground_strain:
        return [f"polymorphs: the target, polymorphs.{forms.target}, is the ground state of the filaments"]
    winding = [spec for k, spec in enumerate(flagella) if _winds_up(scene, k, spec)]
    if not winding:
        return [
            "polymorphs: no motor turns against the handedness of its filament within the run (motor.switching, "
            "negative motor.torque or motor.rate), which changes its form"
        ]
    if any(spec.law == "rate" for spec in winding):
        return []
    bent = (
        f"polymorphs.nucleation {forms.nucleation:g}; only bending near root and tip, as of free cells, may exceed that"
    )
    held = max(_torque_held(scene, spec) for spec in winding)
    if held < forms.nucleation:
        return [f"polymorphs: no motor winds its filament up beyond {held:.3g} pN um, below {bent}"]
    steady = max(_torque_turning(scene, spec, stiff) for spec in winding)
    if steady < forms.nucleation:
        return [
            f"polymorphs: motors wind filaments up with about {steady:.2g} pN um in steady rotation, {held:.3g} only "
            f"while they switch, below {bent}"
        ]
    return []


def _winds_up(scene: Scene, motor: int, spec: FlagellumSpec) -> bool:
    """Whether the motor ever turns against the handedness of the filament at rest, within the scene's duration."""
    if spec.forward == 0.0:
        return False
    if not _in_reverse(scene, spec):
        return True
    return any(time < scene.duration for time in switch_times(scene, motor))


def _in_reverse(scene: Scene, spec: FlagellumSpec) -> bool:
    """Whether the sense that winds up is the motor's second."""
    return spec.forward * scene.flagella.ground_strain[2] <= 0.0


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
