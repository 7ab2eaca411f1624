"""Rotations in NumPy: quaternions (x, y, z, w), matrices, and vectors along the axis as long as the angle.

A quaternion of an orientation takes body axes to lab axes. Quaternions need not have unit length.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["axis_of_body", "matrix", "product", "relative", "rotated", "vector_of_matrix", "vector_of_quaternion"]

Array = NDArray[np.floating]


def _unit(quaternions: ArrayLike) -> Array:
    quaternions = np.asarray(quaternions, float)
    return quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)


def matrix(quaternions: ArrayLike) -> Array:
    """Rotation matrices; their columns are the body axes e_b1, e_b2, e_b3 in the lab.

    Args:
        quaternions: (x, y, z, w), shape [..., 4].

    Returns:
        matrices, shape [..., 3, 3].
    """
    x, y, z, w = np.moveaxis(_unit(quaternions), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def axis_of_body(quaternions: ArrayLike) -> Array:
    """The long axis of the body, e_b3, in the lab; it points to the rear.

    Args:
        quaternions: (x, y, z, w), shape [..., 4].

    Returns:
        unit vectors, shape [..., 3].
    """
    return matrix(quaternions)[..., :, 2]


def rotated(quaternions: ArrayLike, vectors: ArrayLike) -> Array:
    """Vectors in body axes as vectors in the lab.

    Args:
        quaternions: (x, y, z, w), shape [..., 4].
        vectors: the same vectors for every quaternion, shape [count, 3].

    Returns:
        shape [..., count, 3].
    """
    return np.asarray(vectors, float) @ np.swapaxes(matrix(quaternions), -1, -2)


def product(first: ArrayLike, second: ArrayLike) -> Array:
    """Products of quaternions (x, y, z, w): the rotation by `second` and then by `first`.

    Args:
        first: shape [..., 4].
        second: same shape.

    Returns:
        quaternions, same shape, whose lengths are the products of the lengths.
    """
    a, b = np.asarray(first, float), np.asarray(second, float)
    va, wa, vb, wb = a[..., :3], a[..., 3:], b[..., :3], b[..., 3:]
    vector = wa * vb + wb * va + np.cross(va, vb)
    scalar = wa * wb - np.sum(va * vb, axis=-1, keepdims=True)
    return np.concatenate([vector, scalar], axis=-1)


def relative(first: ArrayLike, second: ArrayLike) -> Array:
    """The rotation from one orientation to another in the axes of the first: conjugate(first) second.

    Args:
        first: quaternions (x, y, z, w), shape [..., 4].
        second: quaternions, same shape.

    Returns:
        unit quaternions, same shape.
    """
    return product(_unit(first) * [-1.0, -1.0, -1.0, 1.0], _unit(second))


def vector_of_quaternion(quaternions: ArrayLike) -> Array:
    """Rotation vectors of quaternions, the shorter way round.

    Args:
        quaternions: (x, y, z, w), shape [..., 4].

    Returns:
        axis times angle [rad], at most pi long, shape [..., 3].
    """
    q = _unit(quaternions)
    vector, w = q[..., :3], q[..., 3]
    sine = np.linalg.norm(vector, axis=-1)
    angle = 2.0 * np.arctan2(sine, np.abs(w)) * np.copysign(1.0, w)
    return vector * np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0.0)[..., None]


def vector_of_matrix(matrices: ArrayLike) -> Array:
    """Rotation vectors of rotation matrices that turn by less than half a turn.

    Args:
        matrices: shape [..., 3, 3].

    Returns:
        axis times angle [rad], shape [..., 3].
    """
    m = np.asarray(matrices, float)
    pairs = [(m[..., i, j], m[..., j, i]) for i, j in ((2, 1), (0, 2), (1, 0))]
    twice_sine = np.stack([a - b for a, b in pairs], axis=-1)
    size = np.linalg.norm(twice_sine, axis=-1)
    angle = np.arctan2(size, np.trace(m, axis1=-2, axis2=-1) - 1.0)
    return twice_sine * np.divide(angle, size, out=np.full_like(size, 0.5), where=size > 0.0)[..., None]
