"""Where a simulation starts: a scene's own initial shape, or a frame of a record."""

from __future__ import annotations

import numpy as np

from warpflag.base import rotations
from warpflag.model.clear_start import body_gaps, clear_start
from warpflag.model.geometry import InitialState, initial_state
from warpflag.record import Frame, Record, RecordError
from warpflag.scene import Scene, SceneError, attachment

__all__ = ["check_outside", "shape_of_frame", "starting_state"]

_ANCHOR_TOLERANCE = 1e-3  # um; a record in float32 is off by less


def starting_state(scene: Scene) -> InitialState:
    """The shape that a scene asks for, at time 0.

    Where the scene's own shape would begin inside the body or on another flagellum, it begins a little otherwise, see
    `clear_start`; its notes say how.

    Raises SceneError where `start.record` can't be read or holds another cell than the scene's, and where the scene's
    own shape can't begin clear.
    """
    if scene.start.record is None:
        return clear_start(scene, initial_state(scene))
    try:
        with Record(scene.start.record) as record:
            if scene.start.frame >= record.frame_count:
                problem = f"{record.path} holds frames 0 to {record.frame_count - 1}"
                raise SceneError("start.frame", scene.start.frame, problem, ["start.record"])
            first_node, frame = record.first_node, record.frame(scene.start.frame)
    except RecordError as error:
        raise SceneError(*_record_of(scene), str(error)) from None
    counts = [spec.segment_count for spec in scene.resolved_flagella()]
    recorded = [int(count) - 1 for count in np.diff(first_node)]
    if counts != recorded:
        problem = f"holds flagella of {recorded} segments, the scene's have {counts}"
        raise SceneError(*_record_of(scene), problem, ["flagella.count", "flagella.length"])
    start = shape_of_frame(frame, first_node)
    _check_anchors(scene, start)
    return start


def shape_of_frame(frame: Frame, first_node: np.ndarray) -> InitialState:
    """The shape of a frame, its time set to 0."""
    return InitialState(
        positions=tuple(np.split(frame.positions, first_node[1:-1])),
        directors=tuple(np.split(frame.directors, first_node[1:-1])),
        body_position=frame.body_position,
        body_orientation=frame.body_orientation,
    )


def check_outside(scene: Scene, start: InitialState) -> None:
    """Refuses a start with nodes inside the body, out of which the contact force would tear them in the first step."""
    if not (scene.body.contact and scene.body.enabled):
        return
    to_body = rotations.matrix(start.body_orientation)
    for k, nodes in enumerate(start.positions):
        gaps = body_gaps(scene.body, (nodes[1:] - start.body_position) @ to_body)
        if gaps.min() < 0.0:
            deep = f"node {int(gaps.argmin()) + 1} is {-gaps.min():.3g} um deep"
            raise SceneError("body.contact", True, f"the given start has flagellum {k} inside the body: {deep}")


def _check_anchors(scene: Scene, start: InitialState) -> None:
    """A record of flagella anchored elsewhere would tear them off the body in the first step."""
    to_lab = rotations.matrix(start.body_orientation)
    for k, (spec, nodes) in enumerate(zip(scene.resolved_flagella(), start.positions, strict=True)):
        anchor = start.body_position + to_lab @ np.array(attachment.anchor(scene, spec))
        if np.linalg.norm(anchor - nodes[0]) > _ANCHOR_TOLERANCE:
            problem = f"anchors flagellum {k} elsewhere on the body than the scene does"
            raise SceneError(*_record_of(scene), problem, ["flagella.anchor_offset", "body.width", "hook.length"])


def _record_of(scene: Scene) -> tuple[str, str | None]:
    return "start.record", scene.start.record
