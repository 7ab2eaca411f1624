"""How far two flagella are out of phase: the angle between their material frames, segment by segment."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag.observables.arrays import Array

__all__ = ["local_phase_difference", "phase_difference", "segment_tangents"]

_ANTIPARALLEL = 1e-12  # of 1 + cos: tangents within 1.4e-6 rad of antiparallel have no minimal rotation


def local_phase_difference(e1_a: ArrayLike, tangents_a: ArrayLike, e1_b: ArrayLike, tangents_b: ArrayLike) -> Array:
    """Local phase difference of two flagella, segment by segment: theta(i) = arccos(e1(i) . e1~*(i)) / pi.

    e1~* is the e1 of flagellum b after the minimal rotation that takes its tangent onto the tangent of
    flagellum a. Exchanging the flagella changes nothing.

    Args:
        e1_a: directors e1 of flagellum a, unit, across the tangents, shape [..., segment_count, 3]; all four are
            broadcast together.
        tangents_a: unit tangents e3 of flagellum a.
        e1_b: directors e1 of flagellum b.
        tangents_b: unit tangents e3 of flagellum b.

    Returns:
        theta in [0, 1], shape [..., segment_count]: 0 in phase, 1 in antiphase. Where the tangents are antiparallel
        no rotation is minimal and theta is undefined: NaN there, which the averages leave out.

    Source:
        the paper, text above its Fig. 3.
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


def segment_tangents(positions: ArrayLike) -> Array:
    """Unit tangents of the segments 1..N of one flagellum, shape [..., N, 3].

    Args:
        positions: nodes [um], shape [..., N + 1, 3].
    """
    edges = np.diff(np.asarray(positions, float), axis=-2)
    return edges / np.sqrt(np.vecdot(edges, edges))[..., None]


def phase_difference(positions: ArrayLike, directors: ArrayLike, first_node: NDArray[np.integer]) -> Array:
    """Contour-averaged phase difference <theta> in [0, 1], mean over all pairs of flagella, of one frame or many.

    theta(i) of `local_phase_difference` is averaged over the segments 1..N of a pair (segments are paired by
    their number from the motor; of unequal flagella the common part counts), then over the pairs. Undefined
    segments are left out. The numbers of a frame do not depend on which others are measured with it.

    Args:
        positions: nodes [um], shape [..., node_count, 3].
        directors: e1 of tripod and segments, same shape.
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].

    Returns:
        <theta>, shape [...], a number for one frame; NaN where no segment of any pair is defined.

    Raises:
        ValueError: fewer than two flagella.

    Source:
        the paper, Fig. 3(a).
    """
    positions, directors = np.asarray(positions, float), np.asarray(directors, float)
    bounds = [int(i) for i in np.asarray(first_node)]
    if len(bounds) < 3:
        raise ValueError("phase_difference needs at least two flagella")
    lengths, frames = np.diff(bounds) - 1, positions.shape[:-2]
    # Padded with NaN: ragged flagella broadcast, and the padding drops out with the undefined segments.
    e1 = np.full((*frames, len(lengths), lengths.max(), 3), np.nan)
    tangents = np.full_like(e1, np.nan)
    for k, (first, end) in enumerate(pairwise(bounds)):
        e1[..., k, : lengths[k], :] = directors[..., first + 1 : end, :]
        tangents[..., k, : lengths[k], :] = segment_tangents(positions[..., first:end, :])
    total, pairs = np.zeros(frames), np.zeros(frames)
    for k in range(len(lengths) - 1):
        own, others = (
            (..., slice(k, k + 1), slice(None), slice(None)),
            (..., slice(k + 1, None), slice(None), slice(None)),
        )
        theta = local_phase_difference(e1[own], tangents[own], e1[others], tangents[others])
        defined = ~np.isnan(theta)
        counts = np.count_nonzero(defined, axis=-1)
        sums = np.sum(theta, axis=-1, where=defined)
        total += np.divide(sums, counts, out=np.zeros_like(sums), where=counts > 0).sum(axis=-1)
        pairs += (counts > 0).sum(axis=-1)
    return np.divide(total, pairs, out=np.full(frames, np.nan), where=pairs > 0)[()]
