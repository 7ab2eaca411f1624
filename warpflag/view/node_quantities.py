"""What a movie colours the nodes by, from the record alone: curvature, phase difference, contact load.

Functions take blocks of frames, flagellum after flagellum; flagellum k has the nodes first_node[k] to
first_node[k + 1] - 1.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from warpflag_kernels.contact.constants import CUTOFF

from warpflag.observables import closest_parameters, local_phase_difference, segment_tangents, steric_force

__all__ = ["contact_load", "curvature", "nearest_phase_difference"]

Array = NDArray[np.floating]


def curvature(positions: Array, first_node: NDArray[np.integer]) -> Array:
    """Curvature of the centre line at the nodes [1/um], shape [frame, node].

    It is |kb| of discrete elastic rods over the mean length of the two segments at a node. The ends of a flagellum have
    no joint and take their neighbour's value.

    Args:
        positions: nodes [um], shape [frame, node, 3].
        first_node: shape [flagellum_count + 1].

    Source:
        Bergou et al., Discrete elastic rods, ACM Trans. Graph. 27, 63 (2008), eq. (1).
    """
    values = np.empty(positions.shape[:2])
    for first, end in pairwise(first_node):
        edges = np.diff(positions[:, first:end], axis=1)
        lengths = np.sqrt(np.vecdot(edges, edges))
        tangents = edges / lengths[..., None]
        before, after = tangents[:, :-1], tangents[:, 1:]
        binormal = 2.0 * np.cross(before, after) / (1.0 + np.vecdot(before, after))[..., None]
        joints = 2.0 * np.sqrt(np.vecdot(binormal, binormal)) / (lengths[:, :-1] + lengths[:, 1:])
        values[:, first:end] = np.pad(joints, ((0, 0), (1, 1)), mode="edge")
    return values


def nearest_phase_difference(positions: Array, directors: Array, first_node: NDArray[np.integer]) -> Array:
    """Local phase difference theta(i) in [0, 1] of each node with the nearest other flagellum, shape [frame, node].

    Nearest is the flagellum whose node of the same number is; segments are paired by their number from the motor,
    as the paper does. Node i takes the value of segment i, r_0 that of segment 1. NaN where there is no other
    flagellum of that length, or where the tangents are antiparallel.

    Args:
        positions: nodes [um], shape [frame, node, 3].
        directors: e1 of motor tripod and segments, shape [frame, node, 3].
        first_node: shape [flagellum_count + 1].
    """
    first_node = np.asarray(first_node)
    counts = np.diff(first_node)
    frames = len(positions)
    # Padded to the longest flagellum, node number first: node i meets the nodes i of all others.
    shape = (frames, counts.max(), len(counts), 3)
    nodes, e1, e3 = np.full(shape, np.inf), np.full(shape, np.nan), np.full(shape, np.nan)
    for k, (first, end) in enumerate(pairwise(first_node)):
        nodes[:, : counts[k], k] = positions[:, first:end]
        e1[:, 1 : counts[k], k] = directors[:, first + 1 : end]
        e3[:, 1 : counts[k], k] = segment_tangents(positions[:, first:end])
    theta = np.full(shape[:3], np.nan)
    for i in range(1, counts.max()):
        present = np.flatnonzero(counts > i)
        if len(present) < 2:
            break
        x = nodes[:, i, present]
        x = x - x.mean(axis=1, keepdims=True)
        squares = np.vecdot(x, x)
        distances = squares[:, None, :] - 2.0 * x @ x.swapaxes(1, 2)  # less |x|^2 of the row, which ranks the same
        distances[:, range(len(present)), range(len(present))] = np.inf
        partner = distances.argmin(axis=2)[..., None]
        own_e1, own_e3 = e1[:, i, present], e3[:, i, present]
        theta[:, i, present] = local_phase_difference(
            own_e1, own_e3, np.take_along_axis(own_e1, partner, 1), np.take_along_axis(own_e3, partner, 1)
        )
    theta[:, 0] = theta[:, 1]
    return np.concatenate([theta[:, : counts[k], k] for k in range(len(counts))], axis=1)


def contact_load(
    positions: Array,
    first_node: NDArray[np.integer],
    strength: float,
    diameter: float,
    own_spacing: NDArray[np.integer] | None = None,
) -> Array:
    """Steric load of each node [pN], shape [frame, node].

    It is the node's shares of |F| from every contact between segments of different flagella.

    The force between two segments is `steric_force` of their least distance; at parameter t of a segment it acts by
    1 - t on the first and t on the second node. Every contact counts on both sides, so a frame's sum is twice the
    recorded steric force.

    Args:
        positions: nodes [um], shape [frame, node, 3].
        first_node: shape [flagellum_count + 1].
        strength: F_0 [pN].
        diameter: sigma [um].
        own_spacing: of each flagellum, how many numbers two of its own segments must be apart to touch; default: they
            never do.
    """
    frames, nodes = positions.shape[:2]
    is_segment = np.ones(nodes, dtype=bool)
    is_segment[np.asarray(first_node)[:-1]] = False
    last = np.flatnonzero(is_segment)  # segment i ends at node i
    flagellum = np.repeat(np.arange(len(first_node) - 1), np.diff(first_node))[last]
    starts, vectors = positions[:, last - 1], positions[:, last] - positions[:, last - 1]
    longest = float(np.sqrt(np.vecdot(vectors, vectors).max()))
    own = None if own_spacing is None else np.asarray(own_spacing)[flagellum]
    i, j = _near_pairs(starts + 0.5 * vectors, longest + CUTOFF * diameter, flagellum, own)
    starts, vectors = starts.reshape(-1, 3), vectors.reshape(-1, 3)
    s, t = closest_parameters(starts[i], vectors[i], starts[j], vectors[j])
    gap = starts[i] + s[:, None] * vectors[i] - starts[j] - t[:, None] * vectors[j]
    force = steric_force(np.sqrt(np.vecdot(gap, gap)), strength, diameter)
    node = (np.arange(frames)[:, None] * nodes + last).ravel()
    shares = ((node[i] - 1, 1.0 - s), (node[i], s), (node[j] - 1, 1.0 - t), (node[j], t))
    load = sum(np.bincount(where, share * force, frames * nodes) for where, share in shares)
    return np.reshape(load, (frames, nodes))


def _near_pairs(
    points: Array, reach: float, group: NDArray[np.integer], spacing: NDArray[np.integer] | None = None
) -> tuple[NDArray, NDArray]:
    """Pairs of points of one frame that are near each other and of different groups, each pair once.

    Points are sorted by cell of a grid as wide as the reach; z is its fastest index, so that the cells above and below
    are one range of the sorted points, and five ranges hold every neighbour once.

    Args:
        points: [um], shape [frame, count, 3].
        reach: distance below which two points are near [um].
        group: shape [count].
        spacing: numbers from which on two points of one group make a pair, too, shape [count].

    Returns:
        Indices frame * count + point of the first and of the second of every pair.
    """
    frames, count = points.shape[:2]
    frame = np.repeat(np.arange(frames), count)
    points = points.reshape(-1, 3)
    cell = ((points - points.min(axis=0)) / reach).astype(np.int64) + 1
    nx, ny, nz = cell.max(axis=0) + 2
    key = ((frame * nx + cell[:, 0]) * ny + cell[:, 1]) * nz + cell[:, 2]
    order = np.argsort(key, kind="stable")
    points, key, group = points[order], key[order], np.tile(group, frames)[order]
    pairs = []
    for column in (0, 1, ny - 1, ny, ny + 1):
        centre = key + column * nz
        begin = np.arange(1, len(key) + 1) if column == 0 else np.searchsorted(key, centre - 1)
        counts = np.searchsorted(key, centre + 1, side="right") - begin
        i = np.repeat(np.arange(len(key)), counts)
        j = np.arange(len(i)) + np.repeat(begin - np.cumsum(counts) + counts, counts)
        other = group[i] != group[j]
        if spacing is not None:
            other |= np.abs(order[i] - order[j]) >= spacing[order[i] % count]
        i, j = i[other], j[other]
        away = points[i] - points[j]
        near = np.vecdot(away, away) < reach * reach
        pairs.append((order[i[near]], order[j[near]]))
    return np.concatenate([i for i, _ in pairs]), np.concatenate([j for _, j in pairs])
