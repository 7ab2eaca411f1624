"""A flagellum at rest: the zero-energy shape of a discrete elastic rod.

With one intrinsic strain along the contour that is a helix, on which r_0 is a node like the others. A flagellum on the
axis of its helix starts there instead: its amplitude grows from zero at r_0 over an axial length `TAPER`, and the
intrinsic strain of the joints there is that of this shape.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from warpflag.base import rotations
from warpflag.scene.smooth_helix import TAPER

__all__ = ["DiscreteHelix", "RestShape", "across", "ground_state", "joint_strain", "rest_shape", "rotation_matrix"]

Array = NDArray[np.floating]

_STRAIGHT = 1e-9  # um; a helix of smaller radius has no direction from its axis to a node


@dataclass(frozen=True)
class DiscreteHelix:
    """The zero-energy shape of a discrete rod: every joint turns the frame by the same rotation.

    All of it is in the axes (e1, e2, e3) of the first segment.

    Attributes:
        joint: the rotation of a joint; its columns are the next segment's axes, shape [3, 3].
        axis: unit vector of the helix axis, along which the nodes advance, shape [3].
        angle: turn about the axis per joint [rad], negative for a left-handed helix.
        rise: advance along the axis per segment [um].
        radius: of the nodes [um].
        outward: unit vector from the axis to the first node, shape [3]; e1 for a straight rod, which has none.
    """

    joint: Array
    axis: Array
    angle: float
    rise: float
    radius: float
    outward: Array

    @property
    def pitch(self) -> float:
        """Advance per turn [um]; infinite for a rod that does not turn."""
        return 2 * math.pi * self.rise / abs(self.angle) if self.angle else math.inf


def ground_state(strain: tuple[float, float, float], segment_length: float) -> DiscreteHelix:
    """Discrete helix on which every joint has exactly the intrinsic strain.

    Between segments e and f with curvature binormal kb = 2 t_e x t_f/(1 + t_e.t_f) the strains are h Omega_1 = kb.(e1_e
    + e1_f)/2, h Omega_2 = kb.(e2_e + e2_f)/2, and h Omega_3 is the twist from e1_e, parallel-transported onto f, to
    e1_f. Transport keeps the components of kb, so the first two are cos(twist/2) times kb turned by twist/2. That is
    inverted here: |kb| = h |(Omega_1, Omega_2)|/cos(twist/2).

    Args:
        strain: (Omega_1, Omega_2, Omega_3) [1/um].
        segment_length: h [um].

    Raises:
        ValueError: the twist per joint, h Omega_3, is not below pi in magnitude.

    Source:
        discrete elastic rods, Bergou et al., ACM Trans. Graph. 27, 63 (2008).
    """
    bend_1, bend_2, twist = (segment_length * component for component in strain)
    if not abs(twist) < math.pi:
        raise ValueError(f"the twist per joint is {twist:g} rad; it must be below pi in magnitude")
    cos_half, sin_half = math.cos(twist / 2), math.sin(twist / 2)
    # Half-angle quaternions: |kb| = 2 tan(bend/2), so kb/2 is tan(bend/2) times the bending axis.
    half_binormal = np.array([cos_half * bend_1 - sin_half * bend_2, sin_half * bend_1 + cos_half * bend_2, 0])
    half_binormal /= 2 * cos_half
    turn = rotations.product(np.array([*half_binormal, 1.0]), np.array([0.0, 0.0, sin_half / cos_half, 1.0]))
    vector, scalar = turn[:3], turn[3]
    sine = float(np.linalg.norm(vector))
    angle = 2 * math.atan2(sine, scalar)
    axis = vector / sine if sine > 0 else np.array([0.0, 0.0, 1.0])
    if axis[2] < 0:
        axis, angle = -axis, -angle
    rise = segment_length * float(axis[2])
    # The nodes lie on a circle about the axis; seen along it each segment is a chord of `angle`.
    chord = segment_length * (np.array([0.0, 0.0, 1.0]) - axis[2] * axis)
    chord_length = float(np.linalg.norm(chord))
    radius = chord_length / (2 * math.sin(abs(angle) / 2)) if chord_length > 0 else 0.0
    if radius > _STRAIGHT:
        outward = -(chord + np.cross(axis, chord) / math.tan(angle / 2)) / (2 * radius)
    else:
        outward = np.array([1.0, 0.0, 0.0])
    return DiscreteHelix(rotation_matrix(axis, angle), axis, angle, rise, radius, outward)


@dataclass(frozen=True)
class RestShape:
    """A flagellum at rest, in the axes (e1, e2, e3) of its first segment.

    Attributes:
        frames: axes of every segment as columns, shape [N, 3, 3]; the first is the identity.
        helix_axes: columns are the axis of the helix, away from r_0, a direction across it from which phases are
            counted, that from the axis to r_0 on a helix, and the axis times that; shape [3, 3].
        strain: intrinsic strain Omega^0 of the joints between segments [1/um], shape [N - 1, 3].
    """

    frames: Array
    helix_axes: Array
    strain: Array


@functools.lru_cache(maxsize=256)
def rest_shape(strain: tuple[float, float, float], segment_length: float, count: int, on_axis: bool) -> RestShape:
    """A flagellum at rest.

    Args:
        strain: intrinsic strain of the helix [1/um].
        segment_length: h [um].
        count: number of segments.
        on_axis: whether r_0 lies on the axis of the helix; else it is a node of it.
    """
    helix = ground_state(strain, segment_length)
    axes = np.stack([helix.axis, *across(helix.axis, helix.outward)], axis=1)
    if on_axis and helix.radius > _STRAIGHT:
        return _tapered(helix, axes, segment_length, strain[2], count)
    # Powers of the joint in closed form: no error accumulates along the filament.
    frames = rotation_matrix(helix.axis, helix.angle * np.arange(count))
    return RestShape(frames, axes, np.tile(np.array(strain, float), (count - 1, 1)))


def _tapered(helix: DiscreteHelix, axes: Array, h: float, twist: float, count: int) -> RestShape:
    """The shape that starts on the axis. Coordinates: along the axis, and the two directions of phases 0 and 90 deg.

    Nodes lie on a curve that winds about the axis as the helix does, its distance from it R (3 s^2 - 2 s^3), s the
    share of `TAPER` that is passed, at chords of h; so beyond they are those of the discrete helix. Frames go back from
    there with the intrinsic twist; what they bend is intrinsic.
    """

    def point(z: float) -> Array:
        s, around = min(z / TAPER, 1.0), helix.angle * z / helix.rise
        radius = helix.radius * s * s * (3.0 - 2.0 * s)
        return np.array([z, radius * math.cos(around), radius * math.sin(around)])

    heights = [0.0]
    while heights[-1] < TAPER:
        here = point(heights[-1])
        low, high = heights[-1], heights[-1] + h
        for _ in range(60):
            middle = (low + high) / 2
            low, high = (middle, high) if np.linalg.norm(point(middle) - here) < h else (low, middle)
        heights.append((low + high) / 2)
    begin = len(heights) - 1  # segments before lie on the taper
    count_all = max(count, begin + 1)
    z = np.concatenate([heights, heights[-1] + helix.rise * np.arange(1, count_all - begin + 1)])
    around = np.array([1.0, 0.0, 0.0])
    frames = np.empty((count_all, 3, 3))
    frames[begin:] = rotation_matrix(around, helix.angle / helix.rise * z[begin:count_all]) @ axes.T
    for i in reversed(range(begin)):
        tangent = (point(z[i + 1]) - point(z[i])) / h
        after, e1 = frames[i + 1, :, 2], frames[i + 1, :, 0]
        carried = e1 - np.dot(e1, tangent) / (1.0 + np.dot(after, tangent)) * (tangent + after)
        back = -h * twist
        e1 = math.cos(back) * carried + math.sin(back) * np.cross(tangent, carried)
        frames[i] = np.stack([e1, np.cross(tangent, e1), tangent], axis=1)
    frames = frames[:count]
    strain = joint_strain(frames[:, :, 2], frames[:, :, 0]) / h
    return RestShape(frames[0].T @ frames, frames[0].T, strain)


def joint_strain(tangents: Array, directors: Array) -> Array:
    """Strain h Omega of the joints between consecutive segments [rad], shape [..., count - 1, 3].

    With the curvature binormal kb = 2 t x u/(1 + t.u) of the tangents t, u before and after, h Omega_1,2 =
    kb . (mean e1, mean e2), and h Omega_3 is the angle from e1, after parallel transport by the minimal rotation of t
    onto u, to the next e1.

    Args:
        tangents: e3 of the segments, shape [..., count, 3].
        directors: e1 of the same segments, same shape.

    Source:
        discrete elastic rods, Bergou et al., ACM Trans. Graph. 27, 63 (2008).
    """
    t, u, a, b = tangents[..., :-1, :], tangents[..., 1:, :], directors[..., :-1, :], directors[..., 1:, :]
    one_plus_cos = 1.0 + np.vecdot(t, u)
    binormal = np.cross(t, u) * (2.0 / one_plus_cos)[..., None]
    transported = a - (np.vecdot(u, a) / one_plus_cos)[..., None] * (t + u)
    twist = np.arctan2(np.vecdot(np.cross(transported, b), u), np.vecdot(transported, b))
    bend = [np.vecdot(binormal, a + b) / 2, np.vecdot(binormal, np.cross(t, a) + np.cross(u, b)) / 2]
    return np.stack([*bend, twist], axis=-1)


def across(axis: Array, outward: Array) -> tuple[Array, Array]:
    """Two unit vectors across the unit vector `axis`: `outward` made perpendicular to it, and axis x that."""
    first = outward - np.dot(outward, axis) * axis
    first /= np.linalg.norm(first)
    return first, np.cross(axis, first)


def rotation_matrix(axis: Array, angle: float | Array) -> Array:
    """Rotation matrices about a unit axis by `angle` [rad], shape [..., 3, 3] for angles of shape [...]."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    sine, half = np.sin(angle)[..., None, None], np.sin(np.asarray(angle) / 2)[..., None, None]
    return np.eye(3) + sine * cross + 2 * half**2 * (cross @ cross)
