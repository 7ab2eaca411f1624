"""What an attack finds: outcomes of single attempts, and the command line that most of them drive."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpflag.record import Record

OUTCOMES = ("right", "told", "unfinished", "refused", "stopped", "wrong", "lost", "traceback")
"""right: the numbers of an undisturbed or a finer run.
told: farther from those than ten times what was asked, and the run says why: fixed steps whose estimate is beyond that
too, or an unstable motion.
unfinished: too slow for anything to be compared before the cut-off.
refused: one line and status 2, or 1 where the machine failed.
stopped: by a guard, one line and status 3.
wrong: other numbers, or an end that says nothing.
lost: what was committed can't be read, or a run can't go on.
traceback: more than the lines that a user should see, a crash, or no end.
"""
ROOT = Path(__file__).parent.parent.parent
PATIENCE = 600.0
"""Wall time after which a command is taken to hang [s]: on a busy machine one of seconds may take minutes."""
LIFE = 1.05
"""Times the undisturbed computing time of a command within which a signal comes: now and then it has ended before."""
_SECONDS_PER_LOOK = 0.005  # at the computing time of a command that is to get a signal
_TICKS = os.sysconf("SC_CLK_TCK")  # of Linux, in which it counts computing time, per second


_PROBLEM = re.compile(r"warpflag: .+: .+")  # of a scene: its file, what is wrong
_PROGRESS = re.compile(r"\s*\d+ %|.*compiling kernels")


@dataclass(frozen=True)
class Found:
    """The outcome of one attempt.

    Attributes:
        outcome: one of `OUTCOMES`.
        note: what was done and what came of it, in a line.
        numbers: of the attempt, for tables.
    """

    outcome: str
    note: str
    numbers: dict[str, Any]


def found(outcome: str, note: str, **numbers: Any) -> Found:
    """An outcome with its note in one line."""
    return Found(outcome, " ".join(note.split())[:300], numbers)


def command(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """The command `warpflag` in a process of its own, from the checkout."""
    options.setdefault("timeout", PATIENCE)
    own = {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "kernels")])}
    env = {**os.environ, **own, **options.pop("env", {})}
    line = [sys.executable, "-m", "warpflag", *arguments]
    return subprocess.run(line, capture_output=True, text=True, errors="replace", env=env, **options)


@dataclass(frozen=True)
class Signalled:
    """How a process ended that got a signal.

    Attributes:
        status: its exit status, minus the number of the signal that it died of.
        said: what it wrote on standard error.
        before: whether it had ended before the signal came.
    """

    status: int
    said: str
    before: bool


def signalled(arguments: Sequence[str], number: signal.Signals, after: float) -> Signalled | None:
    """The command `warpflag` that gets a signal after so much computing [s]; None where it goes on for `PATIENCE` then.

    That of all its processes, which other work on the machine leaves alone: the moments are spread over its life.
    """
    line = [sys.executable, "-m", "warpflag", *arguments]
    process = subprocess.Popen(line, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    while process.poll() is None and computed(process.pid) < after:
        time.sleep(_SECONDS_PER_LOOK)
    time.sleep(after * _TICKS % 1.0 / _TICKS)  # anywhere between two ticks, also where it waits
    before = process.poll() is not None
    process.send_signal(number)
    try:
        _, said = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return None
    return Signalled(process.returncode, said, before)


def computed(process: int) -> float:
    """Computing time of a process and of those that it has started and not yet waited for [s]."""
    total, left = 0.0, [process]
    while left:
        own = Path(f"/proc/{left.pop()}")
        try:
            total += sum(map(int, (own / "stat").read_text().rpartition(")")[2].split()[11:15])) / _TICKS
            for task in (own / "task").iterdir():
                left += map(int, (task / "children").read_text().split())
        except OSError:  # it has ended
            continue
    return total


def timed(*arguments: str) -> tuple[subprocess.CompletedProcess[str], float]:
    """As `command`, and the computing time that it took [s]."""
    before = os.times()
    ended = command(*arguments)
    after = os.times()
    return ended, after.children_user + after.children_system - before.children_user - before.children_system


def problem(ended: subprocess.CompletedProcess[str]) -> str:
    """What is wrong with how a command ended, whatever its status; empty where nothing is."""
    if ended.returncode < 0:
        return f"died of {signal.Signals(-ended.returncode).name}"
    if "Traceback" in ended.stderr or "Error:" in ended.stderr.split("warpflag:")[0]:
        return f"traceback: {ended.stderr.strip().splitlines()[-1]}"
    if ended.returncode not in (0, 1, 2, 3, 130, 143):
        return f"status {ended.returncode}"
    lines = told(ended)
    if ended.returncode == 2 and lines and all(_PROBLEM.match(line) for line in lines):
        return ""  # a line each
    if ended.returncode in (1, 2) and len(lines) != 1:
        return f"status {ended.returncode} with {len(lines)} lines: {ended.stderr[-200:]}"
    return ""


def told(ended: subprocess.CompletedProcess[str]) -> list[str]:
    """Lines on standard error that are no progress."""
    lines = ended.stderr.replace("\r", "\n").splitlines()
    return [line for line in lines if line.strip() and not _PROGRESS.match(line)]


def frames_of(directory: Path) -> dict[str, np.ndarray]:
    """Everything that a record holds of its frames."""
    with Record(directory) as record:
        names = ("times", "steps", "positions", "directors", "motor_angle", "body_position", "body_orientation")
        return {name: np.asarray(getattr(record, name)[:]) for name in names} | record.observables


def same(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    """Whether all frames agree to the last bit."""
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)


def leading(a: dict[str, np.ndarray], b: dict[str, np.ndarray]) -> bool:
    """Whether the frames of a are the first frames of b, to the last bit."""
    count = len(a["times"])
    return same(a, {name: values[:count] for name, values in b.items()})
