"""What a summary says of a record whose numbers are known by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from warpflag_kernels.stepping import accuracy

from tests.runs import executed, small, summary
from warpflag.run.summary import accuracy_kept, digest, kept_words, plain

TIMES = 1e-3 * np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 8.0])


def record(count: int = 7, **measured: Any) -> Any:
    """A cell that swims along x at 2 um/s and turns about its axis; its motors turn at 10 and 20 Hz in the body."""
    times = TIMES[:count]
    quarter = np.pi * 5.0 * times  # half the angle of 5 Hz
    observables = {
        "phase_difference": np.array([0.5, 0.3, 0.24, 0.151, 0.149, 0.3, 0.1])[:count],
        "bundle_length": np.array([0.0, 0.2, 0.97, 0.979, 0.5, 0.98, 1.0])[:count],
        "body_rate": np.array([np.nan, 5.0, 5.0, 5.0, 5.0, 5.0, 9.0])[:count],
    }
    return SimpleNamespace(
        times=times,
        observables=observables | measured,
        motor_angle=2 * np.pi * np.outer(times, [10.0, 20.0]),
        body_orientation=np.stack([0 * times, 0 * times, np.sin(quarter), np.cos(quarter)], axis=1),
        body_position=np.outer(times, [2.0, 0.0, 0.0]),
    )


def test_events_are_the_first_frames_that_reach_them():
    events = digest(record(), small())["events"]
    assert events == {"synchronised": 4e-3, "zipped": 5e-3}
    assert digest(record(4), small())["events"] == {"synchronised": None, "zipped": None}


def test_rates_are_those_of_the_last_third():
    found = digest(record(), small({"motor.axis_angle": 60.0}))
    rates = found["rates"]  # from 5.33 ms on there is one frame only; the window begins with the first from there
    assert rates is None
    times = 1e-3 * np.array([0.0, 2.0, 4.0, 5.0, 6.0])
    shorter = record(5)
    shorter.times = times
    shorter.motor_angle = 2 * np.pi * np.outer(times, [10.0, 20.0])
    shorter.body_position = np.outer(np.maximum(times, 3e-3), [2.0, 0.0, 0.0])  # it stands at first
    half = np.pi * 5.0 * times
    shorter.body_orientation = np.stack([0 * times, 0 * times, np.sin(half), np.cos(half)], axis=1)
    shorter.observables["body_rate"] = np.array([np.nan, 1.0, 1.0, 4.0, 6.0])
    rates = digest(shorter, small({"motor.axis_angle": 60.0}))["rates"]
    assert (rates["from"], rates["to"]) == (4e-3, 6e-3)
    np.testing.assert_allclose(rates["motor_rate"], [10.0, 20.0])
    np.testing.assert_allclose(rates["motor_rate_lab"], [12.5, 22.5])  # half of the body's turn lies along each motor
    assert rates["net_speed"] == pytest.approx(2.0) and rates["body_rate"] == pytest.approx(5.0)
    shorter.times = times + 0.1  # a record may begin later
    rates = digest(shorter, small({"motor.axis_angle": 60.0}))["rates"]
    assert (rates["from"], rates["to"]) == pytest.approx((0.104, 0.106))


def test_rates_of_unequal_intervals_are_weighted_with_them():
    times = 1e-3 * np.array([0.0, 1.0, 2.0, 2.5, 3.0])
    made = record(5)
    made.times = times
    made.observables["body_rate"] = np.array([np.nan, 1.0, 1.0, 2.0, 8.0])
    assert digest(made, small())["rates"]["body_rate"] == pytest.approx(5.0)
    made.times = 1e-3 * np.array([0.0, 0.5, 2.0, 2.1, 3.0])
    assert digest(made, small())["rates"]["body_rate"] == pytest.approx(0.1 * 2.0 + 0.9 * 8.0)
    free = {"body.enabled": False, "flagella.count": 1, "flagella.phase_difference": None}
    assert not [name for name in digest(made, small(free))["rates"] if "motor" in name]


def test_last_observables_and_counts():
    found = digest(record(6), small())
    assert (found["time"], found["frames"], found["observables"]["bundle_length"]) == (5e-3, 6, 0.98)


def test_what_is_not_finite_is_none_in_a_file():
    values = {"a": np.nan, "b": [np.inf, 1.0], "c": np.array([2.0, -np.inf]), "d": np.float32(0.5), "e": np.int64(3)}
    assert plain(values) == {"a": None, "b": [None, 1.0], "c": [2.0, None], "d": 0.5, "e": 3}


def kept(**sums: float) -> dict[str, Any]:
    """What a summary says of a run of 3 ms at 5e-3 um/ms whose sums these are."""
    given = dict.fromkeys((*accuracy.SUMS, "at_shortest"), 0.0) | sums
    arrays = {f"stepper.achieved_{name}": np.array([value]) for name, value in given.items()}
    return accuracy_kept(small({"numerics.stepper": "rkc"}), arrays | {"control.time": np.array([3e-3])})


def test_the_worst_window_ends_where_it_was_or_where_the_run_is():
    ended = {"total": 3e-3, "total_time": 3e-3, "worst": 4.0, "worst_end": 1.7e-3}
    assert (kept(**ended)["worst_window"], kept(**ended)["worst_window_end"]) == pytest.approx((2e-2, 1.7e-3))
    found = kept(**ended, window=6e-4, window_time=1e-4)  # the present one is worse
    assert (found["worst_window"], found["worst_window_end"]) == pytest.approx((3e-2, 3e-3))
    assert found["estimate"] == pytest.approx(5e-3)


def test_the_last_line_tells_of_a_window_that_stands_out():
    facts = {"asked": 5e-3, "estimate": 1e-3, "worst_window": 1.5e-2, "worst_window_end": 2.5e-3}
    facts |= {"steps_at_shortest": 0}
    said = "error estimate 0.2 times the 0.005 um/ms asked for"
    assert kept_words(facts) == f"{said} (worst 3 times, just before 2.5 ms)"
    assert kept_words(facts | {"worst_window": 9e-3}) == said  # below twice what was asked
    assert "worst" not in kept_words(facts | {"estimate": 8e-3})  # below twice the mean
    assert kept_words(facts | {"steps_at_shortest": 7}).endswith(", 7 steps as short as estimates may ask for")


def test_refused_steps_are_counted_once(tmp_path):
    scene = small({"numerics.accuracy": 1e-8, "numerics.on_accuracy": "warn", "duration": 4e-5, "frames": 4})
    said = summary(executed(scene, tmp_path / "made"))
    assert said["rejected_steps"] > 0  # or this scene no longer tells refused steps from others: take a harder one
    assert said["evaluations"] == said["steps"] + said["rejected_steps"]  # one a step, refused or not
