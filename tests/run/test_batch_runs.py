"""Batches that write: each member's directory is that of its own single run, whatever happens to the others."""

from __future__ import annotations

import errno
import shutil
import signal
from pathlib import Path

import numpy as np
import pytest

from tests.runs import arrays, assert_same_frames, executed, frame_by_frame, small, summary
from warpflag import observables
from warpflag.record import Record
from warpflag.run import checkpoint, execute, run
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, dumps, load


def members() -> list[Scene]:
    """Cells that share nothing but their terms: torques, lengths, numbers of flagella, ends and frames."""
    return [
        small({"name": "a"}),
        small({"name": "b", "motor.torque": 1.0, "duration": 6e-5, "frames": 3}),
        small({"name": "c", "flagella.count": 3, "flagella.opening_angle": 60.0, "flagella.length": 1.6}),
        small({"name": "d", "flagellum.1.length": 1.2, "duration": 1e-4, "frames": 20}),
    ]


def directories(parent: Path, count: int) -> list[Path]:
    return [parent / f"{k:04d}" for k in range(count)]


def alone(scene: Scene, directory: Path) -> Path:
    """The single run of a member, with the kernels of a strict build."""
    (outcome,) = run.start_batch([scene], [directory], "cpu", strict=True).execute_all(quiet=True)
    assert outcome.status == "done"
    return directory


def test_every_member_is_its_own_single_run_to_the_last_bit(tmp_path):
    scenes, made = members(), directories(tmp_path / "batch", 4)
    batch = run.start_batch(scenes, made, "cpu", strict=True, movies=False)
    assert [outcome.status for outcome in batch.execute_all(quiet=True)] == ["done"] * 4
    assert [bool(summary(directory)["start"]) for directory in made] == [False, False, True, False]  # turned clear
    for scene, directory in zip(scenes, made, strict=True):
        assert_same_frames(alone(scene, tmp_path / scene.name), directory)
        single, member = summary(tmp_path / scene.name), summary(directory)
        for own in ("wall_time", "batch"):
            single.pop(own), member.pop(own)
        assert member == single
        assert load(directory / "scene.toml") == scene
        assert not (directory / "movie.usdc").exists() and (tmp_path / scene.name / "movie.usdc").exists()
        with Record(directory) as record:
            assert record.frame_count == scene.frames + 1 and record.scene_text == dumps(scene)
            assert record.first_node[-1] == record.positions.shape[1]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_batch_that_is_ended_resumes_to_the_same_bits(number, tmp_path):
    scenes, made = members(), directories(tmp_path / "batch", 4)
    batch = run.start_batch(scenes, made, "cpu", strict=True, checkpoint_seconds=0.0)

    def watch(reached: float) -> None:
        if reached > 2.2e-4:
            signal.raise_signal(number)

    with frame_by_frame():
        statuses = [outcome.status for outcome in batch.execute_all(quiet=True, watch=watch)]
    ended = {signal.SIGTERM: "terminated", signal.SIGINT: "interrupted"}[number]
    assert set(statuses) == {ended, "done"}  # the one of three frames is done by then
    left = [path for path, status in zip(made, statuses, strict=True) if status != "done"]
    resumed = run.resume_batch(left, device="cpu", strict=True)
    assert min(resumed.simulation.times) > 0.0
    assert {outcome.status for outcome in resumed.execute_all(quiet=True)} == {"done"}
    for scene, directory in zip(scenes, made, strict=True):
        assert_same_frames(alone(scene, tmp_path / scene.name), directory)


def test_members_resume_from_different_frames(tmp_path):
    """As after a kill between two members' checkpoints: each goes on from its own."""
    scenes, made = members(), directories(tmp_path / "batch", 4)
    batch = run.start_batch(scenes, made, "cpu", strict=True, checkpoint_seconds=0.0)

    def watch(reached: float) -> None:
        if reached > 1.5e-4:
            signal.raise_signal(signal.SIGTERM)

    with frame_by_frame():
        batch.execute_all(quiet=True, watch=watch)
    max(made[2].glob("checkpoint-*")).unlink()
    resumed = run.resume_batch(made, device="cpu", strict=True)
    resumed.execute_all(quiet=True)
    for scene, directory in zip(scenes, made, strict=True):
        assert_same_frames(alone(scene, tmp_path / scene.name), directory)


def test_a_batch_in_parts_is_ended_and_resumed_as_one(tmp_path, monkeypatch):
    """On a CPU a large batch is advanced in parts: one is through, one amid its way and one not begun at the signal."""
    monkeypatch.setattr(execute, "LARGEST_ON_CPU", 2)
    scenes = [*members(), small({"name": "e"})]
    made = directories(tmp_path / "batch", 5)
    batch = run.start_batch(scenes, made, "cpu", strict=True, checkpoint_seconds=0.0, movies=False)
    seen = []

    def watch(reached: float) -> None:
        seen.append(reached)
        if reached > sum(scene.duration for scene in scenes[:1]) + 6e-5:
            signal.raise_signal(signal.SIGTERM)

    with frame_by_frame():
        outcomes = batch.execute_all(quiet=True, watch=watch)
    assert [outcome.status for outcome in outcomes] == ["done", *["terminated"] * 4]
    assert (np.diff(seen) >= 0).all()
    assert run.begun_at_checkpoint(made[1]) and not run.begun_at_checkpoint(made[4])
    resumed = run.resume_batch(made, device="cpu", strict=True, movies=False)
    assert [outcome.status for outcome in resumed.execute_all(quiet=True)] == ["done"] * 5
    for scene, directory in zip(scenes, made, strict=True):
        assert_same_frames(alone(scene, tmp_path / scene.name), directory)


def test_a_member_resumes_by_itself(tmp_path):
    scenes, made = members()[:2], directories(tmp_path / "batch", 2)
    batch = run.start_batch(scenes, made, "cpu", checkpoint_seconds=0.0)

    def watch(reached: float) -> None:
        if reached > 6e-5:
            signal.raise_signal(signal.SIGTERM)

    with frame_by_frame():
        batch.execute_all(quiet=True, watch=watch)
    assert run.resume(str(made[0])).execute(quiet=True).status == "done"
    with Record(made[0]) as record:
        assert record.frame_count == 9


def test_a_member_that_a_guard_stops_leaves_the_others_running(tmp_path):
    wild = small({"name": "wild", "numerics.stepper": "rkc", "motor.torque": 60.0})
    weak = small({"name": "weak", "numerics.stepper": "rkc"})
    made = directories(tmp_path / "batch", 3)
    batch = run.start_batch([weak, wild, weak], made, "cpu", strict=True, movies=False)
    outcomes = batch.execute_all(quiet=True)
    assert [outcome.status for outcome in outcomes] == ["done", "stopped", "done"]
    assert "wild: stopped at" in outcomes[1].message and "\n" not in outcomes[1].message
    said = summary(made[1])
    assert said["status"] == "stopped" and said["guards"]["violated"]["time"] > said["time"]
    with Record(made[1]) as record:
        assert 1 <= record.frame_count < 9
    for directory in (made[0], made[2]):
        assert_same_frames(alone(weak, tmp_path / f"alone-{directory.name}"), directory)


def test_a_member_that_cannot_write_leaves_the_others_running(tmp_path):
    scenes, made = members()[:3], directories(tmp_path / "batch", 3)
    batch = run.start_batch(scenes, made, "cpu", movies=False, checkpoint_seconds=0.0)

    def watch(reached: float) -> None:
        if reached > 8e-5:
            shutil.rmtree(made[1], ignore_errors=True)

    with frame_by_frame():
        outcomes = batch.execute_all(quiet=True, watch=watch)
    assert [outcome.status for outcome in outcomes] == ["done", "failed", "done"]
    assert "0001" in outcomes[1].message and "\n" not in outcomes[1].message
    for k in (0, 2):
        with Record(made[k]) as record:
            assert record.frame_count == scenes[k].frames + 1


def test_a_batch_of_other_terms_is_refused_before_anything_is_written(tmp_path):
    with pytest.raises(ValueError, match="same terms"):
        run.start_batch([small(), small({"steric.enabled": False})], directories(tmp_path / "batch", 2), "cpu")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("counts", [[11, 11], [9, 14, 6], [5]])
def test_measures_of_many_cells_are_those_of_each(counts):
    random = np.random.default_rng(len(counts))
    first_node = np.concatenate([[0], np.cumsum(counts)])
    shape = (7, first_node[-1], 3)
    positions = 0.4 * random.standard_normal(shape) + np.arange(first_node[-1])[:, None] * [0.0, 0.0, 0.02]
    directors = random.standard_normal(shape)
    directors /= np.linalg.norm(directors, axis=-1, keepdims=True)
    lengths = observables.bundle_length(positions, first_node)
    assert lengths.tolist() == [observables.bundle_length(x, first_node) for x in positions]
    assert len(counts) == 1 or len(set(lengths)) > 3
    for part in (slice(0, 1), slice(2, 5)):  # the numbers of a cell do not depend on the others
        assert np.array_equal(observables.bundle_length(positions[part], first_node), lengths[part])
    if len(counts) > 1:
        phases = observables.phase_difference(positions, directors, first_node)
        each = [observables.phase_difference(x, e1, first_node) for x, e1 in zip(positions, directors, strict=True)]
        np.testing.assert_allclose(phases, each, rtol=1e-14)
        assert np.array_equal(observables.phase_difference(positions[3:4], directors[3:4], first_node), phases[3:4])


def test_an_excluded_cell_stays_where_it_is():
    batch = Simulation([small(), small({"motor.torque": 1.0})], device="cpu")
    with frame_by_frame():
        frames = batch.cell_frames()
        next(frames), next(frames)
        batch.exclude(0)
        assert all(set(frame) == {1} for frame in frames)
    assert 1e-5 <= batch.times[0] < 2e-5 and 8e-5 <= batch.times[1] < 1e-4


def test_frames_of_parts_fall_on_the_grid():
    """Frames lie on multiples of the interval, also where runs end between them or the multiples round down."""
    scene = small({"duration": 8e-5, "frames": 12})
    whole = [frame.time for frame in Simulation(scene, device="cpu").frames(scene.duration)]
    parts, simulation = [], Simulation(scene, device="cpu")
    for until in (*(k * 8e-5 / 12 for k in range(1, 12)), 8e-5):
        parts += [frame.time for frame in simulation.frames(until)]
    assert parts == whole and len(whole) == 13
    resumed = Simulation(scene, device="cpu")
    resumed.restore(simulation.checkpoint())
    assert list(resumed.frames(scene.duration)) == []


@pytest.mark.skipif(not Path("/proc/self/fd").exists(), reason="needs a list of the process's open files")
def test_a_record_of_a_batch_keeps_no_file_open(tmp_path):
    made = directories(tmp_path / "batch", 3)
    batch = run.start_batch(members()[:3], made, "cpu", movies=False)
    opened: set[str] = set()

    def watch(reached: float) -> None:
        paths = (str(path.resolve()) for path in Path("/proc/self/fd").iterdir() if path.exists())
        opened.update(path for path in paths if path.endswith("run.h5"))

    with frame_by_frame():
        batch.execute_all(quiet=True, watch=watch)
    assert opened == set()
    assert len(arrays(made[0])["times"]) == 9


def test_a_file_system_that_can_not_be_synced_as_a_whole_has_each_file_synced(tmp_path, monkeypatch):
    def refuse(folders):
        raise OSError(errno.EIO, "of another's file")

    monkeypatch.setattr(execute, "sync_file_systems", refuse)
    made, alone = directories(tmp_path / "batch", 2), directories(tmp_path / "alone", 2)
    ended = run.start_batch(members()[:2], made, "cpu", movies=False, checkpoint_seconds=0.0).execute_all(quiet=True)
    assert {outcome.status for outcome in ended} == {"done"}
    for scene, own, other in zip(members()[:2], made, alone, strict=True):
        assert_same_frames(executed(scene, other), own)
        assert checkpoint.exists(own) and not (own / "checkpoint.tmp").exists()
        again = run.resume_batch([own], ["duration=2e-4"], "cpu", movies=False).execute_all(quiet=True)
        assert again[0].status == "done"
