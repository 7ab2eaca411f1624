"""The command `warpflag tradeoff`: its options, and what they start."""

from __future__ import annotations

import argparse
import math
from typing import Any

from warpflag.base.exit_status import DONE, STOPPED
from warpflag.base.streams import tell

__all__ = ["add", "tradeoff"]


def add(commands: Any) -> argparse.ArgumentParser:
    """Adds the command to a parser's commands."""
    command = commands.add_parser(
        "tradeoff",
        help="measure what accuracy costs on a scene",
        description="Runs windows of the scene's own course (start, first contact, zip, finished bundle) with other "
        "steppers, accuracies, precisions, segment lengths and models, each beside a converged reference, and says "
        "what each costs and how far it is off: a table, tradeoff.csv, tradeoff.png, and [numerics] blocks to paste. "
        "Started again in the same directory, it goes on where it was.",
    )
    command.add_argument("scene", metavar="SCENE.toml", help="the scene to measure")
    command.add_argument("-o", dest="output", metavar="DIR", help="directory (default: runs/NAME-tradeoff)")
    command.add_argument(
        "--budget", type=_seconds, default=300.0, metavar="SECONDS", help="wall time (default: 300); less: fewer points"
    )
    command.add_argument("--record", metavar="DIR", help="take the windows from this run instead of a coarse one")
    command.add_argument("--device", help="cpu, cuda:0, ... (see warpflag devices)")
    command.add_argument(
        "--set", nargs="+", action="extend", default=[], metavar="KEY=VALUE", help="replace values of the scene"
    )
    command.add_argument("--quiet", action="store_true", help="no progress")
    command.set_defaults(command=tradeoff)
    return command


def tradeoff(options: argparse.Namespace) -> int:
    """Runs the study that was asked for and prints its report; returns the exit status."""
    from warpflag.run.faults import NumericalError
    from warpflag.run.stop import Stop
    from warpflag.run.tradeoff import Study
    from warpflag.scene import load

    study = Study(load(options.scene, options.set), options.output, options.device, options.record)
    try:
        with Stop() as stop:
            print(study.execute(options.budget, options.quiet, stop.check))
    except NumericalError as error:  # before the first frame of its course
        return tell(f"{options.scene}: {error}", STOPPED)
    return STOPPED if study.stopped else DONE


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not 1.0 <= seconds <= 1e6:
        raise argparse.ArgumentTypeError(f"{text} is no number of seconds from 1 on")
    return seconds
