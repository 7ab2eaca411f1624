"""Every option of every command reaches what acts on it, and changes what that is told."""

from __future__ import annotations

import importlib
import inspect
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.films import made_record
from warpflag import cli
from warpflag.run.stop import Ended
from warpflag.scene import dumps, paper_scene, with_values

# What is watched, by a short name: an object and its attribute.
WATCHED = {
    "run": ("warpflag.run.run", "start"),
    "resumed": ("warpflag.run.run", "resume"),
    "executed": ("warpflag.run.run", "Run.execute"),
    "sweep": ("warpflag.run.sweep.sweep", "SweepRun.execute"),
    "planned": ("warpflag.run.sweep.plan", "read"),
    "begun": ("warpflag.run.sweep", "start"),
    "begun_again": ("warpflag.run.sweep", "resume_or_start"),
    "continued": ("warpflag.run.sweep", "resume"),
    "submitted": ("warpflag.run.sweep.slurm", "Jobs.submit"),
    "jobs": ("warpflag.run.sweep.slurm", "Jobs.__init__"),
    "study": ("warpflag.run.tradeoff", "Study.__init__"),
    "studied": ("warpflag.run.tradeoff", "Study.execute"),
    "checked": ("warpflag.run.check", "report"),
    "simulated": ("warpflag.run.simulation", "Simulation.__init__"),
    "dashboard": ("warpflag.view.figures", "dashboard"),
    "comparison": ("warpflag.view.figures", "comparison"),
    "sweep_figure": ("warpflag.view.sweep_figures", "figure"),
    "saved": ("warpflag.view.figures", "save"),
    "drawn": ("warpflag.view.render", "render"),
    "filmed": ("warpflag.view.usd", "write_movie"),
    "page": ("warpflag.view.page", "write_page"),
    "csv": ("warpflag.view.export", "write_csv"),
}
LAST = ("executed", "sweep", "submitted", "studied", "checked", "comparison", "saved", "drawn", "filmed", "csv")

RUN, SWEEP = "run small.toml", "sweep small.toml --grid motor.torque=1,2 -o made"
SCRIPT = f"{SWEEP} --slurm-script --jobs 1"
PLOT, RENDER, EXPORT = "plot one -o a.png", "render one -o a.png", "export one --to usd"

Found = dict[str, Any]


def of(name: str) -> Callable[[Found], Any]:
    """What was told by a dotted name: watched, argument, attributes."""

    def look(found: Found) -> Any:
        value: Any = found
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else getattr(value, part, None)
        return value

    return look


def ends(found: Found) -> bool:
    """Whether the wall time of a command is over."""
    time.sleep(2e-3)
    stop = next(found[name]["stop"] for name in ("executed", "sweep") if name in found)
    try:
        stop.check()
    except Ended:
        return True
    return False


# Option of a command, what is typed without it, with it, where to look, and what is found there with it.
ROWS: list[tuple[str, str, str, str | Callable[[Found], Any], Any]] = [
    ("run -o", RUN, "-o there", "run.output", "there"),
    ("run --resume", RUN, "--resume one", "resumed.directory", "one"),
    ("run --resume-or-start", f"{RUN} -o one", "--resume-or-start", "resumed.directory", "one"),
    ("run --quiet", RUN, "--quiet", "executed.quiet", True),
    ("run --max-wall", RUN, "--max-wall 0.001", ends, True),
    ("run --checkpoint-interval", RUN, "--checkpoint-interval 1:10", "run.checkpoint_seconds", 70.0),
    ("run --checkpoint-interval", "run --resume one", "--checkpoint-interval 7", "resumed.checkpoint_seconds", 7.0),
    ("run --device", RUN, "--device cpu", "run.device", "cpu"),
    ("run --device", "run --resume one", "--device cpu", "resumed.device", "cpu"),
    ("run --device", f"{RUN} -o one --resume-or-start", "--device cpu", "resumed.device", "cpu"),
    ("run --precision", RUN, "--precision float32", "run.scene.numerics.precision", "float32"),
    ("run --set", RUN, "--set frames=3", "run.scene.frames", 3),
    ("run --set", "run --resume one", "--set duration=1", "resumed.overrides", ["duration=1"]),
    ("sweep -o", "sweep small.toml --grid motor.torque=1,2", "-o there", "begun.output", "there"),
    ("sweep --resume", SWEEP, "--resume swept", "continued.directory", "swept"),
    ("sweep --resume-or-start", SWEEP, "--resume-or-start", "begun_again.output", "made"),
    ("sweep --grid", SWEEP, "--grid motor.axis_angle=3,4", lambda found: len(found["planned"]["grid"]), 2),
    ("sweep --set", SWEEP, "--set frames=3", "planned.overrides", ["frames=3"]),
    ("sweep --workers", SWEEP, "--workers 3", "sweep.workers", 3),
    ("sweep --workers", SCRIPT, "--workers 3", "jobs.workers", 3),
    ("sweep --device", SWEEP, "--device cpu", "sweep.device", "cpu"),
    ("sweep --device", SCRIPT, "--device cpu", "jobs.device", "cpu"),
    ("sweep --movies", SWEEP, "--movies", "sweep.movies", True),
    ("sweep --movies", SCRIPT, "--movies", "jobs.movies", True),
    ("sweep --share", SWEEP, "--share 1/4", "sweep.share", (1, 4)),
    ("sweep --quiet", SWEEP, "--quiet", "sweep.quiet", True),
    ("sweep --max-wall", SWEEP, "--max-wall 0.001", ends, True),
    ("sweep --checkpoint-interval", SWEEP, "--checkpoint-interval 70", "sweep.checkpoint_seconds", 70.0),
    ("sweep --checkpoint-interval", SCRIPT, "--checkpoint-interval 70", "jobs.checkpoint_seconds", 70.0),
    ("sweep --slurm", SWEEP, "--slurm", lambda found: "submitted" in found, True),
    ("sweep --slurm-script", SWEEP, "--slurm-script --jobs 1", lambda found: "jobs" in found, True),
    ("sweep --jobs", f"{SWEEP} --slurm", "--jobs 2", "jobs.count", 2),
    ("sweep --time", SCRIPT, "--time 2:00:00", "jobs.seconds", 7200.0),
    ("sweep --slurm-set", SCRIPT, "--slurm-set partition=gpu", "jobs.further", {"partition": "gpu"}),
    ("tradeoff -o", "tradeoff small.toml", "-o there", "study.output", "there"),
    ("tradeoff --budget", "tradeoff small.toml", "--budget 7", "studied.budget", 7.0),
    ("tradeoff --record", "tradeoff small.toml", "--record one", "study.record", "one"),
    ("tradeoff --device", "tradeoff small.toml", "--device cpu", "study.device", "cpu"),
    ("tradeoff --set", "tradeoff small.toml", "--set frames=3", "study.scene.frames", 3),
    ("tradeoff --quiet", "tradeoff small.toml", "--quiet", "studied.quiet", True),
    ("check --device", "check small.toml", "--device cpu", "checked.device", "cpu"),
    ("check --precision", "check small.toml", "--precision float32", "checked.scene.numerics.precision", "float32"),
    ("check --set", "check small.toml", "--set frames=3", "checked.scene.frames", 3),
    ("compile --device", "compile small.toml", "--device cpu", "simulated.device", "cpu"),
    ("plot -o", PLOT, "-o b.png", "saved.path", "b.png"),
    ("plot --x", "plot swept -o a.png", "--x speed", "sweep_figure.x", "speed"),
    ("plot --y", "plot swept -o a.png", "--y speed", "sweep_figure.numbers", ["speed"]),
    ("plot --y", PLOT, "--y bundle_length", "comparison.names", ["bundle_length"]),
    ("plot --as", "plot swept -o a.png", "--as map", "sweep_figure.kind", "map"),
    ("plot --as", PLOT, "--as comparison", lambda found: "comparison" in found, True),
    ("render -o", RENDER, "-o b.png", "drawn.output", "b.png"),
    ("render --size", RENDER, "--size 64x48", "drawn.size", (64, 48)),
    ("render --times", RENDER, "--times 1 2", "drawn.times", [1e-3, 2e-3]),
    ("render --snapshots", RENDER, "--snapshots 3", "drawn.snapshots", 3),
    ("render --radius", RENDER, "--radius 0.1", "drawn.radius", 0.1),
    ("render --device", RENDER, "--device cpu", "drawn.device", "cpu"),
    ("render --quiet", RENDER, "--quiet", "drawn.quiet", True),
    ("render --color", RENDER, "--color curvature", "drawn.shot.color_by", "curvature"),
    ("render --follow", f"{RENDER} --color form", "--follow", "drawn.shot.follow", True),
    ("render --fps", RENDER, "--fps 10", "drawn.frames_per_second", 10.0),
    ("render --slow-down", f"{RENDER} --follow", "--slow-down 9", "drawn.shot.slow_down", 9.0),
    ("render --slow-down", RENDER, "--slow-down 9", "drawn.shot.slow_down", 9.0),
    ("render --follow", RENDER, "--follow", "drawn.shot.follow", True),
    ("export --to", EXPORT, "--to csv", lambda found: "csv" in found, True),
    ("export -o", EXPORT, "-o b.usda", "filmed.path", Path("b.usda")),
    ("export -o", "export one --to html", "-o b.html", "page.path", Path("b.html")),
    ("export -o", "export one --to csv", "-o b.csv", "csv.path", Path("b.csv")),
    ("export --clip-frames", EXPORT, "--clip-frames 2", "filmed.shot.clip_frames", 2),
    ("export --mesh", EXPORT, "--mesh", "filmed.shot.mesh", True),
    ("export --color", EXPORT, "--color curvature", "filmed.shot.color_by", "curvature"),
    ("export --color", "export one --to html", "--color curvature", "page.color_by", "curvature"),
    ("export --follow", EXPORT, "--follow", "filmed.shot.follow", True),
    ("export --fps", EXPORT, "--fps 10", "filmed.shot.frames_per_second", 10.0),
    ("export --slow-down", EXPORT, "--slow-down 9", "filmed.shot.slow_down", 9.0),
]


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A directory with a scene, a record, and a sweep."""
    where = tmp_path_factory.mktemp("flags")
    scene = with_values(paper_scene(name="small"), {"flagella.length": 1.0, "duration": 4e-5, "frames": 4})
    (where / "small.toml").write_text(dumps(scene))
    made_record(where / "one", 3).close()
    (where / "one" / "scene.toml").write_text(dumps(scene))
    (where / "swept").mkdir()
    (where / "swept" / "sweep.toml").write_text('scene = "small.toml"\n')
    return where


@pytest.fixture
def told(made, tmp_path, monkeypatch) -> Callable[[str, str], Found]:
    """Runs a command up to something that is watched; returns the arguments of all that was called."""
    monkeypatch.setattr("warpflag.base.forked.Starter.works", lambda: False)  # no process is started for a sweep
    found: Found = {}
    last_wanted = ""

    def watch(name: str, module: str, attribute: str) -> None:
        owner: Any = importlib.import_module(module)
        *inside, last = attribute.split(".")
        for part in inside:
            owner = getattr(owner, part)
        original = getattr(owner, last)

        def watched(*arguments: Any, **named: Any) -> Any:
            bound = inspect.signature(original).bind(*arguments, **named)
            bound.apply_defaults()
            found[name] = bound.arguments | bound.arguments.get("options", {})
            if name == last_wanted or name in LAST:
                raise KeyboardInterrupt
            return original(*arguments, **named)

        monkeypatch.setattr(owner, last, watched)

    for name, (module, attribute) in WATCHED.items():
        watch(name, module, attribute)

    def run(line: str, wanted: str) -> Found:
        nonlocal last_wanted
        last_wanted = wanted
        found.clear()
        place = tmp_path / line.replace("/", ".")
        shutil.copytree(made, place)
        monkeypatch.chdir(place)
        cli.main(line.split())
        return dict(found)

    return run


def options_of(command: str, capsys) -> set[str]:
    with pytest.raises(SystemExit):
        cli.main([command, "--help"])
    usage = capsys.readouterr().out.split("\n\n")[0]
    return {f"{command} {flag}" for flag in re.findall(r"(?<=[\[ ])(-o|--[a-z-]+)", usage)}


def test_every_option_has_a_row(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit):
        cli.main(["--help"])
    commands = re.findall(r"^    ([a-z]+) ", capsys.readouterr().out, re.MULTILINE)
    assert len(commands) == 9
    assert set().union(*(options_of(command, capsys) for command in commands)) == {row[0] for row in ROWS}


@pytest.mark.parametrize("row", ROWS, ids=[f"{row[0]} of {row[1]}" for row in ROWS])
def test_an_option_reaches_what_acts_on_it(row, told):
    option, without, given, where, expected = row
    command, flag = option.split()
    assert given.startswith(flag) and without.startswith(command)
    look, wanted = (where, "") if callable(where) else (of(where), where.partition(".")[0])
    line = f"{command} {given}" if flag == "--resume" else f"{without} {given}"
    assert look(told(line, wanted)) == expected != look(told(without, wanted))


@pytest.mark.parametrize(
    "line, words",
    [
        (f"{SCRIPT} --share 1/2", "--share are of sweeps on this machine"),
        (f"{SWEEP} --slurm --max-wall 60", "--max-wall and"),
        *((f"export one --to csv {own}", f"{own.split()[0]} is for movies: --to usd") for own in (
            "--color form", "--follow", "--fps 9", "--slow-down 9", "--clip-frames 9", "--mesh"
        )),
        ("export one --to html --follow", "--follow is for movies"),
        ("plot one --as dashboard --y bundle_length -o a.png", "plot --as comparison"),
    ],
)  # fmt: skip
def test_an_option_that_nothing_would_act_on_is_refused(line, words, made, monkeypatch, capsys):
    monkeypatch.chdir(made)
    assert cli.main(line.split()) == 2
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1 and words in said.err
