"""The command line: `warpflag run`, `check`, `plot`, `export`, `devices`.

Exit status: 0 done; 2 bad input, told in one line; 3 a guard stopped the run; 130 interrupted, resumable. Everything
heavy is imported by the command that needs it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn

from warpflag import __version__

if TYPE_CHECKING:
    from warpflag.scene import Scene

__all__ = ["main"]

DONE, FAILED, BAD_INPUT, STOPPED, INTERRUPTED = 0, 1, 2, 3, 130


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {message} (see {self.prog} --help)\n")


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns its exit status."""
    options = _parser().parse_args(arguments)
    try:
        return options.command(options)
    except _bad_input() as error:
        return _say(_located(error, options), BAD_INPUT)
    except OSError as error:
        return _say(error, FAILED)
    except KeyboardInterrupt:
        return _say("interrupted", INTERRUPTED)


def _say(message: object, status: int) -> int:
    print(f"warpflag: {message}", file=sys.stderr)
    return status


def _bad_input() -> tuple[type[Exception], ...]:
    from warpflag.checkpoint import CheckpointError
    from warpflag.device import DeviceError
    from warpflag.output import OutputError
    from warpflag.record import RecordError
    from warpflag.run_directory import RunError
    from warpflag.scene import SceneError

    return CheckpointError, DeviceError, OutputError, RecordError, RunError, SceneError


def _located(error: Exception, options: argparse.Namespace) -> Exception:
    """The error with the scene file, which only the command knows once the scene is loaded."""
    from warpflag.scene import SceneError
    from warpflag.scene_file import read_overrides

    if isinstance(error, SceneError) and not error.source and options.scene:
        return error.located(options.scene, read_overrides(options.set))
    return error


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="warpflag", description="Simulates swimming bacteria with elastic flagella.")
    parser.add_argument("--version", action="version", version=f"warpflag {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    run = commands.add_parser("run", help="run a scene, or resume a run", description="Runs a scene file.")
    run.add_argument("scene", nargs="?", metavar="SCENE.toml", help="the scene to run")
    run.add_argument("--resume", metavar="DIR", help="continue the run in DIR; of --set it takes duration only")
    run.add_argument("-o", dest="output", metavar="DIR", help="run directory (default: runs/NAME, never overwritten)")
    run.add_argument("--quiet", action="store_true", help="print errors only")
    run.set_defaults(command=_run)

    check = commands.add_parser(
        "check", help="show what a scene is and requires", description="Shows the resolved scene and what it requires."
    )
    check.add_argument("scene", metavar="SCENE.toml", help="the scene to check")
    check.set_defaults(command=_check)

    for command in (run, check):
        command.add_argument("--device", help="cpu, cuda:0, ... (see warpflag devices)")
        command.add_argument("--precision", choices=("float64", "float32"), help="as --set numerics.precision=...")
        command.add_argument(
            "--set", nargs="+", action="extend", default=[], metavar="KEY=VALUE", help="replace values of the scene"
        )

    plot = commands.add_parser(
        "plot",
        help="draw the curves of runs",
        description="Draws bundle length, phase difference and contact force of runs over time; needs matplotlib, the "
        "extra plot. The bundle length passes over gaps of 1 um; run.h5 has the plain one.",
    )
    plot.add_argument("directories", nargs="+", metavar="DIR", help="run directory")
    plot.add_argument("-o", dest="output", metavar="FIG", required=True, help="ends in .png, .pdf, .svg, ...")
    plot.add_argument(
        "--as",
        dest="kind",
        choices=("series", "comparison"),
        help="panels with contact forces, or one of all runs (default: series of one run, comparison of several)",
    )
    plot.set_defaults(command=_plot)

    export = commands.add_parser(
        "export", help="write a record in another format", description="Writes the record of a run in another format."
    )
    export.add_argument("directory", metavar="DIR", help="run directory")
    export.add_argument("--to", choices=("usd",), required=True, help="format")
    export.add_argument(
        "-o", dest="output", metavar="FILE", help="ends in .usdc, .usda or .usdz (default: movie.usdc in DIR)"
    )
    export.set_defaults(command=_export)

    devices = commands.add_parser("devices", help="list the devices of this machine")
    devices.set_defaults(command=_devices)
    return parser


def _run(options: argparse.Namespace) -> int:
    if options.scene is None and options.set and "=" not in options.set[-1]:
        options.scene = options.set.pop()  # run --set key=value SCENE.toml
    if (options.scene is None) == (options.resume is None):
        return _say("run needs either a SCENE.toml or --resume DIR", BAD_INPUT)
    if options.resume is not None and (options.output or options.precision):
        return _say("--resume goes on in its directory and precision; leave out -o and --precision", BAD_INPUT)
    from warpflag import run

    if options.resume is not None:
        outcome = run.resume(options.resume, options.set, options.device).execute(options.quiet)
    else:
        outcome = run.start(_scene(options), options.output, options.device).execute(options.quiet)
    if outcome.status != "done":
        return _say(outcome.message, {"stopped": STOPPED, "interrupted": INTERRUPTED}[outcome.status])
    if not options.quiet:
        print(outcome.message)
    return DONE


def _check(options: argparse.Namespace) -> int:
    scene = _scene(options)
    from warpflag.check import report
    from warpflag.faults import NumericalError

    try:
        print(report(scene, options.device), end="")
    except NumericalError as error:
        return _say(f"{scene.name}: {error}", STOPPED)
    return DONE


def _scene(options: argparse.Namespace) -> Scene:
    from warpflag.scene import load

    precision = [f"numerics.precision={options.precision}"] if options.precision else []
    return load(options.scene, [*options.set, *precision])


def _plot(options: argparse.Namespace) -> int:
    from pathlib import Path

    from warpflag import figures

    names = [Path(directory).resolve().name for directory in options.directories]
    labels = names if len(set(names)) == len(names) else options.directories
    runs = [figures.read(directory, label) for directory, label in zip(options.directories, labels, strict=True)]
    comparison = options.kind == "comparison" or (options.kind is None and len(runs) > 1)
    figures.save(figures.comparison(runs) if comparison else figures.time_series(runs), options.output)
    print(options.output)
    return DONE


def _export(options: argparse.Namespace) -> int:
    from pathlib import Path

    from warpflag.record import Record
    from warpflag.usd import write_movie

    path = Path(options.output or Path(options.directory) / "movie.usdc")
    with Record(options.directory) as record:
        write_movie(record, path)
    print(path)
    return DONE


def _devices(options: argparse.Namespace) -> int:
    from warpflag.device import list_devices

    print("\n".join(list_devices()))
    return DONE
