"""The shape of flagella: strains and elastic energy along the contour, axis and pitch of the helix, winding."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag.observables.arrays import Array, flagella, unit
from warpflag.observables.phase import segment_tangents
from warpflag.scene.helix import joint_strain, rest_shape

if TYPE_CHECKING:
    from warpflag.scene import Scene

__all__ = [
    "OUTER_PART",
    "elastic_energy",
    "helix_axis",
    "helix_pitch",
    "local_axes",
    "phase_velocity",
    "strain",
    "turns_about_axis",
    "winding_number",
]

OUTER_PART = 1 / 3
"""Where along a flagellum the part begins that turns about its own axis, free of the hook, as a fraction of it."""


def strain(tangents: Array, directors: Array, segment_length: float) -> Array:
    """Curvatures and twist along one flagellum: Omega_1, Omega_2, Omega_3 of every joint [1/um], [..., count - 1, 3].

    Curvature is |(Omega_1, Omega_2)|, twist Omega_3; the ground state has (0, 1.3, -2.1). With the curvature binormal
    kb = 2 t x u/(1 + t.u) of the tangents t, u before and after, h Omega_1,2 = kb . (mean e1, mean e2), and h Omega_3
    is the angle from e1, after parallel transport by the minimal rotation of t onto u, to the next e1.

    Args:
        tangents: e3 of consecutive segments, shape [..., count, 3]; with the motor tripod first, row 0 of the result
            is the hook.
        directors: e1 of the same segments, same shape.
        segment_length: h at rest [um].

    Source:
        discrete elastic rods, Bergou et al., ACM Trans. Graph. 27, 63 (2008).
    """
    tangents, directors = np.asarray(tangents, float), np.asarray(directors, float)
    return joint_strain(tangents, directors) / segment_length


def elastic_energy(
    scene: Scene, positions: Array, directors: Array, motor_axes: Array, first_node: NDArray[np.integer]
) -> Array:
    """Elastic energy of all flagella by term: bending, twist (both with the hook's), stretching [pN um], shape [3].

    Bending and twist are discretised as in `strain`; stretching is (K h/2)(|dr|/h - 1)^2.

    Args:
        scene: gives the elastic constants and segment lengths.
        positions: nodes [um], shape [node_count, 3].
        directors: e1 of tripod and segments, shape [node_count, 3].
        motor_axes: e3 of the tripods in the lab, shape [flagellum_count, 3].
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].

    Source:
        the paper's Kirchhoff energy; its stretching energy has no rest length, this one has.
    """
    group, energy = scene.flagella, np.zeros(3)
    for spec, rows, axis in zip(scene.resolved_flagella(), flagella(first_node), motor_axes, strict=True):
        h, nodes = spec.segment_length, np.asarray(positions[rows], float)
        tangents = np.vstack([axis, segment_tangents(nodes)])
        omega = strain(tangents, directors[rows], h)
        rest = rest_shape(group.strain_at_rest(h), h, spec.segment_count, group.on_axis)
        first = np.stack([directors[rows][1], np.cross(tangents[1], directors[rows][1]), tangents[1]], axis=1)
        stiffness = scene.hook.stiffness * (1.0 + abs(spec.torque) / (scene.hook.stiffening_torque or np.inf))
        bent = 2.0 * np.cross(axis, first @ rest.helix_axes[:, 0]) / (1.0 + axis @ first @ rest.helix_axes[:, 0])
        excess = omega[1:] - rest.strain
        hook = group.hook_twist_factor * omega[0, 2] ** 2
        stretch = np.linalg.norm(np.diff(nodes, axis=0), axis=1) / h - 1.0
        energy += [
            h / 2 * group.bending_rigidity * (excess[:, :2] ** 2).sum() + stiffness / 2 * bent @ bent,
            h / 2 * group.twist_rigidity * ((excess[:, 2] ** 2).sum() + hook),
            h / 2 * group.stretching_stiffness * stretch @ stretch,
        ]
    return energy


def helix_axis(tangents: Array) -> Array:
    """Axis of a helix, pointing along it from first to last segment, unit vectors, shape [..., 3].

    The direction to which the tangents keep the most even angle: along it their covariance is least.

    Args:
        tangents: unit tangents of its segments, shape [..., count, 3].
    """
    tangents = np.asarray(tangents, float)
    mean = tangents.mean(axis=-2, keepdims=True)
    spread = tangents - mean
    _, vectors = np.linalg.eigh(np.einsum("...ia,...ib->...ab", spread, spread))
    axis = vectors[..., 0]
    return axis * np.copysign(1.0, np.vecdot(axis, mean[..., 0, :]))[..., None]


def local_axes(tangents: Array, from_fraction: float = 0.0) -> tuple[NDArray[np.integer], Array]:
    """Axes of the single turns of a helix whose axis may be bent: `helix_axis` of the turn around each segment.

    How many segments make a turn is their mean over segments and frames: a segment turns by the rotation that takes
    its Frenet frame onto the next one's. Segments less than half a turn from the ends are left out; of a flagellum of
    less than a turn there is one axis, that of the whole, for its middle segment.

    Args:
        tangents: unit tangents of the segments, shape [frame_count, segment_count, 3].
        from_fraction: of the segments, where the part begins of which axes are asked for.

    Returns:
        numbers of the segments, shape [axis_count], and unit vectors away from the first segment, shape
        [frame_count, axis_count, 3].
    """
    tangents = np.asarray(tangents, float)
    count = tangents.shape[-2]
    turn = min(count, max(3, round(min(count, _segments_per_turn(tangents)))))
    begin = min(int(from_fraction * count), count - turn)
    starts = np.arange(begin, count - turn + 1)
    windows = np.lib.stride_tricks.sliding_window_view(tangents, turn, axis=-2)[..., starts, :, :]
    return starts + turn // 2, helix_axis(np.swapaxes(windows, -1, -2))


def _segments_per_turn(tangents: Array) -> float:
    """Segments in a turn of a helix, from the mean turn of the Frenet frame per segment; infinite for a line."""
    binormals = np.cross(tangents[..., :-1, :], tangents[..., 1:, :])
    length = np.linalg.norm(binormals, axis=-1, keepdims=True)
    binormals = np.divide(binormals, length, out=np.zeros_like(binormals), where=length > 1e-12)
    t = tangents[..., 1:, :]
    frames = np.stack([t, np.cross(binormals, t), binormals], axis=-1)
    cosine = (np.einsum("...ij,...ij", frames[..., 1:, :, :], frames[..., :-1, :, :]) - 1.0) / 2.0
    angle = float(np.arccos(np.clip(cosine, -1.0, 1.0)).mean()) if cosine.size else 0.0
    return 2.0 * np.pi / angle if angle > 0.0 else float("inf")


def helix_pitch(positions: Array) -> float:
    """Advance along the helix axis per turn of the tangents about it [um], negative for a left-handed helix.

    Args:
        positions: nodes of one flagellum [um], shape [N + 1, 3]; a segment must turn by less than half a turn.
    """
    edges = np.diff(np.asarray(positions, float), axis=0)
    axis = helix_axis(unit(edges))
    # The first and last segment are half outside the turns from middle to middle.
    rise = float((edges @ axis).sum() - (edges[0] + edges[-1]) @ axis / 2)
    return rise / turns_about_axis(edges, [0.0, 0.0, 0.0], axis)


def phase_velocity(pitch: float, rate: float) -> float:
    """Speed v_e of the helical wave away from the body [um/s].

    A left-handed helix that turns positive sends its wave away from the body.

    Args:
        pitch: with its sign, negative for a left-handed helix [um].
        rate: of the rotation about the axis [Hz].

    Source:
        v_e = lambda_f nu_f of the paper's zipper.
    """
    return -pitch * rate


def winding_number(positions_a: Array, positions_b: Array) -> float:
    """Turns that two flagella make about each other: the Gauss linking integral of their centre lines.

    (1/4 pi) sum over segment pairs of the solid angle that the parallelogram of their connecting vectors
    spans, exact for straight segments. Positive where they wind right-handed; for open curves it need not be
    whole, and it jumps by 1 when one passes through the other. The curves must not touch.

    Args:
        positions_a: nodes of one flagellum [um], shape [N_a + 1, 3].
        positions_b: nodes of the other [um], shape [N_b + 1, 3].
    """
    a, b = np.asarray(positions_a, float), np.asarray(positions_b, float)
    vectors = a[:, None, :] - b[None, :, :]
    p, q, r, s = vectors[:-1, :-1], vectors[1:, :-1], vectors[1:, 1:], vectors[:-1, 1:]
    return float((_solid_angle(p, q, r) + _solid_angle(p, r, s)).sum() / (-4.0 * np.pi))


def _solid_angle(a: Array, b: Array, c: Array) -> Array:
    """Signed solid angle of the triangles with corners a, b, c seen from the origin [sr], shapes [..., 3] to [...].

    Source:
        van Oosterom & Strackee, IEEE Trans. Biomed. Eng. 30, 125 (1983).
    """
    la, lb, lc = (np.sqrt(np.vecdot(v, v)) for v in (a, b, c))
    denominator = la * lb * lc + np.vecdot(a, b) * lc + np.vecdot(b, c) * la + np.vecdot(c, a) * lb
    return 2.0 * np.arctan2(np.vecdot(a, np.cross(b, c)), denominator)


def turns_about_axis(points: Array, origin: ArrayLike, axis: ArrayLike) -> float:
    """Turns that a chain of points makes about a straight axis, right-handed about its direction positive.

    Taken along a flagellum it is negative for a left-handed helix; taken along the frames of one node it
    counts the turns of that node. Right as long as two successive points are less than half a turn apart.

    Args:
        points: of the chain [um], shape [count, 3].
        origin: a point of the axis [um], shape [3].
        axis: its direction, shape [3].
    """
    axis = unit(axis)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    offsets = np.asarray(points, float) - np.asarray(origin, float)
    angles = np.unwrap(np.arctan2(offsets @ np.cross(axis, across), offsets @ across))
    return float((angles[-1] - angles[0]) / (2.0 * np.pi))
