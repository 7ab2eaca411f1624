"""The directory of a run: what lies in it, how a new one is found, and whether its parts belong together."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import itertools
import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from warpflag.base.output import whole
from warpflag.record import RECORD_NAME, Record
from warpflag.run.lock import SWEEP_NAME, Lock
from warpflag.scene import Scene, SceneError, dumps, load, loads

__all__ = [
    "COURSE_NAME",
    "MOVIE_NAME",
    "SCENE_NAME",
    "SUMMARY_NAME",
    "RunError",
    "check_same_scene",
    "claim_directory",
    "is_of_scene",
    "recorded_scene",
    "settings_of",
    "settings_sha256",
    "summary_of",
    "write_whole",
]

MOVIE_NAME, SCENE_NAME, SUMMARY_NAME = "movie.usdc", "scene.toml", "summary.json"
COURSE_NAME = "course.npz"
"""What only the directory of a trade-off has, beside a scene."""
_NOT_OF_THE_MOTION = ("duration", "frames", "behaviour")


class RunError(ValueError):
    """A run directory that can't be written or continued; one line."""


def claim_directory(name: str, output: str | None) -> tuple[Path, Lock]:
    """Makes the directory of a new run and locks it.

    Args:
        name: of the scene.
        output: the directory; None: runs/NAME, or runs/NAME-2, -3, ... when taken.

    Raises:
        LockedError: another process has just taken the directory.
        RunError: the directory holds a run, or there can be no directory of that name.
        OSError: the machine refuses it.
    """
    try:
        if output is None:
            directory = _free_directory(name)
            return directory, Lock(directory)
        directory = Path(output)
        directory.mkdir(parents=True, exist_ok=True)
        lock = Lock(directory)
    except OSError as error:
        if error.errno not in (errno.EEXIST, errno.ENOTDIR, errno.ENAMETOOLONG):
            raise
        named = f"-o {output}" if output else f"runs/{name}"
        raise RunError(f"{named}: can't be made: {error.strerror}") from None
    if (directory / COURSE_NAME).exists():
        lock.release()
        raise RunError(f"-o {output}: holds a trade-off (warpflag tradeoff); name another -o")
    for taken in (RECORD_NAME, SCENE_NAME, SUMMARY_NAME, SWEEP_NAME):
        if (directory / taken).exists():
            lock.release()
            problem = f"holds a {taken}; continue that run with --resume {output}, or name another -o"
            raise RunError(f"-o {output}: {problem}")
    return directory, lock


def _free_directory(name: str) -> Path:
    """Makes runs/NAME, or the first of runs/NAME-2, -3, ... that is not there yet."""
    runs = Path("runs")
    runs.mkdir(exist_ok=True)
    for number in itertools.count(1):
        directory = runs / (name if number == 1 else f"{name}-{number}")
        with contextlib.suppress(FileExistsError):
            directory.mkdir()
            break
    return directory


def write_whole(path: Path, text: str) -> None:
    """Writes a text file that is whole or absent."""
    with whole(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def summary_of(directory: Path) -> dict[str, Any]:
    """The summary of a run directory; empty where there is none, or one of another scene than the directory's."""
    path = directory / SUMMARY_NAME
    try:
        summary = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        if not isinstance(summary, dict):
            return {}
        own = summary.get("scene_sha256")  # versions before this one did not write it
        return summary if own is None or own == _sha256((directory / SCENE_NAME).read_text(encoding="utf-8")) else {}
    except (OSError, ValueError, RecursionError):
        return {}


def settings_sha256(scene: Scene, text: str | None = None, defaults: str | None = None) -> str:
    """Hash of everything in a scene but duration, frames and behaviour: equal hashes mean the same motion.

    Only what differs from the defaults counts, so that a setting that a later version adds changes nothing.

    Args:
        scene: what is run.
        text: the scene as TOML, where it is at hand.
        defaults: the scene of defaults alone as TOML; None: this version's.
    """
    values = settings_of(scene, text)
    default = _default_settings() if defaults is None else settings_of(_DEFAULT_SCENE, defaults)
    default = {**default, "name": values["name"]}
    lines = [f"{key} = {value}" for key, value in values.items() if value != default.get(key, "none")]
    chosen = sorted(line for line in lines if line.partition(" ")[0] not in _NOT_OF_THE_MOTION)
    return hashlib.sha256("\n".join(chosen).encode()).hexdigest()


_DEFAULT_SCENE = Scene(name="default")


@functools.cache
def _default_settings() -> dict[str, str]:
    return settings_of(_DEFAULT_SCENE)


def is_of_scene(meta: Mapping[str, Any], scene: Scene, texts: Iterable[str]) -> bool:
    """Whether a checkpoint is of a scene.

    Args:
        meta: of the checkpoint.
        scene: of the run.
        texts: of the scene in the run's files, which checkpoints of earlier versions hash.
    """
    if "settings_sha256" in meta:
        return meta["settings_sha256"] == settings_sha256(scene)
    if "motion_sha256" in meta:
        values = [re.sub(r" *#.*", "", _dynamics(text)) for text in (*texts, dumps(scene))]
        return any(meta["motion_sha256"] == _sha256(text) for text in values)
    return any(meta.get("dynamics_sha256") == _sha256(_dynamics(text)) for text in texts)


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _dynamics(text: str) -> str:
    return re.sub(rf"^({'|'.join(_NOT_OF_THE_MOTION)}) = .*\n", "", text, flags=re.MULTILINE)


def recorded_scene(directory: Path, prolonged: bool) -> Scene:
    """The scene of a run directory, as its scene.toml and its record agree on it.

    Args:
        directory: of a run.
        prolonged: whether a new duration is given, so that theirs may differ.

    Raises:
        RecordError: the record can't be read.
        RunError: there is no scene, it is empty, or the record is of another one.
        SceneError: the scene file is not valid.
    """
    path, record_path = directory / SCENE_NAME, directory / RECORD_NAME
    if not path.is_file():
        raise RunError(f"--resume {directory}: holds no run, there is no {SCENE_NAME}")
    if (directory / COURSE_NAME).exists() and not record_path.exists():
        raise RunError(f"--resume {directory}: holds a trade-off, which warpflag tradeoff goes on with, and no run")
    if not path.read_text(encoding="utf-8", errors="replace").strip():
        raise RunError(f"--resume {directory}: {SCENE_NAME} is empty; the record's /parameters/scene has its text")
    scene = load(path)
    if not record_path.exists():
        return scene
    with Record(record_path) as record:
        text = record.scene_text
    try:
        recorded = loads(text)
    except SceneError as error:
        raise RunError(f"--resume {directory}: {RECORD_NAME}: its scene can't be read: {error}") from None
    texts = dumps(recorded), dumps(scene)
    different = _dynamics(texts[0]) != _dynamics(texts[1]) if prolonged else texts[0] != texts[1]
    if different:
        difference = _difference(recorded, scene)
        problem = f"{SCENE_NAME} is not the scene of {RECORD_NAME}: {difference}; only --set duration=... may change"
        raise RunError(f"--resume {directory}: {problem}")
    return scene


def check_same_scene(directory: Path, scene: Scene) -> None:
    """That a scene is the one of a run directory.

    Raises:
        RunError: it is another one, and in which setting.
    """
    recorded = (directory / SCENE_NAME).read_bytes()
    text = dumps(scene)
    if recorded == text.encode():
        return
    there = load(directory / SCENE_NAME)
    if dumps(there) != text:
        raise RunError(f"{directory}: holds the run of another scene: {_difference(there, scene)}")


def _difference(recorded: Scene, scene: Scene) -> str:
    """The first setting in which two scenes differ, in words."""
    old, new = settings_of(recorded), settings_of(scene)
    key = next(key for key in [*old, *new] if old.get(key) != new.get(key))
    return f"{key} = {new.get(key, 'none')}, recorded with {old.get(key, 'none')}"


def settings_of(scene: Scene, text: str | None = None) -> dict[str, str]:
    """All values of a scene as they are written, by dotted key; "none" where a value is absent."""
    settings: dict[str, str] = {}
    section, tables = "", 0
    for line in (text or dumps(scene)).splitlines():
        header, key, value = _parts(line)
        if header:
            section = header
            if line.startswith("[["):
                section, tables = f"{section}.{tables}", tables + 1
        elif key:
            settings[f"{section}.{key}" if section else key] = value
    return settings


@functools.lru_cache(maxsize=4096)  # scenes of a batch have most of their lines in common
def _parts(line: str) -> tuple[str, str, str]:
    """Of a line of a scene: the name of a table, or the key of a value and the value; empty where it has none."""
    if header := re.match(r"\[+([\w.]+)\]+", line):
        return header[1], "", ""
    if value := re.match(r"(?:# )?(\w+) =\s*(.*?)\s*(?:#.*)?$", line):
        return "", value[1], value[2] or "none"
    return "", "", ""
