"""Where flagella sit on the body: its surface, the motor axes, and the ends of the hooks.

The body is a spherocylinder about e_b3. A point of its surface is given by its azimuth about e_b3, counted from e_b1,
and its offset from the body's middle toward the rear: on the cylinder up to the offset (length - width)/2, on a cap
beyond, at a pole at length/2. Angles of motor and helix axes are counted from e_b3 toward the direction of the azimuth
across it, which is the outward normal on the cylinder.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from warpflag.scene.scene import FlagellumSpec, Scene
    from warpflag.scene.sections import Body

__all__ = ["anchor", "direction", "motor_axis", "surface_radius"]

Vector = tuple[float, float, float]


def surface_radius(body: Body, offset: float) -> float:
    """Distance of the body's surface from its axis at an offset from the middle [um]; 0 beyond the poles."""
    radius = body.width / 2
    beyond = abs(offset) - (body.length - body.width) / 2
    return radius if beyond <= 0.0 else math.sqrt(max(radius * radius - beyond * beyond, 0.0))


def direction(angle: float, azimuth: float) -> Vector:
    """Unit vector at `angle` to e_b3 toward the direction of `azimuth` [deg], in body axes."""
    polar, around = math.radians(angle), math.radians(azimuth)
    return math.sin(polar) * math.cos(around), math.sin(polar) * math.sin(around), math.cos(polar)


def motor_axis(spec: FlagellumSpec) -> Vector:
    """m of a flagellum in body axes."""
    return direction(spec.motor_axis_angle, spec.azimuth)


def anchor(scene: Scene, spec: FlagellumSpec) -> Vector:
    """r_0 of a flagellum in body axes [um]: the end of the hook, which stands on the surface along m. The origin
    for a free filament."""
    if not scene.body.enabled:
        return 0.0, 0.0, 0.0
    around, radius = math.radians(spec.azimuth), surface_radius(scene.body, spec.anchor_offset)
    x, y, z = radius * math.cos(around), radius * math.sin(around), spec.anchor_offset
    a, b, c = motor_axis(spec)
    length = scene.hook.length
    return (x + length * a, y + length * b, z + length * c) if length else (x, y, z)
