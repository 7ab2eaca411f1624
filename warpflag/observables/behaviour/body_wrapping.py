"""Flagella that wrap round the body: how much of each lies along it, and how often it goes round."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag.observables.arrays import Array, flagella, unit
from warpflag.observables.bundle import BUNDLE_DISTANCE

__all__ = ["WHOLE_TURN", "Wrapping", "wrapping"]

WHOLE_TURN = 1.0
"""Turns round the body from which on a flagellum is wrapped: a filament folded back along one side has less."""


@dataclass(frozen=True, eq=False)
class Wrapping:
    """What lies along the body, frame by frame.

    Attributes:
        share: part of a flagellum's nodes that lie along the body, shape [frame_count, flagellum_count].
        turns: of these about the body's long axis, right-handed positive: -2 for a left-handed screw that goes
            twice round, shape [frame_count, flagellum_count].
    """

    share: Array
    turns: Array

    @property
    def wrapped(self) -> NDArray[np.bool_]:
        """Whether a flagellum goes round the body at least once, shape [frame_count, flagellum_count]."""
        return np.abs(self.turns) >= WHOLE_TURN


def wrapping(
    positions: ArrayLike,
    first_node: ArrayLike,
    body_positions: ArrayLike,
    axes: ArrayLike,
    length: float,
    width: float,
    distance: float = BUNDLE_DISTANCE,
) -> Wrapping:
    """How far flagella are wrapped round the body.

    A node lies along the body if it is between the poles, measured along the long axis, and nearer to the surface than
    the distance. Turns are those of segments with both nodes along the body.

    Args:
        positions: nodes [um], shape [frame_count, node_count, 3].
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
        body_positions: centres of the body [um], shape [frame_count, 3].
        axes: long axes of the body, of any length, shape [frame_count, 3].
        length: of the body, caps included [um].
        width: of the body [um].
        distance: from the surface within which a node counts [um].
    """
    axes = unit(axes)[:, None]
    relative = np.asarray(positions, float) - np.asarray(body_positions, float)[:, None]
    along = np.vecdot(relative, axes)
    across = relative - along[..., None] * axes
    straight = (length - width) / 2  # the cylinder, between the caps
    beyond = np.maximum(np.abs(along) - straight, 0.0)
    beside = np.hypot(beyond, np.linalg.norm(across, axis=-1)) < width / 2 + distance
    beside &= np.abs(along) < length / 2
    before, after = across[:, :-1], across[:, 1:]
    turned = np.arctan2(np.vecdot(np.cross(before, after), axes), np.vecdot(before, after)) / (2 * np.pi)
    counted = beside[:, :-1] & beside[:, 1:]
    turned, passed = np.where(counted, turned, 0.0), np.where(counted, np.diff(along, axis=1), 0.0)
    shares, turns = [], []
    for row in flagella(first_node):
        segments = slice(row.start, row.stop - 1)
        shares.append(beside[:, row].mean(axis=1))
        turns.append(turned[:, segments].sum(axis=1) * np.sign(passed[:, segments].sum(axis=1)))
    return Wrapping(np.stack(shares, axis=1), np.stack(turns, axis=1))
