"""Sweeps: what they leave behind, and that it does not matter how often they are stopped."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

import warpflag
from tests.runs import arrays, assert_same_frames, executed, small, summary
from warpflag.base.output import OutputError
from warpflag.record import Record
from warpflag.run import sweep
from warpflag.run.run_directory import RunError
from warpflag.run.stop import Stop
from warpflag.run.sweep import Sweep, batches
from warpflag.run.sweep.pool import Pool
from warpflag.run.sweep.table import status_of
from warpflag.scene import dumps

BASE = {"duration": 4e-5, "frames": 4, "flagella.length": 1.0}
TORQUES = [1.0, 2.0, 3.0]


def rows(directory: Path, name: str = "table.csv") -> list[dict[str, str]]:
    with open(directory / name, newline="") as file:
        return list(csv.DictReader(file))


def test_a_sweep_leaves_a_run_per_member_and_a_table(tmp_path):
    started = sweep.start(Sweep(small(BASE), {"motor.torque": TORQUES}), str(tmp_path / "out"))
    outcome = started.execute(workers=2, quiet=True)
    assert outcome.status == "done" and "3 members: 3 done" in outcome.message
    table = rows(tmp_path / "out")
    assert [(row["member"], float(row["motor.torque"]), row["status"]) for row in table] == [
        (str(k), torque, "done") for k, torque in enumerate(TORQUES)
    ]
    for k, (row, member) in enumerate(zip(table, started.members, strict=True)):
        directory = tmp_path / "out" / f"{k:04d}"
        assert_same_frames(executed(member.scene, tmp_path / f"alone-{k}"), directory)
        said = summary(directory)
        assert float(row["rates.net_speed"]) == said["rates"]["net_speed"]
        assert float(row["rates.motor_rate_lab.1"]) == said["rates"]["motor_rate_lab"][1]
        assert float(row["rates.motor_rate_lab"]) == np.mean(said["rates"]["motor_rate_lab"])
        assert row["events.zipped"] == "" and int(row["steps"]) == said["steps"]
    with h5py.File(tmp_path / "out" / "table.h5") as file:
        held = file["members"][:]
    assert held["motor.torque"].tolist() == TORQUES and held["status"].tolist() == [b"done"] * 3
    np.testing.assert_array_equal(held["rates.net_speed"], [float(row["rates.net_speed"]) for row in table])


def test_pandas_reads_the_tables_in_one_line(tmp_path):
    pandas = pytest.importorskip("pandas")
    plan = Sweep(small(BASE), {"motor.torque": [1.0]}, {"flagellum.torque": {"low": 1.0, "high": 2.0}}, repeats=2)
    told = sweep.start(plan, str(tmp_path / "out")).execute(workers=1, quiet=True).message
    table = pandas.read_csv(tmp_path / "out" / "table.csv")
    assert table["rates.net_speed"].dtype == float and len(table) == 2
    held = pandas.DataFrame(h5py.File(tmp_path / "out" / "table.h5")["members"][:])
    assert (held["rates.net_speed"] == table["rates.net_speed"]).all()
    speed = table["rates.net_speed"]
    assert told.endswith(f"; net_speed {speed.mean():.4g} +- {speed.sem():.2g} um/s (standard error of 2)")


def test_means_and_standard_errors_are_those_of_the_repeats(tmp_path):
    plan = Sweep(
        small(BASE), {"motor.axis_angle": [50, 60]}, {"flagellum.torque": {"low": 1.0, "high": 3.0}}, repeats=3
    )
    sweep.start(plan, str(tmp_path / "out")).execute(workers=1, quiet=True)
    table, means = rows(tmp_path / "out"), rows(tmp_path / "out", "means.csv")
    assert [(row["motor.axis_angle"], row["status"]) for row in means] == [("50", "3 of 3 done"), ("60", "3 of 3 done")]
    for point, mean in enumerate(means):
        speeds = np.array([float(row["rates.net_speed"]) for row in table if row["point"] == str(point)])
        assert len(set(speeds)) == 3
        assert float(mean["rates.net_speed"]) == pytest.approx(speeds.mean(), rel=1e-12)
        error = np.sqrt(((speeds - speeds.mean()) ** 2).sum() / 2) / np.sqrt(3)
        assert float(mean["rates.net_speed.error"]) == pytest.approx(error, rel=1e-12)
        assert (mean["events.zipped"], mean["events.zipped.count"]) == (
            "",
            "0",
        )  # none zips
        assert "flagellum.0.torque" not in mean  # it differs from repeat to repeat


@pytest.mark.parametrize("count, size", [(24, 12), (24, 24), (25, 12), (7, 3), (1000, 64), (5, 1), (1, 64)])
def test_every_member_is_in_one_batch_and_batches_are_equal(count, size):
    group = list(range(100, 100 + count))
    cut = batches.cut(group, size)
    assert sorted(k for own in cut for k in own) == group
    lengths = [len(own) for own in cut]
    assert max(lengths) <= size and max(lengths) - min(lengths) <= 1 and len(cut) == -(-count // size)
    assert cut == batches.cut(group, size)


@pytest.mark.parametrize("period", [2, 3, 5, None])
def test_no_batch_gets_the_long_members(period):
    """Costs that grow along an axis, or repeat along the last one."""
    cost = np.arange(48.0) if period is None else np.arange(48.0) % period
    sums = [cost[own].sum() for own in batches.cut(range(48), 12)]
    assert max(sums) < 1.2 * np.mean(sums)  # 1.8 in order, 2.0 every fourth


@pytest.mark.parametrize(
    "count, workers, sizes",
    [
        (24, 1, [24]),
        (24, 2, [12, 12]),
        (7, 2, [3, 4]),
        (3, 8, [1, 1, 1]),
        (130, 2, [32, 32, 33, 33]),  # no worker takes two batches beside another that takes one
        (1000, 3, [55] * 8 + [56] * 10),
    ],
)
def test_workers_take_equal_shares_in_as_few_batches_as_may_be(count, workers, sizes):
    size = batches.share(count, workers, 64)
    assert sorted(map(len, batches.cut(range(count), size))) == sizes


def test_batches_are_of_members_with_one_structure(tmp_path, capsys):
    axes = {"hydrodynamics.mode": ["none", "all"], "motor.torque": [1.0, 2.0, 3.0, 3.4]}
    started = sweep.start(Sweep(small(BASE), axes), str(tmp_path / "out"))
    found = started.batches_for(Pool(["cpu"] * 2, {}), list(range(8)), False)
    assert sorted(map(len, (own.members for own in found))) == [2, 2, 2, 2]
    assert "8 members on 2 workers (cpu), batches of 2" in capsys.readouterr().err
    assert sorted(k for own in found for k in own.members) == list(range(8))
    for own in found:
        assert len({scene.hydrodynamics.mode for scene in own.scenes}) == 1
        assert [path.name for path in own.directories] == [f"{k:04d}" for k in own.members]
        assert [scene.name for scene in own.scenes] == [started.members[k].scene.name for k in own.members]


def test_the_time_of_a_member_is_measured_on_some(tmp_path):
    """What jobs on a cluster are cut by: it grows with the length of the runs, which are not run."""
    seconds = []
    for k, duration in enumerate((4e-5, 4.0)):
        started = sweep.start(
            Sweep(small(BASE | {"duration": duration}), {"motor.torque": [1.0, 2.0]}), str(tmp_path / f"{k}")
        )
        with Stop() as stop:
            seconds.append(started.seconds_per_member([0, 1], "cpu", stop))
        assert started.statuses() == ["missing"] * 2
    assert 0.0 < 10.0 * seconds[0] < seconds[1]


def test_what_is_done_is_not_run_again(tmp_path):
    plan = Sweep(small(BASE), {"motor.torque": TORQUES})
    sweep.start(plan, str(tmp_path / "out")).execute(workers=1, quiet=True)
    table = (tmp_path / "out" / "table.csv").read_bytes()
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("0*/*")}
    removed = tmp_path / "out" / "0001"
    kept = arrays(removed)
    for path in removed.iterdir():
        path.unlink()
    removed.rmdir()
    assert sweep.resume(tmp_path / "out").execute(workers=1, quiet=True).status == "done"
    after = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").glob("0*/*")}
    assert {path for path in before if before[path] != after[path]} == {p for p in before if p.parent == removed}
    assert (tmp_path / "out" / "table.csv").read_bytes() == table
    for name, values in kept.items():
        np.testing.assert_array_equal(arrays(removed)[name], values)


def test_a_member_that_a_guard_stops_is_reported_and_the_rest_done(tmp_path, capsys):
    base = small({**BASE, "numerics.stepper": "rkc", "flagella.length": 2.0})
    started = sweep.start(Sweep(base, {"motor.torque": [1.0, 60.0, 2.0]}), str(tmp_path / "out"))
    outcome = started.execute(workers=1)
    assert outcome.status == "stopped" and "2 done, 1 stopped" in outcome.message
    assert started.statuses() == ["done", "stopped", "done"]
    lines = capsys.readouterr().err.splitlines()
    told = [line for line in lines if "stopped at" in line]
    assert len(told) == 1 and "0001" in told[0] and "flagellum" in told[0]
    (reached,) = [float(line.partition("%")[0]) for line in lines if " / 0.12 ms" in line]
    assert 66.0 < reached < 100.0
    assert [row["status"] for row in rows(tmp_path / "out")] == ["done", "stopped", "done"]
    again = sweep.resume(tmp_path / "out").execute(workers=1, quiet=True)
    assert again.status == "stopped"


def test_a_member_whose_files_are_damaged_is_reported_and_the_rest_done(tmp_path):
    plan = Sweep(small(BASE), {"motor.torque": TORQUES})
    sweep.start(plan, str(tmp_path / "out")).execute(workers=1, quiet=True)
    for name in ("0000", "0002"):
        (tmp_path / "out" / name / "summary.json").unlink()
    (tmp_path / "out" / "0002" / "run.h5").write_bytes(b"no record")
    outcome = sweep.resume(tmp_path / "out").execute(workers=1, quiet=True)
    assert outcome.status == "failed" and "2 done" in outcome.message
    assert [row["status"] for row in rows(tmp_path / "out")] == ["done", "done", "begun"]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that plays a full disk")
@pytest.mark.parametrize(
    "axis",
    [
        {"motor.torque": TORQUES},  # one batch
        {"hydrodynamics.mode": ("none", "within", "between")},  # each alone
    ],
)
def test_a_member_whose_disk_is_full_is_told_in_one_line_and_the_rest_done(tmp_path, capsys, axis):
    started = sweep.start(Sweep(small(BASE), axis), str(tmp_path / "out"))
    full = tmp_path / "out" / "0001" / "run.h5.tmp"
    full.parent.mkdir()
    full.symlink_to("/dev/full")
    outcome = started.execute(workers=1, stop=Stop())
    told = [line for line in capsys.readouterr().err.splitlines() if "0001:" in line]
    assert len(told) == 1 and "No space left on device" in told[0] and "resumable with --resume" in told[0]
    assert outcome.status == "failed" and "2 done, 1 begun" in outcome.message
    assert [row["status"] for row in rows(tmp_path / "out")] == ["done", "begun", "done"]
    full.unlink(missing_ok=True)
    assert sweep.resume(tmp_path / "out").execute(workers=1, quiet=True).status == "done"
    for k, member in enumerate(started.members):
        assert_same_frames(executed(member.scene, tmp_path / f"alone-{k}"), tmp_path / "out" / f"{k:04d}")


def test_a_folder_that_takes_no_files_is_told_in_one_line_and_the_rest_done(tmp_path, capsys):
    """What root may write anywhere stands in for a read-only folder: a file where the folder should be."""
    started = sweep.start(Sweep(small(BASE), {"motor.torque": TORQUES}), str(tmp_path / "out"))
    (tmp_path / "out" / "0001").touch()
    outcome = started.execute(workers=1, stop=Stop())
    told = [line for line in capsys.readouterr().err.splitlines() if "0001" in line]
    assert len(told) == 1 and outcome.status == "failed" and "2 done" in outcome.message


def test_a_member_of_another_scene_is_refused(tmp_path):
    plan = Sweep(small(BASE), {"motor.torque": TORQUES})
    started = sweep.start(plan, str(tmp_path / "out"))
    (tmp_path / "out" / "0001").mkdir()
    (tmp_path / "out" / "0001" / "scene.toml").write_text(dumps(small({"motor.torque": 1.5})))
    with pytest.raises(RunError, match="another scene"):
        started.execute(workers=1, quiet=True)


def test_a_finished_member_of_another_scene_is_refused(tmp_path):
    """A value put in front of an axis would give every row of the table the numbers of its neighbour."""
    plan = Sweep(small(BASE), {"motor.torque": TORQUES})
    sweep.start(plan, str(tmp_path / "out")).execute(workers=1, quiet=True)
    table, file = (tmp_path / "out" / "table.csv").read_bytes(), tmp_path / "out" / "sweep.toml"
    text = file.read_text()
    file.write_text(text.replace("[1.0,", "[0.5, 1.0,"))
    with pytest.raises(RunError, match=r"0000: holds the run of another scene: motor.torque = 0.5"):
        sweep.resume(tmp_path / "out").execute(workers=1, quiet=True)
    assert (tmp_path / "out" / "table.csv").read_bytes() == table
    file.write_text(text.replace("3.0]", "3.0, 3.4]"))  # one more at the end is a longer sweep
    assert sweep.resume(tmp_path / "out").execute(workers=1, quiet=True).status == "done"
    assert [row["motor.torque"] for row in rows(tmp_path / "out")] == ["1.0", "2.0", "3.0", "3.4"]
    with pytest.raises(RunError, match=r"0003 was a member"):
        file.write_text(text)  # and one less would leave its run behind
        sweep.resume(tmp_path / "out")


def test_the_summary_of_another_member_is_none(tmp_path):
    """Copied over a member's own it would give that row the numbers of its neighbour."""
    plan = Sweep(small(BASE), {"motor.torque": TORQUES})
    sweep.start(plan, str(tmp_path / "out")).execute(workers=1, quiet=True)
    table = (tmp_path / "out" / "table.csv").read_bytes()
    other = (tmp_path / "out" / "0002" / "summary.json").read_text()
    (tmp_path / "out" / "0001" / "summary.json").write_text(other)
    assert status_of(tmp_path / "out" / "0001") == "begun"
    sweep.resume(tmp_path / "out").execute(workers=1, quiet=True)
    assert (tmp_path / "out" / "table.csv").read_bytes() == table


@pytest.mark.parametrize("name", ["sweep.toml", "base.toml"])
def test_a_sweep_whose_files_hold_no_text_is_refused(tmp_path, name):
    plan = Sweep(small(BASE), {"motor.torque": TORQUES})
    sweep.start(plan, str(tmp_path / "out"))
    (tmp_path / "out" / name).write_bytes(b"\xe9")
    with pytest.raises(OutputError, match=f"{name}: is not a text file"):
        sweep.resume_or_start(plan, str(tmp_path / "out"))
    (tmp_path / "out" / name).unlink()
    os.mkfifo(tmp_path / "out" / name)
    with pytest.raises(OutputError, match=f"{name}: can't be read: it is no file"):
        sweep.resume_or_start(plan, str(tmp_path / "out"))


def test_an_odd_summary_does_not_end_the_table(tmp_path):
    started = sweep.start(Sweep(small(BASE), {"motor.torque": TORQUES}), str(tmp_path / "out"))
    started.execute(workers=1, quiet=True)
    odd = '{"status": "done", "time": "x", "rates": 3, "observables": [1, "a", null]}'
    (tmp_path / "out" / "0001" / "summary.json").write_text(odd)
    assert sweep.resume(tmp_path / "out").execute(workers=1, quiet=True).status == "done"
    assert [row["status"] for row in rows(tmp_path / "out")] == ["done"] * 3


@pytest.mark.parametrize("options", [{"share": (2, 2)}, {"share": (0, 0)}, {"share": (-1, 2)}, {"workers": 0}])
def test_shares_and_workers_that_there_are_not(tmp_path, options):
    started = sweep.start(Sweep(small(BASE), {"motor.torque": TORQUES}), str(tmp_path / "out"))
    with pytest.raises(ValueError, match="must be"):
        started.execute(quiet=True, **options)


def test_shares_complete_each_other(tmp_path):
    plan = Sweep(small(BASE), {"motor.torque": TORQUES})
    started = sweep.start(plan, str(tmp_path / "out"))
    assert started.execute(workers=1, quiet=True, share=(0, 2), movies=True).status == "done"
    assert started.statuses() == ["done", "missing", "done"]
    assert len(list((tmp_path / "out").glob("*/movie.usdc"))) == 2
    assert started.execute(workers=1, quiet=True, share=(1, 2)).status == "done"
    assert started.statuses() == ["done"] * 3


SWEEP = """
base = "base.toml"
[axes]
motor.torque = { from = 0.5, to = 3.0, count = 6 }
"""


def process(folder: Path, *arguments: str) -> subprocess.Popen:
    root = Path(warpflag.__file__).parents[1]
    paths = os.pathsep.join([str(root), str(root / "kernels")])
    command = [sys.executable, "-m", "warpflag", "sweep", *arguments, "--workers", "2"]
    return subprocess.Popen(
        [*command, "--checkpoint-interval", "0.2"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": paths},
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


def some_frames(folder: Path, since: float) -> bool:
    """Whether some member has a checkpoint that a sweep has written which began at a time."""
    # The workers of a sweep that was killed write theirs a moment after it.
    found = [path for path in folder.glob("out/0*/checkpoint-*.npz") if path.exists()]
    return any(os.path.getmtime(path) > since + 1.0 for path in found if path.exists())


def ended(folder: Path, number: int, *arguments: str) -> subprocess.Popen:
    """A sweep that got a signal while some member was under way."""
    began = time.time()
    started = process(folder, *arguments)
    while not some_frames(folder, began) and started.poll() is None:
        time.sleep(0.02)
    started.send_signal(number)
    return started


def test_a_sweep_that_is_stopped_again_and_again_ends_as_if_it_never_was(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "base.toml").write_text(dumps(small({"duration": 0.02, "frames": 800})))
        (tmp_path / folder / "sweep.toml").write_text(SWEEP)
    undisturbed = process(tmp_path / "a", "sweep.toml", "-o", "out")
    said, error = undisturbed.communicate()
    assert undisturbed.returncode == 0, error
    assert said.count("\n") == 1 and "6 members: 6 done" in said
    arguments: tuple[str, ...] = ("sweep.toml", "-o", "out")
    for number, status in ((signal.SIGKILL, -9), (signal.SIGTERM, 143), (signal.SIGINT, 130), (signal.SIGKILL, -9)):
        stopped = ended(tmp_path / "b", number, *arguments)
        error = stopped.communicate()[1]
        assert stopped.returncode in (status, 0), error
        if status > 0 and stopped.returncode:
            assert "resumable with --resume out" in error.splitlines()[-1]
        arguments = ("--resume", "out")
    finished = {path: path.read_bytes() for path in (tmp_path / "b").glob("out/0*/summary.json")}
    last = process(tmp_path / "b", *arguments)
    assert last.wait() == 0, last.communicate()[1]
    for path, content in finished.items():
        if b'"done"' in content:
            assert path.read_bytes() == content  # not repeated
    assert (tmp_path / "a/out/table.csv").read_bytes() == (tmp_path / "b/out/table.csv").read_bytes()
    for name in ("0000", "0005"):
        assert_same_frames(tmp_path / "a/out" / name, tmp_path / "b/out" / name)


def children(pid: int) -> list[int]:
    listed = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True)
    return [int(child) for child in listed.stdout.split()]


def test_a_worker_that_dies_fails_its_batch_alone(tmp_path):
    base = small({"duration": 0.02, "frames": 800})
    (tmp_path / "base.toml").write_text(dumps(base))
    (tmp_path / "sweep.toml").write_text(SWEEP)
    began = time.time()
    started = process(tmp_path, "sweep.toml", "-o", "out")
    while not some_frames(tmp_path, began) and started.poll() is None:
        time.sleep(0.02)
    starter = children(started.pid)[0]
    os.kill(children(starter)[0], signal.SIGKILL)
    error = started.communicate()[1]
    assert started.returncode == 1, error
    assert "its worker ended by signal 9" in error
    statuses = [row["status"] for row in rows(tmp_path / "out")]
    assert 3 <= statuses.count("done") < 6
    assert sweep.resume(tmp_path / "out").execute(workers=1, quiet=True).status == "done"
    with Record(tmp_path / "out" / "0000") as record:
        assert record.frame_count == 801
