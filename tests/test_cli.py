"""The command line: what it prints, where it writes, and how it ends."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from warpflag import cli
from warpflag.record import Record
from warpflag.scene import dumps, load

EXAMPLES = Path(__file__).parent.parent / "examples"
SMALL = """
format = 1
name = "small"
duration = 4e-5
frames = 4
flagella.length = 2.0
hydrodynamics.mode = "all"
hook = { length = 0, stiffness = 0 }
"""


@pytest.fixture
def scene(tmp_path, monkeypatch) -> str:
    """A scene of a few steps, in the directory where the command is given."""
    monkeypatch.chdir(tmp_path)
    Path("small.toml").write_text(SMALL)
    return "small.toml"


def command(*arguments: str, **options) -> subprocess.CompletedProcess[str]:
    """The command in a process of its own."""
    return subprocess.run([sys.executable, "-m", "warpflag", *arguments], capture_output=True, text=True, **options)


def refused(capsys, *arguments: str) -> str:
    """The one line that a command says about bad input."""
    try:
        status = cli.main(arguments)
    except SystemExit as exit:  # argparse
        status = exit.code
    said = capsys.readouterr()
    assert status == 2
    assert said.out == ""
    assert said.err.endswith("\n") and said.err.count("\n") == 1, said.err
    return said.err


def test_help_imports_nothing_heavy_and_is_quick():
    heavy = {"warp", "numpy", "h5py", "pxr"}
    code = (
        f"import sys; from warpflag import cli; cli._parser().format_help(); assert not {heavy!r} & sys.modules.keys()"
    )
    subprocess.run([sys.executable, "-c", code.replace(repr(heavy), repr(set(heavy)))], check=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    shown = command("--help")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert shown.returncode == 0 and "devices" in shown.stdout
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 0.5


MALFORMED = [
    "duration = ",
    "name = 3",
    "name = 'a/b'",
    "duration = 0",
    "duration = -1e-3",
    "duration = 15",
    "duration = nan",
    "frames = 0",
    "frames = 1.5",
    "durations = 0.015",
    "flagella = 2",
    "[flagella]\ncount = 0",
    "[flagella]\nlength = 6e-6",
    "[flagella]\nlength = 6000.0",
    "[flagella]\nsegment_length = 5.0",
    "[flagella]\nopening_angle = 270.0",
    "format = 1\n[flagella]\nphase_difference = 0.01",
    "[flagella]\ncount = 1\nphase_difference = 0.5",
    "[flagella]\nanchor_offset = 3.0",
    "[flagella]\nintrinsic_curvature = [0.0, 1.3]",
    "[flagella]\nbending_rigidity = -3.5",
    "[flagella]\nbending_rigidity = 3.5e-24",
    "[motor]\ntorque = '3.4'",
    "[motor]\ntorque = inf",
    "[motor]\ntorqe = 3.4",
    "[moter]\ntorque = 3.4",
    "[fluid]\nviscosity = 0.0",
    "[hydrodynamics]\nmode = 'full'",
    "[hydrodynamics]\nmode = 'none'\npair_radius = 0.03",
    "[steric]\nenabled = 1",
    "[steric]\nstrength = 8e-13",
    "[body]\nwidth = 3.0",
    "[body]\nanchored = 'yes'",
    "[numerics]\nstepper = 'rk4'",
    "[numerics]\ntime_step = -1e-6",
    "duration = 1e-4\n[numerics]\ntime_step = 1e-3",
    "[numerics]\nprecision = 'double'",
    "format = 1\n[start]\nrecord = 'nowhere'",
    "[start]\nframe = 3",
    "[[flagellum]]\nazimuth = 10.0\n[[flagellum]]\nazimuth = 10.0",
    "[[flagellum]]\nlenght = 3.0",
]


@pytest.mark.parametrize("toml", MALFORMED)
def test_a_malformed_scene_is_one_line_and_no_directory(toml, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("bad.toml").write_text(toml)
    line = refused(capsys, "run", "bad.toml", "-o", "made")
    assert line.startswith("warpflag: bad.toml: ")
    assert os.listdir() == ["bad.toml"]


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["run"], ["SCENE.toml", "--resume"]),
        (["run", "missing.toml"], ["missing.toml", "no such file"]),
        (["run", "small.toml", "--set", "motor.torqe=2"], ["--set", "motor.torqe", "motor.torque"]),
        (["run", "small.toml", "--set", "motor.torque"], ["motor.torque", "key=value"]),
        (["run", "small.toml", "--device", "cuda:7"], ["cuda:7", "cpu"]),
        (["run", "small.toml", "--precision", "half"], ["half", "float32"]),
        (["run", "small.toml", "-o", "small.toml"], ["small.toml", "exists"]),
        (["run", "small.toml", "--resume", "."], ["either"]),
        (["run", "--resume", "nowhere"], ["nowhere", "scene.toml"]),
        (["run", "--resume", "nowhere", "-o", "elsewhere"], ["--resume", "-o"]),
        (["run", "--resume", "nowhere", "--precision", "float32"], ["--resume", "--precision"]),
        (["check", "missing.toml"], ["missing.toml", "no such file"]),
        (["check", "small.toml", "--device", "tpu"], ["tpu", "cpu"]),
        (["compile", "small.toml", "--device", "tpu"], ["tpu", "cpu"]),
        (["sweep", "small.toml", "--device", "tpu"], ["tpu", "cpu"]),
        (["tradeoff", "small.toml", "--device", "tpu"], ["tpu", "cpu"]),
        (["export", "nowhere", "--to", "usd"], ["nowhere", "no such record"]),
        (["export", "nowhere", "--to", "gif"], ["gif", "usd"]),
        (["export", "nowhere", "--to", "usd", "-o", "movie.mp4"], ["nowhere", "no such record"]),
        (["run", "small.toml", "--resume-or-start"], ["--resume-or-start", "-o"]),
        (["run", "small.toml", "--max-wall", "1 h"], ["--max-wall", "is no time"]),
        (["sweep"], ["SWEEP.toml", "--resume"]),
        (["sweep", "--resume", "nowhere"], ["nowhere", "no sweep"]),
        (["sweep", "--resume", "nowhere", "--grid", "motor.torque=1:2:3"], ["--grid"]),
        (["sweep", "small.toml", "--grid", "motor.torque=1:2"], ["--grid", "from:to:count"]),
        (["sweep", "small.toml", "--share", "2/2"], ["2/2"]),
        (["sweep", "small.toml", "--workers", "0"], ["0", "whole number"]),
        (["plot", "small.toml", "-o", "x.png", "--x", "steps"], ["small.toml", "is no sweep"]),
        (["swim"], ["swim", "run"]),
    ],
)
def test_a_wrong_command_is_one_line(arguments, words, scene, capsys):
    line = refused(capsys, *arguments)
    assert line.startswith("warpflag") and all(word in line for word in words), line
    assert os.listdir() == [scene]


def test_bad_input_of_a_real_process(scene):
    ended = command("run", scene, "--set", "motor.torque=much")
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.count("\n") == 1 and "motor.torque" in ended.stderr


@pytest.mark.skipif(not os.access("/sys", os.R_OK), reason="needs a file system that takes no directories")
def test_a_directory_that_the_machine_refuses_is_one_line(scene, capsys):
    assert cli.main(["run", scene, "-o", "/sys/made"]) == 1
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and "/sys/made: " in said.err


def test_the_progress_ends_with_its_end(scene):
    ended = command("run", scene)
    assert ended.stderr.splitlines()[-1].startswith("100 %  0.04 / 0.04 ms")


def test_precision_wins_over_set(scene):
    assert cli.main(["run", scene, "--precision", "float32", "--set", "numerics.precision=float64", "--quiet"]) == 0
    assert load("runs/small/scene.toml").numerics.precision == "float32"


@pytest.mark.parametrize(
    "error",
    [MemoryError("Unable to allocate 118. MiB"), RuntimeError("Failed to allocate 8 bytes on device 'cpu'")],
    ids=["NumPy", "Warp"],
)
def test_too_little_memory_is_one_line(scene, capsys, monkeypatch, error):
    def short(*_arguments: object) -> None:
        raise error

    monkeypatch.setattr("warpflag.run.simulation.build_model", short)
    assert cli.main(["run", scene, "-o", "out"]) == 1
    assert capsys.readouterr().err == f"warpflag: out of memory: {error}\n"
    monkeypatch.setattr("warpflag.run.simulation.build_model", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        cli.main(["run", scene, "-o", "out"])


@pytest.mark.parametrize("allowed, status", [(1.2e9, 1), (8e9, 0)])
def test_a_process_that_may_have_too_few_addresses_is_told_so(scene, allowed, status):
    """Below some 1.7 GB Warp's compiler crashes."""

    def limited() -> None:
        resource.setrlimit(resource.RLIMIT_AS, (int(allowed), resource.getrlimit(resource.RLIMIT_AS)[1]))

    ended = command("run", scene, "-o", "out", "--quiet", preexec_fn=limited)
    assert ended.returncode == status, ended.stderr
    if status:
        assert ended.stderr.count("\n") == 1 and "1.2 of the 2 GB" in ended.stderr and "ulimit -v" in ended.stderr


def test_the_wall_time_ends_a_run_with_its_own_status(scene, capsys):
    assert cli.main(["run", scene, "-o", "made", "--max-wall", "0", "--set", "duration=1.0", "frames=100000"]) == 143
    line = capsys.readouterr().err.splitlines()[-1]
    assert "wall time" in line and "--resume made" in line


def test_resuming_a_finished_run_says_so(scene, capsys):
    assert cli.main(["run", scene, "-o", "made", "--quiet"]) == 0
    assert cli.main(["run", "--resume", "made"]) == 0
    assert "done already" in capsys.readouterr().out


def test_limits_reach_a_run_however_it_begins(scene, monkeypatch):
    from warpflag.run import run

    taken = []

    def beginning(how):
        def begin(*_arguments, **options):
            taken.append((how, options["checkpoint_seconds"]))
            raise KeyboardInterrupt

        return begin

    for how in ("start", "resume"):
        monkeypatch.setattr(run, how, beginning(how))
    for given in ([scene], ["--resume", "made"], [scene, "-o", "made", "--resume-or-start"]):
        assert cli.main(["run", *given, "--checkpoint-interval", "1:30"]) == 130
    Path("made").mkdir()
    Path("made/scene.toml").write_text(dumps(load(scene)))
    assert cli.main(["run", scene, "-o", "made", "--resume-or-start", "--checkpoint-interval", "7"]) == 130
    assert taken == [("start", 90.0), ("resume", 90.0), ("start", 90.0), ("resume", 7.0)]


def test_a_sweep_from_the_command_line(scene, capsys):
    arguments = ["--grid", "motor.torque=1:3:2", "-o", "out", "--workers", "1", "--set", "frames=2", "--quiet"]
    assert cli.main(["sweep", scene, *arguments]) == 0
    assert [load(f"out/000{k}/scene.toml").motor.torque for k in range(2)] == [1.0, 3.0]
    assert cli.main(["sweep", "--resume", "out", "--quiet"]) == 0
    assert not list(Path("out").glob("*/movie.usdc"))
    assert cli.main(["sweep", "--quiet", "--movies", "--set", "frames=1", "--grid", "motor.torque=2,", scene]) == 0
    assert load("runs/small/0000/scene.toml").motor.torque == 2 and Path("runs/small/0000/movie.usdc").is_file()
    line = refused(capsys, "sweep", scene, *arguments)
    assert "--resume out" in line
    assert cli.main(["sweep", scene, *arguments, "--resume-or-start"]) == 0
    assert "another sweep" in refused(capsys, "sweep", scene, "-o", "out", "--resume-or-start")
    first = Path("out", "0000")
    assert f"it holds 2 runs, name one: {first}" in refused(capsys, "export", "out", "--to", "csv")
    assert "warpflag sweep out/sweep.toml" in refused(capsys, "run", "out/sweep.toml")


def test_bad_members_are_a_line_each_and_nothing_is_made(scene, capsys):
    assert cli.main(["sweep", scene, "--grid", "motor.torque=1,5000,x"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and all(line.startswith("warpflag: member 000") for line in lines), lines
    assert os.listdir() == [scene]


def test_a_script_for_slurm_names_every_share(scene, capsys):
    arguments = ["--grid", "motor.torque=1:3:4", "-o", "out", "--slurm-script", "--jobs", "3", "--time", "1:30:00"]
    assert cli.main(["sweep", scene, *arguments, "--slurm-set", "partition=long"]) == 0
    script = capsys.readouterr().out
    assert script.startswith("#!/bin/bash\n") and "#SBATCH --array=0-2\n" in script
    for option in ("time=01:30:00", "signal=B:USR1@120", "partition=long", "requeue"):
        assert f"#SBATCH --{option}\n" in script
    assert f'--resume {Path("out").resolve()} --share "$SLURM_ARRAY_TASK_ID/3"' in script
    checked = subprocess.run(["bash", "-n"], input=script, text=True, capture_output=True)
    assert checked.returncode == 0, checked.stderr
    on_gpus = ["sweep", scene, *arguments, "--device", "cuda", "--resume-or-start"]
    assert cli.main(on_gpus) == 0 and "ask Slurm for no GPU" in capsys.readouterr().err
    assert cli.main([*on_gpus, "--slurm-set", "gpus-per-task=1"]) == 0 and capsys.readouterr().err == ""


def test_a_run_says_where_it_wrote_and_nothing_of_warp(scene):
    ended = command("run", scene)
    assert ended.returncode == 0
    assert ended.stdout.count("\n") == 1 and ended.stdout.endswith(f"{Path('runs', 'small')}\n")
    assert all(line.endswith("per simulated ms") or "compiling" in line for line in ended.stderr.splitlines()), (
        ended.stderr
    )
    quiet = command("run", scene, "--quiet")
    assert (quiet.returncode, quiet.stdout, quiet.stderr) == (0, "", "")


def test_directories_are_numbered_and_never_overwritten(scene, capsys):
    for expected in ("small", "small-2", "small-3"):
        assert cli.main(["run", scene]) == 0
        assert capsys.readouterr().out.endswith(f"{Path('runs', expected)}\n")
    assert cli.main(["run", scene, "-o", "named", "--quiet"]) == 0
    before = Path("named/run.h5").read_bytes()
    line = refused(capsys, "run", scene, "-o", "named")
    assert "--resume named" in line and "-o" in line
    assert Path("named/run.h5").read_bytes() == before


def test_values_are_set_in_any_order(scene):
    assert cli.main(["run", "--quiet", "--set", "frames=2", "duration=2e-5", scene]) == 0
    assert (
        cli.main(["run", scene, "--set", "frames=1", "--precision", "float32", "--set", "duration=2e-5", "--quiet"])
        == 0
    )
    first, second = load("runs/small/scene.toml"), load("runs/small-2/scene.toml")
    assert (first.frames, first.duration, first.numerics.precision) == (2, 2e-5, "float64")
    assert (second.frames, second.duration, second.numerics.precision) == (1, 2e-5, "float32")


def test_check_prints_a_scene_and_what_it_requires(scene, capsys):
    assert cli.main(["check", scene, "--set", "frames=3"]) == 0
    everything = capsys.readouterr().out
    Path("resolved.toml").write_text(everything)
    assert load("resolved.toml") == load(scene, ["frames=3"])
    assert "steric, body contact" in everything and "pair sum (all pairs)" in everything
    assert "2 flagella, 20 segments, 22 nodes" in everything and "cpu" in everything
    assert cli.main(["check", scene, "--set", "steric.enabled=false", "hydrodynamics.mode=none"]) == 0
    bare = capsys.readouterr().out
    assert "steric," not in bare and "and pair sum" not in bare
    assert os.listdir() != [] and not Path("runs").exists()


def test_a_run_after_compile_compiles_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    few_kernels = 'flagella.count = 1\nbody.contact = false\nnumerics.stepper = "rkc"\n'
    Path("bare.toml").write_text(SMALL.replace('"all"', '"none"') + few_kernels)
    environment = {**os.environ, "WARP_CACHE_PATH": str(tmp_path / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
    ended = command("compile", "bare.toml", env=environment)
    assert ended.returncode == 0 and "small: kernels are compiled" in ended.stdout, ended.stderr
    built = set((tmp_path / "cache").glob("**/*.o"))
    assert len(built) > 5
    assert command("run", "bare.toml", "--quiet", env=environment).returncode == 0
    assert set((tmp_path / "cache").glob("**/*.o")) == built


def test_compile_keeps_bytecode_where_python_does_not(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(sys, "pycache_prefix", str(tmp_path / "bytecode"))
    Path("small.toml").write_text(SMALL)
    assert cli.main(["compile", "small.toml", "--device", "cpu"]) == 0
    kept = {path.name.split(".")[0] for path in (tmp_path / "bytecode").glob("**/*.pyc")}
    assert {"cli", "simulation", "right_hand_side"} <= kept


def test_devices_lists_the_cpu(capsys):
    assert cli.main(["devices"]) == 0
    assert any(line.split()[0] == "cpu" for line in capsys.readouterr().out.splitlines())


def test_export_writes_the_movie_again(scene, capsys):
    assert cli.main(["run", scene, "-o", "made", "--quiet"]) == 0
    movie = Path("made/movie.usdc")
    first = movie.read_bytes()
    movie.unlink()
    assert cli.main(["export", "made", "--to", "usd"]) == 0
    assert movie.read_bytes() == first
    assert cli.main(["export", "made", "--to", "usd", "-o", "other.usdc"]) == 0
    assert capsys.readouterr().out.splitlines() == [str(movie), "other.usdc"]
    assert Path("other.usdc").read_bytes() == first
    assert ".usdc" in refused(capsys, "export", "made", "--to", "usd", "-o", "movie.mp4")


def test_a_stopped_run_keeps_its_frames(scene, capsys):
    # Explicit Euler at 200 times its stable step.
    wrong = ["numerics.stepper=euler", "numerics.time_step=1e-6", "duration=1e-3"]
    assert cli.main(["run", scene, "-o", "made", "--set", *wrong]) == 3
    said = capsys.readouterr()
    line = said.err.splitlines()[-1]
    assert said.out == "" and "flagellum" in line and "numerics.time_step" in line and "made" in line
    with Record("made") as record:
        assert record.frame_count >= 1
    assert cli.main(["check", scene, "--set", *wrong]) == 3
    assert "stopped at " in capsys.readouterr().err


def test_a_run_goes_on_on_the_device_that_is_named(scene, capsys):
    assert cli.main(["run", scene, "-o", "made", "--quiet"]) == 0
    longer = ["--set", "duration=8e-5", "--device", "tpu"]
    assert "tpu" in refused(capsys, "run", "--resume", "made", *longer)
    Path("made/summary.json").unlink()  # or nothing is left to be computed
    assert "tpu" in refused(capsys, "run", scene, "--resume-or-start", "-o", "made", "--device", "tpu")


def test_a_figure_needs_no_backend_of_the_notebook_it_was_asked_for_in(scene):
    assert cli.main(["run", scene, "--quiet"]) == 0
    drawn = command("plot", "runs/small", "-o", "x.png", env=os.environ | {"MPLBACKEND": "module://not_here.inline"})
    assert (drawn.returncode, drawn.stdout, drawn.stderr) == (0, "x.png\n", "")
