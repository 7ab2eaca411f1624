"""The files of a run belong together, and to one process at a time; whatever else is refused by name."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

import warpflag
from tests.runs import arrays, assert_same_frames, ended_at, executed, small, summary
from warpflag import cli
from warpflag.record import Record, RecordError
from warpflag.run import checkpoint, run
from warpflag.run.checkpoint import CheckpointError
from warpflag.run.lock import Lock, LockedError
from warpflag.run.run_directory import RunError, settings_sha256
from warpflag.scene import Scene, dumps, load, with_values


def halved(directory: Path, values=None, frame: int = 5) -> Path:
    """A run that was interrupted, with a checkpoint at its last frame."""
    ended_at(run.start(small(values), str(directory), "cpu", checkpoint_seconds=0.0), frame)
    return directory


def edited(directory: Path, values: dict) -> Scene:
    scene = with_values(load(directory / "scene.toml"), values)
    (directory / "scene.toml").write_text(dumps(scene))
    return scene


@pytest.mark.parametrize(
    "values",
    [
        {"motor.torque": 1.0},
        {"fluid.viscosity": 2e-3},
        {"flagella.length": 2.2},
        {"flagella.count": 3},
        {"frames": 16},
        {"duration": 1.6e-4},
        {"duration": 1.6e-4, "frames": 16},
        {"numerics.accuracy": 1e-3},
        {"name": "other"},
        {"flagellum.1.torque": 1.0},
    ],
    ids=str,
)
def test_an_edited_scene_is_refused_and_nothing_changed(values, tmp_path):
    directory = halved(tmp_path / "made")
    edited(directory, values)
    before = {path: path.read_bytes() for path in directory.iterdir()}
    with pytest.raises(RunError) as refused:
        run.resume(str(directory))
    line = str(refused.value)
    assert "\n" not in line and any(key in line for key in values) and "recorded with" in line, line
    assert {path: path.read_bytes() for path in directory.iterdir()} == before


def test_an_edited_scene_of_a_finished_run_is_refused_when_it_is_prolonged(tmp_path):
    directory = executed(small(), tmp_path / "made")
    edited(directory, {"motor.torque": 3.0})
    with pytest.raises(RunError, match=r"motor\.torque = 3\.0, recorded with 3\.4"):
        run.resume(str(directory), ["duration=1.6e-4"])
    with Record(directory) as record:
        assert record.frame_count == 9 and "torque = 3.4" in record.scene_text


def test_a_prolongation_that_was_killed_early_can_be_given_again(tmp_path):
    """The scene file was written, the record not yet."""
    directory = executed(small(), tmp_path / "made")
    longer = small({"duration": 1.6e-4, "frames": 16})
    (directory / "scene.toml").write_text(dumps(longer))
    with pytest.raises(RunError, match="duration"):
        run.resume(str(directory))
    assert run.resume(str(directory), ["duration=1.6e-4"]).execute(quiet=True).status == "done"
    assert_same_frames(executed(longer, tmp_path / "whole"), directory)


@pytest.mark.parametrize("text", ["", "\n  \n"])
def test_an_empty_scene_is_no_scene_of_defaults(text, tmp_path):
    directory = halved(tmp_path / "made")
    (directory / "scene.toml").write_text(text)
    with pytest.raises(RunError, match=r"scene\.toml is empty"):
        run.resume(str(directory))


def test_a_scene_whose_hash_is_wrong_is_refused(tmp_path):
    directory = halved(tmp_path / "made")
    other = dumps(small({"motor.torque": 1.0}))
    (directory / "scene.toml").write_text(other)
    with h5py.File(directory / "run.h5", "r+") as file:
        del file["parameters/scene"]
        file["parameters/scene"] = other
    with pytest.raises(RecordError, match="/parameters does not agree with its checksum"):
        run.resume(str(directory))


def test_the_checkpoint_of_another_run_is_refused(tmp_path):
    directory, other = halved(tmp_path / "made"), halved(tmp_path / "other", {"motor.torque": 1.0})
    for path in directory.glob("checkpoint-*"):
        path.unlink()
    for path in other.glob("checkpoint-*"):
        shutil.copy(path, directory)
    with pytest.raises(RunError, match="checkpoint is of another scene"):
        run.resume(str(directory))


def test_runs_of_which_some_have_no_checkpoint_are_resumed_together(tmp_path):
    made, other = halved(tmp_path / "made"), halved(tmp_path / "other")
    for path in other.glob("checkpoint-*"):
        path.unlink()
    outcomes = run.resume_batch([made, other]).execute_all(quiet=True)
    assert [outcome.status for outcome in outcomes] == ["done", "done"]
    assert_same_frames(made, other)


def test_a_setting_that_a_later_version_adds_leaves_runs_resumable():
    """Checkpoints are known by the hash of the settings, in which what is as by default does not count."""
    scene, default = small({"motor.torque": 1.0}), Scene(name="default")
    later, later_default, set_later = (
        dumps(own).replace("[steric]", f"[steric]\nadded = {value}")
        for own, value in ((scene, 0.0), (default, 0.0), (scene, 1.0))
    )
    assert settings_sha256(scene, later, later_default) == settings_sha256(scene)
    assert settings_sha256(scene, set_later, later_default) != settings_sha256(scene)


def test_what_leaves_the_motion_alone_is_no_part_of_a_checkpoint_s_scene():
    scene = small({"motor.torque": 1.0})
    for values in ({"duration": 1.0}, {"frames": 99}, {"behaviour": True}):
        assert settings_sha256(with_values(scene, values)) == settings_sha256(scene)
    assert settings_sha256(with_values(scene, {"motor.torque": 1.1})) != settings_sha256(scene)


def test_the_record_of_another_run_is_refused(tmp_path):
    directory, other = halved(tmp_path / "made"), halved(tmp_path / "other", {"motor.torque": 1.0})
    shutil.copy(other / "run.h5", directory)
    with pytest.raises(RunError, match=r"motor\.torque = 3\.4, recorded with 1\.0"):
        run.resume(str(directory))


def test_a_checkpoint_newer_than_the_record_falls_back_to_the_one_before(tmp_path):
    """As after a power cut that took the last frames of the record but not the checkpoint."""
    whole, directory = executed(small(), tmp_path / "whole"), halved(tmp_path / "made", frame=6)
    newest, older = sorted(directory.glob("checkpoint-*"), reverse=True)
    steps = np.load(older)["array.control.steps"][0]
    with h5py.File(directory / "run.h5", "r+") as file:
        count = int(np.searchsorted(file["particles/flagella/position/step"][:], steps, side="right"))
        file["particles/flagella/position/step"].resize(count, axis=0)
    resumed = run.resume(str(directory))
    assert resumed.simulation.steps[0] == steps < np.load(newest)["array.control.steps"][0]
    assert resumed.execute(quiet=True).status == "done"
    assert_same_frames(whole, directory)
    # None left that fits: refused, and the record stays.
    again = halved(tmp_path / "again", frame=6)
    with h5py.File(again / "run.h5", "r+") as file:
        file["particles/flagella/position/step"].resize(1, axis=0)
    with pytest.raises(CheckpointError, match="frame of its record"):
        run.resume(str(again))
    assert len(arrays(again)["times"]) == 1


def test_a_checkpoint_restores_every_array(tmp_path):
    """What resuming reads is what the run had, name by name; three flagella in contact use them all."""
    scene = small({"flagella.count": 3, "flagella.length": 3.0})
    directory = tmp_path / "made"
    started = run.start(scene, str(directory), "cpu", checkpoint_seconds=0.0)
    ended_at(started, 5)
    kept, _ = checkpoint.load(directory)
    restored = run.resume(str(directory)).simulation.checkpoint()
    assert restored.keys() == kept.keys()
    assert {"guard.position", "stepper.over_implicit", "control.time", "chart.motor_angle"} <= kept.keys()
    for name, values in kept.items():
        np.testing.assert_array_equal(restored[name], values, err_msg=name)
    assert np.abs(kept["guard.position"]).max() > 0.0


def test_another_version_is_said(tmp_path, monkeypatch, capsys):
    directory = halved(tmp_path / "made")
    capsys.readouterr()
    monkeypatch.setattr(run, "__version__", "9.9")
    run.resume(str(directory))
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and warpflag.__version__ in line and "9.9" in line


def process(folder: Path, *arguments: str, **options) -> subprocess.Popen:
    root = Path(warpflag.__file__).parents[1]
    paths = os.pathsep.join([str(root), str(root / "kernels")])
    environment = {**os.environ, "PYTHONPATH": paths, "HDF5_USE_FILE_LOCKING": "FALSE"}
    command = [sys.executable, "-m", "warpflag", *arguments]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, cwd=folder, env=environment, **pipes, **options)


def test_two_runs_never_share_a_directory(tmp_path):
    (tmp_path / "scene.toml").write_text(dumps(small({"duration": 4e-3, "frames": 400})))
    both = [process(tmp_path, "run", "scene.toml", "-o", "made", "--quiet") for _ in range(2)]
    said = [one.communicate()[1] for one in both]
    assert sorted(one.returncode for one in both) == [0, 2], said
    line = next(text for one, text in zip(both, said, strict=True) if one.returncode)
    assert line.count("\n") == 1 and "made" in line
    assert summary(tmp_path / "made")["frames"] == 401


def test_a_run_that_goes_on_is_not_resumed_beside_itself(tmp_path):
    (tmp_path / "scene.toml").write_text(dumps(small({"duration": 1.0, "frames": 100_000})))
    running = process(tmp_path, "run", "scene.toml", "-o", "made", "--quiet")
    while not (tmp_path / "made" / "run.h5").exists():
        assert running.poll() is None, running.communicate()
    second = process(tmp_path, "run", "--resume", "made", "--quiet")
    line = second.communicate()[1]
    assert second.returncode == 2 and line.count("\n") == 1 and "written by another process" in line
    running.kill()
    running.wait()
    resumed = process(tmp_path, "run", "--resume", "made", "--quiet", "--max-wall", "0.1")
    assert resumed.wait() == 143, resumed.communicate()


def test_a_lock_is_held_once_and_let_go(tmp_path):
    lock = Lock(tmp_path)
    with pytest.raises(LockedError, match=tmp_path.name):
        Lock(tmp_path)
    lock.release()
    lock.release()
    Lock(tmp_path).release()
    (tmp_path / "sweep.toml").write_text("")
    for name in ("0000", "0001"):
        (tmp_path / name).mkdir()
    sweep, first, second = Lock(tmp_path), Lock(tmp_path / "0000"), Lock(tmp_path / "0001")
    with pytest.raises(LockedError):
        Lock(tmp_path / "0001")
    first.release()
    with pytest.raises(LockedError):
        Lock(tmp_path / "0001")
    Lock(tmp_path / "0000").release()
    second.release()
    sweep.release()
    assert {path.name for path in tmp_path.glob("**/*")} == {".lock", "sweep.toml", "0000", "0001"}


def test_resume_or_start_starts_once_and_then_resumes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("scene.toml").write_text(dumps(small({"duration": 4e-3, "frames": 400})))
    command = ["run", "scene.toml", "-o", "made", "--resume-or-start", "--quiet", "--device", "cpu"]
    assert cli.main([*command, "--max-wall", "0"]) == 143
    assert "wall time" in capsys.readouterr().err and Path("made/scene.toml").exists()
    assert not Path("made/summary.json").exists()
    assert cli.main(command) == 0
    assert cli.main(command) == 0
    with Record("made") as record:
        assert record.frame_count == 401
    assert cli.main([*command, "--set", "motor.torque=2"]) == 2
    assert "motor.torque" in capsys.readouterr().err
