"""What summary.json says of a run: where it ended, its rates, and when the bundle formed. From the record alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from warpflag import observables
from warpflag.observables.behaviour import of_record as behaviour
from warpflag.record import Record
from warpflag.scene import Scene

__all__ = ["digest", "plain"]

SYNCHRONISED = 0.15
"""Phase difference below which two flagella count as synchronised."""


def digest(record: Record, scene: Scene) -> dict[str, Any]:
    """Observables of the last frame, rates over the last third of the recorded time, and first times of two events.

    Args:
        record: with at least one frame.
        scene: of the record.

    Returns:
        `time` [s] and number of `frames`; `observables` by name; `rates`: `motor_rate` relative to the body and
        `motor_rate_lab` [Hz], shape [flagellum_count], `body_rate` about the rearward axis [Hz] and `net_speed`,
        displacement over time [um/s], None where the window is a single frame; `events`: time of the first frame that
        is `synchronised` and that is `zipped` [s], None where there is none; where the scene asks for it, `behaviour`
        (see `warpflag.observables.behaviour.of_record.digest`).
    """
    times, measured = record.times, record.observables
    found = {
        "time": float(times[-1]),
        "frames": len(times),
        "observables": {name: values[-1] for name, values in measured.items()},
        "rates": _rates(record, scene, times, measured),
        "events": {
            "synchronised": _first(times, measured.get("phase_difference", np.ones(0)) < SYNCHRONISED),
            "zipped": _first(times, measured["bundle_length"] >= observables.ZIPPED),
        },
    }
    return found | {"behaviour": behaviour.digest(record)} if scene.behaviour else found


def plain(value: Any) -> Any:
    """The value as JSON knows it: arrays as lists, what is not finite as None."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _rates(record: Record, scene: Scene, times: np.ndarray, measured: dict[str, np.ndarray]) -> dict[str, Any] | None:
    first = int(np.searchsorted(times, times[0] + 2 / 3 * (times[-1] - times[0]) - 1e-12))
    if len(times) - first < 2:
        return None
    window = times[first:]
    angles, orientations = record.motor_angle[first:], record.body_orientation[first:]
    return {
        "from": window[0],
        "to": window[-1],
        "motor_rate": observables.motor_rate(window, angles),
        "motor_rate_lab": observables.lab_motor_rate(window, angles, orientations, observables.motor_axes(scene)),
        # Each frame's rate is that of the interval before it, from the accumulated angle.
        "body_rate": np.average(measured["body_rate"][first + 1 :], weights=np.diff(window)),
        "net_speed": observables.net_speed(window, record.body_position[first:]),
    }


def _first(times: np.ndarray, reached: np.ndarray) -> float | None:
    return float(times[reached.argmax()]) if reached.any() else None
