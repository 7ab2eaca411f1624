"""Going on where a run was interrupted, killed or finished."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

import warpflag
from tests.runs import arrays, assert_same_frames, ended_at, executed, frame_by_frame, small, summary
from warpflag.record import Record, RecordError
from warpflag.run import member, run
from warpflag.run.checkpoint import CheckpointError
from warpflag.run.run_directory import RunError
from warpflag.run.stop import Ended, Stop, wall_seconds
from warpflag.run.sweep.table import status_of
from warpflag.scene import SceneError, dumps, load


@pytest.mark.parametrize("stop", [1, 9, 16])
def test_an_interrupted_run_resumes_to_the_same_record(stop, tmp_path):
    # Long enough that the steps depend on all that the stepper remembers, and some are refused.
    scene = small({"flagella.count": 3, "flagella.length": 3.0, "duration": 1.6e-3, "frames": 16})
    whole, halved = executed(scene, tmp_path / "whole"), tmp_path / "halved"
    outcome = ended_at(run.start(scene, str(halved), "cpu", checkpoint_seconds=0.0), stop)
    assert outcome.status == "interrupted" and f"--resume {halved}" in outcome.message
    assert "movie left out" in outcome.message and not (halved / "movie.usdc").exists()
    with Record(halved) as record:
        assert record.frame_count == stop
    assert (summary(halved)["status"], summary(halved)["frames"]) == ("interrupted", stop)
    resumed = run.resume(str(halved))
    assert (stop - 1) * 1e-4 <= resumed.simulation.times[0] + 1e-12 < stop * 1e-4
    assert resumed.execute(quiet=True).status == "done"
    assert_same_frames(whole, halved)
    for name in ("steps", "evaluations", "rejected_steps"):
        assert summary(halved)[name] == summary(whole)[name]
    assert (halved / "movie.usdc").exists()


def test_wall_time_counts_on_when_a_run_is_resumed(tmp_path, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(member, "monotonic", lambda: now[0])
    halved = run.start(small(), str(tmp_path / "halved"), "cpu")
    now[0] += 30.0
    ended_at(halved, 5)
    assert summary(tmp_path / "halved")["wall_time"] == 30.0
    now[0] += 5000.0
    resumed = run.resume(str(tmp_path / "halved"))
    now[0] += 12.0
    resumed.execute(quiet=True)
    assert summary(tmp_path / "halved")["wall_time"] == 42.0


def test_resume_goes_back_to_the_last_checkpoint(tmp_path):
    """Frames beyond the checkpoint are computed again."""
    whole, halved = executed(small(), tmp_path / "whole"), tmp_path / "halved"
    ended_at(run.start(small(), str(halved), "cpu", checkpoint_seconds=0.0), 7)
    max(halved.glob("checkpoint-*")).unlink()
    before = run.resume(str(halved))
    assert 5e-5 <= before.simulation.times[0] < 6e-5
    assert before.execute(quiet=True).status == "done"
    assert_same_frames(whole, halved)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGXCPU])
def test_signals_that_terminate_leave_a_resumable_run(number, tmp_path):
    whole, halved = executed(small(), tmp_path / "whole"), tmp_path / "halved"
    outcome = ended_at(run.start(small(), str(halved), "cpu", checkpoint_seconds=0.0), 4, number)
    assert outcome.status == "terminated" and signal.Signals(number).name in outcome.message
    assert summary(halved)["status"] == "terminated"
    assert run.resume(str(halved)).execute(quiet=True).status == "done"
    assert_same_frames(whole, halved)


def test_a_second_ctrl_c_ends_a_process_wherever_it_is():
    with Stop() as stop:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGTERM)  # waits for `check`, as the first did
        with pytest.raises(Ended):
            stop.check()
        with pytest.raises(Ended) as ended:
            signal.raise_signal(signal.SIGINT)
    assert ended.value.status == "interrupted"


def test_the_wall_time_ends_a_run(tmp_path):
    scene = small({"duration": 1.0, "frames": 100_000})
    begun = run.start(scene, str(tmp_path / "made"), "cpu")
    begun.simulation.prepare(recording=True, quiet=True)  # on a busy machine that alone can take the second
    outcome = begun.execute(quiet=True, stop=Stop(max_wall=1.0))
    assert outcome.status == "terminated" and "wall time" in outcome.message
    with Record(tmp_path / "made") as record:
        assert 1 < record.frame_count < 100_000
    assert run.resume(str(tmp_path / "made")).simulation.times[0] > 0.0


@pytest.mark.parametrize(
    "text, seconds", [("90", 90), ("1.5", 1.5), ("2:03", 123), ("1:00:05", 3605), ("2-01:00:00", 176400)]
)
def test_wall_times_are_read(text, seconds):
    assert wall_seconds(text) == seconds


@pytest.mark.parametrize("text", ["", "-5", "1 h", "nan", "1::2", "1:2:3:4"])
def test_what_is_no_wall_time_is_refused(text):
    with pytest.raises(ValueError, match="is no time"):
        wall_seconds(text)


def test_a_run_stopped_before_its_first_frame_starts_again(tmp_path):
    whole, late = executed(small(), tmp_path / "whole"), tmp_path / "late"
    outcome = run.start(small(), str(late), "cpu").execute(quiet=True, stop=Stop(max_wall=-1.0))
    assert outcome.status == "terminated" and f"--resume {late}" in outcome.message
    assert not (late / "run.h5").exists()
    assert run.resume(str(late), device="cpu").execute(quiet=True).status == "done"
    assert_same_frames(whole, late)


def test_a_resumed_run_that_ends_at_once_says_that_its_frames_are_kept(tmp_path):
    directory = tmp_path / "made"
    ended_at(run.start(small(), str(directory), "cpu", checkpoint_seconds=0.0), 3)
    outcome = run.resume(str(directory)).execute(quiet=True, stop=Stop(max_wall=-1.0))
    assert "are kept; resumable with" in outcome.message and "start again" not in outcome.message


def test_a_record_without_any_checkpoint_is_made_again(tmp_path):
    whole, late = executed(small(), tmp_path / "whole"), tmp_path / "late"
    ended_at(run.start(small(), str(late), "cpu"), 3)
    for path in late.glob("checkpoint-*"):
        path.unlink()
    assert run.resume(str(late)).execute(quiet=True).status == "done"
    assert_same_frames(whole, late)


def test_a_run_killed_after_its_last_frame_is_completed(tmp_path):
    directory = executed(small(), tmp_path / "made")
    before = arrays(directory)
    for name in ("summary.json", "movie.usdc"):
        (directory / name).unlink()
    assert run.resume(str(directory)).execute(quiet=True).status == "done"
    assert (directory / "movie.usdc").exists() and summary(directory)["status"] == "done"
    for name, values in arrays(directory).items():
        np.testing.assert_array_equal(values, before[name])


def test_a_finished_run_says_that_it_is_done(tmp_path):
    directory = executed(small(), tmp_path / "made")
    before = (directory / "run.h5").read_bytes()
    outcome = run.resume(str(directory)).execute(quiet=True)
    assert outcome.status == "done" and "done already, 0.08 ms" in outcome.message
    assert (directory / "run.h5").read_bytes() == before


def test_a_finished_run_whose_record_is_gone_is_computed_again(tmp_path):
    whole, emptied = executed(small(), tmp_path / "whole"), executed(small(), tmp_path / "emptied")
    (emptied / "run.h5").unlink()
    outcome = run.resume(str(emptied)).execute(quiet=True)
    assert outcome.status == "done" and "done already" not in outcome.message
    assert_same_frames(whole, emptied)


def test_a_finished_run_with_a_shorter_record_is_not_done(tmp_path):
    directory = executed(small(), tmp_path / "made")
    with h5py.File(directory / "run.h5", "r+") as file:
        file["particles/flagella/position/step"].resize((4,))
    with pytest.raises(CheckpointError, match="none belongs to a frame of its record"):
        run.resume(str(directory))


@pytest.mark.parametrize("name", ["summary.json", "checkpoint"])
def test_a_pipe_in_place_of_a_file_is_not_waited_for(name, tmp_path):
    directory = executed(small(), tmp_path / "made")
    for path in directory.glob(f"{name}*"):
        path.unlink()
        os.mkfifo(path)
    if name == "checkpoint":
        with pytest.raises(CheckpointError, match="can be read"):
            run.resume(str(directory), ["duration=1.6e-4"])
    else:
        assert status_of(directory) == "begun"
        assert run.resume(str(directory)).execute(quiet=True).status == "done"


def test_a_full_disk_fails_a_run_in_one_line_and_it_resumes(tmp_path, monkeypatch):
    whole, halved = executed(small(), tmp_path / "whole"), tmp_path / "halved"
    usage, calls = shutil.disk_usage(tmp_path), []

    def filling(path):
        calls.append(path)
        return usage._replace(free=usage.free if len(calls) <= 5 else 1000)

    monkeypatch.setattr(shutil, "disk_usage", filling)
    with frame_by_frame():
        outcome = run.start(small(), str(halved), "cpu", checkpoint_seconds=0.0).execute(quiet=True)
    assert outcome.status == "failed" and "\n" not in outcome.message
    assert "No space left" in outcome.message and str(halved) in outcome.message
    with Record(halved) as record:
        assert record.frame_count == 5
    monkeypatch.undo()
    assert run.resume(str(halved)).execute(quiet=True).status == "done"
    assert_same_frames(whole, halved)


@pytest.mark.parametrize(("chunks", "status"), [(2, "failed"), (4, "done")])
def test_a_run_ends_while_the_disk_has_room_for_what_it_would_still_write(chunks, status, tmp_path, monkeypatch):
    """Chunks of 64 frames of its record, beside 1/4 MiB: HDF5 leaves a file damaged when a write of its own fails."""
    usage, nodes = shutil.disk_usage(tmp_path), 2 * 11
    free = (1 << 18) + chunks * 64 * 2 * 24 * nodes
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=free))
    outcome = run.start(small(), str(tmp_path / "made"), "cpu").execute(quiet=True)
    assert outcome.status == status, outcome.message


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


def test_ctrl_c_leaves_a_readable_resumable_run(tmp_path):
    process = started_process(tmp_path)
    process.send_signal(signal.SIGINT)
    line = process.communicate()[1]
    assert process.returncode == 130
    assert line.count("\n") == 1 and "interrupted" in line and "resumable with --resume made" in line
    with Record(tmp_path / "made") as record:
        assert record.frame_count >= 20
        assert summary(tmp_path / "made")["frames"] == record.frame_count


def test_a_killed_run_resumes_where_it_was(tmp_path):
    process = started_process(tmp_path)
    process.kill()
    process.communicate()
    with Record(tmp_path / "made") as record:
        kept = record.frame_count
    until = (kept + 5) * 1e-5
    resumed = run.resume(str(tmp_path / "made"))
    with frame_by_frame():
        resumed.execute_all(quiet=True, watch=lambda reached: raise_signal_beyond(until, reached))
    whole = executed(small({"duration": until, "frames": kept + 5}), tmp_path / "whole")
    found, expected = arrays(tmp_path / "made"), arrays(whole)
    assert len(found["times"]) >= kept + 5
    # The times of frames are the scene's duration in parts, and round differently in the longer scene.
    for name, values in expected.items():
        np.testing.assert_allclose(found[name][: kept + 5], values[: kept + 5], rtol=1e-6, atol=1e-9, err_msg=name)


def raise_signal_beyond(until: float, reached: float) -> None:
    if reached > until:
        signal.raise_signal(signal.SIGINT)


def test_a_finished_run_can_be_prolonged(tmp_path):
    short = executed(small({"duration": 4e-5, "frames": 4}), tmp_path / "short")
    assert run.resume(str(short), ["duration=8e-5"]).execute(quiet=True).status == "done"
    assert_same_frames(executed(small(), tmp_path / "long"), short)
    assert load(short / "scene.toml") == small()
    with Record(short) as record:
        assert record.scene_text == dumps(small())


def test_a_multiple_of_the_frame_interval_that_rounds_down_is_one(tmp_path):
    """7e-5 over 1e-5 is 6.999... in float64."""
    short = executed(small({"duration": 4e-5, "frames": 4}), tmp_path / "short")
    assert run.resume(str(short), ["duration=7e-5"]).execute(quiet=True).status == "done"
    with Record(short) as record:
        assert record.times == pytest.approx(1e-5 * np.arange(8))


@pytest.mark.parametrize(
    "override, words",
    [
        ("motor.torque=2", "--set: motor.torque = 2: .* no other change than duration; start.record goes on"),
        ("duration=4e-5", "--resume .*: duration = 4e-05: .* where the run stands"),
        ("duration=8.5e-5", "--set: duration = 8.5e-05: must be a multiple of the frame interval"),
        ("duration=8.05e-5", "multiple of the frame interval"),
        ("duration=-1", "--set: duration = -1: must be a number"),
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


def test_resume_needs_a_run_with_a_sound_checkpoint(tmp_path):
    with pytest.raises(RunError, match=r"scene\.toml"):
        run.resume(str(tmp_path))
    assert list(tmp_path.iterdir()) == []
    directory = tmp_path / "made"
    ended_at(run.start(small(), str(directory), "cpu"), 4)
    for path in directory.glob("checkpoint-*"):
        path.write_bytes(b"")
    with pytest.raises(CheckpointError):
        run.resume(str(directory))
