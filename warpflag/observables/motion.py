"""How fast the body swims and turns, and how fast motors and flagella rotate, over a window of frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from warpflag.observables.arrays import Array, elapsed, flagella, unit
from warpflag.observables.phase import segment_tangents
from warpflag.observables.shape import helix_axis
from warpflag.scene.resistance import SpheroidMobility, spheroid_mobility

if TYPE_CHECKING:
    from warpflag.scene import Scene

__all__ = [
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


def body_speed(times: Array, body_positions: Array, body_orientations: Array) -> float:
    """Swimming speed along the body axis over the window [um/s], positive forward (along -e_b3).

    The displacement of each interval along the mean axis of its two ends, summed, over the time passed. A
    wobbling body swims along a helix, whose length this measures; `net_speed` is the way it gets ahead.

    times: [s], shape [frame_count], at least two. body_positions: [um], shape [frame_count, 3].
    body_orientations: quaternions (x, y, z, w), shape [frame_count, 4].
    """
    duration = elapsed(times)
    axes = _rearward(body_orientations)
    moved = np.diff(np.asarray(body_positions, float), axis=0)
    return float(-np.vecdot(moved, unit(axes[1:] + axes[:-1])).sum() / duration)


def _rearward(orientations: Array) -> Array:
    """e_b3 in the lab, shape [frame_count, 3]."""
    x, y, z, w = np.moveaxis(unit(orientations), -1, 0)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def net_speed(times: Array, body_positions: Array) -> float:
    """Net displacement of the body over the window, over the time passed [um/s]: never negative.

    times: [s], shape [frame_count], at least two. body_positions: [um], shape [frame_count, 3].
    """
    body_positions = np.asarray(body_positions, float)
    return float(np.linalg.norm(body_positions[-1] - body_positions[0]) / elapsed(times))


def body_rate(times: Array, body_orientations: Array) -> float:
    """Rotation rate of the body about its own axis e_b3 (it points to the rear) [Hz], over the window.

    The angles about e_b3 of the rotations between successive frames, summed: right as long as the body turns
    by less than half a turn between two frames. Negative for the paper's cell, whose left-handed flagella
    turn positive.

    times: [s], shape [frame_count], at least two. body_orientations: quaternions (x, y, z, w), shape
    [frame_count, 4].
    """
    return float(_body_turns(body_orientations)[:, 2].sum() / (2.0 * np.pi * elapsed(times)))


def _body_turns(orientations: Array) -> Array:
    """Rotation vectors from each frame to the next in body axes [rad], taken the short way, [frame_count - 1, 3]."""
    q = unit(orientations)
    (ax, ay, az, aw), (bx, by, bz, bw) = np.moveaxis(q[:-1], -1, 0), np.moveaxis(q[1:], -1, 0)
    # conj(a) b
    x, y, z = aw * bx - ax * bw - ay * bz + az * by, aw * by + ax * bz - ay * bw - az * bx, aw * bz - az * bw
    z = z - ax * by + ay * bx
    w = aw * bw + ax * bx + ay * by + az * bz
    sine = np.sqrt(x * x + y * y + z * z)
    angle = 2.0 * np.arctan2(sine, np.abs(w)) * np.copysign(1.0, w)
    return np.stack([x, y, z], axis=-1) * (angle / np.where(sine > 0.0, sine, 1.0))[:, None]


def motor_rate(times: Array, motor_angles: Array) -> Array:
    """Rotation rate of each motor about its axis m relative to the body [Hz], shape [flagellum_count].

    times: [s], shape [frame_count], at least two. motor_angles: accumulated angles [rad], shape
    [frame_count, flagellum_count].
    """
    motor_angles = np.asarray(motor_angles, float)
    return (motor_angles[-1] - motor_angles[0]) / (2.0 * np.pi * elapsed(times))


def lab_motor_rate(times: Array, motor_angles: Array, body_orientations: Array, motor_axes: Array) -> Array:
    """Spin of each motor about its axis m in the lab [Hz], shape [flagellum_count].

    That relative to the body plus the body's own rotation along m; right as long as the body turns by less than
    half a turn between two frames.

    times, motor_angles: as in `motor_rate`. body_orientations: quaternions (x, y, z, w), shape [frame_count, 4].
    motor_axes: unit vectors m in body axes, shape [flagellum_count, 3].
    """
    turned = np.asarray(motor_axes, float) @ _body_turns(body_orientations).sum(axis=0)
    return motor_rate(times, motor_angles) + turned / (2.0 * np.pi * elapsed(times))


def motor_axes(scene: Scene) -> Array:
    """Motor axes m = cos(angle) e_b3 + sin(angle) n in body axes, n the outward normal, shape [flagellum_count, 3]."""
    specs = scene.resolved_flagella()
    angle = np.radians([spec.motor_axis_angle for spec in specs])
    around = np.radians([spec.azimuth for spec in specs])
    return np.stack([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)], axis=1)


def helix_rate(times: Array, positions: Array, first_node: NDArray[np.integer]) -> Array:
    """Rotation rate of each flagellum about its own helix axis in the lab [Hz], shape [flagellum_count].

    From one frame to the next, the rotation that takes the tangents of all segments onto the new ones with the
    least squared error; its angles about the helix axis (away from the body, see `helix_axis`), summed. In a bundle
    that axis is the bundle's. Right as long as a flagellum turns by less than half a turn between two frames.

    times: [s], shape [frame_count], at least two. positions: nodes [um], shape [frame_count, node_count, 3].
    """
    duration, positions = elapsed(times), np.asarray(positions, float)
    rates = []
    for rows in flagella(first_node):
        tangents = segment_tangents(positions[:, rows])
        axes = helix_axis(tangents)
        left, _, right = np.linalg.svd(np.einsum("fia,fib->fab", tangents[1:], tangents[:-1]))
        left[..., 2] *= np.linalg.det(left @ right)[:, None]  # a rotation, not a reflection
        turns = _rotation_vectors(left @ right)
        rates.append(np.vecdot(turns, unit(axes[1:] + axes[:-1])).sum() / (2 * np.pi * duration))
    return np.array(rates)


def _rotation_vectors(matrices: Array) -> Array:
    """Axis times angle [rad] of rotations by less than half a turn, shape [..., 3]."""
    twice_sine = np.stack(
        [
            matrices[..., 2, 1] - matrices[..., 1, 2],
            matrices[..., 0, 2] - matrices[..., 2, 0],
            matrices[..., 1, 0] - matrices[..., 0, 1],
        ],
        axis=-1,
    )
    size = np.linalg.norm(twice_sine, axis=-1, keepdims=True)
    angle = np.arctan2(size[..., 0], np.trace(matrices, axis1=-2, axis2=-1) - 1.0)[..., None]
    return twice_sine * np.divide(angle, size, out=np.full_like(size, 0.5), where=size > 0.0)


def thrust(speed: float, scene: Scene) -> float:
    """Force with which the flagella push the body along its axis [pN], from its speed along it [um/s].

    The body moves by its own drag alone, so the force is the speed over the mobility along the axis, that of the
    prolate spheroid of its aspect ratio. Not for a body that is held.
    """
    return speed / _mobility(scene).along


def body_power(times: Array, body_positions: Array, body_orientations: Array, scene: Scene) -> float:
    """Power that the fluid takes from the body's translation and rotation [pN um/s], from differences over the window.

    times: [s], shape [frame_count], at least two. body_positions: [um], shape [frame_count, 3]. body_orientations:
    quaternions (x, y, z, w), shape [frame_count, 4].
    """
    duration, intervals = elapsed(times), np.diff(np.asarray(times, float))
    axes = _rearward(body_orientations)
    moved, turned = np.diff(np.asarray(body_positions, float), axis=0), _body_turns(body_orientations)
    along, spun = np.vecdot(moved, unit(axes[1:] + axes[:-1])), turned[:, 2]
    mobility, work = _mobility(scene), 0.0
    for motion, part, parallel, other in (
        (moved, along, mobility.along, mobility.across),
        (turned, spun, mobility.spin, mobility.tumble),
    ):
        work += (part**2 / parallel + (np.vecdot(motion, motion) - part**2) / other) / intervals
    return float(np.sum(work) / duration)


def _mobility(scene: Scene) -> SpheroidMobility:
    return spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity)
