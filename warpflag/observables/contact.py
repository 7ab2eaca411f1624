"""Steric forces between flagella from their shapes, and their density f_c by three rules of counting."""

from __future__ import annotations

from itertools import combinations, combinations_with_replacement
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from warpflag_kernels.contact.constants import CUTOFF, LINEAR_BELOW, OWN_SPACING, PARALLEL

from warpflag.observables.arrays import Array, flagella

__all__ = ["closest_parameters", "own_spacing", "steric_force", "steric_force_density"]


def steric_force(distance: ArrayLike, strength: float, diameter: float) -> Array:
    """Repulsion of two centre lines [pN]: F_0 [2 (sigma/r)^13 - (sigma/r)^7] below 2^(1/6) sigma, else 0.

    The derivative of the paper's truncated Lennard-Jones potential; below 0.7 sigma it continues along its tangent.

    Args:
        distance: r [um], any shape.
        strength: F_0 [pN].
        diameter: sigma [um].

    Returns:
        forces, shape of `distance`.
    """
    x = np.asarray(distance, float) / diameter
    y = np.maximum(x, LINEAR_BELOW)
    slope = 26.0 * LINEAR_BELOW**-14 - 7.0 * LINEAR_BELOW**-8
    force = 2.0 * y**-13 - y**-7 + slope * (y - x)
    return np.where(x < CUTOFF, strength * force, 0.0)


def closest_parameters(p: Array, d: Array, q: Array, e: Array) -> tuple[Array, Array]:
    """Parameters s, t in [0, 1] of the closest points of segments p + s d and q + t e.

    Parallel segments, which have many, are taken at s = 1/2.

    Args:
        p: starts of the first segments [um], shape [..., 3]; all four are broadcast together.
        d: from start to end of the first segments [um].
        q: starts of the second segments [um].
        e: from start to end of the second segments [um].

    Returns:
        s and t, shape [...] each.
    """
    r = p - q
    dd, ee, de, dr, er = np.vecdot(d, d), np.vecdot(e, e), np.vecdot(d, e), np.vecdot(d, r), np.vecdot(e, r)
    # Through the cross product: dd ee - de^2 would lose the digits of nearly parallel segments.
    normal = np.cross(d, e)
    square = np.vecdot(normal, normal)
    skew = square > PARALLEL * dd * ee
    s = np.vecdot(np.cross(e, r), normal) / np.where(skew, square, 1.0)
    s = np.where(skew, np.clip(s, 0.0, 1.0), 0.5)
    t = (de * s + er) / ee
    s = np.where(t < 0.0, np.clip(-dr / dd, 0.0, 1.0), np.where(t > 1.0, np.clip((de - dr) / dd, 0.0, 1.0), s))
    return s, np.clip(t, 0.0, 1.0)


def own_spacing(diameter: float, segment_length: float) -> int:
    """Least difference of the numbers of two segments of one flagellum that can touch: 2, and 3 sigma of contour.

    Args:
        diameter: sigma [um].
        segment_length: h [um].
    """
    return max(2, int(OWN_SPACING * diameter / segment_length) + 1)


def steric_force_density(
    positions: ArrayLike,
    first_node: NDArray[np.integer],
    strength: float,
    diameter: float,
    length: float,
    rule: Literal["pairs", "nodes", "net"] = "pairs",
    *,
    self_contact: bool = False,
) -> float:
    """Steric force density of one frame [pN/um]: the paper's f_c = |F_s|/L, whose counting it does not print.

    Every pair of segments of two flagella, or of one where that is in contact with itself, within the cutoff acts, by
    (1 - s) on its first and s on its second node. The rules: "pairs" sums |F| over the pairs, each once, so a contact
    near a node counts up to four times (records hold this one); "nodes" sums the magnitudes of the forces on the
    nodes of a flagellum, in which forces from opposite sides cancel; "net" is the magnitude of the summed force on a
    flagellum. The last two are means over the flagella. None of them converges with the segment length: compare shapes,
    not values.

    Args:
        positions: nodes [um], shape [node_count, 3].
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
        strength: F_0 [pN].
        diameter: sigma [um].
        length: L [um].
        rule: how forces are counted.
        self_contact: whether segments of one flagellum repel, more than 3 sigma of contour apart.
    """
    positions = np.asarray(positions, float)
    forces, total = np.zeros_like(positions), 0.0
    parts = list(flagella(first_node))
    for a, b in combinations_with_replacement(parts, 2) if self_contact else combinations(parts, 2):
        p, q = positions[a], positions[b]
        d, e = np.diff(p, axis=0), np.diff(q, axis=0)
        s, t = closest_parameters(p[:-1, None], d[:, None], q[None, :-1], e[None])
        gap = p[:-1, None] + s[..., None] * d[:, None] - q[None, :-1] - t[..., None] * e[None]
        distance = np.linalg.norm(gap, axis=-1)
        magnitude = steric_force(distance, strength, diameter)
        if a is b:
            magnitude = np.triu(magnitude, own_spacing(diameter, float(np.linalg.norm(d, axis=1).mean())))
        total += float(magnitude.sum())
        force = (magnitude / np.maximum(distance, np.finfo(float).tiny))[..., None] * gap
        for rows, share, sign, axis in ((a, s, 1.0, 1), (b, t, -1.0, 0)):
            forces[rows][:-1] += sign * ((1.0 - share)[..., None] * force).sum(axis=axis)
            forces[rows][1:] += sign * (share[..., None] * force).sum(axis=axis)
    by_rule = {
        "pairs": lambda: total,
        "nodes": lambda: np.mean([np.linalg.norm(forces[rows], axis=1).sum() for rows in parts]),
        "net": lambda: np.mean([np.linalg.norm(forces[rows].sum(axis=0)) for rows in parts]),
    }
    return float(by_rule[rule]()) / length
