"""Messages to standard error or another text stream that may be closed, full, or read by nobody."""

from __future__ import annotations

import contextlib
import functools
import os
import sys
from collections.abc import Callable, Iterator
from typing import Any, TextIO

from warpflag.base.exit_status import FAILED

__all__ = ["explained_cache", "is_terminal", "protected_streams", "say", "tell"]


def say(text: str, stream: TextIO | None = None) -> bool:
    """Writes a text and flushes it; a stream that can't take it never stops the program.

    Args:
        text: what is written as it is; characters that the stream can't encode are escaped.
        stream: where to; default: standard error, which is None in a process started without one.

    Returns:
        Whether it was written. After False the stream is better left alone.
    """
    stream = sys.stderr if stream is None else stream
    if stream is None:
        return False
    try:
        encoding = getattr(stream, "encoding", None) or "utf-8"
        stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        stream.flush()
    except (OSError, ValueError):  # full, or without a reader; closed
        return False
    return True


def tell(message: object, status: int = 0) -> int:
    """Tells the user on standard error, above any bar that is shown; each line begins with the program's name.

    Args:
        message: a line or several.
        status: handed back, for a command that ends with these words.
    """
    library = sys.modules.get("tqdm")  # whoever shows a bar has imported it
    bars = list(getattr(library.tqdm, "_instances", ())) if library else []
    for bar in bars:
        bar.clear()
    say("".join(f"warpflag: {line}\n" for line in str(message).splitlines()))
    for bar in bars:
        bar.refresh()
    return status


def is_terminal(stream: TextIO | None) -> bool:
    """Whether a stream is a terminal; not if it is closed or absent."""
    try:
        return stream is not None and stream.isatty()
    except (OSError, ValueError):
        return False


@contextlib.contextmanager
def protected_streams() -> Iterator[None]:
    """While it lasts, what is printed never stops the program; around or, as a decorator, on a whole command.

    Standard streams that are closed are opened on the null device, so that no file of the program takes their place.
    One that is full or has lost its reader goes to the null device from then on.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, this one
    kept = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = _Protected(sys.stdout, 1), _Protected(sys.stderr, 2)
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stdout, sys.stderr = kept


class _Protected:
    """A text stream whose write and flush never raise for want of a reader, of room, or of a character."""

    def __init__(self, stream: TextIO | None, descriptor: int) -> None:
        self._stream = open(os.devnull, "w") if stream is None else stream  # noqa: SIM115 (lasts as long as this does)
        self._descriptor = descriptor

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        try:
            encoding = getattr(self._stream, "encoding", None) or "utf-8"
            return self._stream.write(text.encode(encoding, "backslashreplace").decode(encoding))
        except (OSError, ValueError):
            self._let_go()
            return len(text)

    def flush(self) -> None:
        try:
            self._stream.flush()
        except (OSError, ValueError):
            self._let_go()

    def _let_go(self) -> None:
        """Points the descriptor to the null device, where what the stream still holds can go."""
        with contextlib.suppress(OSError, ValueError):
            if self._stream.fileno() == self._descriptor:
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, self._descriptor)
                os.close(nowhere)


def explained_cache(command: Callable[..., int]) -> Callable[..., int]:
    """A command that tells in one line, with status 1, that Warp can't read a kernel from its cache."""

    @functools.wraps(command)
    def explained(*arguments: Any) -> int:
        try:
            return command(*arguments)
        except Exception as error:
            if not _is_of_cache(error):
                raise
            folder, words = sys.modules["warp"].config.kernel_cache_dir, " ".join(str(error).split())
            return tell(f"kernel cache {folder}: can't be read ({words}); without it kernels compile anew", FAILED)

    return explained


def _is_of_cache(error: BaseException) -> bool:
    """Whether an error comes from where Warp loads a module's kernels."""
    place = error.__traceback__
    while place is not None:
        code = place.tb_frame.f_code
        if code.co_name == "load" and code.co_filename.endswith(os.path.join("warp", "_src", "context.py")):
            return True
        place = place.tb_next
    return False
