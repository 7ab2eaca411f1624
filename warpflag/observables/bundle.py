"""How much of the flagella is bundled, and when the zip is complete."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from warpflag.observables.arrays import Array, flagella

__all__ = ["BUNDLE_DISTANCE", "STRAY", "ZIPPED", "bundle_length", "bundled_fraction", "bundled_nodes", "zip_time"]

BUNDLE_DISTANCE = 0.44
"""Twice the radius of the normal flagellar helix, 2R [um]: a node this near to another one is bundled."""
STRAY = 1.0
"""Contour length [um] outside the distance that a steady measure of the bundle passes over."""
ZIPPED = 0.98
"""Bundle length from which the zip counts as complete."""

_PAIRS_PER_BLOCK = 1 << 15  # point-segment pairs held at once: temporary arrays that fit the cache


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


def bundled_fraction(
    positions: Array, first_node: NDArray[np.integer], distance: float = BUNDLE_DISTANCE, gap: float = 0.0
) -> Array:
    """Bundled part of each flagellum as a fraction of its length, shape [flagellum_count].

    The rule: nodes r_0..r_N are scanned from the motor; the index of the last node of the first contiguous
    run of bundled nodes (see `bundled_nodes`), over N; 0 without such a run. The anchors themselves may lie
    outside the distance, so the run need not start at r_0.

    gap: contour length [um], rounded to whole segments, that may lie outside the distance without ending the run. By
    the plain rule, 0, one node that strays, in or out, resets the length: near the body, where the flagella cross,
    some come within the distance now and then before the bundle begins.
    """
    positions = np.asarray(positions, float)
    bundled = bundled_nodes(positions, first_node, distance)
    fractions = []
    for rows in flagella(first_node):
        edges = np.diff(positions[rows], axis=0)
        passed_over = round(gap / float(np.median(np.sqrt(np.vecdot(edges, edges)))))
        found = np.flatnonzero(bundled[rows])
        ends = found[:-1][np.diff(found) > passed_over + 1]
        last = 0 if found.size == 0 else ends[0] if ends.size else found[-1]
        fractions.append(last / len(edges))
    return np.array(fractions)


def bundle_length(
    positions: Array, first_node: NDArray[np.integer], distance: float = BUNDLE_DISTANCE, gap: float = 0.0
) -> float:
    """Bundle length l_r of one frame in [0, 1]: mean of `bundled_fraction` over the flagella.

    Source: the paper, Fig. 3(b), which measures it from the cell body to the bundle front over the axial
    length. 0 with one flagellum. positions: nodes [um], shape [node_count, 3]. gap: as there [um]; records hold the
    plain rule, 0; figures take 1 um, `STRAY`.
    """
    return float(bundled_fraction(positions, first_node, distance, gap).mean())


def zip_time(times: Array, bundle_lengths: Array, hold: float = 0.0) -> float:
    """When the zip is complete: the first frame from which on l_r >= 0.98 for at least `hold` [s]; NaN if never.

    With hold = 0 the first touch counts, also where two flagella that do not repel pass through each other.
    times: [s], shape [frame_count]. bundle_lengths: l_r, same shape.
    """
    times = np.asarray(times, float)
    zipped = np.concatenate([[False], np.asarray(bundle_lengths) >= ZIPPED, [False]])
    starts, ends = np.flatnonzero(zipped[1:-1] & ~zipped[:-2]), np.flatnonzero(zipped[1:-1] & ~zipped[2:])
    lasting = starts[times[ends] - times[starts] >= hold * (1 - 1e-9)]
    return float(times[lasting[0]]) if lasting.size else float("nan")
