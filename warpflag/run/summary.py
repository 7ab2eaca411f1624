"""What summary.json says of a run: where it ended, its rates, and when the bundle formed. From the record alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from warpflag_kernels.stepping import accuracy

from warpflag import observables
from warpflag.observables.behaviour import of_record as behaviour
from warpflag.record import Record
from warpflag.record.layout import BODY_ORIENTATION, BODY_POSITION, MOTOR_ANGLE
from warpflag.scene import Scene

__all__ = ["accuracy_kept", "digest", "kept_words", "plain"]

SYNCHRONISED = 0.15
"""Phase difference below which two flagella count as synchronised."""


_OBSERVABLES = "observables/"
_NOTABLE_WINDOW = 2.0
"""The worst window is told where its estimate is more than this many times the mean, and what was asked."""


def digest(record: Record, scene: Scene, kept: Mapping[str, np.ndarray] | None = None) -> dict[str, Any]:
    """Observables of the last frame, rates over the last third of the recorded time, and first times of two events.

    Args:
        record: with at least one frame.
        scene: of the record.
        kept: its small entries by name, where they need not be read.

    Returns:
        `time` [s] and number of `frames`; `observables` by name; `rates`: `motor_rate` relative to the body and
        `motor_rate_lab` [Hz], shape [flagellum_count], both only with a body, `body_rate` about the rearward axis [Hz]
        and `net_speed`, displacement over time [um/s], None where the window is a single frame; `events`: time of the
        first frame that is `synchronised` and that is `zipped` [s], None where there is none; where the scene asks for
        it, `behaviour`
        (see `warpflag.observables.behaviour.of_record.digest`).
    """
    entries = _read(record) if kept is None else kept
    times = entries["time"]
    names = sorted(name for name in entries if name.startswith(_OBSERVABLES))
    measured = {name.removeprefix(_OBSERVABLES): entries[name] for name in names}
    found = {
        "time": float(times[-1]),
        "frames": len(times),
        "observables": {name: values[-1] for name, values in measured.items()},
        "rates": _rates(entries, scene, times, measured),
        "events": {
            "synchronised": _first(times, measured.get("phase_difference", np.ones(0)) < SYNCHRONISED),
            "zipped": _first(times, measured["bundle_length"] >= observables.ZIPPED),
        },
    }
    return found | {"behaviour": behaviour.digest(record)} if scene.behaviour else found


def accuracy_kept(scene: Scene, checkpoint: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """What the error estimates of all steps add up to, by the checkpoint of one cell.

    Returns:
        `asked` of the steps [um/ms]; their `estimate` over the whole run and in the `worst_window` of 0.1 ms [um/ms],
        the end of that window, `worst_window_end` [s]; None where no step has an estimate. `beyond`: whether a run that
        ends here has erred by more than ten times what was asked. `steps_at_shortest`: steps that were wanted shorter
        than the shortest that an estimate may ask for.
    """
    asked = scene.numerics.asked
    facts = {"asked": asked, "estimate": None, "worst_window": None, "worst_window_end": None, "beyond": False}
    facts["steps_at_shortest"] = 0
    if "stepper.achieved_total" not in checkpoint or scene.numerics.stepper == "euler":
        return facts
    own = {name: float(checkpoint[f"stepper.achieved_{name}"][0]) for name in (*accuracy.SUMS, "at_shortest")}
    independent = scene.numerics.stepper == "implicit"
    found = accuracy.estimates(own, independent)
    if found is None:
        return facts
    ends = own["worst_end"] if found[1] == own["worst"] else float(checkpoint["control.time"][0])
    facts |= {"estimate": asked * found[0], "worst_window": asked * found[1], "worst_window_end": ends}
    facts["beyond"] = accuracy.last_span(own, independent) > accuracy.LARGEST_EXCESS
    return facts | {"steps_at_shortest": int(own["at_shortest"])}


def kept_words(facts: Mapping[str, Any]) -> str:
    """What `accuracy_kept` found, for the last line of a run; empty where there is no estimate."""
    if facts["estimate"] is None:
        return ""
    mean, worst = facts["estimate"] / facts["asked"], facts["worst_window"] / facts["asked"]
    words = f"error estimate {mean:.2g} times the {facts['asked']:g} um/ms asked for"
    if worst > max(_NOTABLE_WINDOW, _NOTABLE_WINDOW * mean):
        words += f" (worst {worst:.2g} times, just before {1e3 * facts['worst_window_end']:.4g} ms)"
    if shortest := facts["steps_at_shortest"]:
        words += f", {shortest} step{'s' if shortest > 1 else ''} as short as estimates may ask for"
    return words


def plain(value: Any) -> Any:
    """The value as JSON knows it: arrays as lists, what is not finite as None."""
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _read(record: Record) -> dict[str, np.ndarray]:
    """The small entries of a record by name."""
    observed = {f"{_OBSERVABLES}{name}": values for name, values in record.observables.items()}
    own = {MOTOR_ANGLE: record.motor_angle, BODY_POSITION: record.body_position}
    return {"time": record.times, BODY_ORIENTATION: record.body_orientation, **own, **observed}


def _rates(
    entries: Mapping[str, np.ndarray], scene: Scene, times: np.ndarray, measured: Mapping[str, np.ndarray]
) -> dict[str, Any] | None:
    first = int(np.searchsorted(times, times[0] + 2 / 3 * (times[-1] - times[0]) - 1e-12))
    if len(times) - first < 2:
        return None
    window = times[first:]
    angles, orientations = entries[MOTOR_ANGLE][first:], entries[BODY_ORIENTATION][first:]
    axes = observables.motor_axes(scene)
    motors = {
        "motor_rate": observables.motor_rate(window, angles),
        "motor_rate_lab": observables.lab_motor_rate(window, angles, orientations, axes),
    }
    return {
        "from": window[0],
        "to": window[-1],
        **(motors if scene.body.enabled else {}),  # a filament without a body has none
        # Each frame's rate is that of the interval before it, from the accumulated angle.
        "body_rate": np.average(measured["body_rate"][first + 1 :], weights=np.diff(window)),
        "net_speed": observables.net_speed(window, entries[BODY_POSITION][first:]),
    }


def _first(times: np.ndarray, reached: np.ndarray) -> float | None:
    return float(times[reached.argmax()]) if reached.any() else None
