"""The paper's measures of synchronisation, bundling and swimming, as NumPy functions on arrays.

Functions of one frame take the flagella as flat arrays, flagellum after flagellum, and `first_node`, shape
[flagellum_count + 1]: flagellum k has the rows first_node[k] to first_node[k + 1] - 1, its nodes r_0..r_N.
Row i of a flagellum's directors belongs to segment i, which joins r_{i-1} and r_i; row 0 is the motor tripod
and is left out of every measure here. "The paper" is Adhyapak & Stark, Phys. Rev. E 92, 052701 (2015).

Functions of a window take consecutive frames, and the rates are differences over that window: instantaneous
velocities of a stiff model carry fast modes that say nothing about swimming.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "BUNDLE_DISTANCE",
    "body_rate",
    "body_speed",
    "bundle_length",
    "bundled_fraction",
    "bundled_nodes",
    "local_phase_difference",
    "motor_rate",
    "net_speed",
    "phase_difference",
    "segment_tangents",
    "turns_about_axis",
    "winding_number",
]

Array = NDArray[np.floating]

BUNDLE_DISTANCE = 0.44
"""Twice the radius of the normal flagellar helix, 2R [um]: a node this near to another one is bundled."""

_ANTIPARALLEL = 1e-12  # of 1 + cos: tangents within 1.4e-6 rad of antiparallel have no minimal rotation
_PAIRS_PER_BLOCK = 1 << 15  # point-segment pairs held at once: temporary arrays that fit the cache


def local_phase_difference(e1_a: Array, tangents_a: Array, e1_b: Array, tangents_b: Array) -> Array:
    """Local phase difference of two flagella, segment by segment: theta(i) = arccos(e1(i) . e1~*(i)) / pi.

    e1~* is the e1 of flagellum b after the minimal rotation that takes its tangent onto the tangent of
    flagellum a. Exchanging the flagella changes nothing. Source: the paper, text above its Fig. 3.

    e1_a, e1_b: material directors e1, unit, across the tangents; shape [..., segment_count, 3], broadcast
    together. tangents_a, tangents_b: unit tangents e3, same shapes.

    Returns theta in [0, 1], shape [..., segment_count]: 0 in phase, 1 in antiphase. Where the tangents are
    antiparallel no rotation is minimal and theta is undefined: NaN there, which the averages leave out.
    """
    e1_a, tangents_a = np.asarray(e1_a, float), np.asarray(tangents_a, float)
    e1_b, tangents_b = np.asarray(e1_b, float), np.asarray(tangents_b, float)
    tangent_sum = tangents_a + tangents_b
    one_plus_cos = 0.5 * np.vecdot(tangent_sum, tangent_sum)  # free of the cancellation in 1 + t.t
    one_plus_cos = np.where(one_plus_cos < _ANTIPARALLEL, np.nan, one_plus_cos)
    # e1* = e1_b - (t_a . e1_b) / (1 + t_a . t_b) (t_a + t_b), resolved along e1_a and e2_a. The angle from
    # atan2 is exact to round-off at 0 and pi, where arccos loses half the digits.
    e2_a = np.cross(tangents_a, e1_a)
    tilt = np.vecdot(tangents_a, e1_b) / one_plus_cos
    along_e1 = np.vecdot(e1_a, e1_b) - tilt * np.vecdot(e1_a, tangents_b)
    along_e2 = np.vecdot(e2_a, e1_b) - tilt * np.vecdot(e2_a, tangents_b)
    return np.abs(np.arctan2(along_e2, along_e1)) / np.pi


def segment_tangents(positions: Array) -> Array:
    """Unit tangents of the segments 1..N of one flagellum with nodes `positions` [um], [..., N + 1, 3]."""
    edges = np.diff(np.asarray(positions, float), axis=-2)
    return edges / np.sqrt(np.vecdot(edges, edges))[..., None]


def phase_difference(positions: Array, directors: Array, first_node: NDArray[np.integer]) -> float:
    """Contour-averaged phase difference <theta> in [0, 1] of one frame, mean over all pairs of flagella.

    theta(i) of `local_phase_difference` is averaged over the segments 1..N of a pair (segments are paired by
    their number from the motor; of unequal flagella the common part counts), then over the pairs. Undefined
    segments are left out. Source: the paper, Fig. 3(a).

    positions: nodes [um], shape [node_count, 3]. directors: e1 of tripod and segments, shape [node_count, 3].

    Returns NaN where no segment of any pair is defined. Raises ValueError with fewer than two flagella.
    """
    positions, directors = np.asarray(positions, float), np.asarray(directors, float)
    bounds = [int(i) for i in np.asarray(first_node)]
    if len(bounds) < 3:
        raise ValueError("phase_difference needs at least two flagella")
    lengths = np.diff(bounds) - 1
    # Padded with NaN: ragged flagella broadcast, and the padding drops out with the undefined segments.
    e1 = np.full((len(lengths), lengths.max(), 3), np.nan)
    tangents = np.full_like(e1, np.nan)
    for k, (first, end) in enumerate(pairwise(bounds)):
        e1[k, : lengths[k]] = directors[first + 1 : end]
        tangents[k, : lengths[k]] = segment_tangents(positions[first:end])
    pair_means = []
    for k in range(len(lengths) - 1):
        theta = local_phase_difference(e1[k], tangents[k], e1[k + 1 :], tangents[k + 1 :])
        defined = ~np.isnan(theta)
        counts = np.count_nonzero(defined, axis=-1)
        sums = np.sum(theta, axis=-1, where=defined)
        pair_means.append(sums[counts > 0] / counts[counts > 0])
    means = np.concatenate(pair_means)
    return float(means.mean()) if means.size else float("nan")


def bundled_nodes(
    positions: Array, first_node: NDArray[np.integer], distance: float = BUNDLE_DISTANCE
) -> NDArray[np.bool_]:
    """Which nodes lie within `distance` [um] of the segments 1..N of any other flagellum; shape [node_count].

    The distance is the least one from the node to the centre line. Source: the paper's bundled portion,
    "within a distance 2R". positions: nodes [um], shape [node_count, 3].
    """
    positions = np.asarray(positions, float)
    positions = positions - positions.mean(axis=0)  # keeps the squares below small far from the origin
    bounds = [int(i) for i in np.asarray(first_node)]
    bundled = np.zeros(len(positions), dtype=bool)
    edges = np.diff(positions, axis=0)
    is_segment = np.ones(len(edges), dtype=bool)
    is_segment[np.asarray(bounds[1:-1], dtype=int) - 1] = False  # tip of one, r_0 of the next
    for first, end in pairwise(bounds):
        others = is_segment.copy()
        others[first : end - 1] = False
        starts, vectors = positions[:-1][others], edges[others]
        rows = max(1, _PAIRS_PER_BLOCK // max(1, len(starts)))
        for row in range(first, end, rows):
            stop = min(row + rows, end)
            bundled[row:stop] = _near_segments(positions[row:stop], starts, vectors, distance)
    return bundled


def _near_segments(points: Array, starts: Array, vectors: Array, distance: float) -> NDArray[np.bool_]:
    """Which points lie within `distance` of any segment start + s vector, s in [0, 1]."""
    squared_lengths = np.vecdot(vectors, vectors)
    inverse = 1.0 / np.maximum(squared_lengths, np.finfo(float).tiny)
    # With along = (p - start).vector, the squared distance is |p - start|^2 - s (2 along - s |vector|^2).
    along = points @ vectors.T - np.vecdot(starts, vectors)
    squared = (-2.0 * points) @ starts.T
    squared += np.vecdot(points, points)[:, None]
    squared += np.vecdot(starts, starts)
    s = np.clip(along * inverse, 0.0, 1.0)
    along *= 2.0
    along -= s * squared_lengths
    squared -= s * along
    return (squared <= distance * distance).any(axis=1)


def bundled_fraction(positions: Array, first_node: NDArray[np.integer], distance: float = BUNDLE_DISTANCE) -> Array:
    """Bundled part of each flagellum as a fraction of its length, shape [flagellum_count].

    The rule: nodes r_0..r_N are scanned from the motor; the index of the last node of the first contiguous
    run of bundled nodes (see `bundled_nodes`), over N; 0 without such a run. The anchors themselves may lie
    outside the distance, so the run need not start at r_0; a node that leaves it ends it.
    """
    bundled = bundled_nodes(positions, first_node, distance)
    bounds = [int(i) for i in np.asarray(first_node)]
    fractions = np.zeros(len(bounds) - 1)
    for k, (first, end) in enumerate(pairwise(bounds)):
        mask = bundled[first:end]
        start = int(mask.argmax())
        if mask[start]:
            gap = int(mask[start:].argmin())  # 0: no gap after the start, the run reaches the tip
            fractions[k] = (start + gap - 1 if gap else len(mask) - 1) / (len(mask) - 1)
    return fractions


def bundle_length(positions: Array, first_node: NDArray[np.integer], distance: float = BUNDLE_DISTANCE) -> float:
    """Bundle length l_r of one frame in [0, 1]: mean of `bundled_fraction` over the flagella.

    Source: the paper, Fig. 3(b), which measures it from the cell body to the bundle front over the axial
    length. 0 with one flagellum. positions: nodes [um], shape [node_count, 3].
    """
    return float(bundled_fraction(positions, first_node, distance).mean())


def body_speed(times: Array, body_positions: Array, body_orientations: Array) -> float:
    """Swimming speed along the body axis over the window [um/s], positive forward (along -e_b3).

    The displacement of each interval along the mean axis of its two ends, summed, over the time passed. A
    wobbling body swims along a helix, whose length this measures; `net_speed` is the way it gets ahead.

    times: [s], shape [frame_count], at least two. body_positions: [um], shape [frame_count, 3].
    body_orientations: quaternions (x, y, z, w), shape [frame_count, 4].
    """
    duration = _window(times)
    x, y, z, w = np.moveaxis(_unit(body_orientations), -1, 0)
    rearward = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    mean_axis = rearward[1:] + rearward[:-1]
    mean_axis /= np.linalg.norm(mean_axis, axis=-1, keepdims=True)
    return float(-np.vecdot(np.diff(np.asarray(body_positions, float), axis=0), mean_axis).sum() / duration)


def net_speed(times: Array, body_positions: Array) -> float:
    """Net displacement of the body over the window, over the time passed [um/s]: never negative.

    times: [s], shape [frame_count], at least two. body_positions: [um], shape [frame_count, 3].
    """
    body_positions = np.asarray(body_positions, float)
    return float(np.linalg.norm(body_positions[-1] - body_positions[0]) / _window(times))


def body_rate(times: Array, body_orientations: Array) -> float:
    """Rotation rate of the body about its own axis e_b3 (it points to the rear) [Hz], over the window.

    The angles about e_b3 of the rotations between successive frames, summed: right as long as the body turns
    by less than half a turn between two frames. Negative for the paper's cell, whose left-handed flagella
    turn positive.

    times: [s], shape [frame_count], at least two. body_orientations: quaternions (x, y, z, w), shape
    [frame_count, 4].
    """
    duration = _window(times)
    q = _unit(body_orientations)
    (ax, ay, az, aw), (bx, by, bz, bw) = np.moveaxis(q[:-1], -1, 0), np.moveaxis(q[1:], -1, 0)
    # conj(a) b: the rotation from one frame to the next in body axes, taken the short way round.
    x, y, z = aw * bx - ax * bw - ay * bz + az * by, aw * by + ax * bz - ay * bw - az * bx, aw * bz - az * bw
    z = z - ax * by + ay * bx
    w = aw * bw + ax * bx + ay * by + az * bz
    sine = np.sqrt(x * x + y * y + z * z)
    angle = 2.0 * np.arctan2(sine, np.abs(w)) * np.copysign(1.0, w)
    about_axis = angle * z / np.where(sine > 0.0, sine, 1.0)
    return float(about_axis.sum() / (2.0 * np.pi * duration))


def motor_rate(times: Array, motor_angles: Array) -> Array:
    """Rotation rate of each motor about its axis m relative to the body [Hz], shape [flagellum_count].

    times: [s], shape [frame_count], at least two. motor_angles: accumulated angles [rad], shape
    [frame_count, flagellum_count].
    """
    motor_angles = np.asarray(motor_angles, float)
    return (motor_angles[-1] - motor_angles[0]) / (2.0 * np.pi * _window(times))


def winding_number(positions_a: Array, positions_b: Array) -> float:
    """Turns that two flagella make about each other: the Gauss linking integral of their centre lines.

    (1/4 pi) sum over segment pairs of the solid angle that the parallelogram of their connecting vectors
    spans, exact for straight segments. Positive where they wind right-handed; for open curves it need not be
    whole, and it jumps by 1 when one passes through the other. The curves must not touch.

    positions_a, positions_b: nodes [um], shapes [N_a + 1, 3] and [N_b + 1, 3].
    """
    a, b = np.asarray(positions_a, float), np.asarray(positions_b, float)
    vectors = a[:, None, :] - b[None, :, :]
    p, q, r, s = vectors[:-1, :-1], vectors[1:, :-1], vectors[1:, 1:], vectors[:-1, 1:]
    return float((_solid_angle(p, q, r) + _solid_angle(p, r, s)).sum() / (-4.0 * np.pi))


def _solid_angle(a: Array, b: Array, c: Array) -> Array:
    """Signed solid angle of the triangles a, b, c seen from the origin (van Oosterom & Strackee 1983)."""
    la, lb, lc = (np.sqrt(np.vecdot(v, v)) for v in (a, b, c))
    denominator = la * lb * lc + np.vecdot(a, b) * lc + np.vecdot(b, c) * la + np.vecdot(c, a) * lb
    return 2.0 * np.arctan2(np.vecdot(a, np.cross(b, c)), denominator)


def turns_about_axis(points: Array, origin: ArrayLike, axis: ArrayLike) -> float:
    """Turns that a chain of points makes about a straight axis, right-handed about its direction positive.

    Taken along a flagellum it is negative for a left-handed helix; taken along the frames of one node it
    counts the turns of that node. Right as long as two successive points are less than half a turn apart.

    points: [um], shape [count, 3]. origin: a point of the axis [um], shape [3]. axis: its direction, shape
    [3].
    """
    axis = _unit(axis)
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    across /= np.linalg.norm(across)
    offsets = np.asarray(points, float) - np.asarray(origin, float)
    angles = np.unwrap(np.arctan2(offsets @ np.cross(axis, across), offsets @ across))
    return float((angles[-1] - angles[0]) / (2.0 * np.pi))


def _unit(vectors: ArrayLike) -> Array:
    vectors = np.asarray(vectors, float)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _window(times: Array) -> float:
    """The time passed over the window [s]; raises ValueError where there is none."""
    times = np.asarray(times, float)
    if len(times) < 2 or not times[-1] > times[0]:
        raise ValueError("a rate needs at least two frames at increasing times")
    return float(times[-1] - times[0])
