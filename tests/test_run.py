"""One run: its directory, what it says of itself, and going on where it was stopped."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from warpflag import observables, run
from warpflag.checkpoint import CheckpointError
from warpflag.record import Frame, Record, RecordError
from warpflag.recorder import Recorder
from warpflag.run_directory import RunError
from warpflag.scene import Scene, SceneError, dumps, load, with_values
from warpflag.simulation import NumericalError, Simulation

STEPPERS = {
    "rkc": {},
    "euler": {"numerics.stepper": "euler", "duration": 4e-7},
    "implicit": {"numerics.stepper": "implicit"},
    "float32": {"numerics.precision": "float32"},
}


def small(values=None) -> Scene:
    """Two short flagella, eight frames."""
    return with_values(Scene(name="small"), {"duration": 8e-5, "frames": 8, "flagella.length": 2.0, **(values or {})})


def executed(scene: Scene, directory: Path) -> Path:
    outcome = run.start(scene, str(directory), "cpu").execute(quiet=True)
    assert outcome.status == "done", outcome.message
    return directory


def summary(directory: Path) -> dict:
    return json.loads((directory / "summary.json").read_text())


def interrupt_at(monkeypatch, frame: int) -> None:
    """Ctrl-C while the steps toward a frame are taken."""
    advance = Simulation.advance

    def interrupted(self, until, watch=None):
        advance(self, until, watch)
        if round(until / self.scenes[0].duration * self.scenes[0].frames) == frame:
            raise KeyboardInterrupt

    monkeypatch.setattr(Simulation, "advance", interrupted)


def arrays(directory: Path) -> dict[str, np.ndarray]:
    """Everything that is recorded of the frames."""
    with Record(directory) as record:
        names = ("times", "steps", "positions", "directors", "motor_angle", "body_position", "body_orientation")
        return {name: np.asarray(getattr(record, name)) for name in names} | record.observables


def assert_same_frames(a: Path, b: Path) -> None:
    """To the last bit."""
    first, second = arrays(a), arrays(b)
    assert first.keys() == second.keys()
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name], err_msg=name)


# The directory.


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
    assert (said["device"], said["precision"], said["stepper"]) == ("cpu", "float64", "rkc")
    assert said["wall_time"] > 0 and said["rejected_steps"] == 0 and said["evaluations"] > said["steps"]
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


# Going on.


@pytest.mark.parametrize("values", STEPPERS.values(), ids=STEPPERS)
def test_a_restored_simulation_goes_on_with_the_same_bits(values, device):
    scene = small(values)
    one = Simulation(scene, device=device)
    frames, kept = [], {}
    for index, frame in enumerate(one.frames(scene.duration)):
        frames.append(frame)
        kept[index] = one.checkpoint()
    for index in (0, 3, 7):
        other = Simulation(scene, device=device)
        other.restore(kept[index])
        rest = list(other.frames(scene.duration))
        assert len(rest) == 8 - index
        for a, b in zip(frames[index + 1 :], rest, strict=True):
            assert (a.time, a.step) == (b.time, b.step)
            np.testing.assert_array_equal(a.positions, b.positions)
            np.testing.assert_array_equal(a.directors, b.directors)
            for name, value in a.observables.items():
                np.testing.assert_array_equal(value, b.observables[name])


def test_a_checkpoint_of_other_cells_is_refused():
    kept = Simulation(small(), device="cpu").checkpoint()
    for values in ({"flagella.length": 2.4}, {"numerics.stepper": "implicit"}):
        with pytest.raises(ValueError, match="checkpoint is of"):
            Simulation(small(values), device="cpu").restore(kept)


@pytest.mark.parametrize("stop", [1, 5, 8])
def test_an_interrupted_run_resumes_to_the_same_record(stop, tmp_path, monkeypatch):
    whole, halved = executed(small(), tmp_path / "whole"), tmp_path / "halved"
    with monkeypatch.context() as patch:
        interrupt_at(patch, stop)
        outcome = run.start(small(), str(halved), "cpu").execute(quiet=True)
    assert outcome.status == "interrupted" and f"--resume {halved}" in outcome.message
    with Record(halved) as record:
        assert record.frame_count == stop
    assert (summary(halved)["status"], summary(halved)["frames"]) == ("interrupted", stop)
    wall_time = summary(halved)["wall_time"]
    assert run.resume(str(halved)).execute(quiet=True).status == "done"
    assert_same_frames(whole, halved)
    assert summary(halved)["evaluations"] == summary(whole)["evaluations"]
    assert summary(halved)["wall_time"] > wall_time


def test_resume_goes_back_to_the_last_checkpoint(tmp_path, monkeypatch):
    whole, halved = executed(small(), tmp_path / "whole"), tmp_path / "halved"
    with monkeypatch.context() as patch:
        patch.setattr(run, "_SECONDS_PER_CHECKPOINT", 0.0)
        save = run.Run._save
        saves = []

        def some(self):
            saves.append(len(saves))
            if len(saves) <= 3:
                save(self)

        patch.setattr(run.Run, "_save", some)
        interrupt_at(patch, 7)
        run.start(small(), str(halved), "cpu").execute(quiet=True)
    assert len(saves) == 7
    resumed = run.resume(str(halved))
    assert resumed.simulation.times[0] == pytest.approx(2e-5)
    resumed.execute(quiet=True)
    assert_same_frames(whole, halved)


def test_a_run_stopped_before_its_first_frame_starts_again(tmp_path, monkeypatch):
    whole, late = executed(small(), tmp_path / "whole"), tmp_path / "late"
    with monkeypatch.context() as patch:
        patch.setattr(Simulation, "prepare", lambda self: signal.raise_signal(signal.SIGINT))
        outcome = run.start(small(), str(late), "cpu").execute(quiet=True)
    assert outcome.status == "interrupted" and f"--resume {late}" in outcome.message
    assert run.resume(str(late), device="cpu").execute(quiet=True).status == "done"
    assert_same_frames(whole, late)


LONG = ["run", "long.toml", "-o", "made", "--quiet", "--device", "cpu"]


def started_process(directory: Path) -> subprocess.Popen:
    """A run that would go on for long, some frames into its record."""
    (directory / "long.toml").write_text(dumps(small({"duration": 1.0, "frames": 100_000})))
    root = Path(run.__file__).parent.parent
    paths = os.pathsep.join([str(root), str(root / "kernels")])
    process = subprocess.Popen(
        [sys.executable, "-m", "warpflag", *LONG],
        cwd=directory,
        env={**os.environ, "PYTHONPATH": paths},
        stderr=subprocess.PIPE,
        text=True,
    )
    while True:
        assert process.poll() is None
        with contextlib.suppress(RecordError):  # not there yet, or caught while it is written
            if Record(directory / "made").frame_count >= 20:
                return process


def shortened(directory: Path, frames: int) -> None:
    """Rewrites the scene of a run to end after some frames, so that resuming it is short."""
    (directory / "scene.toml").write_text(dumps(small({"duration": frames * 1e-5, "frames": frames})))


def test_ctrl_c_leaves_a_readable_resumable_run(tmp_path):
    process = started_process(tmp_path)
    process.send_signal(signal.SIGINT)
    line = process.communicate()[1]
    assert process.returncode == 130
    assert line.count("\n") == 1 and "interrupted" in line and "resumable with --resume made" in line
    with Record(tmp_path / "made") as record:
        assert record.frame_count >= 20
        assert summary(tmp_path / "made")["frames"] == record.frame_count


def test_a_killed_run_resumes_to_the_same_record(tmp_path):
    process = started_process(tmp_path)
    process.kill()
    process.communicate()
    with Record(tmp_path / "made") as record:
        kept = record.frame_count
    shortened(tmp_path / "made", kept + 5)
    assert run.resume(str(tmp_path / "made")).execute(quiet=True).status == "done"
    whole = executed(small({"duration": (kept + 5) * 1e-5, "frames": kept + 5}), tmp_path / "whole")
    found, expected = arrays(tmp_path / "made"), arrays(whole)
    # The times of frames are the scene's duration in parts, and round differently in the longer scene.
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-6, atol=1e-9, err_msg=name)


def test_a_finished_run_can_be_prolonged(tmp_path):
    short = executed(small({"duration": 4e-5, "frames": 4}), tmp_path / "short")
    assert run.resume(str(short), ["duration=8e-5"]).execute(quiet=True).status == "done"
    assert_same_frames(executed(small(), tmp_path / "long"), short)
    assert load(short / "scene.toml") == small()
    with Record(short) as record:
        assert record.scene_text == dumps(small())


@pytest.mark.parametrize(
    "override, words",
    [
        ("motor.torque=2", "no other change than duration"),
        ("duration=4e-5", "where the run stands"),
        ("duration=8.5e-5", "multiple of the frame interval"),
        ("duration=-1", "must be a number"),
        ("duration", "key=value"),
    ],
)
def test_resume_takes_only_a_longer_duration(override, words, tmp_path):
    directory = executed(small(), tmp_path / "made")
    before = arrays(directory)
    with pytest.raises(SceneError, match=words) as refused:
        run.resume(str(directory), [override])
    assert "\n" not in str(refused.value)
    assert arrays(directory).keys() == before.keys() and load(directory / "scene.toml") == small()


def test_resume_needs_a_run_with_a_checkpoint(tmp_path):
    with pytest.raises(RunError, match=r"scene\.toml"):
        run.resume(str(tmp_path))
    directory = executed(small(), tmp_path / "made")
    for path in directory.glob("checkpoint-*"):
        path.write_bytes(b"")
    with pytest.raises(CheckpointError):
        run.resume(str(directory))


# A run that loses its footing.


def test_a_violated_guard_keeps_the_sound_frames(tmp_path, monkeypatch):
    # Explicit Euler far above its stable step, but only from the fourth frame on.
    scene = small({"numerics.stepper": "euler", "duration": 8e-7, "frames": 8})
    started = run.start(scene, str(tmp_path / "made"), "cpu")
    advance = Simulation.advance

    def reckless(self, until, watch=None):
        if until > 3.5e-7:
            self.system.control.longest_step.fill_(1e-7)
        advance(self, until, watch)

    monkeypatch.setattr(Simulation, "advance", reckless)
    outcome = started.execute(quiet=True)
    assert outcome.status == "stopped"
    assert "\n" not in outcome.message and "flagellum" in outcome.message and "numerics.time_step" in outcome.message
    said = summary(tmp_path / "made")
    assert said["status"] == "stopped" and said["guards"]["violated"]["time"] > said["time"]
    assert said["message"] in outcome.message
    with Record(tmp_path / "made") as record:
        assert said["frames"] == record.frame_count >= 4
        monkeypatch.undo()
        sound = executed(scene, tmp_path / "sound")
        np.testing.assert_array_equal(record.positions[:4], arrays(sound)["positions"][:4])


# Starting from a record.


def test_a_scene_starts_from_a_frame_of_a_record(tmp_path):
    directory = executed(small(), tmp_path / "made")
    for index in (-1, 3):
        scene = small({"start.record": str(directory), "start.frame": index, "motor.torque": 1.0})
        simulation = Simulation(scene, device="cpu")
        first = next(simulation.frames(scene.duration))
        with Record(directory) as record:
            frame = record.frame(index)
        np.testing.assert_allclose(first.positions, frame.positions, rtol=0, atol=1e-14)
        np.testing.assert_allclose(first.directors, frame.directors, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(first.body_orientation, frame.body_orientation)
        assert first.time == 0.0 and first.step == 0 and (first.motor_angle == 0).all()
        assert first.observables["phase_difference"] == pytest.approx(frame.observables["phase_difference"], abs=1e-12)
        assert first.observables["elastic_energy"] == pytest.approx(frame.observables["elastic_energy"], rel=1e-9)


@pytest.mark.parametrize(
    "values, words",
    [
        ({"flagella.length": 2.4}, "segments"),
        ({"flagella.count": 3}, "segments"),
        ({"start.frame": 9}, "frames 0 to 8"),
        ({"flagella.anchor_offset": 0.5}, "anchors flagellum 0 elsewhere"),
        ({"start.record": "nowhere"}, "no such record"),
    ],
)
def test_a_record_of_another_cell_is_no_start(values, words, tmp_path):
    directory = executed(small(), tmp_path / "made")
    with pytest.raises(SceneError, match=words):
        Simulation(small({"start.record": str(directory), **values}), device="cpu")


def test_a_run_that_started_from_a_record_resumes_without_it(tmp_path, monkeypatch):
    origin = executed(small(), tmp_path / "origin")
    scene = small({"start.record": str(origin)})
    whole = executed(scene, tmp_path / "whole")
    with monkeypatch.context() as patch:
        interrupt_at(patch, 4)
        run.start(scene, str(tmp_path / "halved"), "cpu").execute(quiet=True)
    (origin / "run.h5").unlink()
    run.resume(str(tmp_path / "halved")).execute(quiet=True)
    assert_same_frames(whole, tmp_path / "halved")


# From Python.


class Listener:
    """A reporter that keeps what it is told."""

    def __init__(self):
        self.heard: list[str] = []
        self.frames: list[Frame] = []

    def start(self, scene_text, first_node, **facts):
        self.heard.append("start")

    def write(self, frame):
        self.heard.append("write")
        self.frames.append(frame)

    def close(self):
        self.heard.append("close")


def test_reporters_take_the_frames_of_one_run(tmp_path):
    listener = Listener()
    simulation = Simulation(small(), device="cpu", reporters=[listener, Recorder(tmp_path / "run.h5")])
    simulation.run(4.5e-5)
    assert listener.heard == ["start", *["write"] * 5, "close"]
    assert simulation.state.time == pytest.approx(4.5e-5) and listener.frames[-1].time == pytest.approx(4e-5)
    simulation.run()
    assert simulation.state.time == small().duration and len(listener.frames) == 5
    with Record(tmp_path / "run.h5") as record:
        assert record.frame_count == 5
        np.testing.assert_array_equal(record.positions[-1], listener.frames[-1].positions)


def test_reporters_are_closed_when_a_guard_is_violated():
    listener = Listener()
    scene = small({"numerics.stepper": "euler", "numerics.time_step": 1e-6})
    with pytest.raises(NumericalError):
        Simulation(scene, device="cpu", reporters=[listener]).run()
    assert listener.heard[-1] == "close"


def test_a_batch_has_no_reporters_but_runs():
    batch = [small(), small({"motor.torque": 2.0})]
    with pytest.raises(ValueError, match="single scene"):
        Simulation(batch, device="cpu", reporters=[Listener()]).run()
    simulation = Simulation(batch, device="cpu")
    simulation.run()
    assert simulation.cell_state(1).time == small().duration
