"""Where body and motors of a record are: body axes in the lab, motors in the body."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag.base import rotations
from warpflag.observables import motor_axes
from warpflag.record import Record
from warpflag.scene import Scene

__all__ = ["Motors", "body_axes", "motors"]

Array = NDArray[np.floating]


class Motors(NamedTuple):
    """The motors of a cell in body axes, before they have turned.

    Attributes:
        anchors: where each motor stands, from the middle of the body [um], shape [motor_count, 3].
        tripods: e1, e2 and the motor axis m as rows, shape [motor_count, 3, 3].
    """

    anchors: Array
    tripods: Array


def body_axes(orientation: ArrayLike) -> Array:
    """Body axes e_b1, e_b2, e_b3 in the lab as rows, shape [3, 3].

    Args:
        orientation: quaternion (x, y, z, w) from body to lab axes, shape [4]; its norm is divided out.
    """
    return rotations.matrix(orientation).T


def motors(record: Record, scene: Scene) -> Motors:
    """The motors of a record, turned back from its first frame by the motor angle that they have there; a filament
    without a body has none."""
    if not scene.body.enabled:
        return Motors(np.zeros((0, 3)), np.zeros((0, 3, 3)))
    first = record.first_node[:-1]
    to_body = body_axes(record.body_orientation[0])
    anchors = (record.positions[0][first] - record.body_position[0]) @ to_body.T
    axes, angle = motor_axes(scene), record.motor_angle[0][:, None]
    e1 = record.directors[0][first] @ to_body.T
    e1 = np.cos(angle) * e1 - np.sin(angle) * np.cross(axes, e1)
    return Motors(anchors, np.stack([e1, np.cross(axes, e1), axes], axis=1))
