"""The file of a record below HDF5: locked for one writer, given its space before HDF5 writes, and synced.

A write that fails inside HDF5 leaves its caches and the file in disagreement: closing the file fails then, or crashes,
and the file can't be opened again. So space is taken from the file system first, where a full disk or a size limit is
an ordinary error and the file stays as it was.
"""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

from warpflag.base.output import DiskError
from warpflag.record.layout import RecordError

__all__ = ["DiskFile"]


class DiskFile:
    """An existing file, open beside HDF5 and locked until `close`.

    Args:
        path: the file.

    Raises:
        RecordError: another process, or another recorder of this one, is writing the file.
        DiskError: the file can't be opened for writing.
    """

    def __init__(self, path: Path):
        self.path = path
        try:
            self._descriptor = os.open(path, os.O_RDWR | getattr(os, "O_CLOEXEC", 0))
        except OSError as error:
            raise DiskError.of(path, error) from error
        try:
            _lock(self._descriptor)
        except OSError:
            os.close(self._descriptor)
            raise RecordError(f"{path}: is being written by another run") from None

    def reserve(self, size: int) -> None:
        """Makes the file at least `size` bytes long, with disk space for all of them.

        Raises:
            DiskError: there is no room; the file has its former length.
        """
        present = os.fstat(self._descriptor).st_size
        if size <= present:
            return
        try:
            _allocate(self._descriptor, present, size - present)
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._descriptor, present)
            raise DiskError.of(self.path, error) from error

    def extend(self, size: int) -> None:
        """Makes the file `size` bytes long, if it can: HDF5 opens no file that is shorter than its header says."""
        with contextlib.suppress(OSError):
            if os.fstat(self._descriptor).st_size < size:
                os.ftruncate(self._descriptor, size)

    def trim(self, size: int) -> None:
        """Gives back what was reserved beyond `size` bytes; call it once HDF5 has closed the file."""
        with contextlib.suppress(OSError):
            if os.fstat(self._descriptor).st_size > size:
                os.ftruncate(self._descriptor, size)

    def sync(self) -> None:
        """Returns once everything written so far would survive a power cut.

        Raises:
            DiskError: the device could not store it.
        """
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # a file system that can't sync
                raise DiskError.of(self.path, error) from error

    def close(self) -> None:
        """Releases the lock."""
        os.close(self._descriptor)


def _lock(descriptor: int) -> None:
    """Takes the lock of an open file; OSError where another holds it. Systems without such locks go without."""
    try:
        import fcntl
    except ImportError:
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EWOULDBLOCK, errno.EACCES, errno.EAGAIN):
            raise


def _allocate(descriptor: int, start: int, count: int) -> None:
    """Takes `count` bytes of disk space behind the end of a file, `start`; they read as zeros."""
    if hasattr(os, "posix_fallocate"):
        try:
            os.posix_fallocate(descriptor, start, count)
            return
        except OSError as error:
            if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP, errno.ENOSYS, errno.ENODEV):
                raise
    os.lseek(descriptor, start, os.SEEK_SET)
    while count > 0:
        count -= os.write(descriptor, bytes(min(count, 1 << 20)))
