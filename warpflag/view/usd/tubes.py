"""Surfaces of round rods as triangles and quadrilaterals: tubes through points, capsules."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["SIDES", "capsule_points", "faces", "node_of_vertex", "tube"]

Array = NDArray[np.float64]

SIDES = 8
"""Sides of a tube."""
_PIECES_PER_SEGMENT = 2  # straight pieces of a tube per segment
# Rings of a round end, from its pole: radius, and distance from the end of the axis, in radii of the tube.
_CAP = np.array([[0.05, 1.0], [0.7, 0.7]])


def tube(points: Array, radius: float) -> tuple[Array, Array]:
    """Vertices and normals of tubes with round ends along Catmull-Rom curves.

    Args:
        points: that the curve goes through [um], shape [frame, point, 3], at least two.
        radius: of the tube [um].

    Returns:
        Vertices [um] and unit normals, ring after ring, shape [frame, ring * SIDES, 3].
    """
    centres = _curve(points)
    tangents = np.gradient(centres, axis=1)
    tangents /= np.linalg.norm(tangents, axis=2, keepdims=True)
    across = _untwisted(tangents)
    share = np.concatenate([_CAP[:, 0], np.ones(centres.shape[1]), _CAP[::-1, 0]])
    lean = np.concatenate([-_CAP[:, 1], np.zeros(centres.shape[1]), _CAP[::-1, 1]])
    ends = ((0, 0), (len(_CAP), len(_CAP)), (0, 0))
    centres, tangents, across = (np.pad(each, ends, mode="edge") for each in (centres, tangents, across))
    angle = 2.0 * np.pi * np.arange(SIDES) / SIDES
    other = np.cross(tangents, across)
    outward = np.cos(angle)[:, None] * across[:, :, None] + np.sin(angle)[:, None] * other[:, :, None]
    shape = share[:, None, None] * outward + (lean[:, None] * tangents)[:, :, None]
    vertices = centres[:, :, None] + radius * shape
    normals = shape / np.linalg.norm(shape, axis=-1, keepdims=True)
    return vertices.reshape(len(points), -1, 3), normals.reshape(len(points), -1, 3)


def node_of_vertex(point_count: int) -> NDArray[np.integer]:
    """The point that is nearest to each vertex of a tube, shape [ring * SIDES]."""
    along = np.arange((point_count - 1) * _PIECES_PER_SEGMENT + 1)
    nearest = np.pad((along + _PIECES_PER_SEGMENT // 2) // _PIECES_PER_SEGMENT, len(_CAP), mode="edge")
    return np.repeat(nearest, SIDES)


def faces(ring_count: int, sides: int = SIDES) -> NDArray[np.int32]:
    """Corners of the quadrilaterals between rings of vertices, seen from outside anticlockwise, shape [face, 4]."""
    ring, side = np.meshgrid(np.arange(ring_count - 1), np.arange(sides), indexing="ij")
    after = (side + 1) % sides
    corners = [ring * sides + side, ring * sides + after, (ring + 1) * sides + after, (ring + 1) * sides + side]
    return np.stack(corners, axis=-1).reshape(-1, 4).astype(np.int32)


def capsule_points(height: float, radius: float, rings: int = 8, sides: int = 32) -> tuple[Array, Array]:
    """Vertices and normals of a capsule about the z axis, ring after ring.

    Args:
        height: of its straight part [um].
        radius: [um].
        rings: of each round end.
        sides: vertices of a ring.

    Returns:
        Vertices [um] and unit normals, shape [2 * rings * sides, 3].
    """
    tilt = np.linspace(-0.5 * np.pi + 1e-3, 0.0, rings)
    tilt = np.concatenate([tilt, -tilt[::-1]])
    angle = 2.0 * np.pi * np.arange(sides) / sides
    normals = np.stack(
        np.broadcast_arrays(
            np.cos(tilt)[:, None] * np.cos(angle), np.cos(tilt)[:, None] * np.sin(angle), np.sin(tilt)[:, None]
        ),
        axis=-1,
    )
    vertices = radius * normals
    vertices[:rings, :, 2] -= 0.5 * height
    vertices[rings:, :, 2] += 0.5 * height
    return vertices.reshape(-1, 3), normals.reshape(-1, 3)


def _curve(points: Array) -> Array:
    """Points along Catmull-Rom curves, whose ends are continued by their mirror image, shape [frame, ring, 3]."""
    before, after = 2.0 * points[:, :1] - points[:, 1:2], 2.0 * points[:, -1:] - points[:, -2:-1]
    p = np.concatenate([before, points, after], axis=1)
    p0, p1, p2, p3 = p[:, :-3, None], p[:, 1:-2, None], p[:, 2:-1, None], p[:, 3:, None]
    t = (np.arange(_PIECES_PER_SEGMENT) / _PIECES_PER_SEGMENT)[:, None]
    spans = 0.5 * (
        2.0 * p1 + (p2 - p0) * t + (2.0 * p0 - 5.0 * p1 + 4.0 * p2 - p3) * t**2 + (3.0 * (p1 - p2) + p3 - p0) * t**3
    )
    return np.concatenate([spans.reshape(len(points), -1, 3), points[:, -1:]], axis=1)


def _untwisted(tangents: Array) -> Array:
    """Unit vectors across the tangents that turn about them as little as they can, shape [frame, ring, 3]."""
    across = np.empty_like(tangents)
    side = np.eye(3)[np.argmin(np.abs(tangents[:, 0]), axis=1)]
    for ring in range(tangents.shape[1]):
        side = side - np.vecdot(side, tangents[:, ring])[:, None] * tangents[:, ring]
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        across[:, ring] = side
    return across
