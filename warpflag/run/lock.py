"""One writer per run directory: a lock that the operating system lets go when its process ends, however it ends."""

from __future__ import annotations

import os
from pathlib import Path

__all__ = ["LOCK_NAME", "SWEEP_NAME", "Lock", "LockedError"]

LOCK_NAME, SWEEP_NAME = ".lock", "sweep.toml"

_open_files: dict[Path, int] = {}
_held: dict[Path, set[int]] = {}  # bytes of each file that this process has locked


class LockedError(ValueError):
    """Another process writes the run; one line."""


class Lock:
    """Keeps a run directory for this process until `release`, or until the process ends.

    The lock is one byte of the file .lock: in the run directory, or, for a member of a sweep, in the sweep's directory
    at a byte of the member's own, so that a thousand members take one open file.

    Args:
        directory: the run directory; it exists.

    Raises:
        LockedError: the run is being written by another process, or by another run of this one.
    """

    def __init__(self, directory: Path) -> None:
        directory = directory.resolve()
        member = (directory.parent / SWEEP_NAME).is_file() and directory.name.isdecimal()
        file = (directory.parent if member else directory) / LOCK_NAME
        self._key = (file, int(directory.name) + 1 if member else 0)
        if self._key[1] in _held.get(file, ()) or not _locked(*self._key):
            raise LockedError(f"{directory}: is being written by another process")
        _held.setdefault(file, set()).add(self._key[1])

    def release(self) -> None:
        """Lets the directory go; calling it again does nothing."""
        file, slot = self._key
        if slot not in _held.get(file, ()):
            return
        _held[file].discard(slot)
        if _held[file]:
            _unlock(file, slot)
        else:
            del _held[file]
            if file in _open_files:
                os.close(_open_files.pop(file))  # closing lets all locks go


def _locked(file: Path, slot: int) -> bool:
    """Whether the byte could be locked; a file system without locks is taken to have one writer."""
    try:
        import fcntl
    except ImportError:  # no POSIX system
        return True
    if file not in _open_files:
        _open_files[file] = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        fcntl.lockf(_open_files[file], fcntl.LOCK_EX | fcntl.LOCK_NB, 1, slot)
    except (BlockingIOError, PermissionError):
        if not _held.get(file):
            os.close(_open_files.pop(file))
        return False
    except OSError:
        return True
    return True


def _unlock(file: Path, slot: int) -> None:
    try:
        import fcntl

        fcntl.lockf(_open_files[file], fcntl.LOCK_UN, 1, slot)
    except (ImportError, OSError):
        pass
