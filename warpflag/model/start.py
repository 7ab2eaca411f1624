"""Where a simulation starts: a scene's own initial shape, or a frame of a record."""

from __future__ import annotations

import math

import numpy as np
from warpflag_kernels.stepping.health import LARGEST_TWIST

from warpflag.base import rotations
from warpflag.model.clear_start import body_gaps, clear_start
from warpflag.model.geometry import InitialState, initial_state
from warpflag.record import Frame, Record, RecordError
from warpflag.scene import Scene, SceneError, attachment, loads
from warpflag.scene.helix import rest_shape

__all__ = ["check_outside", "shape_of_frame", "starting_state"]

_MEAN_STRAIN = 0.01  # mean strain of a flagellum from which a record is taken to be of one of another length
_TENSION = 10.0  # pN; tension that may stretch a soft filament by more than that
_ANCHOR_TOLERANCE = 1e-3  # um; largest difference of anchors; a record in float32 is off by less


def starting_state(scene: Scene) -> InitialState:
    """The shape that a scene asks for, at time 0.

    Where the scene's own shape would begin inside the body or on another flagellum it is changed (`clear_start`); the
    notes of the result say how.

    Raises:
        SceneError: `start.record` can't be read or holds another cell than the scene's, or the scene's own shape can't
            be made clear or is twisted beyond what the guard allows.
    """
    if scene.start.record is None:
        _check_twist(scene)
        return clear_start(scene, initial_state(scene))
    try:
        with Record(scene.start.record) as record:
            if scene.start.frame >= record.frame_count:
                problem = f"{record.path} holds frames 0 to {record.frame_count - 1}"
                raise SceneError("start.frame", scene.start.frame, problem, ["start.record"])
            first_node, frame = record.first_node, record.frame(scene.start.frame)
            if frame.step > 0:
                _check_seeds(scene, record)
    except RecordError as error:
        raise SceneError(*_record_of(scene), str(error)) from None
    counts = [spec.segment_count for spec in scene.resolved_flagella()]
    recorded = [int(count) - 1 for count in np.diff(first_node)]
    if counts != recorded:
        problem = f"holds flagella of {recorded} segments, the scene's have {counts}"
        raise SceneError(*_record_of(scene), problem, ["flagella.count", "flagella.length"])
    start = shape_of_frame(frame, first_node)
    _check_finite(scene, start)
    _check_lengths(scene, start)
    _check_anchors(scene, start)
    return start


def shape_of_frame(frame: Frame, first_node: np.ndarray) -> InitialState:
    """The shape of a frame, its time set to 0."""
    return InitialState(
        positions=tuple(np.split(frame.positions, first_node[1:-1])),
        directors=tuple(np.split(frame.directors, first_node[1:-1])),
        body_position=frame.body_position,
        body_orientation=frame.body_orientation,
        forms=frame.forms,
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


def _check_twist(scene: Scene) -> None:
    """Refuses segments so long that a run would be stopped at once by the guard of twists, whatever drives it."""
    group = scene.flagella
    for spec in scene.resolved_flagella():
        h = spec.segment_length
        rest = rest_shape(group.strain_at_rest(h), h, spec.segment_count, group.on_axis)
        twist = h * float(np.abs(rest.strain[:, 2]).max(initial=0.0))
        if twist >= LARGEST_TWIST:
            problem = (
                f"makes segments of {h:.3g} um, whose joints are twisted by {math.degrees(twist):.3g} deg at rest; a "
                "run takes less than 90: take shorter ones"
            )
            related = ["flagella.intrinsic_curvature", "flagella.helix_pitch"]
            raise SceneError("flagella.segment_length", group.segment_length, problem, related)


def _check_seeds(scene: Scene, record: Record) -> None:
    """A run counts its steps from 0: with the seed of the run that it goes on from, which has made the shape that it
    starts with, the same random numbers would come again."""
    try:
        made = loads(record.scene_text)
    except SceneError:
        return  # of another version, whose random numbers were others
    noisy = min(scene.fluid.temperature, made.fluid.temperature) > 0.0
    switching = scene.motor.switching == made.motor.switching == "markov"
    for key, random, seed, other in (
        ("fluid.seed", noisy, scene.fluid.seed, made.fluid.seed),
        ("motor.seed", switching, scene.motor.seed, made.motor.seed),
    ):
        if random and seed == other:
            problem = f"is the seed of {record.path}, whose random numbers would come again; take another"
            raise SceneError(key, seed, problem, ["start.record"])


def _check_finite(scene: Scene, start: InitialState) -> None:
    for k, (nodes, directors) in enumerate(zip(start.positions, start.directors, strict=True)):
        if not (np.isfinite(nodes).all() and np.isfinite(directors).all()):
            raise SceneError(*_record_of(scene), f"has values that are not finite in flagellum {k}")
    if not (np.isfinite(start.body_position).all() and np.isfinite(start.body_orientation).all()):
        raise SceneError(*_record_of(scene), "has a body whose pose is not finite")


def _check_lengths(scene: Scene, start: InitialState) -> None:
    """A record of longer or shorter flagella would begin stretched as a whole, which no load does to stiff segments."""
    allowed = max(_MEAN_STRAIN, _TENSION / scene.flagella.stretching_stiffness)
    for k, (spec, nodes) in enumerate(zip(scene.resolved_flagella(), start.positions, strict=True)):
        mean = float(np.linalg.norm(np.diff(nodes, axis=0), axis=1).mean())
        if abs(mean / spec.segment_length - 1) > allowed:
            problem = f"has segments of {mean:.4g} um in flagellum {k}, the scene's are of {spec.segment_length:.4g} um"
            raise SceneError(*_record_of(scene), problem, ["flagella.length", "flagella.segment_length"])


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
