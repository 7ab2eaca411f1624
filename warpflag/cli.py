"""The command line: `warpflag run`, `sweep`, `tradeoff`, `check`, `plot`, `render`, `export`, `compile`, `devices`.

Exit status: 0 done; 1 the machine failed the run (disk full, no permission); 2 bad input, a line for each problem; 3 a
guard stopped the run; 130 interrupted by Ctrl-C, 143 terminated by a signal or out of wall time, both resumable.
Everything heavy is imported by the command that needs it.
"""

from __future__ import annotations

import argparse
import gc
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, NoReturn

from warpflag import __version__, sweep_command, tradeoff_command, view_command
from warpflag.base.exit_status import BAD_INPUT, DONE, FAILED, INTERRUPTED, STOPPED, TERMINATED
from warpflag.base.output import machine_error
from warpflag.base.streams import explained_cache, protected_streams, tell
from warpflag.base.threads import keep_to_one_thread

if TYPE_CHECKING:
    from warpflag.run.run import Outcome, Run
    from warpflag.scene import Scene

__all__ = ["command", "main"]

_STATUS = {"done": DONE, "failed": FAILED, "stopped": STOPPED, "interrupted": INTERRUPTED, "terminated": TERMINATED}


# Objects made between two looks of Python for garbage: with the usual 700 they take a tenth of the time until a run
# begins, in which all that is made stays.
_OBJECTS_PER_LOOK = 100_000


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one line."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {message} (see {self.prog} --help)\n")


def command() -> int:
    """The process of the command line: `main`, with a quick start and end; returns its exit status."""
    keep_to_one_thread()
    gc.set_threshold(_OBJECTS_PER_LOOK)
    status = main()
    gc.freeze()  # or Python looks for garbage among all that Warp has defined, a fifth of a second
    return status


@protected_streams()
@explained_cache
def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command; returns its exit status."""
    options = _parser().parse_args(arguments)
    try:
        return options.command(options)
    except KeyboardInterrupt as error:
        status, reason = getattr(error, "status", "interrupted"), getattr(error, "reason", "")
        return tell(status + (f" ({reason})" if reason else ""), _STATUS[status])
    except _bad_input() as error:  # after the interrupt, which may have come while these were being imported
        return tell(_located(error, options), BAD_INPUT)
    except OSError as error:
        return tell(machine_error(error), FAILED)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, RuntimeError) and "Failed to allocate" not in str(error):  # as Warp says it
            raise
        return tell(f"out of memory: {' '.join(str(error).split())}", FAILED)


def _bad_input() -> tuple[type[Exception], ...]:
    from warpflag.base.device import DeviceError
    from warpflag.base.output import OutputError
    from warpflag.record import RecordError
    from warpflag.run.checkpoint import CheckpointError
    from warpflag.run.lock import LockedError
    from warpflag.run.run_directory import RunError
    from warpflag.run.sweep import BadMembers
    from warpflag.scene import SceneError

    found = (BadMembers, CheckpointError, DeviceError, LockedError, OutputError, RecordError, RunError, SceneError)
    return (*found, sweep_command.OptionError)


def _located(error: Exception, options: argparse.Namespace) -> Exception:
    """The error with the scene file, which only the command knows once the scene is loaded."""
    from warpflag.scene import SceneError
    from warpflag.scene.scene_file import read_overrides

    if isinstance(error, SceneError) and not error.source and getattr(options, "scene", None):
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
    run.add_argument("--resume-or-start", action="store_true", help="continue the run in -o DIR, or start it there")
    run.add_argument("--quiet", action="store_true", help="print errors only")
    _add_limits(run)
    run.set_defaults(command=_run)

    sweep_command.add(commands, _add_limits).set_defaults(command=_sweep)
    tradeoff_command.add(commands)

    check = commands.add_parser(
        "check",
        help="show what a scene is and requires, or what is wrong with a movie",
        description="Shows the resolved scene and what it requires; of a USD file, what is wrong with it.",
    )
    check.add_argument("scene", metavar="SCENE.toml", help="the scene to check, or a .usdc, .usda or .usdz file")
    check.set_defaults(command=_check)

    for command in (run, check):
        command.add_argument("--device", help="cpu, cuda:0, ... (see warpflag devices)")
        command.add_argument("--precision", choices=("float64", "float32"), help="as --set numerics.precision=...")
        said = "replace values: motor.torque=2 flagellum.0.torque=1.5 (check lists all keys)"
        command.add_argument("--set", nargs="+", action="extend", default=[], metavar="KEY=VALUE", help=said)

    view_command.add(commands)

    build = commands.add_parser(
        "compile",
        help="compile the kernels that scenes need",
        description="Fills Warp's kernel cache (WARP_CACHE_PATH) for scenes, so that no run has to wait for it, and "
        "keeps the bytecode of warpflag's modules, which Python does not where PYTHONDONTWRITEBYTECODE is set.",
    )
    build.add_argument("scenes", nargs="*", metavar="SCENE.toml", help="default: a scene of defaults")
    build.add_argument("--device", help="cpu, cuda:0, ... (see warpflag devices)")
    build.set_defaults(command=_compile)

    devices = commands.add_parser("devices", help="list the devices of this machine")
    devices.set_defaults(command=_devices)
    return parser


def _add_limits(command: argparse.ArgumentParser) -> None:
    """What limits the wall time of a command that runs scenes."""
    command.add_argument(
        "--max-wall", type=_wall_time, metavar="TIME", help="end resumable after [[D-]HH:]MM:SS or seconds, status 143"
    )
    command.add_argument(
        "--checkpoint-interval", type=_wall_time, metavar="TIME", help="wall time between checkpoints (default: 5)"
    )


def _run(options: argparse.Namespace) -> int:
    if options.scene is None and options.set and "=" not in options.set[-1]:
        options.scene = options.set.pop()  # run --set key=value SCENE.toml
    if options.scene is not None and os.path.isdir(options.scene):
        return tell(
            f"{options.scene} is no SCENE.toml; to go on there: warpflag run --resume {options.scene}", BAD_INPUT
        )
    if (options.scene is None) == (options.resume is None):
        return tell("run needs either a SCENE.toml or --resume DIR", BAD_INPUT)
    if options.resume is not None and (options.output or options.precision):
        return tell("--resume goes on in its directory and precision; leave out -o and --precision", BAD_INPUT)
    if options.resume_or_start and not (options.scene and options.output):
        return tell("--resume-or-start needs a SCENE.toml and -o DIR", BAD_INPUT)
    from warpflag.run.stop import Stop

    with Stop(options.max_wall) as stop:
        return _told(_started(options).execute(options.quiet, stop), options)


def _sweep(options: argparse.Namespace) -> int:
    outcome = sweep_command.sweep(options)
    if not isinstance(outcome, str):
        return _told(outcome, options)
    print(outcome)
    return DONE


def _told(outcome: Outcome, options: argparse.Namespace) -> int:
    """Says how runs have ended; returns the exit status."""
    if outcome.status != "done":
        return tell(outcome.message, _STATUS[outcome.status])
    if not options.quiet:
        print(outcome.message)
    return DONE


def _started(options: argparse.Namespace) -> Run:
    """The run that `warpflag run` was asked for."""
    from pathlib import Path

    from warpflag.run import run
    from warpflag.run.run_directory import SCENE_NAME, check_same_scene

    limits = {} if options.checkpoint_interval is None else {"checkpoint_seconds": options.checkpoint_interval}
    if options.resume is not None:
        return run.resume(options.resume, options.set, options.device, **limits)
    scene = _scene(options)
    if options.resume_or_start and (Path(options.output) / SCENE_NAME).exists():
        check_same_scene(Path(options.output), scene)
        return run.resume(options.output, device=options.device, **limits)
    return run.start(scene, options.output, options.device, **limits)


def _check(options: argparse.Namespace) -> int:
    if options.scene.endswith((".usd", ".usda", ".usdc", ".usdz")):
        for option, value in (("--device", options.device), ("--precision", options.precision), ("--set", options.set)):
            if value:
                return tell(f"{option} is of scenes, and {options.scene} is a movie", BAD_INPUT)
        return _check_movie(options.scene)
    scene = _scene(options)
    from warpflag.run.check import report
    from warpflag.run.faults import NumericalError

    try:
        print(report(scene, options.device), end="")
    except NumericalError as error:
        return tell(f"{scene.name}: {error}", STOPPED)
    return DONE


def _compile(options: argparse.Namespace) -> int:
    import compileall
    import importlib

    from warpflag.run.simulation import Simulation
    from warpflag.scene import Scene, load

    for scene in [load(path) for path in options.scenes] or [Scene(name="defaults")]:
        simulation = Simulation(scene, device=options.device)
        simulation.prepare(recording=True)
        print(f"{scene.name}: kernels are compiled")
    for package in ("warpflag", "warpflag_kernels"):
        for folder in importlib.import_module(package).__path__:
            compileall.compile_dir(folder, quiet=2)
    return DONE


def _check_movie(path: str) -> int:
    from warpflag.view.usd.check import problems_of

    found = problems_of(path)
    print("\n".join(found) or f"{path}: plays")
    return BAD_INPUT if found else DONE


def _scene(options: argparse.Namespace) -> Scene:
    from warpflag.scene import load

    precision = [f"numerics.precision={options.precision}"] if options.precision else []
    return load(options.scene, [*options.set, *precision])


def _wall_time(text: str) -> float:
    from warpflag.run.stop import wall_seconds

    try:
        return wall_seconds(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _devices(options: argparse.Namespace) -> int:
    from warpflag.base.device import list_devices

    print("\n".join(list_devices()))
    return DONE
