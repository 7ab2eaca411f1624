"""What the arrays of a checkpoint may hold. Checksums tell that a file is as it was written, not that it is sound."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from warpflag.record import Record

__all__ = ["check_frame", "check_shapes", "check_values"]

_LAST_FORM = 2.0  # forms 0, 1 and 2 of polymorphs
_AT_LEAST_0, _FROM_0_TO_1 = (0.0, math.inf), (0.0, 1.0)  # least and greatest value of an array
_NOT_BELOW_0 = (
    *("control.time", "control.steps", "frame.time", "frame.before_step_before", "stepper.evaluations"),
    *("stepper.last_step", "stepper.step_before", "stepper.wanted_step", "stepper.rejected", "stepper.noise_products"),
    *("stepper.error_sum", "stepper.error_time", "stepper.kappa", "stepper.balance_refused", "stepper.balance_lasting"),
    *("stepper.probe_norm", "stepper.probes_left", "stepper.spectral_radius"),
    *("stepper.achieved_total", "stepper.achieved_total_time", "stepper.achieved_window", "stepper.achieved_worst"),
    *("stepper.achieved_window_time", "stepper.achieved_worst_end", "stepper.achieved_span"),
    *("stepper.achieved_span_time", "stepper.achieved_at_shortest"),
)
ALLOWED: dict[str, tuple[float, float]] = {
    **dict.fromkeys(_NOT_BELOW_0, _AT_LEAST_0),
    "frame.index": (-1.0, math.inf),
    "stepper.stage": (-1.0, math.inf),
    "stepper.history": (0.0, 2.0),
    "stepper.over_implicit": (1.0, math.inf),
    "stepper.share": _FROM_0_TO_1,
    "stepper.lowered": _FROM_0_TO_1,
    "stepper.strong": _FROM_0_TO_1,
    "stepper.balance_known": _FROM_0_TO_1,
    "forms.form": (0.0, _LAST_FORM),
    "forms.before": (0.0, _LAST_FORM),
}
"""Least and largest value of arrays by name; of all others any that is finite. Units as where they are declared."""
_UNIT = ("chart.base_tangent", "chart.base_director", "chart.base_body_orientation")
_UNIT_BEFORE = ("frame.before_tangent", "frame.before_director", "frame.before_body_orientation")
_UNIT_TOLERANCE = 1e-3  # of lengths and cosines; poses in float32 with segments of 0.01 um keep 1e-4
_TIME_TOLERANCE = 1e-6  # of a frame interval: times this close are the same


def check_shapes(arrays: Mapping[str, np.ndarray], own: Mapping[str, np.ndarray]) -> None:
    """That the arrays of a checkpoint are those that a simulation has of its `own`.

    Raises:
        ValueError: they are not.
    """
    if own.keys() != arrays.keys():
        raise ValueError("the checkpoint is of another version or another stepper")
    for name, then in arrays.items():
        if (then.shape, then.dtype) != (own[name].shape, own[name].dtype):
            raise ValueError(f"the checkpoint is of other cells: {name} has shape {then.shape}, type {then.dtype}")


def check_values(arrays: Mapping[str, np.ndarray], intervals: np.ndarray, anchors: np.ndarray) -> None:
    """That a checkpoint is of a state that a simulation can be in.

    Args:
        arrays: of the checkpoint, by name; their shapes are known to fit.
        intervals: between frames, of every cell [s].
        anchors: node r_0 of every flagellum.

    Raises:
        ValueError: it is not; the array, its value and what is allowed.
    """
    for name, values in arrays.items():
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise _wrong(name, values[~np.isfinite(values)][0], "must be finite")
        least, most = ALLOWED.get(name, (-math.inf, math.inf))
        outside = (values < least) | (values > most)
        if outside.any():
            span = f"from {least:g} to {most:g}" if math.isfinite(most) else f"at least {least:g}"
            raise _wrong(name, values[outside][0], f"must be {span}")
    before = _UNIT_BEFORE if (arrays.get("frame.before_step_before", np.zeros(1)) > 0.0).all() else ()
    for name in (*_UNIT, *before):
        lengths = np.linalg.norm(arrays[name], axis=1)
        if (off := np.abs(lengths - 1.0) > _UNIT_TOLERANCE).any():
            raise _wrong(name, lengths[off][0], "has a vector of that length, all are unit vectors")
    segments = np.diff(arrays["chart.base_position"], axis=0)
    cosines = np.einsum("ei,ei->e", segments, arrays["chart.base_tangent"][1:]) / np.linalg.norm(segments, axis=1)
    cosines[anchors[1:] - 1] = 1.0  # from the tip of a flagellum to the anchor of the next
    if not (cosines > 1.0 - _UNIT_TOLERANCE).all():
        raise ValueError("chart.base_position: nodes do not lie along the tangents")
    time, index, framed = arrays["control.time"], arrays["frame.index"], arrays["frame.time"]
    for wrong, name, values, problem in (
        ((time > 0.0) & (arrays["control.steps"] == 0), "control.steps", arrays["control.steps"], "is too few"),
        (index * intervals > time + _TIME_TOLERANCE * intervals, "frame.index", index, "is of a later time"),
        (framed > time + _TIME_TOLERANCE * intervals, "frame.time", framed, "is later"),
    ):
        if wrong.any():
            raise _wrong(name, values[wrong][0], f"{problem} than control.time = {time[wrong][0]:g} allows")


def check_frame(arrays: Mapping[str, np.ndarray], record: Record, interval: float) -> None:
    """That the last frame of a checkpoint is the one that the record has of that time.

    Args:
        arrays: of the checkpoint of one cell.
        record: of the same run.
        interval: between frames [s].

    Raises:
        ValueError: it is not; in which array.
    """
    index, time = int(arrays["frame.index"][0]), float(arrays["frame.time"][0])
    if not 0 <= index < record.frame_count or abs(record.times[index] - time) > _TIME_TOLERANCE * interval:
        raise _wrong("frame.index", index, f"is not the record's frame of {time:g} s")
    if abs(index * interval - time) > _TIME_TOLERANCE * interval:
        raise _wrong("frame.time", time, f"is not that of frame {index}, {index * interval:g} s")
    if record.steps[index] > arrays["control.steps"][0]:
        raise _wrong("control.steps", arrays["control.steps"][0], f"is before step {record.steps[index]} of its frame")
    for name in ("body_position", "body_orientation", "motor_angle"):
        if not np.array_equal(getattr(record, name)[index], arrays[f"frame.{name}"].ravel()):
            raise ValueError(f"frame.{name} is not that of frame {index} of the record")


def _wrong(name: str, value: float, problem: str) -> ValueError:
    return ValueError(f"{name} = {value:g} {problem}")
