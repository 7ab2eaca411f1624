"""The directory of a run: what lies in it, and how a new one is found."""

from __future__ import annotations

import contextlib
import itertools
from pathlib import Path

from warpflag.base.output import whole
from warpflag.record import RECORD_NAME

__all__ = ["MOVIE_NAME", "SCENE_NAME", "SUMMARY_NAME", "RunError", "claim_directory", "write_whole"]

MOVIE_NAME, SCENE_NAME, SUMMARY_NAME = "movie.usdc", "scene.toml", "summary.json"


class RunError(ValueError):
    """A run directory that can't be written or continued; one line."""


def claim_directory(name: str, output: str | None) -> Path:
    """Makes the directory of a new run.

    name: of the scene. output: the directory; None: runs/NAME, or runs/NAME-2, -3, ... when taken.

    Raises RunError where `output` holds a run, or where the directory can't be made.
    """
    try:
        return _free_directory(name) if output is None else _named_directory(output)
    except OSError as error:
        raise RunError(f"-o {output or 'runs'}: can't be made: {error.strerror}") from None


def _named_directory(output: str) -> Path:
    """Makes the directory unless it holds a run."""
    directory = Path(output)
    directory.mkdir(parents=True, exist_ok=True)
    for name in (RECORD_NAME, SCENE_NAME, SUMMARY_NAME):
        if (directory / name).exists():
            problem = f"holds a {name}; continue that run with --resume {output}, or name another -o"
            raise RunError(f"-o {output}: {problem}")
    return directory


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
