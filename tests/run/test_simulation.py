"""A simulation from Python: checkpoints, starts from a record, reporters, batches."""

from __future__ import annotations

import dataclasses
import io
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from warpflag_kernels.stepping import frame_slots

from tests.films import made_record
from tests.runs import assert_same_frames, ended_at, executed, frame_by_frame, small
from warpflag.record import Frame, Record, RecordError
from warpflag.record.recorder import Recorder
from warpflag.record.reporters import start_reporter
from warpflag.run import run
from warpflag.run.simulation import NumericalError, Simulation
from warpflag.scene import SceneError, loads, with_values

STEPPERS = {
    "rkc": {"numerics.stepper": "rkc"},
    "rkc, fixed steps": {"numerics.stepper": "rkc", "numerics.time_step": 1e-6},
    "euler": {"numerics.stepper": "euler", "duration": 4e-7},
    "implicit": {"numerics.stepper": "implicit"},
    "float32": {"numerics.precision": "float32"},
}


@pytest.mark.parametrize("values", STEPPERS.values(), ids=STEPPERS)
def test_a_restored_simulation_goes_on_with_the_same_bits(values, device):
    scene = small(values)
    one = Simulation(scene, device=device)
    frames, kept = [], {}
    with frame_by_frame():
        for index, frame in enumerate(one.frames(scene.duration)):
            frames.append(frame)
            kept[index] = one.checkpoint()
    # New simulations, and one that has gone on.
    for index, other in ((0, None), (3, None), (3, one), (7, one)):
        other = other or Simulation(scene, device=device)
        other.restore(kept[index])
        rest = list(other.frames(scene.duration))
        assert len(rest) == 8 - index
        for a, b in zip(frames[index + 1 :], rest, strict=True):
            assert (a.time, a.step) == (b.time, b.step)
            np.testing.assert_array_equal(a.positions, b.positions)
            np.testing.assert_array_equal(a.directors, b.directors)
            for name, value in a.observables.items():
                np.testing.assert_array_equal(value, b.observables[name])


def times_of(frames):
    return [frame.time for frame in frames]


def test_frames_go_on_where_an_iterator_was_left(device):
    """Frames come in blocks, of which those that nobody has taken are not lost."""
    scene = small()
    whole = list(Simulation(scene, device=device).frames(scene.duration))
    simulation = Simulation(scene, device=device)
    frames = simulation.frames(scene.duration)
    first = [next(frames) for _ in range(3)]
    with pytest.raises(ValueError, match="frames that were not taken yet"):
        simulation.checkpoint()
    until = whole[4].time
    found = first + list(simulation.frames(until)) + list(simulation.frames(scene.duration))
    assert times_of(found) == times_of(whole) and next(frames, None) is None
    for a, b in zip(found, whole, strict=True):
        np.testing.assert_array_equal(a.positions, b.positions)


def test_a_cell_that_is_not_there_has_no_part():
    simulation = Simulation([small(), small()], device="cpu")
    kept = simulation.checkpoint()
    for name, values in simulation.part(kept, -1).items():
        np.testing.assert_array_equal(values, simulation.part(kept, 1)[name])
    with pytest.raises(IndexError):
        simulation.part(kept, 2)


def test_frames_of_a_cell_that_has_advanced_begin_where_it_stands(device):
    """The first is of the present; those before it are past."""
    simulation = Simulation(small(), device=device)
    simulation.advance(2.5e-5)
    expected = [2.5e-5, *(k * 1e-5 for k in range(3, 9))]
    np.testing.assert_allclose(times_of(simulation.frames(8e-5)), expected, rtol=1e-12)


def test_two_iterators_share_the_frames_of_a_batch(device, monkeypatch):
    monkeypatch.setattr(frame_slots, "MOST_SLOTS", 3)
    scenes = [small(), small({"frames": 5})]
    simulation = Simulation(scenes, device=device)
    one, two = simulation.cell_frames(), simulation.cell_frames()
    found = {0: [], 1: []}
    while True:
        taken = [frames for frames in (next(one, None), next(two, None)) if frames is not None]
        for frames in taken:
            for cell, frame in frames.items():
                found[cell].append(frame.time)
        if not taken:
            break
    for cell, scene in enumerate(scenes):
        np.testing.assert_allclose(found[cell], np.linspace(0.0, scene.duration, scene.frames + 1), rtol=1e-12)


def test_a_restored_simulation_forgets_frames_of_before(device):
    scene = small()
    simulation = Simulation(scene, device=device)
    frames = simulation.frames(scene.duration)
    assert [next(frames).time for _ in range(2)] == [0.0, 1e-5]  # the first stands alone, the second is of a block
    with frame_by_frame():
        other = Simulation(scene, device=device)
        frames = other.frames(scene.duration)
        kept = [other.checkpoint() for _ in zip(range(3), frames, strict=False)][-1]
    simulation.restore(kept)
    assert times_of(simulation.frames(scene.duration)) == [k * 1e-5 for k in range(3, 9)]


def test_a_checkpoint_of_other_cells_is_refused():
    kept = Simulation(small(), device="cpu").checkpoint()
    for values in ({"flagella.length": 2.4}, {"numerics.stepper": "rkc"}, {"numerics.precision": "float32"}):
        with pytest.raises(ValueError, match="checkpoint is of"):
            Simulation(small(values), device="cpu").restore(kept)


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
        ({"flagella.length": 2.06, "flagella.segment_length": 0.206}, "segments of 0.1997 um in flagellum 0"),
    ],
)
def test_a_record_of_another_cell_is_no_start(values, words, tmp_path):
    directory = executed(small(), tmp_path / "made")
    with pytest.raises(SceneError, match=words):
        Simulation(small({"start.record": str(directory), **values}), device="cpu")


@pytest.mark.parametrize("what", ["positions", "directors", "body_orientation"])
def test_a_record_that_is_not_finite_is_no_start(what, tmp_path):
    simulation = Simulation(small(), device="cpu")
    frame = next(simulation.frames(8e-5))
    values = np.array(getattr(frame, what))
    values.flat[5 if values.ndim == 2 else 1] = np.nan
    recorder = Recorder(tmp_path / "run.h5")
    start_reporter(recorder, small(), simulation.first_node)
    recorder.write(dataclasses.replace(frame, **{what: values}))
    recorder.close()
    with pytest.raises(SceneError, match="not finite"):
        Simulation(small({"start.record": str(tmp_path)}), device="cpu")


@pytest.mark.parametrize(
    "values", [{"fluid.temperature": 298.0}, {"motor.switching": "markov"}], ids=["noise", "motors"]
)
def test_a_seed_may_stay_where_only_one_of_both_runs_draws_from_it(values, tmp_path):
    for name, made, own in (("first", {}, values), ("then", values, {}), ("both", values, values)):
        made_record(tmp_path / name, 2, scene=small(made)).close()
        scene = small({**own, "start.record": str(tmp_path / name)})
        if name != "both":
            assert Simulation(scene, device="cpu").times[0] == 0.0
            continue
        with pytest.raises(SceneError, match="whose random numbers would come again"):
            Simulation(scene, device="cpu")


def test_soft_filaments_may_begin_under_tension_and_stiff_ones_not(tmp_path):
    """Stretched by 5 % all along, as 5 pN do it to a stiffness of 100 pN, and nothing sound to one of 1000 pN."""
    with made_record(tmp_path / "made", 1, scene=small()) as record:
        frame, first_node = record.frame(0), record.first_node
        anchors = np.repeat(frame.positions[first_node[:-1]], np.diff(first_node), axis=0)
        recorder = Recorder(tmp_path / "run.h5")
        recorder.start(record.scene_text, first_node, filament_radius=0.01, body_length=2.5, body_width=0.8)
        recorder.write(dataclasses.replace(frame, positions=anchors + 1.05 * (frame.positions - anchors)))
        recorder.close()
    values = {"start.record": str(tmp_path)}
    start = Simulation(small({**values, "flagella.stretching_stiffness": 100.0}), device="cpu").state.positions
    assert np.linalg.norm(start[1] - start[0]) == pytest.approx(0.21)
    with pytest.raises(SceneError, match=r"segments of 0\.21 um in flagellum 0, the scene's are of 0\.2 um"):
        Simulation(small(values), device="cpu")


@pytest.mark.parametrize(
    ("key", "values"),
    [
        ("fluid.seed", {"fluid.temperature": 300.0, "hydrodynamics.mode": "none", "motor.bearing_torque": True}),
        ("motor.seed", {"motor.switching": "markov"}),
    ],
)
def test_random_numbers_do_not_come_again(key, values, tmp_path):
    """A run counts its steps from 0: going on with the seed of before it would repeat the random numbers."""
    directory = executed(small({**values, key: 5}), tmp_path / "made")
    going_on = small({**values, key: 5, "start.record": str(directory)})
    with pytest.raises(SceneError, match="again") as error:
        Simulation(going_on, device="cpu")
    assert error.value.key == key
    for other in ({key: 6}, {"start.frame": 0}):  # another seed; the same run from its start
        Simulation(with_values(going_on, other), device="cpu")


def test_a_run_that_started_from_a_record_resumes_without_it(tmp_path):
    origin = executed(small(), tmp_path / "origin")
    scene = small({"start.record": str(origin)})
    whole = executed(scene, tmp_path / "whole")
    assert ended_at(run.start(scene, str(tmp_path / "halved"), "cpu"), 4).status == "interrupted"
    (origin / "run.h5").unlink()
    run.resume(str(tmp_path / "halved")).execute(quiet=True)
    assert_same_frames(whole, tmp_path / "halved")


def test_a_duration_counts_from_where_the_cell_is():
    parts, whole = (Simulation(small(), device="cpu") for _ in range(2))
    for duration in (2e-5, 1e-5):
        parts.run(duration)
    for until in (2e-5, 2e-5 + 1e-5):
        whole.advance(until)
    assert parts.state.time == whole.state.time == 2e-5 + 1e-5
    np.testing.assert_array_equal(parts.state.positions, whole.state.positions)


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


def test_reporters_take_the_frames_of_a_run_and_of_what_follows(tmp_path):
    listener = Listener()
    simulation = Simulation(small(), device="cpu", reporters=[listener, Recorder(tmp_path / "run.h5")])
    simulation.run(4.5e-5)
    assert listener.heard == ["start", *["write"] * 5, "close"]
    assert simulation.state.time == pytest.approx(4.5e-5) and listener.frames[-1].time == pytest.approx(4e-5)
    simulation.run()
    times = small().duration / small().frames * np.arange(small().frames + 1)
    assert simulation.state.time == small().duration
    assert [frame.time for frame in listener.frames] == pytest.approx(times)  # none is left out, none comes twice
    assert listener.heard[5:] == ["write", "close", "start", *["write"] * (len(times) - 5), "close"]
    with Record(tmp_path / "run.h5") as record:
        assert record.times == pytest.approx(times)
        np.testing.assert_array_equal(record.positions[-1], listener.frames[-1].positions)


def test_a_run_shows_a_bar_on_a_terminal_and_is_quiet_in_a_log(monkeypatch, capfd):
    simulation = Simulation(small(), device="cpu")
    simulation.run(4e-5, progress=True)
    assert capfd.readouterr().err == ""
    screen = io.StringIO()
    screen.isatty = lambda: True  # type: ignore[method-assign]
    monkeypatch.setattr(sys, "stderr", screen)
    simulation.run(progress=True)
    assert "100%" in screen.getvalue() and "ms" in screen.getvalue()


def test_reporters_are_closed_when_a_guard_is_violated():
    listener = Listener()
    scene = small({"numerics.stepper": "euler", "numerics.time_step": 1e-6})
    with pytest.raises(NumericalError):
        Simulation(scene, device="cpu", reporters=[listener]).run()
    assert listener.heard[-1] == "close"


@pytest.mark.parametrize("duration", [float("nan"), -1e-3, float("inf")])
def test_a_run_takes_a_time_from_zero_on(duration):
    with pytest.raises(ValueError, match="a time from 0 on"):
        Simulation(small(), device="cpu").run(duration)


@pytest.mark.parametrize("time", [float("nan"), float("inf"), float("-inf")])
def test_a_time_to_reach_is_finite(time):
    simulation = Simulation(small(), device="cpu")
    for reach in (simulation.advance, lambda until: next(simulation.frame_blocks(until))):
        with pytest.raises(ValueError, match="finite"):
            reach(time)


@pytest.mark.parametrize("reached", [0.0, 4e-5])
def test_a_recorder_keeps_to_one_scene_and_one_run(tmp_path, reached):
    recorder = Recorder(tmp_path / "run.h5")
    Simulation(small(), device="cpu", reporters=[recorder]).run(4e-5)
    other = Simulation(small({"motor.torque": 2.0}), device="cpu", reporters=[recorder])
    other.advance(reached)
    with pytest.raises(RecordError, match="another scene"):
        other.run(4e-5)
    with pytest.raises(ValueError, match="does not come after"):
        Simulation(small(), device="cpu", reporters=[recorder]).run(4e-5)
    with Record(tmp_path / "run.h5") as record:
        assert len(record.times) == 5 and loads(record.scene_text) == small()


def test_a_batch_has_no_reporters_but_runs():
    batch = [small(), small({"motor.torque": 2.0})]
    with pytest.raises(ValueError, match="single scene"):
        Simulation(batch, device="cpu", reporters=[Listener()]).run()
    simulation = Simulation(batch, device="cpu")
    simulation.run()
    assert simulation.cell_state(1).time == small().duration


def test_simulations_in_threads_give_the_numbers_of_one_alone():
    """A capture records what any thread launches, so threads take turns."""

    def positions(_turn: int = 0) -> np.ndarray:
        simulation = Simulation(small(), device="cpu")
        simulation.run()
        return simulation.state.positions

    alone = positions()
    for found in ThreadPoolExecutor(4).map(positions, range(8)):
        np.testing.assert_array_equal(found, alone)
