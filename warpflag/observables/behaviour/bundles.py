"""Which flagella swim together: bundles, their members and their axes, for any number of flagella."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag.observables.arrays import Array, flagella, unit
from warpflag.observables.bundle import BUNDLE_DISTANCE, near_segments
from warpflag.observables.phase import segment_tangents
from warpflag.observables.shape import OUTER_PART, local_axes

__all__ = ["ALONE", "BESIDE_SHARE", "bundle_axes", "bundle_counts", "bundle_membership"]

ALONE = -1
"""Stands for the bundle of a flagellum that is in none."""
BESIDE_SHARE = 1 / 3
"""Part of a flagellum's nodes that lie beside another one if the two are of one bundle: more than a crossing gives, and
less than a finished bundle has, whose flagella come together at some distance from a wide body (three of 7.5 um: at
half their length)."""

_PAIRS_AT_ONCE = 1 << 15  # of nodes and segments: temporary arrays that fit the cache


def bundle_membership(
    positions: ArrayLike, first_node: ArrayLike, distance: float = BUNDLE_DISTANCE, share: float = BESIDE_SHARE
) -> NDArray[np.int64]:
    """The bundle of every flagellum, shape [frame_count, flagellum_count]; -1 for one that is alone.

    Two flagella are joined if a third of the nodes of one lie within the distance of the other's centre line; a bundle
    is what is joined directly or through others. It has the number of its first flagellum.

    Args:
        positions: nodes [um], shape [frame_count, node_count, 3].
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
        distance: within which a node counts as beside another flagellum [um].
        share: of the nodes of either flagellum.
    """
    positions = np.asarray(positions, float)
    rows = list(flagella(first_node))
    lows = [positions[:, r].min(axis=1) - distance for r in rows]
    highs = [positions[:, r].max(axis=1) for r in rows]
    joined = np.zeros((len(positions), len(rows), len(rows)), dtype=bool)
    for k, own in enumerate(rows):
        for other in range(k + 1, len(rows)):
            apart = (lows[k] > highs[other]) | (lows[other] > highs[k])
            frames = np.flatnonzero(~apart.any(axis=1))
            for block in _blocks(frames, own, rows[other]):
                one, two = positions[block, own], positions[block, rows[other]]
                near = np.maximum(_beside(one, two, distance), _beside(two, one, distance))
                joined[block, k, other] = joined[block, other, k] = near >= share
    return _components(joined)


def _blocks(frames: NDArray[np.integer], one: slice, two: slice) -> list[NDArray[np.integer]]:
    pairs = (one.stop - one.start) * (two.stop - two.start)
    return [
        frames[i : i + max(1, _PAIRS_AT_ONCE // pairs)] for i in range(0, len(frames), max(1, _PAIRS_AT_ONCE // pairs))
    ]


def _beside(points: Array, nodes: Array, distance: float) -> Array:
    """Part of the points within a distance of the segments between nodes, shape [frame_count]."""
    origin = nodes.mean(axis=1, keepdims=True)  # keeps the squares small far from the origin
    points, nodes = points - origin, nodes - origin
    return near_segments(points, nodes[:, :-1], np.diff(nodes, axis=1), distance).mean(axis=-1)


def _components(joined: NDArray[np.bool_]) -> NDArray[np.int64]:
    count = joined.shape[-1]
    numbers = np.broadcast_to(np.arange(count), joined.shape[:2]).copy()
    while True:
        lowest = np.where(joined, numbers[:, None, :], count).min(axis=-1, initial=count)
        lower = np.minimum(numbers, lowest)
        if (lower == numbers).all():
            break
        numbers = lower
    numbers[~joined.any(axis=-1)] = ALONE
    return numbers


def bundle_counts(membership: NDArray[np.integer]) -> NDArray[np.int64]:
    """Number of bundles in each frame, shape [frame_count]; of two members or more each.

    Args:
        membership: the bundle of every flagellum, shape [frame_count, flagellum_count].
    """
    own = np.arange(membership.shape[1])
    return (membership == own).sum(axis=1)  # a bundle has the number of its first flagellum


def bundle_axes(positions: ArrayLike, first_node: ArrayLike, members: Sequence[int] | None = None) -> Array:
    """Axis of a bundle in each frame, away from the body, unit vectors, shape [frame_count, 3].

    The mean of the helix axes of the turns of the outer two thirds of its flagella.

    Args:
        positions: nodes [um], shape [frame_count, node_count, 3].
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
        members: numbers of its flagella; default: all.
    """
    positions, rows = np.asarray(positions, float), list(flagella(first_node))
    axes = np.zeros((len(positions), 3))
    for k in range(len(rows)) if members is None else members:
        axes += unit(local_axes(segment_tangents(positions[:, rows[k]]), OUTER_PART)[1].mean(axis=1))
    return unit(axes)
