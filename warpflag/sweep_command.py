"""The command `warpflag sweep`: its options, and what they start."""

from __future__ import annotations

import argparse
import contextlib
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from warpflag.base.exit_status import DONE
from warpflag.base.streams import tell

if TYPE_CHECKING:
    from warpflag.base.forked import Starter
    from warpflag.run.run import Outcome
    from warpflag.run.sweep import SweepRun

__all__ = ["OptionError", "add", "sweep"]


# Options of sbatch that the jobs of a sweep depend on, and what sets them.
_OWN_OF_JOBS = {"array": "--jobs", "time": "--time", "signal": "--time"}
_LEAST_JOB_SECONDS = 60.0  # Slurm counts minutes, and a worker takes seconds to begin


class OptionError(ValueError):
    """Options that do not go together; one line."""


def add(commands: Any, add_limits: Callable[[argparse.ArgumentParser], None]) -> argparse.ArgumentParser:
    """Adds the command to a parser's commands.

    Args:
        commands: of the parser.
        add_limits: adds what limits the wall time of a command.
    """
    command = commands.add_parser(
        "sweep",
        help="run a scene many times with varied values, or resume a sweep",
        description="Runs all members of a sweep file, or of a scene file and --grid; a run directory each.",
    )
    command.add_argument("scene", nargs="?", metavar="SWEEP.toml", help="a sweep file, or a scene file for --grid")
    command.add_argument("--resume", metavar="DIR", help="continue the sweep in DIR; what is done is skipped")
    command.add_argument("-o", dest="output", metavar="DIR", help="directory (default: runs/NAME, never overwritten)")
    command.add_argument(
        "--resume-or-start", action="store_true", help="continue the sweep in -o DIR, or start it there"
    )
    command.add_argument(
        "--grid",
        nargs="+",
        action="extend",
        default=[],
        metavar="KEY=FROM:TO:COUNT",
        help="an axis, also KEY=FROM:TO:COUNT:log, KEY=A,B,C or, of keys that vary together, KEY,OTHER=[A,B],[C,D]; "
        "several make all combinations",
    )
    command.add_argument(
        "--set", nargs="+", action="extend", default=[], metavar="KEY=VALUE", help="replace values of the base scene"
    )
    command.add_argument(
        "--workers", type=_count, metavar="N", help="processes (default: one per GPU, or one per core)"
    )
    command.add_argument("--device", help="of all workers (default: every GPU in turn, or the CPU)")
    command.add_argument("--movies", action="store_true", help="a movie of every member")
    command.add_argument("--share", type=_share, default=(0, 1), metavar="K/N", help="only share K, from 0, of N")
    command.add_argument("--quiet", action="store_true", help="print errors only")
    add_limits(command)
    cluster = command.add_argument_group("on a cluster", "Slurm runs the sweep as one job array; see docs/sweeps.md.")
    cluster.add_argument("--slurm", action="store_true", help="submit the sweep through submitit (extra slurm)")
    cluster.add_argument("--slurm-script", action="store_true", help="print the script for sbatch instead")
    cluster.add_argument("--jobs", type=_count, metavar="N", help="jobs of the array (default: by --time)")
    cluster.add_argument("--time", metavar="TIME", help="wall time of a job, [[D-]HH:]MM:SS (default: 1:00:00)")
    cluster.add_argument(
        "--slurm-set",
        nargs="+",
        default=[],
        metavar="KEY=VALUE",
        help="further options of sbatch, partition=gpu gres=gpu:1",
    )
    return command


def sweep(options: argparse.Namespace) -> Outcome | str:
    """Runs or submits the sweep that was asked for; returns how it ended, or what to print.

    Raises:
        OptionError: the options do not go together.
    """
    for values in (options.set, options.grid):  # sweep --set key=value SWEEP.toml
        if options.scene is None and values and "=" not in values[-1]:
            options.scene = values.pop()
    if (options.scene is None) == (options.resume is None):
        raise OptionError("sweep needs either a SWEEP.toml or --resume DIR")
    if options.resume is not None and (options.output or options.grid or options.set):
        raise OptionError("--resume goes on with the sweep of its directory; leave out -o, --grid and --set")
    if options.resume_or_start and not (options.scene and options.output):
        raise OptionError("--resume-or-start needs a SWEEP.toml and -o DIR")
    if not (options.slurm or options.slurm_script):
        for option, value in (("--jobs", options.jobs), ("--time", options.time), ("--slurm-set", options.slurm_set)):
            if value:
                raise OptionError(f"{option} is for --slurm or --slurm-script; --max-wall ends a sweep on this machine")
    elif options.max_wall is not None or options.share != (0, 1):
        raise OptionError("--max-wall and --share are of sweeps on this machine; --time and --jobs say them of jobs")
    for pair in options.slurm_set:
        key, sign, value = pair.partition("=")
        if not (key and sign and value) or key.startswith("-"):
            raise OptionError(f"--slurm-set {pair}: must be written KEY=VALUE, without dashes")
        if key in _OWN_OF_JOBS:
            raise OptionError(f"--slurm-set {pair}: {key} is set by {_OWN_OF_JOBS[key]}")
    from warpflag.run.stop import Stop

    limits = {} if options.checkpoint_interval is None else {"checkpoint_seconds": options.checkpoint_interval}
    with Stop(options.max_wall) as stop, _early_starter(options) as starter:
        seconds = _job_seconds(options)
        started = _started(options, starter)
        if seconds is not None:
            return _submitted(started, options, seconds)
        limits |= {"movies": options.movies, "share": options.share}
        return started.execute(options.workers, options.device, options.quiet, stop, starter=starter, **limits)


def _early_starter(options: argparse.Namespace) -> contextlib.AbstractContextManager[Starter | None]:
    """What starts workers on the CPU: it imports while the sweep is read. None where they may get a GPU each."""
    from warpflag.base.forked import Starter

    gpu = options.device != "cpu" if options.device else os.path.exists("/dev/nvidiactl")
    if gpu or options.slurm or options.slurm_script or not Starter.works():
        return contextlib.nullcontext()
    return contextlib.closing(Starter("warpflag.run.sweep.worker"))


def _started(options: argparse.Namespace, starter: Starter | None) -> SweepRun:
    from warpflag.run.sweep import plan  # without Warp: the workers begin to load kernels while this process imports it

    read = None if options.scene is None else plan.read(options.scene, options.set, options.grid)
    if starter is not None and read is not None and (scene := read.first_scene()) is not None:
        from warpflag.scene import dumps

        with contextlib.suppress(OSError):  # which `execute` finds as well
            starter.begin({"scene": dumps(scene), "quiet": options.quiet})
    if options.device and not (options.slurm or options.slurm_script):
        from warpflag.base.device import find_device

        find_device(options.device)
    from warpflag.run import sweep

    if read is None:
        return sweep.resume(options.resume)
    return (sweep.resume_or_start if options.resume_or_start else sweep.start)(read, options.output)


def _job_seconds(options: argparse.Namespace) -> float | None:
    """Wall time of a job on a cluster [s]; None where the sweep runs on this machine."""
    from warpflag.run.stop import wall_seconds

    if not (options.slurm or options.slurm_script):
        return None
    try:
        seconds = wall_seconds(options.time or "1:00:00")
    except ValueError as error:
        raise OptionError(f"--time: {error}") from None
    if seconds < _LEAST_JOB_SECONDS:
        raise OptionError(f"--time {options.time}: a job needs a minute at least")
    return seconds


def _submitted(started: SweepRun, options: argparse.Namespace, seconds: float) -> str:
    from warpflag.run.sweep import slurm

    further = dict(pair.partition("=")[::2] for pair in options.slurm_set)
    if (options.device or "").startswith("cuda") and not any("gres" in key or "gpu" in key for key in further):
        tell(f"--device {options.device}: these jobs ask Slurm for no GPU; --slurm-set gres=gpu:1 does", DONE)
    jobs = slurm.Jobs(
        started,
        seconds,
        options.jobs,
        options.workers,
        options.device,
        options.movies,
        options.checkpoint_interval,
        further,
    )
    return jobs.script() if options.slurm_script else jobs.submit()


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text} is not a whole number from 1 on")
    return int(text)


def _share(text: str) -> tuple[int, int]:
    """Number and count of "2/8"."""
    number, _, count = text.partition("/")
    if not (number.isdecimal() and count.isdecimal() and int(number) < int(count)):
        raise argparse.ArgumentTypeError(f"{text} is not of the form 2/8, the first from 0")
    return int(number), int(count)
