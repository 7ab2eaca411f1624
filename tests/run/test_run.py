"""One run: its directory and what it says of itself."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from warpflag_kernels.stepping.health import Fault

from tests.runs import arrays, ended_at, executed, frame_by_frame, small, summary
from warpflag import observables
from warpflag.record import Record
from warpflag.run import run
from warpflag.run.faults import NumericalError, likely_causes
from warpflag.run.member import Member
from warpflag.scene import dumps, load


def test_a_run_leaves_record_movie_scene_and_summary(tmp_path):
    scene = small()
    directory = executed(scene, tmp_path / "made")
    assert load(directory / "scene.toml") == scene
    from pxr import Usd

    assert Usd.Stage.Open(str(directory / "movie.usdc")).GetEndTimeCode() == 8
    said = summary(directory)
    with Record(directory) as record:
        np.testing.assert_allclose(record.times, np.arange(9) * 1e-5, rtol=1e-12)
        assert record.scene_text == dumps(scene)
        assert said["steps"] == record.steps[-1] >= 8
        assert said["frames"] == record.frame_count == 9
        for name, values in record.observables.items():
            np.testing.assert_array_equal(said["observables"][name], values[-1])
    assert said["status"] == "done" and said["guards"]["violated"] is None
    assert (said["device"], said["precision"], said["stepper"]) == ("cpu", "float64", "implicit")
    assert said["wall_time"] > 0 and said["rejected_steps"] >= 0
    assert said["evaluations"] == said["steps"] + said["rejected_steps"]  # one a step
    assert said["versions"].keys() >= {"warpflag", "warp-lang", "python"} and "-march=native" in said["kernel_flags"]


def test_rates_are_differences_of_the_recorded_frames(tmp_path):
    directory = executed(small(), tmp_path / "made")
    with Record(directory) as record:
        times, measured = record.times, record.observables
        assert all(np.isnan(measured[name][0]).all() for name in ("body_speed", "body_rate", "motor_rate"))
        turned = np.diff(record.motor_angle, axis=0) / (2 * np.pi * np.diff(times)[:, None])
        np.testing.assert_allclose(measured["motor_rate"][1:], turned, rtol=1e-12)
        for k, (i, j) in enumerate(pairwise(range(9)), 1):
            pair = record.body_orientation[[i, j]]
            # Each stepper adds the turns of its steps; over one frame that is the turn between its ends.
            np.testing.assert_allclose(measured["body_rate"][k], observables.body_rate(times[[i, j]], pair), rtol=1e-3)
        window = summary(directory)["rates"]
        assert (window["from"], window["to"]) == (times[6], times[8])
        np.testing.assert_allclose(window["motor_rate"], turned[6:].mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(window["body_rate"], measured["body_rate"][7:].mean(), rtol=1e-12)


def test_a_motor_that_stands_still_in_the_body_turns_with_it_in_the_lab():
    # The body turns about its axis at 100 Hz; of that a motor axis at 60 degrees to it sees a half.
    times = np.linspace(0.0, 2e-3, 21)
    half = np.pi * 100.0 * times
    orientations = np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=1)
    axes = np.array([[np.sin(np.pi / 3), 0.0, 0.5], [0.0, 0.0, -1.0]])
    angles = np.outer(times, [0.0, 2 * np.pi * 300.0])
    rates = observables.lab_motor_rate(times, angles, orientations, axes)
    np.testing.assert_allclose(rates, [50.0, 200.0], rtol=1e-12)


def test_a_violated_guard_keeps_the_sound_frames(tmp_path):
    # Explicit Euler far above its stable step, but only from the fourth frame on.
    scene = small({"numerics.stepper": "euler", "duration": 8e-7, "frames": 8})
    started = run.start(scene, str(tmp_path / "made"), "cpu")

    def watch(reached: float) -> None:
        if reached > 2.5e-7:
            started.simulation.system.control.longest_step.fill_(1e-7)

    with frame_by_frame():
        (outcome,) = started.execute_all(quiet=True, watch=watch)
    assert outcome.status == "stopped"
    assert "\n" not in outcome.message and "flagellum" in outcome.message and "twisted" in outcome.message
    said = summary(tmp_path / "made")
    assert said["status"] == "stopped" and said["guards"]["violated"]["time"] > said["time"]
    assert said["message"] in outcome.message
    with Record(tmp_path / "made") as record:
        assert said["frames"] == record.frame_count >= 4
        sound = executed(scene, tmp_path / "sound")
        np.testing.assert_array_equal(record.positions[:4], arrays(sound)["positions"][:4])
    # What was stopped is followed, to tell whether its motion is to blame.
    assert said["growth"] is not None and summary(sound)["growth"] is None


def test_likely_causes_are_told_the_farthest_from_usual_first():
    assert likely_causes(small()) == likely_causes(small({"fluid.viscosity": 2e-3})) == []  # twice is ordinary
    pulled = {"external.body_force": (0.0, 0.0, 1.0)}
    far = small({"motor.torque": 34.0, "flagella.bending_rigidity": 350.0, "fluid.viscosity": 2e-3, **pulled})
    causes = [
        "flagella.bending_rigidity = 350, 100 times the default",
        "motor.torque = 34, 10 times the default",
        "external.body_force = (0.0, 0.0, 1.0)",
    ]
    assert likely_causes(far) == causes
    assert likely_causes(small({"motor.torque": 0.01})) == []  # a weak motor stops no run
    (soft,) = likely_causes(small({"flagella.stretching_stiffness": 10.0}))
    assert soft == "flagella.stretching_stiffness = 10, 1/100 of the default"
    for apart, said in ((0.1, ["anchors 0.1 um apart crowd the flagella"]), (0.13, [])):  # three diameters are 0.12
        azimuth = 2 * np.degrees(np.arcsin(apart / 0.8))
        assert likely_causes(small({"flagellum.0.azimuth": 0.0, "flagellum.1.azimuth": azimuth})) == said
    line = str(NumericalError(Fault.STRAIN, 2e-3, 0, 1, 4, far))
    assert "flagellum 1, segment 4: a segment is stretched" in line and "stopped at 2 ms" in line
    assert f"; likely cause: {causes[0]}, {causes[1]}; take a lower motor.torque" in line  # two at most


@pytest.mark.parametrize(("stepper", "judged"), [("implicit", True), ("rkc", False)])
def test_the_summary_tells_whether_steps_were_asked_for_their_balance(stepper, judged, tmp_path):
    scene = small({"numerics.stepper": stepper, "duration": 1e-5, "frames": 1})
    assert summary(executed(scene, tmp_path / "made"))["balance"] == {"judged": judged, "violations": 0}


@pytest.mark.parametrize(("seconds", "count"), [(0.01, 4), (0.5, 2)])
def test_checkpoints_take_a_twentieth_of_the_time_at_most(seconds, count, tmp_path, monkeypatch):
    """Of 32 frames of a second each: every 5 s, and where writing one takes half a second, every 10 s."""
    clock, saved = [0.0], []
    written, kept = Member.write, Member.save

    def write(own, frames):
        clock[0] += 1.0
        return written(own, frames)

    def save(own, *arguments, **options):
        clock[0] += seconds
        saved.append(clock[0])
        return kept(own, *arguments, **options)

    monkeypatch.setattr("warpflag.run.execute.monotonic", lambda: clock[0])
    monkeypatch.setattr(Member, "write", write)
    monkeypatch.setattr(Member, "save", save)
    with frame_by_frame():
        executed(small({"frames": 31}), tmp_path / "made")
    apart = np.diff([0.0, *saved[:-1]])  # the last is of the end
    assert apart[0] == pytest.approx(6.0 + seconds) and (apart[1:] > 20 * seconds).all()
    assert len(saved) == count + 1


def test_the_last_line_says_how_far_a_run_came(tmp_path):
    done = run.start(small(), str(tmp_path / "done"), "cpu").execute(quiet=True).message
    assert done.startswith("small: 9 frames to 0.08 ms in ") and done.endswith(f": {tmp_path / 'done'}")
    half = ended_at(run.start(small(), str(tmp_path / "half"), "cpu"), 3).message
    assert half.startswith("small: interrupted, 3 frames to 0.02 ms kept; movie left out; resumable with --resume ")
