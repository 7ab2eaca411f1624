"""One run in its directory: run.h5, movie.usdc, scene.toml, summary.json, and checkpoints to continue from.

A run can be killed at any time: the record holds every frame committed by then, and `resume` goes on from the last
checkpoint with the numbers of a run that was never stopped.
"""

from __future__ import annotations

import json
import math
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

from warpflag.base.progress import Progress
from warpflag.model.start import shape_of_frame
from warpflag.record import RECORD_NAME, Record
from warpflag.record.recorder import Recorder
from warpflag.record.reporters import start_reporter, versions
from warpflag.run import checkpoint
from warpflag.run.faults import NumericalError
from warpflag.run.run_directory import MOVIE_NAME, SCENE_NAME, SUMMARY_NAME, RunError, claim_directory, write_whole
from warpflag.run.simulation import Simulation
from warpflag.run.summary import digest, plain
from warpflag.scene import Scene, SceneError, dumps, load, with_values
from warpflag.scene.scene_file import read_overrides
from warpflag.view.usd import write_movie

__all__ = ["Outcome", "Run", "resume", "start"]

_SECONDS_PER_CHECKPOINT = 5.0
_SECONDS_BEFORE_EXPLAINING = 2.0


@dataclass(frozen=True)
class Outcome:
    """How a run ended.

    status: done; stopped, by a guard; interrupted, by Ctrl-C. message: one line for the user.
    """

    status: str
    message: str


class Run:
    """A simulation that writes its run directory; made by `start` or `resume`.

    began: when, by the monotonic clock [s]; earlier by the time that the run took before it was resumed.
    """

    def __init__(self, directory: Path, simulation: Simulation, recorder: Recorder, began: float) -> None:
        self.directory, self.simulation, self.recorder = directory, simulation, recorder
        self.scene = simulation.scenes[0]
        self._began = began

    def execute(self, quiet: bool = False) -> Outcome:
        """Runs to the end of the scene, or until a guard or Ctrl-C stops it; the directory is complete afterwards."""
        progress = Progress(self.scene.duration, quiet=quiet)
        fault: NumericalError | None = None
        status = "done"
        try:
            start_reporter(self.recorder, self.scene, self.simulation.first_node)
            self._prepare(quiet)
            progress.update(float(self.simulation.times[0]))
            self._record(progress)
        except KeyboardInterrupt:
            status = "interrupted"
        except NumericalError as error:
            status, fault = "stopped", error
        finally:
            progress.close()
            self.recorder.close()
        message = self._finish(status, fault)
        return Outcome(status, f"{self.scene.name}: {message}")

    def _prepare(self, quiet: bool) -> None:
        said = "warpflag: compiling kernels, once on each machine\n"
        timer = threading.Timer(_SECONDS_BEFORE_EXPLAINING, sys.stderr.write, [said])
        if not quiet:
            timer.start()
        try:
            self.simulation.prepare()
        finally:
            timer.cancel()

    def _record(self, progress: Progress) -> None:
        saved = -math.inf
        for frame in self.simulation.frames(self.scene.duration, progress.update):
            self.recorder.write(frame)
            if monotonic() - saved > _SECONDS_PER_CHECKPOINT:
                self.recorder.flush()
                self._save()
                saved = monotonic()

    def _save(self) -> None:
        meta = {
            "step": int(self.simulation.steps[0]),
            "time": float(self.simulation.times[0]),
            "wall_time": monotonic() - self._began,
            "device": self.simulation.device.alias,
            "versions": versions(),
        }
        checkpoint.save(self.directory, self.simulation.checkpoint(), meta)

    def _finish(self, status: str, fault: NumericalError | None) -> str:
        """Last checkpoint, summary and movie; returns what the user is told."""
        if self.recorder.frame_count == 0:
            return f"interrupted before the first frame; start again with --resume {self.directory}"
        if status == "done":  # else the state is one between two frames
            self._save()
        with Record(self.directory) as record:
            found = digest(record, self.scene)
            wall_time = monotonic() - self._began
            ending = {"status": status, "message": str(fault) if fault else "", "wall_time": wall_time}
            summary = {**ending, **self._facts(fault), **found}
            write_whole(self.directory / SUMMARY_NAME, json.dumps(plain(summary), indent=2) + "\n")
            write_movie(record, self.directory / MOVIE_NAME)
        count = found["frames"]
        reached = f"{count} frame{'s' if count > 1 else ''} to {found['time'] * 1e3:.6g} ms"
        return {
            "done": f"{reached} in {wall_time:.1f} s: {self.directory}",
            "interrupted": f"interrupted, {reached} kept; resumable with --resume {self.directory}",
            "stopped": f"{fault}; {reached} kept in {self.directory}",
        }[status]

    def _facts(self, fault: NumericalError | None) -> dict[str, Any]:
        simulation = self.simulation
        memory, system = simulation.stepper.memory(), simulation.system
        violated = None
        if fault:
            place = {"flagellum": fault.flagellum, "segment": fault.segment}
            violated = {"kind": fault.kind.name.lower(), "time": fault.time, **place}
        return {
            "scene": self.scene.name,
            "duration": self.scene.duration,
            "steps": simulation.steps[0],
            "rejected_steps": memory["rejected"][0] if "rejected" in memory else 0,
            "evaluations": memory["evaluations"][0],
            "guards": {"steps_between_checks": system.guard.interval.numpy()[0], "violated": violated},
            "precision": self.scene.numerics.precision,
            "stepper": self.scene.numerics.stepper,
            "device": simulation.device.alias,
            "device_name": simulation.device.name,
            "kernel_flags": system.model.precision.cpu_flags if simulation.device.is_cpu else "",
            "versions": versions(),
        }


def start(scene: Scene, output: str | None = None, device: str | None = None) -> Run:
    """A new run. The directory is made once the scene is known to be sound.

    output: its directory; None: runs/NAME, or runs/NAME-2, -3, ... when taken.

    Raises SceneError, DeviceError, and RunError where `output` holds a run or can't be made.
    """
    began = monotonic()
    simulation = Simulation(scene, device=device)
    directory = claim_directory(scene.name, output)
    write_whole(directory / SCENE_NAME, dumps(scene))
    return Run(directory, simulation, Recorder(directory / RECORD_NAME), began)


def resume(directory: str, overrides: Sequence[str] = (), device: str | None = None) -> Run:
    """The run of a directory from its last checkpoint on, or from its start where it came to none.

    overrides: "duration=..." and nothing else; frames keep their interval. device: None is the one it ran on.

    Raises SceneError, DeviceError, RecordError, CheckpointError, and RunError where there is no run.
    """
    began, path = monotonic(), Path(directory)
    if not (path / SCENE_NAME).is_file():
        raise RunError(f"--resume {directory}: holds no run, there is no {SCENE_NAME}")
    scene = _prolonged(load(path / SCENE_NAME), overrides)
    if not (path / RECORD_NAME).exists():
        return Run(path, Simulation(scene, device=device), Recorder(path / RECORD_NAME), began)
    arrays, meta = checkpoint.load(path)
    if scene.duration < meta["time"] * (1 - 1e-9):
        problem = f"must not be below {meta['time']:g} s, where the run stands"
        raise SceneError("duration", scene.duration, problem, source=f"--resume {directory}")
    with Record(path) as record:
        origin = shape_of_frame(record.frame(0), record.first_node)
    simulation = Simulation(scene, starts=origin, device=device or meta["device"])
    try:
        simulation.restore(arrays)
    except ValueError as error:
        raise RunError(f"--resume {directory}: {error}") from None
    write_whole(path / SCENE_NAME, dumps(scene))
    recorder = Recorder(path / RECORD_NAME, resume_step=meta["step"])
    return Run(path, simulation, recorder, began - meta["wall_time"])


def _prolonged(scene: Scene, overrides: Sequence[str]) -> Scene:
    """The scene with another duration and as many frames as that takes at its interval."""
    values = read_overrides(overrides)
    for key in values.keys() - {"duration"}:
        raise SceneError(key, values[key], "a run that is resumed takes no other change than duration", source="--set")
    if not values:
        return scene
    try:
        longer = with_values(scene, values)
        interval = scene.duration / scene.frames
        frames = round(longer.duration / interval)
        if frames < 1 or abs(frames * interval - longer.duration) > 1e-6 * interval:
            raise SceneError("duration", longer.duration, f"must be a multiple of the frame interval, {interval:g} s")
        return with_values(longer, {"frames": frames})
    except SceneError as error:
        raise error.located("--set") from None
