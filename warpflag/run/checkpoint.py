"""Checkpoints: the state that a run continues from, in small files apart from the record.

A checkpoint appears under its name only when it is whole on the disk (temporary name, fsync, os.replace), and
the one before it is kept: where the newest turns out damaged, the older one is loaded.
"""

from __future__ import annotations

import json
import os
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["CheckpointError", "exists", "load", "save"]

_KEPT = 2  # the newest, and one to fall back to where that is damaged
_NAME = re.compile(r"checkpoint-(\d+)\.npz")


class CheckpointError(ValueError):
    """No checkpoint to continue from; the message is one line that names the directory."""


def save(directory: str | Path, arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any]) -> Path:
    """Writes a checkpoint into a run directory and removes all but the last two.

    Args:
        directory: of the run.
        arrays: by name, any shape and dtype but objects.
        meta: what JSON can hold (time, step, ...).

    Returns:
        Its path; from then on the checkpoint survives the end of the process and a power cut.

    Raises:
        ValueError: an array holds objects.
    """
    objects = [name for name, array in arrays.items() if np.asarray(array).dtype.hasobject]
    if objects:
        raise ValueError(f"a checkpoint holds no arrays of objects: {objects}")
    directory = Path(directory)
    numbered = _numbered(directory)
    path = directory / f"checkpoint-{numbered[-1][0] + 1 if numbered else 0:06d}.npz"
    temporary = directory / "checkpoint.tmp"
    # Prefixed, so that an array may have any name; npz keeps a CRC of each entry, which loading checks.
    entries: dict[str, Any] = {f"array.{name}": array for name, array in arrays.items()}
    with open(temporary, "wb") as file:
        np.savez(file, meta=np.array(json.dumps(dict(meta))), **entries)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)
    _sync_directory(directory)
    for _, old in numbered[: len(numbered) + 1 - _KEPT]:
        old.unlink(missing_ok=True)
    return path


def load(
    directory: str | Path, fits: Callable[[dict[str, Any]], bool] = lambda meta: True
) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
    """The arrays and meta of the latest checkpoint in a run directory that can be read whole and fits.

    Args:
        directory: of the run.
        fits: whether a checkpoint of this meta may be taken; else the one before it is looked at.

    Raises:
        CheckpointError: there is none.
    """
    numbered, readable = _numbered(Path(directory)), 0
    for _, path in reversed(numbered):
        try:
            with np.load(path, allow_pickle=False) as data:
                meta = json.loads(str(data["meta"]))
                arrays = {name[len("array.") :]: data[name] for name in data.files if name != "meta"}
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile):
            continue
        readable += 1
        if fits(meta):
            return arrays, meta
    if not numbered:
        found = "it holds none"
    elif not readable:
        found = f"none of its {len(numbered)} can be read"
    else:
        found = "none belongs to a frame of its record"
    raise CheckpointError(f"{directory}: no checkpoint to continue from, {found}")


def exists(directory: str | Path) -> bool:
    """Whether a run directory holds any checkpoint, sound or not."""
    return bool(_numbered(Path(directory)))


def _numbered(directory: Path) -> list[tuple[int, Path]]:
    """The checkpoints of a directory by number, oldest first."""
    matches = ((_NAME.fullmatch(path.name), path) for path in directory.glob("checkpoint-*.npz"))
    return sorted((int(match[1]), path) for match, path in matches if match)


def _sync_directory(directory: Path) -> None:
    """Makes the rename itself last; a file system that can't sync a directory is taken at its word."""
    try:
        descriptor = os.open(directory, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        pass
    finally:
        os.close(descriptor)
