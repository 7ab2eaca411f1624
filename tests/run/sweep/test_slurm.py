"""Jobs on a cluster without one: what they are asked to run, and how a share ends when its time is over."""

from __future__ import annotations

import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.runs import small
from warpflag.cli import main
from warpflag.run import sweep
from warpflag.run.run_directory import RunError
from warpflag.run.sweep import Sweep, slurm
from warpflag.scene import dumps

PAGE = Path(__file__).parents[3] / "docs" / "sweeps.md"
PATIENT = "import signal, sys, time; signal.signal(signal.SIGTERM, lambda *_: sys.exit(143)); time.sleep(60)"


@pytest.fixture
def started(tmp_path):
    base = small({"duration": 4e-5, "frames": 4, "flagella.length": 1.0})
    return sweep.start(Sweep(base, {"motor.torque": [1.0, 2.0, 3.0]}), str(tmp_path / "out"))


def test_shares_of_a_script_cover_every_member(started, tmp_path):
    """The script is run as Slurm would run it, one task after another."""
    script = slurm.Jobs(started, 3600.0, count=2, device="cpu").script()
    for task in ("0", "1"):
        environment = {"PATH": "/usr/bin:/bin", "SLURM_ARRAY_TASK_ID": task, "PYTHONPATH": ":".join(sys.path)}
        ended = subprocess.run(["bash"], input=script, text=True, capture_output=True, env=environment, cwd=tmp_path)
        assert ended.returncode == 0, ended.stderr
    assert started.statuses() == ["done"] * 3


def test_any_name_of_a_directory_is_kept_whole_in_a_script(tmp_path):
    """Slurm reads its directives as a shell does, and a per cent sign as the beginning of a job's number."""
    base = small({"duration": 4e-5, "frames": 4, "flagella.length": 1.0})
    odd = sweep.start(Sweep(base, {"motor.torque": [1.0, 2.0]}), str(tmp_path / "a 'b'@c %d"))
    script = slurm.Jobs(odd, 3600.0, count=2, further={"comment": "two words"}).script()
    place = str(odd.directory.resolve())
    assert shlex.split(next(line for line in script.splitlines() if "--output" in line))[1:] == [
        f"--output={place.replace('%', '%%')}/slurm-%A_%a.log"
    ]
    assert "#SBATCH --comment='two words'\n" in script
    (command,) = [line for line in script.splitlines() if "--resume" in line]
    assert place in shlex.split(command) and shlex.split(command)[-6:-3] == [
        "--share",
        "$SLURM_ARRAY_TASK_ID/2",
        "--quiet",
    ]


@pytest.mark.parametrize(
    ("given", "word"),
    [
        (["--slurm-script", "--slurm-set", "array=1-3"], "array is set by --jobs"),
        (["--slurm-script", "--slurm-set", "exclusive"], "KEY=VALUE"),
        (["--jobs", "3"], "--jobs is for --slurm"),
        (["--time", "1:00:00"], "--max-wall"),
    ],
)
def test_options_of_jobs_that_would_be_passed_over_or_break_them_are_refused(given, word, tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(dumps(small()))
    assert main(["sweep", str(tmp_path / "scene.toml"), "-o", str(tmp_path / "out"), *given]) == 2
    assert word in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_job_runs_with_what_was_said_of_it(tmp_path, capsys):
    scene, out = tmp_path / "cell.toml", tmp_path / "out"
    scene.write_text("format = 1\nduration = 4e-5\nframes = 4\n")
    plan = ["sweep", str(scene), "--grid", "motor.torque=1,2", "-o", str(out), "--slurm-script", "--jobs", "2"]
    said = ["--workers", "3", "--device", "cuda:1", "--movies", "--checkpoint-interval", "1:30"]
    assert main([*plan, "--time", "90:00", *said]) == 0
    script = capsys.readouterr().out
    (line,) = (line for line in script.splitlines() if " -m warpflag " in line)
    assert f" sweep --resume {out} --share " in line
    assert line.endswith(" --quiet --workers 3 --device cuda:1 --movies --checkpoint-interval 90 &")
    assert "#SBATCH --cpus-per-task=3\n" in script and "#SBATCH --time=01:30:00\n" in script
    assert main(["sweep", "--resume", str(out), "--slurm-script", "--jobs", "1"]) == 0
    assert " --quiet --workers 1 &\n" in capsys.readouterr().out


def test_members_are_cut_to_fit_the_wall_time(started, monkeypatch):
    monkeypatch.setattr(type(started), "seconds_per_member", lambda *_: 100.0)
    assert slurm.Jobs(started, 100.0).jobs() == 3
    assert slurm.Jobs(started, 160.0).jobs() == 3  # members fill four fifths of the time at most
    assert slurm.Jobs(started, 200.0).jobs() == 2
    assert slurm.Jobs(started, 200.0, workers=2).jobs() == 1
    assert slurm.Jobs(started, 3600.0, count=9).jobs() == 3  # never more than members


@pytest.mark.parametrize(("seconds", "notice"), [(60.0, 10), (600.0, 60), (1800.0, 120), (86400.0, 120)])
def test_a_job_is_told_to_end_a_tenth_of_its_time_before(started, seconds, notice):
    """At least ten seconds, in which a batch ends in order, and at most two minutes."""
    assert f"#SBATCH --signal=B:USR1@{notice}\n" in slurm.Jobs(started, seconds, count=1).script()


@pytest.mark.parametrize(
    "seconds, text", [(60, "00:01:00"), (61, "00:02:00"), (5400, "01:30:00"), (86400, "1-00:00:00"), (1, "00:01:00")]
)
def test_wall_times_are_whole_minutes_up(seconds, text):
    assert slurm.slurm_time(seconds) == text


def test_submitit_is_asked_for_by_name_where_it_is_absent(started, monkeypatch):
    monkeypatch.setitem(sys.modules, "submitit", None)
    with pytest.raises(RunError, match="--extra slurm"):
        slurm.Jobs(started, 3600.0, count=1).submit()


def test_a_share_that_fails_is_a_failed_job():
    assert slurm.Share((sys.executable, "-c", "raise SystemExit(3)"))() == 3  # guards stopped members: no failure
    with pytest.raises(RuntimeError, match="status 1"):
        slurm.Share((sys.executable, "-c", "raise SystemExit(1)"))()


def test_a_share_ends_when_its_time_is_over_and_is_queued_again():
    submitit = pytest.importorskip("submitit")
    share, queued = slurm.Share((sys.executable, "-c", PATIENT)), []

    def notice(*_):  # submitit's handler interrupts the call in the same thread
        queued.append(share.checkpoint())

    previous = signal.signal(signal.SIGALRM, notice)
    signal.setitimer(signal.ITIMER_REAL, 1.0)
    began = time.monotonic()
    try:
        with pytest.raises(RuntimeError, match="status"):
            share()
    finally:
        signal.signal(signal.SIGALRM, previous)
    assert time.monotonic() - began < 30.0
    assert isinstance(queued[0], submitit.helpers.DelayedSubmission)
    assert queued[0].function == slurm.Share(share.command)


def recipe(language: str, word: str) -> str:
    """The block of code of the page that holds a word."""
    blocks = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), flags=re.DOTALL)
    return next(block for block in blocks if word in block)


def in_runs(started, tmp_path: Path) -> Path:
    """The sweep at the place that the recipes name."""
    (tmp_path / "runs").mkdir()
    started.directory.rename(tmp_path / "runs" / "phases")
    return tmp_path / "runs" / "phases"


def test_the_dask_recipe_runs_a_sweep(started, tmp_path):
    pytest.importorskip("distributed")
    directory = in_runs(started, tmp_path)
    text = recipe("python", "dask").replace("Client()", "Client(n_workers=1, threads_per_worker=1)")
    (tmp_path / "recipe.py").write_text(text)
    environment = {"PATH": "/usr/bin:/bin", "HOME": str(Path.home()), "PYTHONPATH": ":".join(sys.path)}
    ended = subprocess.run(
        [sys.executable, "recipe.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300
    )
    assert ended.returncode == 0, ended.stderr
    assert sweep.resume(directory).statuses() == ["done"] * 3


def test_the_snakemake_recipe_runs_a_sweep(started, tmp_path):
    pytest.importorskip("snakemake")
    directory = in_runs(started, tmp_path)
    (tmp_path / "Snakefile").write_text(recipe("python", "rule all"))
    path = f"{Path(sys.executable).parent}:/usr/bin:/bin"
    environment = {"PATH": path, "HOME": str(Path.home()), "PYTHONPATH": ":".join(sys.path)}
    command = [sys.executable, "-m", "snakemake", "--cores", "2", "--quiet"]
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300)
    assert ended.returncode == 0, ended.stderr
    assert sweep.resume(directory).statuses() == ["done"] * 3
