"""How fast the body swims and turns, and how fast motors and flagella rotate, over a window of frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag.base import rotations
from warpflag.observables.arrays import Array, elapsed, flagella, unit
from warpflag.observables.phase import segment_tangents
from warpflag.observables.shape import OUTER_PART, local_axes
from warpflag.scene import attachment
from warpflag.scene.resistance import SpheroidMobility, spheroid_mobility

if TYPE_CHECKING:
    from warpflag.scene import Scene

__all__ = [
    "along_axis",
    "body_power",
    "body_rate",
    "body_speed",
    "helix_rate",
    "lab_motor_rate",
    "motor_axes",
    "motor_rate",
    "net_speed",
    "thrust",
]


def body_speed(times: ArrayLike, body_positions: ArrayLike, body_orientations: ArrayLike) -> float:
    """Swimming speed along the body axis over the window [um/s], positive forward (along -e_b3).

    The displacement of each interval along the mean axis of its two ends, summed, over the time passed. A
    wobbling body swims along a helix, whose length this measures; `net_speed` is its speed along the helix axis.

    Args:
        times: of the frames [s], shape [frame_count], at least two.
        body_positions: centres of the body [um], shape [frame_count, 3].
        body_orientations: quaternions (x, y, z, w), shape [frame_count, 4].

    Raises:
        ValueError: fewer than two frames, or times that do not increase.
    """
    duration = elapsed(times)
    return -float(_moves(body_positions, body_orientations)[1].sum()) / duration


def along_axis(before: Array, now: Array, orientation_before: Array, orientation: Array) -> Array:
    """Displacements along the mean body axis e_b3 of their ends [um], shape [...]; negative forward.

    Args:
        before: places of the body at the beginning [um], shape [..., 3].
        now: the same at the end.
        orientation_before: quaternions (x, y, z, w) from body to lab at the beginning, shape [..., 4].
        orientation: the same at the end.
    """
    axis = unit(rotations.axis_of_body(orientation_before) + rotations.axis_of_body(orientation))
    return np.vecdot(now - before, axis)


def net_speed(times: ArrayLike, body_positions: ArrayLike) -> float:
    """Net displacement of the body over the window, over the time passed [um/s]: never negative.

    Args:
        times: of the frames [s], shape [frame_count], at least two.
        body_positions: centres of the body [um], shape [frame_count, 3].

    Raises:
        ValueError: fewer than two frames, or times that do not increase.
    """
    body_positions = np.asarray(body_positions, float)
    return float(np.linalg.norm(body_positions[-1] - body_positions[0]) / elapsed(times))


def body_rate(times: ArrayLike, body_orientations: ArrayLike) -> float:
    """Rotation rate of the body about its own axis e_b3 (it points to the rear) [Hz], over the window.

    The angles about e_b3 of the rotations between successive frames, summed: right as long as the body turns
    by less than half a turn between two frames. Negative for the paper's cell, whose left-handed flagella
    turn positive.

    Args:
        times: of the frames [s], shape [frame_count], at least two.
        body_orientations: quaternions (x, y, z, w), shape [frame_count, 4].

    Raises:
        ValueError: fewer than two frames, or times that do not increase.
    """
    return float(_body_turns(body_orientations)[:, 2].sum() / (2.0 * np.pi * elapsed(times)))


def motor_rate(times: ArrayLike, motor_angles: ArrayLike) -> Array:
    """Rotation rate of each motor about its axis m relative to the body [Hz], shape [flagellum_count].

    Args:
        times: of the frames [s], shape [frame_count], at least two.
        motor_angles: accumulated angles [rad], shape [frame_count, flagellum_count].

    Raises:
        ValueError: fewer than two frames, or times that do not increase.
    """
    motor_angles = np.asarray(motor_angles, float)
    return (motor_angles[-1] - motor_angles[0]) / (2.0 * np.pi * elapsed(times))


def lab_motor_rate(
    times: ArrayLike, motor_angles: ArrayLike, body_orientations: ArrayLike, motor_axes: ArrayLike
) -> Array:
    """Spin of each motor about its axis m in the lab [Hz], shape [flagellum_count].

    That relative to the body plus the body's own rotation along m; right as long as the body turns by less than
    half a turn between two frames.

    Args:
        times: of the frames [s], shape [frame_count], at least two.
        motor_angles: accumulated angles [rad], shape [frame_count, flagellum_count].
        body_orientations: quaternions (x, y, z, w), shape [frame_count, 4].
        motor_axes: unit vectors m in body axes, shape [flagellum_count, 3].

    Raises:
        ValueError: fewer than two frames, or times that do not increase.
    """
    turned = np.asarray(motor_axes, float) @ _body_turns(body_orientations).sum(axis=0)
    return motor_rate(times, motor_angles) + turned / (2.0 * np.pi * elapsed(times))


def motor_axes(scene: Scene) -> Array:
    """Motor axes m = cos(angle) e_b3 + sin(angle) n in body axes, n the outward normal, shape [flagellum_count, 3]."""
    return np.array([attachment.motor_axis(spec) for spec in scene.resolved_flagella()])


def helix_rate(times: ArrayLike, positions: ArrayLike, first_node: NDArray[np.integer]) -> Array:
    """Rotation rate of each flagellum about its own helix axis in the lab [Hz], shape [flagellum_count].

    The phase of a segment is the angle of its tangent about the axis of the turn of the helix around it, which bends
    with the flagellum and moves with it. From one frame to the next the phase of all segments of the outer two thirds
    grows by one angle, their mean weighted with the tangents' parts across the axes; these angles are summed. Seen
    from the body along the flagellum, positive is clockwise (right-handed about the direction away from the body).
    Right as long as a flagellum turns by less than half a turn between two frames.

    Args:
        times: of the frames [s], shape [frame_count], at least two.
        positions: nodes [um], shape [frame_count, node_count, 3].
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].

    Raises:
        ValueError: fewer than two frames, or times that do not increase.
    """
    duration, positions = elapsed(times), np.asarray(positions, float)
    rates = []
    for rows in flagella(first_node):
        tangents = segment_tangents(positions[:, rows])
        segments, axes = local_axes(tangents, from_fraction=OUTER_PART)
        across = tangents[:, segments] - np.vecdot(tangents[:, segments], axes)[..., None] * axes
        before, after, axis = across[:-1], across[1:], axes[1:]
        # The minimal rotation that takes the axis before onto the axis after carries the tangents' parts along.
        both = axes[:-1] + axis
        before = before - (np.vecdot(axis, before) / (1.0 + np.vecdot(axes[:-1], axis)))[..., None] * both
        turned = np.arctan2(np.vecdot(np.cross(before, after), axis).sum(-1), np.vecdot(before, after).sum(-1))
        rates.append(turned.sum() / (2 * np.pi * duration))
    return np.array(rates)


def thrust(speed: float, scene: Scene) -> float:
    """Force with which the flagella push the body along its axis [pN].

    The body moves by its own drag alone, so the force is the speed over the mobility along the axis, that of the
    prolate spheroid of its aspect ratio. Not for a body that is held.

    Args:
        speed: of the body along its axis [um/s].
        scene: gives the body's size and the viscosity.
    """
    return speed / _mobility(scene).along


def body_power(times: ArrayLike, body_positions: ArrayLike, body_orientations: ArrayLike, scene: Scene) -> float:
    """Power that the fluid takes from the body's translation and rotation [pN um/s], from differences over the window.

    Args:
        times: of the frames [s], shape [frame_count], at least two.
        body_positions: centres of the body [um], shape [frame_count, 3].
        body_orientations: quaternions (x, y, z, w), shape [frame_count, 4].
        scene: gives the body's size and the viscosity.

    Raises:
        ValueError: fewer than two frames, or times that do not increase.
    """
    duration, intervals = elapsed(times), np.diff(np.asarray(times, float))
    moved, along = _moves(body_positions, body_orientations)
    turned = _body_turns(body_orientations)
    mobility, work = _mobility(scene), 0.0
    for motion, part, parallel, other in (
        (moved, along, mobility.along, mobility.across),
        (turned, turned[:, 2], mobility.spin, mobility.tumble),
    ):
        work += (part**2 / parallel + (np.vecdot(motion, motion) - part**2) / other) / intervals
    return float(np.sum(work) / duration)


def _moves(body_positions: ArrayLike, body_orientations: ArrayLike) -> tuple[Array, Array]:
    """Displacements from each frame to the next [um], shape [frame_count - 1, 3], and their parts along e_b3."""
    places, turns = np.asarray(body_positions, float), np.asarray(body_orientations, float)
    return np.diff(places, axis=0), along_axis(places[:-1], places[1:], turns[:-1], turns[1:])


def _body_turns(body_orientations: ArrayLike) -> Array:
    """Rotation vectors from each frame to the next in body axes [rad], shape [frame_count - 1, 3]."""
    orientations = np.asarray(body_orientations, float)
    return rotations.vector_of_quaternion(rotations.relative(orientations[:-1], orientations[1:]))


def _mobility(scene: Scene) -> SpheroidMobility:
    return spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity)
