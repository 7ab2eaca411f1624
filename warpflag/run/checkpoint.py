"""Checkpoints: the state that a run continues from, in small files apart from the record.

A checkpoint appears under its name only when it is whole on the disk (temporary name, fsync, os.replace), and
the one before it is kept: where the newest turns out damaged, the older one is loaded.
"""

from __future__ import annotations

import functools
import io
import json
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["CheckpointError", "exists", "load", "name", "save", "write"]

_TEMPORARY = "checkpoint.tmp"

LONGEST_ZIP = 1 << 31  # bytes: what is longer needs another format of zip
_CHECKPOINTS_KEPT = 2  # the newest, and one to fall back to where that is damaged
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
    write(directory, arrays, meta)
    path = name(directory)
    _sync_directory(Path(directory))
    return path


def write(
    directory: str | Path, arrays: Mapping[str, NDArray[Any]], meta: Mapping[str, Any], sync: bool = True
) -> None:
    """Writes a checkpoint under a temporary name, which `name` replaces; else as `save`.

    Args:
        directory, arrays, meta: as in `save`.
        sync: whether it is on the disk then; if not, it has to be before it gets its name.
    """
    objects = [own for own, array in arrays.items() if np.asarray(array).dtype.hasobject]
    if objects:
        raise ValueError(f"a checkpoint holds no arrays of objects: {objects}")
    # Prefixed, so that an array may have any name; npz keeps a CRC of each entry, which loading checks.
    entries: dict[str, Any] = {f"array.{own}": array for own, array in arrays.items()}
    with open(Path(directory) / _TEMPORARY, "wb") as file:
        file.write(npz_bytes({"meta": np.array(json.dumps(dict(meta))), **entries}))
        if sync:
            file.flush()
            os.fsync(file.fileno())


def name(directory: str | Path, sync: bool = False) -> Path:
    """Gives the checkpoint that `write` has written its name, and removes all but the last two; its path.

    Args:
        directory: of the run.
        sync: whether it has yet to be brought to the disk.
    """
    directory = Path(directory)
    if sync:
        with open(directory / _TEMPORARY, "rb+") as file:
            os.fsync(file.fileno())
    numbered = _numbered(directory)
    path = directory / f"checkpoint-{numbered[-1][0] + 1 if numbered else 0:06d}.npz"
    os.replace(directory / _TEMPORARY, path)
    for _, old in numbered[: len(numbered) + 1 - _CHECKPOINTS_KEPT]:
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
        if not path.is_file():  # a pipe would be waited for
            continue
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


def npz_bytes(arrays: Mapping[str, Any], longest: int = LONGEST_ZIP) -> bytes:
    """Arrays as the bytes of a file of NumPy, as `np.savez` writes it, which takes ten times as long for small ones.

    Args:
        arrays: by name.
        longest: size from which `np.savez` itself writes them [bytes].
    """
    content, directory = bytearray(), bytearray()
    for name, array in arrays.items():
        array = np.asarray(array, order="C")
        entry, data = f"{name}.npy".encode(), _header(array.dtype.str, array.shape) + array.tobytes()
        if len(content) + len(data) > longest:
            file = io.BytesIO()
            np.savez(file, **dict[str, Any](arrays))
            return file.getvalue()
        # Version to read it, flags (a name in UTF-8), no compression, 1 January 1980, then checksum and sizes.
        common = struct.pack("<5H3I2H", 20, 0x800, 0, 0, 33, zlib.crc32(data), len(data), len(data), len(entry), 0)
        directory += b"PK\x01\x02\x14\x00" + common + struct.pack("<3H2I", 0, 0, 0, 0, len(content)) + entry
        content += b"PK\x03\x04" + common + entry + data
    ending = struct.pack("<4H2IH", 0, 0, len(arrays), len(arrays), len(directory), len(content), 0)
    return bytes(content + directory + b"PK\x05\x06" + ending)


@functools.lru_cache(maxsize=1024)
def _header(kind: str, shape: tuple[int, ...]) -> bytes:
    """What a file of NumPy has before the numbers of an array of a dtype and shape."""
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(file, {"descr": kind, "fortran_order": False, "shape": shape})
    return file.getvalue()


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
