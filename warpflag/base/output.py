"""Output files: written whole or not at all, and the errors of those that can't be written."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

__all__ = ["DiskError", "OutputError", "machine_error", "missing", "sync_file_systems", "text_of_file", "whole"]


class OutputError(ValueError):
    """A movie, picture or export that can't be made as it was asked for; the message is one line."""


def missing(package: str, extra: str) -> str:
    """How to get a package that is not installed, for a message.

    Args:
        package: its name for pip.
        extra: of this program that has it.
    """
    return f"pip install {package}, or uv run --extra {extra} ..."


class DiskError(OSError):
    """A file that the machine could not write; the message is one line with its path and the reason."""

    @classmethod
    def of(cls, path: str | Path, error: BaseException) -> DiskError:
        """The error for a file at `path` that could not be written because of `error`."""
        if isinstance(error, OSError) and error.errno:
            reason = os.strerror(error.errno)
        else:
            reason = " ".join(str(error).split())
        return cls(f"{path}: can't be written: {reason}")


def text_of_file(path: Path) -> str:
    """What a text file holds.

    Raises:
        OutputError: it is no file, or holds no text. A pipe would be waited for.
    """
    try:
        if path.exists() and not path.is_file():
            raise OutputError(f"{path}: can't be read: it is no file")
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{path}: can't be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise OutputError(f"{path}: is not a text file in UTF-8") from None


@contextlib.contextmanager
def whole(path: Path) -> Iterator[Path]:
    """Yields a temporary path beside `path`, which takes the place of `path` when the block ends without an error.

    Args:
        path: the file to write; its suffix is also that of the temporary path.

    Raises:
        OutputError: the folder of `path` does not exist.
        DiskError: the operating system could not write the file.
    """
    if not path.parent.is_dir():
        raise OutputError(f"{path}: can't be written: there is no folder {path.parent}")
    temporary = path.with_name(f".{path.stem[:100]}.tmp{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        if isinstance(error, DiskError):
            raise
        if error.filename is not None and Path(os.fsdecode(error.filename)) != temporary:
            raise  # of another file, which the message names
        raise DiskError.of(path, error) from error
    finally:
        with contextlib.suppress(OSError):
            temporary.unlink()


def sync_file_systems(folders: Iterable[Path]) -> None:
    """Returns once all that was written so far where these folders lie would survive a power cut.

    For many files that takes a small part of the time that syncing each takes.

    Raises:
        OSError: a device could not store it.
    """
    for folder in {os.stat(folder).st_dev: folder for folder in folders}.values():
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            sync = getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None)
            if sync is None:
                os.sync()
            elif sync(descriptor) != 0:
                number = ctypes.get_errno()
                raise OSError(number, os.strerror(number), str(folder))
        finally:
            os.close(descriptor)


def machine_error(error: OSError) -> str:
    """What the machine refused, in one line."""
    if not error.filename:
        return str(error)
    cache = getattr(getattr(sys.modules.get("warp"), "config", None), "kernel_cache_dir", None)
    place, cache = os.path.realpath(os.fsdecode(error.filename)), os.path.realpath(str(cache)) if cache else ""
    kept = bool(cache) and (place.startswith(cache) or place == os.path.dirname(cache))
    advice = "; kernels are kept there: let WARP_CACHE_PATH name a folder that can be written" if kept else ""
    return f"{error.filename}: {error.strerror}{advice}"
