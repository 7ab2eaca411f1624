"""Going on where a run was interrupted, killed or finished."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import warpflag
from tests.runs import arrays, assert_same_frames, executed, interrupt_at, small, summary
from warpflag.record import Record, RecordError
from warpflag.run import run
from warpflag.run.checkpoint import CheckpointError
from warpflag.run.run_directory import RunError
from warpflag.run.simulation import Simulation
from warpflag.scene import SceneError, dumps, load


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
    root = Path(warpflag.__file__).parents[1]
    paths = os.pathsep.join([str(root), str(root / "kernels")])
    process = subprocess.Popen(
        [sys.executable, "-m", "warpflag", *LONG],
        cwd=directory,
        env={**os.environ, "PYTHONPATH": paths},
        stderr=subprocess.PIPE,
        text=True,
    )
    while True:
        assert process.poll() is None, process.communicate()[1]
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
