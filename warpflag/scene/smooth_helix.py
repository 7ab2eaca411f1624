"""Strains of smooth helices, and of joints whose nodes lie on one: plain numbers, the standard library alone."""

from __future__ import annotations

import functools
import math

__all__ = ["TAPER", "inscribed_strain", "smooth_strain"]

TAPER = 0.5  # um; axial length over which the amplitude of a flagellum on its helix axis grows to that of the helix


def smooth_strain(radius: float, pitch: float) -> tuple[float, float, float]:
    """Strain of the smooth helix of a radius R and a pitch P [um], negative for a left-handed one.

    That is (0, R/w, p/w) [1/um] with p = P/(2 pi), w = R^2 + p^2.
    """
    p = pitch / (2.0 * math.pi)
    w = radius * radius + p * p
    return (0.0, radius / w, p / w)


@functools.lru_cache(maxsize=256)
def inscribed_strain(strain: tuple[float, float, float], segment_length: float) -> tuple[float, float, float]:
    """Strain of the joints [1/um] of segments of length h [um] whose nodes lie on the smooth helix of a strain.

    That helix has curvature k = |(Omega_1, Omega_2)|, torsion t = Omega_3, and with w^2 = k^2 + t^2 the radius k/w^2
    and the rise t/w^2 per radian. Two nodes are a chord of length h apart, so the angle a between them obeys

        h^2 = (2 k/w^2 sin(a/2))^2 + (t a/w^2)^2,

    and a joint turns the frame by a about the axis, seen from the chord: `helix.ground_state` backwards.

    Raises:
        ValueError: no two nodes less than half a turn apart are so far from each other.
    """
    bend, third = math.hypot(strain[0], strain[1]), strain[2]
    square = bend * bend + third * third
    if bend == 0.0:
        return strain
    around, along = 2.0 * bend / square, third / square
    low, high = 0.0, math.pi
    if math.hypot(around, along * high) <= segment_length:
        raise ValueError(f"segments of {segment_length:g} um span half a turn of the helix")
    for _ in range(100):
        angle = (low + high) / 2
        chord = math.hypot(around * math.sin(angle / 2), along * angle)
        low, high = (angle, high) if chord < segment_length else (low, angle)
    # The rotation is a twist about the chord and a bend across it: half-angle quaternion (across, along the chord, 1).
    half = math.tan(angle / 2)
    twist = 2.0 * math.atan(half * along * angle / segment_length)
    across_chord = half * around * math.sin(angle / 2) / segment_length * math.cos(twist / 2)
    size = 2.0 * across_chord * math.cos(twist / 2) / segment_length
    return (size * strain[0] / bend, size * strain[1] / bend, twist / segment_length)
