"""How much of the flagella is bundled, and when the zip is complete."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag.observables.arrays import Array, flagella

__all__ = [
    "BUNDLE_DISTANCE",
    "STRAY",
    "ZIPPED",
    "bundle_length",
    "bundled_fraction",
    "bundled_nodes",
    "near_segments",
    "zip_time",
]

BUNDLE_DISTANCE = 0.44
"""Twice the radius of the normal flagellar helix, 2R [um]: a node this near to another flagellum is bundled."""
STRAY = 1.0
"""Contour length [um] outside that distance which does not yet end a bundle in figures and zip times."""
ZIPPED = 0.98
"""Bundle length from which the zip counts as complete."""

_PAIRS_AT_ONCE = 1 << 15  # of nodes and segments: temporary arrays that fit the cache


def bundled_nodes(
    positions: ArrayLike,
    first_node: NDArray[np.integer],
    distance: float = BUNDLE_DISTANCE,
    *,
    pairs_at_once: int = _PAIRS_AT_ONCE,
) -> NDArray[np.bool_]:
    """Which nodes lie near the segments 1..N of any other flagellum, shape [..., node_count], of one frame or many.

    The distance is the least one from the node to the centre line.

    Args:
        positions: nodes [um], shape [..., node_count, 3].
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
        distance: up to which a node counts as near [um].
        pairs_at_once: pairs of a node and a segment whose distances are held in memory; changes no result.

    Source:
        the paper's bundled portion, "within a distance 2R".
    """
    given: Array = np.asarray(positions, float)
    nodes = given.reshape(-1, *given.shape[-2:])
    nodes = nodes - nodes.mean(axis=1, keepdims=True)  # keeps the squares below small far from the origin
    bounds = [int(i) for i in np.asarray(first_node)]
    bundled = np.zeros(nodes.shape[:2], dtype=bool)
    edges = np.diff(nodes, axis=1)
    is_segment = np.ones(edges.shape[1], dtype=bool)
    is_segment[np.asarray(bounds[1:-1], dtype=int) - 1] = False  # tip of one, r_0 of the next
    for first, end in pairwise(bounds):
        others = is_segment.copy()
        others[first : end - 1] = False
        count = max(1, int(others.sum()))
        rows = max(1, pairs_at_once // count)
        frames = max(1, pairs_at_once // (count * min(rows, end - first)))
        for frame in range(0, len(nodes), frames):
            block = slice(frame, frame + frames)
            starts, vectors = nodes[block, :-1][:, others], edges[block][:, others]
            for row in range(first, end, rows):
                stop = min(row + rows, end)
                bundled[block, row:stop] = near_segments(nodes[block, row:stop], starts, vectors, distance)
    return bundled.reshape(given.shape[:-1])


def near_segments(points: Array, starts: Array, vectors: Array, distance: float) -> NDArray[np.bool_]:
    """Which points lie within a distance of any segment start + s vector, s in [0, 1], shape [..., point_count].

    Args:
        points: [um], shape [..., point_count, 3].
        starts: of the segments [um], shape [..., segment_count, 3].
        vectors: from start to end of the segments [um], same shape.
        distance: [um].
    """
    squared_lengths = np.vecdot(vectors, vectors)[..., None, :]
    inverse = 1.0 / np.maximum(squared_lengths, np.finfo(float).tiny)
    # With along = (p - start).vector, the squared distance is |p - start|^2 - s (2 along - s |vector|^2).
    along = points @ np.swapaxes(vectors, -1, -2) - np.vecdot(starts, vectors)[..., None, :]
    squared = (-2.0 * points) @ np.swapaxes(starts, -1, -2)
    squared += np.vecdot(points, points)[..., None]
    squared += np.vecdot(starts, starts)[..., None, :]
    s = np.clip(along * inverse, 0.0, 1.0)
    along *= 2.0
    along -= s * squared_lengths
    squared -= s * along
    return (squared <= distance * distance).any(axis=-1)


def bundled_fraction(
    positions: ArrayLike, first_node: NDArray[np.integer], distance: float = BUNDLE_DISTANCE, gap: float = 0.0
) -> Array:
    """Bundled part of each flagellum as a fraction of its length, shape [..., flagellum_count], of one frame or many.

    The rule: nodes r_0..r_N are scanned from the motor; the index of the last node of the first contiguous
    run of bundled nodes (see `bundled_nodes`), over N; 0 without such a run. The anchors themselves may lie
    outside the distance, so the run need not start at r_0.

    Args:
        positions: nodes [um], shape [..., node_count, 3].
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
        distance: up to which a node counts as bundled [um].
        gap: contour length that may lie outside the distance without ending the run [um], rounded to whole segments.
            With 0, one node that is near or far by itself sets the length anew: near the body, where the flagella
            cross, some come within the distance now and then before the bundle begins.
    """
    positions = np.asarray(positions, float)
    bundled = bundled_nodes(positions, first_node, distance)
    fractions = []
    for rows in flagella(first_node):
        edges = np.diff(positions[..., rows, :], axis=-2)
        passed_over = np.round(gap / np.median(np.sqrt(np.vecdot(edges, edges)), axis=-1, keepdims=True))
        own, index = bundled[..., rows], np.arange(rows.stop - rows.start)
        # The next bundled node after each: the least of those behind it.
        beyond = np.where(own, index, 3 * len(index))[..., ::-1]
        following = np.minimum.accumulate(beyond, axis=-1)[..., ::-1]
        following = np.append(following[..., 1:], np.full((*own.shape[:-1], 1), 3 * len(index)), axis=-1)
        ends = own & ((following - index > passed_over + 1) | (following == 3 * len(index)))
        fractions.append(ends.argmax(axis=-1) / (len(index) - 1))
    return np.stack(fractions, axis=-1)


def bundle_length(
    positions: ArrayLike, first_node: NDArray[np.integer], distance: float = BUNDLE_DISTANCE, gap: float = 0.0
) -> Array:
    """Bundle length l_r in [0, 1] of one frame or many: mean of `bundled_fraction` over the flagella; 0 with one.

    Args:
        positions: nodes [um], shape [..., node_count, 3].
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
        distance: up to which a node counts as bundled [um].
        gap: contour length that may lie outside the distance [um]; records hold l_r with 0, figures take `STRAY`.

    Returns:
        l_r, shape [...], a number for one frame.

    Source:
        the paper, Fig. 3(b), which measures it from the cell body to the bundle front over the axial length.
    """
    return bundled_fraction(positions, first_node, distance, gap).mean(axis=-1)


def zip_time(times: ArrayLike, bundle_lengths: ArrayLike, hold: float = 0.0) -> float:
    """When the zip is complete [s]: the first frame from which on l_r >= 0.98 long enough; NaN if never.

    Args:
        times: of the frames [s], shape [frame_count].
        bundle_lengths: l_r, same shape.
        hold: how long l_r must stay there [s]. With 0 the first touch counts, also where two flagella that do not
            repel pass through each other.
    """
    times = np.asarray(times, float)
    zipped = np.concatenate([[False], np.asarray(bundle_lengths) >= ZIPPED, [False]])
    starts, ends = np.flatnonzero(zipped[1:-1] & ~zipped[:-2]), np.flatnonzero(zipped[1:-1] & ~zipped[2:])
    lasting = starts[times[ends] - times[starts] >= hold * (1 - 1e-9)]
    return float(times[lasting[0]]) if lasting.size else float("nan")
