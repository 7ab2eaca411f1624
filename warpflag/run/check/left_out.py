"""What a scene leaves out, and how large it would be: an entry each, which is dropped where the scene has the effect.

Sizes are estimates from closed formulas; docs/tradeoff.md has them with their sources. To add one, write a function
that returns a line for a scene, or None where the scene has the effect or can't have it, and name it in `EFFECTS`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from warpflag.run.check import rigid
from warpflag.run.check.rigid import Turning, mesh_dependence
from warpflag.scene import Scene
from warpflag.scene.resistance import filament_mobility, spheroid_mobility, steric_diameter

__all__ = ["EFFECTS", "left_out"]

_THERMAL = 4.11e-3  # kT at 298 K [pN um]
_DENSITY = 1.0e-9  # of water [pN s^2/um^4]
_HOOK_LENGTH, _HOOK_STIFFNESS = 0.055, 0.65  # of a real hook, relaxed [um, pN um/rad]
_FREE_END_FACTOR = 4.0  # squared displacement of a free end over that of the middle of a long rod
_FREE_MODE = 1.8751  # slowest bending mode of a rod held at one end: first root of cos q cosh q = -1


def left_out(scene: Scene, stiff: Turning) -> list[str]:
    """A line for every effect that the scene leaves out.

    Args:
        scene: to look at.
        stiff: its longest flagellum, if it were stiff.
    """
    return [line for effect in EFFECTS if (line := effect(scene, stiff)) is not None]


def _has(scene: Scene, key: str) -> bool:
    """Whether a setting is there and on, whatever the version of the scene's sections."""
    section, _, name = key.partition(".")
    return bool(getattr(getattr(scene, section, None), name, False))


def thermal_noise(scene: Scene, stiff: Turning) -> str | None:
    """Transverse displacement of the tip: of a long rod's free end while it grows as t^3/4, at most in equilibrium."""
    if _has(scene, "fluid.temperature"):
        return None
    group, spec = scene.flagella, max(scene.resolved_flagella(), key=lambda own: own.length)
    drag = 1 / (filament_mobility(scene, spec.segment_length).across * spec.segment_length)
    a = group.bending_rigidity
    growth = (a * scene.duration / drag) ** 0.75
    middle = 2 * _THERMAL * math.gamma(0.25) / (3 * math.pi * a) * growth
    rest = _THERMAL * stiff.axial_length**2 * spec.length / (3 * a)
    size = math.sqrt(2 * min(_FREE_END_FACTOR * middle, rest))
    return f"thermal noise: would move the tips by about {size:.2g} um (rms) in {1e3 * scene.duration:.3g} ms"


def body_flow(scene: Scene, stiff: Turning) -> str | None:
    """Flow of the body's drag, a Stokeslet on its axis, mean over the flagellum."""
    if not _has_body(scene) or scene.has_body_flow:
        return None
    eta, body = scene.fluid.viscosity, scene.body
    sphere = 1 / (6 * math.pi * eta * spheroid_mobility(body.length, body.width, eta).along)
    near = max(sphere, max(spec.anchor_offset for spec in scene.resolved_flagella()))
    mean = 1.5 * sphere * math.log(1 + stiff.axial_length / near) / stiff.axial_length
    return f"flow round the body: about {100 * min(mean, 1.0):.0f} % of the swimming speed at the flagella"


def hook(scene: Scene, stiff: Turning) -> str | None:
    """The hook's stiffness over the torque, which says whether it keeps the filament along the motor's axis."""
    if not _has_body(scene) or scene.hook.stiffness:
        return None
    specs = scene.resolved_flagella()
    torque = max(stiff.drag * abs(spec.rate) if spec.law == "rate" else abs(spec.torque) for spec in specs)
    if torque == 0.0:
        return None
    ratio = _HOOK_STIFFNESS / torque
    return (
        f"hook stiffness: a relaxed hook of {_HOOK_STIFFNESS:g} pN um/rad is {ratio:.2g} of the torque per rad; above "
        "about 0.5 it holds the filament along its motor"
    )


def hook_length(scene: Scene, stiff: Turning) -> str | None:
    """The angle at which the body's contact holds the first segment of a flagellum that begins on the surface."""
    if not _has_body(scene) or not scene.body.contact or scene.hook.length:
        return None
    h = min(spec.segment_length for spec in scene.resolved_flagella())
    lifted = min(0.9 * steric_diameter(scene) / h, 1.0)  # contacts rest at nine tenths of sigma
    angle = math.degrees(math.asin(lifted))
    return (
        f"hook length: the body's contact lifts the first segment by about {angle:.0f} degrees, which depends on its "
        f"length; with hook.length = {_HOOK_LENGTH:g} it does not"
    )


def self_contact(scene: Scene, stiff: Turning) -> str | None:
    """Turns of the helix at rest beside each other."""
    if _has(scene, "steric.self_contact") or not scene.steric.enabled:
        return None
    _o1, o2, o3 = scene.flagella.ground_strain
    strain = math.hypot(_o1, o2, o3)
    if strain == 0.0:
        return None
    pitch = 2 * math.pi * abs(o3) / strain**2
    return f"contact of a flagellum with itself: turns at rest are {pitch / steric_diameter(scene):.0f} sigma apart"


def mesh(scene: Scene, stiff: Turning) -> str | None:
    """Rate of a bundle of stiff flagella on this mesh and on one half as long."""
    found = mesh_dependence(scene, 0.5)
    if found is None:
        many = max(spec.segment_count for spec in scene.resolved_flagella())
        return f"mesh: not looked at with {many} segments" if many > 0.5 * rigid.MOST_SEGMENTS else None
    h = max(scene.resolved_flagella(), key=lambda spec: spec.length).segment_length
    more = "" if scene.hydrodynamics.mode in ("none", "between", "consistent") else ", and more with finer ones"
    if not _has_body(scene):
        what = f"how easily the filament turns about its axis is with h = {h:.3g} um"
        return f"mesh: {what} about {100 * found:+.1f} % off that with half of it{more}"
    return f"mesh: rates with h = {h:.3g} um are about {100 * found:+.1f} % off those with half of it{more}"


def inertia(scene: Scene, stiff: Turning) -> str | None:
    """The Reynolds number of a turning flagellum, or of one that is pulled."""
    spec = max(scene.resolved_flagella(), key=lambda own: own.length)
    across = filament_mobility(scene, spec.segment_length).across * spec.segment_length
    speed = max(stiff.tip_speed, math.hypot(*scene.external.force_per_length) * across)
    if speed == 0.0:
        return None
    return f"inertia: Reynolds number {_DENSITY * speed * stiff.radius / scene.fluid.viscosity:.0e}"


def lubrication(scene: Scene, stiff: Turning) -> str | None:
    """Gap between the surfaces of filaments in contact."""
    if not scene.steric.enabled or len(scene.resolved_flagella()) < 2:
        return None
    a = scene.flagella.filament_radius
    gap = (steric_diameter(scene) - 2 * a) / a
    size = "small" if gap >= 1 else "not small"
    return f"lubrication: surfaces in contact are {gap:.2g} filament radii apart; {size}"


def _has_body(scene: Scene) -> bool:
    return bool(getattr(scene.body, "enabled", True))


EFFECTS: tuple[Callable[[Scene, Turning], str | None], ...] = (
    thermal_noise,
    body_flow,
    hook,
    hook_length,
    self_contact,
    mesh,
    inertia,
    lubrication,
)
"""In the order in which they are told."""
