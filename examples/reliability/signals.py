"""Attacks on runs and sweeps by the signals that ask them to end: they end resumable, and resumed as if undisturbed."""

from __future__ import annotations

import random
import signal
from pathlib import Path

from examples.reliability.attempt import LIFE, Found, command, found, frames_of, problem, same, signalled, timed, told
from examples.reliability.runs import CHECKPOINTS, Base

NUMBERS = (signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGXCPU, signal.SIGINT)
SWEEP = """
base = "{base}"
[axes]
"motor.torque" = [1.5, 2.0, 2.5, 3.0]
"""
OPTIONS = ("--workers", "1", *CHECKPOINTS)


def _undisturbed(base: Base) -> tuple[Path, float]:
    """A sweep that nobody disturbs, made once, and the computing time that it takes [s]."""
    plan, whole = base.folder / "signals.toml", base.folder / "swept"
    taken = base.folder / "swept.seconds"
    if not taken.exists():
        plan.write_text(SWEEP.format(base=base.scene))
        ended, seconds = timed("sweep", str(plan), "-o", str(whole), *OPTIONS)
        assert ended.returncode == 0, ended.stderr
        taken.write_text(f"{seconds}")
    return whole, float(taken.read_text())


def asked_to_end(base: Base, seed: int, folder: Path) -> Found:
    """A run or a sweep gets one signal at a random moment of its life, is resumed, and compared to the last bit."""
    chance, directory = random.Random(f"signal {seed}"), folder / "signalled"
    number, swept = NUMBERS[seed % len(NUMBERS)], seed // len(NUMBERS) % 2 == 1
    whole, seconds = _undisturbed(base) if swept else (base.whole, base.seconds)
    what = ("sweep", str(base.folder / "signals.toml"), *OPTIONS) if swept else ("run", str(base.scene), *CHECKPOINTS)
    after = chance.random() * seconds * LIFE
    end = signalled([*what, "-o", str(directory)], number, after)
    if end is None:
        return found("traceback", f"{what[0]}: {number.name} after {after:.2f} s: goes on")
    status, said = end.status, end.said
    done = f"{what[0]}: {number.name} after {after:.2f} of {seconds:.2f} s, status {status}"
    begun = (directory / ("sweep.toml" if swept else "scene.toml")).exists()
    # Before the program has taken signals over they act as on any process, and nothing has begun.
    if not begun and (status == -number or "KeyboardInterrupt" in said):
        return found("right", f"{done}: before the program began")
    # Once all is written it hands signals back, and may end by one before it has said so.
    after_all = status == -number and (directory / "table.csv" if swept else directory / "summary.json").exists()
    if (status < 0 and not after_all) or "Traceback" in said:
        return found("traceback", f"{done}: {said.strip().splitlines()[-1:]}")
    if status not in (0, -number, 130 if number == signal.SIGINT else 143):
        return found("wrong", f"{done}: {said[-200:]}")
    if not begun:
        return found("right", f"{done}: nothing was begun")
    if status != 0:
        ended = command(what[0], "--resume", str(directory), *(("--workers", "1") if swept else ()))
        if wrong := problem(ended):
            return found("traceback", f"{done}: resume {wrong}")
        if ended.returncode:
            return found("lost", f"{done}: resume ends {ended.returncode}: {told(ended)}")
    return _compared(whole, directory, swept, done)


def _compared(whole: Path, directory: Path, swept: bool, done: str) -> Found:
    names = [path.name for path in sorted(whole.glob("0*"))] if swept else ["."]
    differ = [name for name in names if not same(frames_of(directory / name), frames_of(whole / name))]
    if differ:
        return found("wrong", f"{done}: other numbers in {' '.join(differ)}")
    if swept and _table(directory) != _table(whole):
        return found("wrong", f"{done}: another table")
    return found("right", done)


def _table(directory: Path) -> list[str]:
    return (directory / "table.csv").read_text().splitlines()
