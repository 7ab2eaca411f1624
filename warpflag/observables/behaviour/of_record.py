"""Runs and tumbles, bundles, wobble and motor loads of the record of a run."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from warpflag.base.rotations import axis_of_body
from warpflag.observables.arrays import elapsed
from warpflag.observables.behaviour import body_wrapping, bundles, load, precession, runs
from warpflag.observables.behaviour.body_wrapping import Wrapping
from warpflag.observables.behaviour.load import LoadPoint
from warpflag.observables.behaviour.precession import Wobble
from warpflag.observables.behaviour.runs import RunsAndTumbles
from warpflag.observables.recorded import motor_torques
from warpflag.record import Record
from warpflag.scene import loads

__all__ = ["bundle_membership", "digest", "motor_loads", "runs_and_tumbles", "wobble", "wrapping"]


def runs_and_tumbles(record: Record, **options: float) -> RunsAndTumbles:
    """Runs and tumbles of the whole run; options as of `warpflag.observables.behaviour.runs_and_tumbles`.

    Raises:
        ValueError: the run is shorter than three averaging times.
        RecordError: the record can't be read.
    """
    return runs.runs_and_tumbles(record.times, record.body_position, **options)


def bundle_membership(record: Record, **options: float) -> NDArray[np.int64]:
    """The bundle of every flagellum in every frame, shape [frame_count, flagellum_count]; -1 for one that is alone.

    Options as of `warpflag.observables.behaviour.bundle_membership`; `bundle_counts` of the result is their number.

    Raises:
        RecordError: the record can't be read.
    """
    return bundles.bundle_membership(record.positions[:], record.first_node, **options)


def wobble(
    record: Record, of: Literal["body", "bundle"] = "body", start: float | None = None, stop: float | None = None
) -> Wobble:
    """Precession and nutation about the direction of swimming, which is that of the net displacement.

    Args:
        record: of the run.
        of: the forward end of the body's axis, or that of the axis of all flagella.
        start: of the window [s]; default: after two thirds of the run.
        stop: of the window [s]; default: the end of the run.

    Raises:
        ValueError: the window holds fewer than two frames, or the cell does not move.
        RecordError: the record can't be read.
    """
    window = record.window(start, stop)
    positions = record.body_position[window]
    elapsed(record.times[window])
    moved = positions[-1] - positions[0]
    if not moved.any():
        raise ValueError(f"{record.path}: the body does not move, so there is no direction of swimming")
    rearward = axis_of_body(record.body_orientation[window])
    if of == "bundle":
        rearward = bundles.bundle_axes(record.positions[window], record.first_node)
    return precession.wobble(record.times[window], -rearward, moved)


def wrapping(record: Record, **options: float) -> Wrapping:
    """How far each flagellum is wrapped round the body, in every frame.

    Options as of `warpflag.observables.behaviour.wrapping`.

    Raises:
        ValueError: a free filament, without a body.
        RecordError: the record can't be read.
    """
    return _wrapping(record, slice(None), **options)


def _wrapping(record: Record, window: slice, **options: float) -> Wrapping:
    body = loads(record.scene_text).body
    if not body.enabled:
        raise ValueError(f"{record.path}: there is no body to wrap round")
    positions, axes = record.positions[window], axis_of_body(record.body_orientation[window])
    centres = record.body_position[window]
    return body_wrapping.wrapping(positions, record.first_node, centres, axes, body.length, body.width, **options)


def motor_loads(record: Record, start: float | None = None, stop: float | None = None) -> list[LoadPoint]:
    """Rate, torque and drag at which each motor works; torques that are not constant are those of the record.

    Args:
        record: of the run.
        start: of the window [s]; default: after two thirds of the run.
        stop: of the window [s]; default: the end of the run.

    Raises:
        ValueError: the window holds fewer than two frames.
        RecordError: the record can't be read.
    """
    window = record.window(start, stop)
    torques = motor_torques(record, loads(record.scene_text), window)
    return load.load_points(record.times[window], record.motor_angle[window], torques)


def digest(record: Record) -> dict[str, Any]:
    """The numbers of a run's behaviour that its summary holds.

    Returns:
        `runs`: their number, mean speed [um/s] and duration [s], number, mean duration [s] and mean angle [deg] of
        tumbles, tumbling fraction; None for a run too short. Over the last third `bundles`: mean number, and part of
        the flagella that are in one; `wrapped`: part of the flagella that are, and of their nodes along the body, None
        without a body; `wobble`: of body and bundle, angles [deg] and rates [Hz], None for a body that stands still;
        `motor_drag` of each motor [pN um s]. All None where there are fewer than two frames.
    """
    window = record.window(None, None)
    if len(record.times[window]) < 2:
        return dict.fromkeys(("runs", "bundles", "wrapped", "wobble", "motor_drag"))
    membership = bundles.bundle_membership(record.positions[window], record.first_node)
    moves = np.ptp(record.body_position[window], axis=0).any()
    return {
        "runs": _of_runs(record),
        "bundles": {
            "count": float(bundles.bundle_counts(membership).mean()),
            "members": float((membership != bundles.ALONE).mean()),
        },
        "wrapped": _of_wrapping(record, window),
        "wobble": {of: _in_degrees(wobble(record, of)) for of in ("body", "bundle")} if moves else None,
        "motor_drag": [point.drag for point in motor_loads(record)],
    }


def _of_runs(record: Record) -> dict[str, float | int] | None:
    if record.times[-1] - record.times[0] < 3 * runs.SMOOTHING:
        return None
    found = runs_and_tumbles(record)
    angles = found.tumble_angles[np.isfinite(found.tumble_angles)]
    return {
        "runs": len(found.runs),
        "run_speed": found.run_speed,
        "run_duration": _mean(found.run_durations),
        "run_length": found.run_length[0],
        "tumbles": len(found.tumbles),
        "tumble_duration": _mean(found.tumble_durations),
        "tumble_angle": float(np.degrees(_mean(angles))),
        "tumbling_fraction": found.tumbling_fraction,
    }


def _of_wrapping(record: Record, window: slice) -> dict[str, float] | None:
    if not loads(record.scene_text).body.enabled:
        return None
    found = _wrapping(record, window)
    return {"flagella": float(found.wrapped.mean()), "along_body": float(found.share.mean())}


def _mean(values: NDArray[np.floating]) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _in_degrees(found: Wobble) -> dict[str, float]:
    return {
        "angle": float(np.degrees(found.angle)),
        "precession_rate": found.precession_rate,
        "nutation": float(np.degrees(found.nutation)),
        "nutation_rate": found.nutation_rate,
    }
