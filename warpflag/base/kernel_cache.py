"""The cache of compiled kernels: where it is, and checksums that find a damaged file in it.

Warp loads whatever lies in its cache. A file that a disk or a copy has damaged would crash the process, or compute
other numbers. So each file that was loaded has its CRC-32 in a file beside it, and one that no longer agrees is
removed before it is loaded: Warp then compiles it again.
"""

from __future__ import annotations

import contextlib
import os
import zlib
from collections.abc import Iterable
from pathlib import Path

from warpflag.base.device import start_warp

__all__ = ["keep_checksums", "kernel_folder", "remove_damaged"]

_LOADED_SUFFIXES = (".o", ".cubin", ".ptx", ".meta")  # what Warp reads when it loads a module
_CHECKSUM = ".crc32"


def kernel_folder() -> Path:
    """Where Warp keeps compiled kernels: WARP_CACHE_PATH, or a folder of the user's cache."""
    return Path(start_warp().config.kernel_cache_dir)


def remove_damaged(folders: Iterable[Path]) -> list[Path]:
    """Removes compiled files that no longer have the checksum they were loaded with.

    Args:
        folders: one for each module; those that do not exist are passed over.

    Returns:
        Folders in which a file was damaged; nothing compiled is left in them.

    Raises:
        OSError: a damaged file can't be removed.
    """
    damaged = []
    for folder in folders:
        if any(_checksum(path) != noted for path, noted in _noted(folder).items()):
            for path in _compiled(folder):
                _beside(path).unlink(missing_ok=True)
                path.unlink(missing_ok=True)
            damaged.append(folder)
    return damaged


def keep_checksums(folders: Iterable[Path]) -> None:
    """Notes the checksum of each compiled file that has none yet; where the cache can't be written, none is kept."""
    for folder in folders:
        for path in _compiled(folder):
            if _beside(path).exists():
                continue
            temporary = folder / f"{_beside(path).name}.{os.getpid()}"
            with contextlib.suppress(OSError):
                temporary.write_text(f"{_checksum(path):08x}\n")
                os.replace(temporary, _beside(path))


def _compiled(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.suffix in _LOADED_SUFFIXES)
    except OSError:
        return []


def _beside(path: Path) -> Path:
    return path.with_name(path.name + _CHECKSUM)


def _noted(folder: Path) -> dict[Path, int | None]:
    """Each compiled file that has a checksum, and that checksum; None where it can't be read as one."""
    noted: dict[Path, int | None] = {}
    for path in _compiled(folder):
        try:
            noted[path] = int(_beside(path).read_text(), 16)
        except FileNotFoundError:
            continue
        except (OSError, ValueError):
            noted[path] = None
    return noted


def _checksum(path: Path) -> int:
    try:
        return zlib.crc32(path.read_bytes())
    except OSError:  # gone, or not readable: not what was noted
        return -1
