"""Runs: one scene in its directory, or a batch of scenes that one simulation advances, a directory each.

A run can be killed at any time: the record holds every frame committed by then, and `resume` goes on from the last
checkpoint with the numbers of a run that was never stopped.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpflag import __version__
from warpflag.base.streams import tell
from warpflag.model.start import shape_of_frame
from warpflag.record import RECORD_NAME, Record, RecordError
from warpflag.run import checkpoint
from warpflag.run.carried_values import check_frame
from warpflag.run.execute import Run, in_parts, parts
from warpflag.run.lock import Lock
from warpflag.run.member import Member, Outcome
from warpflag.run.run_directory import (
    SCENE_NAME,
    RunError,
    claim_directory,
    is_of_scene,
    recorded_scene,
    summary_of,
    write_whole,
)
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, SceneError, with_values
from warpflag.scene.scene_file import read_overrides

__all__ = ["Outcome", "Run", "begun_at_checkpoint", "resume", "resume_batch", "start", "start_batch"]

# What is said of a checkpoint, and in which arrays it stands as well.
_META = {"step": int, "time": float, "wall_time": float, "device": str, "versions": dict}
_REPEATED = {"step": "control.steps", "time": "frame.time"}


def start(scene: Scene, output: str | None = None, device: str | None = None, **options: Any) -> Run:
    """A new run. The directory is made once the scene is known to be sound.

    Args:
        scene: to run.
        output: its directory; None: runs/NAME, or runs/NAME-2, -3, ... when taken.
        device: "cpu", "cuda:0", ...; None: the preferred one.
        options: `movies` and `checkpoint_seconds` of `Run`.

    Raises:
        DeviceError: there is no such device.
        LockedError: another process has just taken the directory.
        RunError: `output` holds a run or can't be made.
        SceneError: the scene can't be simulated.
    """
    simulation = Simulation(scene, device=device)
    directory, lock = claim_directory(scene.name, output)
    member = Member(directory, scene, lock)
    write_whole(directory / SCENE_NAME, member.text)
    return Run(simulation, [member], **options)


def start_batch(
    scenes: Sequence[Scene],
    directories: Sequence[Path],
    device: str | None = None,
    strict: bool = False,
    **options: Any,
) -> Run:
    """New runs of scenes that are advanced together, on a CPU in `parts`.

    Args:
        scenes: all with the same precision, stepper and switches.
        directories: of the runs; they hold none yet.
        device: "cpu", "cuda:0", ...; None: the preferred one.
        strict: kernels built without reassociation, for comparisons to the last bit.
        options: `movies` and `checkpoint_seconds` of `Run`.

    Raises:
        As `start`.
    """
    simulations = [Simulation(part, device=device, strict=strict) for part in parts(scenes, device)]
    locks: list[Lock] = []
    members: list[Member] = []
    try:
        for scene, path in zip(scenes, directories, strict=True):
            directory, lock = claim_directory(scene.name, str(path))
            locks.append(lock)
            members.append(Member(directory, scene, lock, alone=len(scenes) == 1))
            write_whole(directory / SCENE_NAME, members[-1].text)
    except BaseException:
        for lock in locks:
            lock.release()
        raise
    of_each = zip(simulations, parts(members, device), strict=True)
    return in_parts([Run(simulation, own, **options) for simulation, own in of_each])


def resume(directory: str, overrides: Sequence[str] = (), device: str | None = None, **options: Any) -> Run:
    """The run of a directory from its last checkpoint on, or from its start where it came to none.

    Args:
        directory: of the run.
        overrides: "duration=..." and nothing else; frames keep their interval.
        device: None: the one it ran on.
        options: `movies` and `checkpoint_seconds` of `Run`.

    Raises:
        CheckpointError: no checkpoint can be read.
        DeviceError: there is no such device.
        LockedError: another process writes the run.
        RecordError: the record can't be read.
        RunError: there is no run, or its files are not of one run.
        SceneError: the scene or the duration is not allowed.
    """
    return resume_batch([directory], overrides, device, **options)


def resume_batch(
    directories: Sequence[str | Path],
    overrides: Sequence[str] = (),
    device: str | None = None,
    strict: bool = False,
    **options: Any,
) -> Run:
    """Runs that are advanced together, on a CPU in `parts`, each from its own last checkpoint on; see `resume`.

    Those that have no checkpoint start again.
    """
    locks: list[Lock] = []
    try:
        stretches = [list(own) for _, own in itertools.groupby(map(Path, directories), begun_at_checkpoint)]
        cut = [part for stretch in stretches for part in parts(stretch, device)]
        return in_parts([_resumed(part, overrides, device, strict, options, locks) for part in cut])
    except BaseException:
        for lock in locks:
            lock.release()
        raise


def _resumed(
    paths: list[Path],
    overrides: Sequence[str],
    device: str | None,
    strict: bool,
    options: dict[str, Any],
    locks: list[Lock],
) -> Run:
    """Runs of one part of a batch: all of them are at a checkpoint, or none; their locks are added to `locks`."""
    scenes, metas, states, origins, own = [], [], [], [], []
    for path in paths:
        if not (path / SCENE_NAME).is_file():
            raise RunError(f"--resume {path}: holds no run, there is no {SCENE_NAME}")
        own.append(Lock(path))
        locks.append(own[-1])
        scenes.append(_prolonged(recorded_scene(path, bool(overrides)), overrides))
    if len(paths) == 1 and _is_done(paths[0], scenes[0]):
        return Run(None, [_done_already(paths[0], scenes[0], own[0])])
    if not begun_at_checkpoint(paths[0]):
        for path in paths:
            (path / RECORD_NAME).unlink(missing_ok=True)  # frames without a checkpoint: they are computed again
        simulation = Simulation(scenes, device=device, strict=strict)
    else:
        for path, scene in zip(paths, scenes, strict=True):
            arrays, meta = _checkpoint(path, scene)
            states.append(arrays)
            metas.append(meta)
            with Record(path) as record:
                origins.append(shape_of_frame(record.frame(0), record.first_node))
                try:
                    check_frame(arrays, record, scene.duration / scene.frames)
                except (KeyError, ValueError) as error:
                    raise _not_sound(path, error) from None
        simulation = Simulation(scenes, starts=origins, device=device or metas[0]["device"], strict=strict)
        try:
            names = states[0].keys()
            simulation.restore({name: np.concatenate([state[name] for state in states]) for name in names})
        except (KeyError, ValueError) as error:
            raise _not_sound(paths[0], error) from None
    members = []
    for k, (path, scene, lock) in enumerate(zip(paths, scenes, own, strict=True)):
        members.append(Member(path, scene, lock, metas[k] if metas else None, alone=len(paths) == 1))
        write_whole(path / SCENE_NAME, members[-1].text)
    return Run(simulation, members, **options)


def _not_sound(path: Path, error: Exception) -> RunError:
    told = f"has no {error}" if isinstance(error, KeyError) else str(error)
    return RunError(f"--resume {path}: its checkpoint: {told}")


def begun_at_checkpoint(directory: Path) -> bool:
    """Whether a run goes on from a checkpoint, and not from its start."""
    return (directory / RECORD_NAME).exists() and checkpoint.exists(directory)


def _checkpoint(path: Path, scene: Scene) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The latest checkpoint whose frame the record holds."""
    with Record(path) as record:
        times, texts = record.times, [(path / SCENE_NAME).read_text(encoding="utf-8"), record.scene_text]

    def fits(meta: Any) -> bool:
        if not isinstance(meta, dict) or not all(isinstance(meta.get(name), kind) for name, kind in _META.items()):
            return False
        if not 0.0 <= meta["wall_time"] < np.inf:
            return False
        return bool((np.abs(times - meta["time"]) <= 1e-12 * abs(meta["time"])).any())

    arrays, meta = checkpoint.load(path, fits)
    if any(meta[name] != arrays.get(array, np.zeros(0)).ravel()[:1] for name, array in _REPEATED.items()):
        raise RunError(f"--resume {path}: its checkpoint is of another step than it says")
    if not is_of_scene(meta, scene, texts):
        raise RunError(f"--resume {path}: its checkpoint is of another scene than {SCENE_NAME}")
    if scene.duration < meta["time"] * (1 - 1e-9):
        problem = f"must not be below {meta['time']:g} s, where the run stands"
        raise SceneError("duration", scene.duration, problem, source=f"--resume {path}")
    if (written := meta["versions"].get("warpflag")) != __version__:
        tell(f"{path} was written by version {written}, this is {__version__}")
    return arrays, meta


def _is_done(path: Path, scene: Scene) -> bool:
    """Whether the summary says so, and the record is there to its end."""
    summary = summary_of(path)
    if summary.get("status") != "done" or summary.get("duration") != scene.duration:
        return False
    try:
        return bool(Record(path).times[-1] >= scene.duration * (1 - 1e-9))
    except (RecordError, IndexError):
        return False


def _done_already(path: Path, scene: Scene, lock: Lock) -> Member:
    member = Member(path, scene, lock)
    lock.release()
    member.outcome = Outcome("done", f"{scene.name}: is done already, {scene.duration * 1e3:.6g} ms: {path}")
    return member


def _prolonged(scene: Scene, overrides: Sequence[str]) -> Scene:
    """The scene with another duration and as many frames as that takes at its interval."""
    values = read_overrides(overrides)
    for key in values.keys() - {"duration"}:
        problem = "a run that is resumed takes no other change than duration; start.record goes on from it with others"
        raise SceneError(key, values[key], problem, source="--set")
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
