"""A worker of a sweep: a process that runs batches as they come on its standard input, and answers on its output.

Requests and answers are JSON, one a line. A request is a batch: {"batch" (its number), "directories", "scenes" (TOML
texts), "device", "options"}; {"measure": [TOML texts], "device", "quiet"} asks what a cell of these costs in a batch.
Answers: {"reached" (simulated time [s]), "members_left", "seconds_left"} while it runs, then {"outcomes": [[status,
message], ...]}; or {"seconds"}. {"hand_back": number} ends the batch of that number resumable, if it still runs; its
members that are not done are then "terminated". At the end of its input, also when the process that started it is gone,
the worker ends its batch resumable.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable, Collection
from pathlib import Path
from time import monotonic, perf_counter, process_time
from typing import Any, TextIO

from warpflag.run import run
from warpflag.run.faults import NumericalError
from warpflag.run.member import Outcome
from warpflag.run.run_directory import SCENE_NAME
from warpflag.run.simulation import Simulation
from warpflag.run.stop import Ended, Stop
from warpflag.scene import Scene, loads

__all__ = ["cost", "main", "prepare"]

_SECONDS_PER_REPORT = 0.2  # between two reports of the time reached: five a second
_LEAST_SEEN = 1.0  # wall time [s] from which a worker tells how long its batch will take: the first steps are short
_SAMPLE_SECONDS = 0.1  # of computing, which a sample takes at least: long enough to be timed to some per cent
_FIRST_PART = 64  # the first sample is the simulated time over this; each further one is twice as long
_loaded: set[str] = set()  # devices on which kernels were loaded before


def prepare(given: dict[str, Any]) -> None:
    """Loads what every worker needs: the modules that a run imports late, and the kernels of a scene.

    Args:
        given: the scene as TOML, `scene`, and whether it is `quiet` while kernels are compiled.
    """
    import h5py  # noqa: F401

    with contextlib.suppress(OSError, ValueError, RuntimeError):  # the worker that runs it tells what is wrong
        _load_kernels(loads(given["scene"]), "cpu", given["quiet"])


def main() -> None:
    """Answers requests until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # between batches it ends the process without a word
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print does not get between the answers
    requests: queue.Queue[dict[str, Any] | None] = queue.Queue()
    handed_back: set[int] = set()
    threading.Thread(target=_listen, args=(sys.stdin, requests, handed_back), daemon=True).start()
    while (request := requests.get()) is not None:
        with Stop() as stop:
            try:
                measure = "measure" in request
                _answer(answers, _measured(request) if measure else _run(request, answers, stop, handed_back))
            except KeyboardInterrupt:
                return
            except (OSError, ValueError) as error:
                message = " ".join(str(error).split())
                _answer(answers, {"outcomes": [["failed", message]] * len(request.get("directories", [0]))})


def _listen(stream: TextIO, requests: queue.Queue[dict[str, Any] | None], handed_back: set[int]) -> None:
    with contextlib.suppress(ValueError):  # of a request that was not written to its end: the sweep was killed
        for line in stream:
            request = json.loads(line)
            if "hand_back" in request:
                handed_back.add(request["hand_back"])
            else:
                requests.put(request)
    requests.put(None)
    os.kill(os.getpid(), signal.SIGTERM)  # ends what is running; without a run, the process


def _answer(answers: TextIO, answer: dict[str, Any]) -> None:
    try:
        answers.write(json.dumps(answer) + "\n")
        answers.flush()
    except BrokenPipeError:  # the sweep was killed: the end of the input, which comes as well, ends the batch in order
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, answers.fileno())
        os.close(nowhere)


class _Reports:
    """Says a few times a second how far a run is, and ends it when it is to be handed back.

    Args:
        answers: where it is said.
        started: the run.
        is_handed_back: whether it is to end.
    """

    def __init__(self, answers: TextIO, started: run.Run, is_handed_back: Callable[[], bool]) -> None:
        self._answers, self._run, self._is_handed_back = answers, started, is_handed_back
        self._reported, self._first = -math.inf, (0.0, 0.0)

    def __call__(self, reached: float) -> None:
        """Takes note of the simulated time that all members together have reached [s]."""
        if self._is_handed_back():
            raise Ended("terminated", "")
        now = monotonic()
        if self._reported == -math.inf:
            self._first = (now, reached)
        elif now - self._reported < _SECONDS_PER_REPORT:
            return
        self._reported = now
        left = self._left()
        report = {"reached": reached, "members_left": len(left), "seconds_left": self._seconds(now, reached, sum(left))}
        _answer(self._answers, report)

    def _left(self) -> list[float]:
        """Simulated time that is left to each member that still goes on [s]."""
        members, times = self._run.members, self._run.simulation.times
        own = zip(members, times, strict=True)
        return [max(m.scene.duration - float(time), 0.0) for m, time in own if m.outcome is None]

    def _seconds(self, now: float, reached: float, left: float) -> float:
        """Wall time that so much simulated time will take [s]; 0 while that is not known."""
        seen, simulated = now - self._first[0], reached - self._first[1]
        return left * seen / simulated if seen > _LEAST_SEEN and simulated > 0.0 else 0.0


def _run(request: dict[str, Any], answers: TextIO, stop: Stop, handed_back: Collection[int]) -> dict[str, Any]:
    """Runs a batch; where it can't begin together, each member by itself."""
    directories = [Path(directory) for directory in request["directories"]]
    scenes = [loads(text) for text in request["scenes"]]

    def ended(batch: slice) -> list[Outcome]:
        started = _started(directories[batch], scenes[batch], request)
        reports = _Reports(answers, started, lambda: request["batch"] in handed_back)
        return started.execute_all(quiet=True, stop=stop, watch=reports)

    try:
        outcomes = ended(slice(None))
    except (OSError, ValueError) as error:
        if len(scenes) == 1:
            raise error
        outcomes = []
        for k in range(len(scenes)):
            try:
                outcomes += ended(slice(k, k + 1))
            except (OSError, ValueError) as own:
                outcomes.append(Outcome("failed", f"{scenes[k].name}: {' '.join(str(own).split())}"))
    return {"outcomes": [[outcome.status, outcome.message] for outcome in outcomes]}


def _started(directories: list[Path], scenes: list[Scene], request: dict[str, Any]) -> run.Run:
    options = {"device": request["device"], **request["options"]}
    if all((directory / SCENE_NAME).exists() for directory in directories):
        return run.resume_batch(directories, **options)
    return run.start_batch(scenes, directories, **options)


def _load_kernels(scene: Scene, device: str, quiet: bool) -> None:
    Simulation(scene, device=device).load(recording=True, quiet=quiet)
    _loaded.add(device)


def _measured(request: dict[str, Any]) -> dict[str, Any]:
    scenes = [loads(text) for text in request["measure"]]
    if request["device"] not in _loaded:
        _load_kernels(scenes[0], request["device"], request["quiet"])
    return {"seconds": cost(scenes, request["device"])}


def cost(scenes: list[Scene], device: str | None) -> float:
    """Time per cell of a batch's start and of stepping until its longest scene ends, by a part of that [s].

    Args:
        scenes: of the cells.
        device: to compute on; on the CPU the time is that of computing.
    """
    clock = process_time if device == "cpu" else perf_counter  # a core is shared with what else the machine does
    began = clock()
    simulation = Simulation(scenes, device=device)
    simulation.prepare()
    started = clock() - began
    # Advances that double until one is long enough to time: the first steps after a start are short ones.
    reached, end = 0.0, min(scene.duration for scene in scenes)
    until = end / _FIRST_PART
    while True:
        began = clock()
        with contextlib.suppress(NumericalError):
            simulation.advance(until)
        taken = clock() - began
        if taken > _SAMPLE_SECONDS or until >= end:
            break
        reached, until = until, min(2 * until, end)
    stepping = taken / (until - reached) * max(scene.duration for scene in scenes)
    return (started + stepping) / len(scenes)


if __name__ == "__main__":
    main()
