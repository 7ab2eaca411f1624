"""The measures of a frame for many cells of one structure in one pass.

Arrays have the cells first; `first_node` is that of one cell and holds for all. The numbers of a cell do not depend on
which others are measured with it, to the last bit.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from warpflag.base.rotations import axis_of_body
from warpflag.observables.arrays import Array, unit
from warpflag.observables.bundle import BUNDLE_DISTANCE, near_segments
from warpflag.observables.phase import local_phase_difference, segment_tangents

__all__ = ["body_speeds", "bundle_lengths", "phase_differences"]

_PAIRS_PER_BLOCK = 1 << 15  # point-segment pairs held at once: temporary arrays that fit the cache


def phase_differences(positions: Array, directors: Array, first_node: NDArray[np.integer]) -> Array:
    """Contour-averaged phase difference of each cell, mean over its pairs of flagella, shape [cell_count].

    Args:
        positions: nodes [um], shape [cell_count, node_count, 3].
        directors: e1 of tripods and segments, same shape.
        first_node: of one cell, shape [flagellum_count + 1], at least two flagella.

    Returns:
        As `phase_difference`: NaN where no segment of any pair is defined.
    """
    bounds = np.asarray(first_node).tolist()
    lengths = np.diff(bounds) - 1
    # Padded with NaN where flagella are shorter: the padding drops out with the undefined segments.
    e1 = np.full((len(positions), len(lengths), lengths.max(), 3), np.nan)
    tangents = np.full_like(e1, np.nan)
    for k, (first, end) in enumerate(pairwise(bounds)):
        e1[:, k, : lengths[k]] = directors[:, first + 1 : end]
        tangents[:, k, : lengths[k]] = segment_tangents(positions[:, first:end])
    total, defined_pairs = np.zeros(len(positions)), np.zeros(len(positions))
    for k in range(len(lengths) - 1):
        theta = local_phase_difference(e1[:, k, None], tangents[:, k, None], e1[:, k + 1 :], tangents[:, k + 1 :])
        defined = ~np.isnan(theta)
        counts = np.count_nonzero(defined, axis=-1)
        sums = np.sum(theta, axis=-1, where=defined)
        total += np.divide(sums, counts, out=np.zeros_like(sums), where=counts > 0).sum(axis=1)
        defined_pairs += (counts > 0).sum(axis=1)
    return np.divide(total, defined_pairs, out=np.full(len(total), np.nan), where=defined_pairs > 0)


def bundle_lengths(
    positions: Array, first_node: NDArray[np.integer], distance: float = BUNDLE_DISTANCE
) -> NDArray[np.float64]:
    """Bundle length l_r of each cell in [0, 1] by the plain rule of `bundled_fraction`, shape [cell_count].

    Args:
        positions: nodes [um], shape [cell_count, node_count, 3].
        first_node: of one cell, shape [flagellum_count + 1].
        distance: within which a node counts as bundled [um].
    """
    bounds = np.asarray(first_node).tolist()
    cells = len(positions)
    if len(bounds) < 3:
        return np.zeros(cells)
    positions = positions - positions.mean(axis=1, keepdims=True)  # keeps the squares below small far from the origin
    edges = np.diff(positions, axis=1)
    is_segment = np.ones(edges.shape[1], dtype=bool)
    is_segment[np.array(bounds[1:-1]) - 1] = False  # between the tip of one flagellum and r_0 of the next
    fractions = np.zeros((len(bounds) - 1, cells))
    for k, (first, end) in enumerate(pairwise(bounds)):
        others = is_segment.copy()
        others[first : end - 1] = False
        rows = max(1, _PAIRS_PER_BLOCK // int(others.sum()))
        bundled = np.zeros((cells, end - first), dtype=bool)
        at_once = max(1, _PAIRS_PER_BLOCK // int(others.sum() * min(rows, end - first)))
        for c in range(0, cells, at_once):
            block = slice(c, c + at_once)
            starts, vectors = positions[block, :-1][:, others], edges[block][:, others]
            for row in range(first, end, rows):
                stop = min(row + rows, end)
                near = near_segments(positions[block, row:stop], starts, vectors, distance)
                bundled[block, row - first : stop - first] = near
        fractions[k] = _end_of_first_run(bundled) / (end - first - 1)
    return fractions.mean(axis=0)


def _end_of_first_run(bundled: NDArray[np.bool_]) -> NDArray[np.integer]:
    """Index of the last node of the first contiguous run of bundled nodes; 0 without one; shape [cell_count]."""
    first = bundled.argmax(axis=1)
    after = ~bundled & (np.arange(bundled.shape[1]) > first[:, None])
    end = np.where(after.any(axis=1), after.argmax(axis=1), bundled.shape[1]) - 1
    return np.where(bundled.any(axis=1), end, 0)


def body_speeds(duration: Array, before: Array, now: Array, orientation_before: Array, orientation: Array) -> Array:
    """Speed of each body along the mean of its axes at both ends of an interval, positive forward, [cell_count].

    Args:
        duration: of the interval [s], shape [cell_count].
        before: body positions at its beginning [um], shape [cell_count, 3].
        now: the same at its end.
        orientation_before: quaternions (x, y, z, w) from body to lab at its beginning, shape [cell_count, 4].
        orientation: the same at its end.
    """
    axis = unit(axis_of_body(orientation_before) + axis_of_body(orientation))
    return -np.vecdot(now - before, axis) / duration
