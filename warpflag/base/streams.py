"""Messages to standard error or another text stream that may be closed, full, or read by nobody."""

from __future__ import annotations

import sys
from typing import TextIO

__all__ = ["is_terminal", "say"]


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


def is_terminal(stream: TextIO | None) -> bool:
    """Whether a stream is a terminal; not if it is closed or absent."""
    try:
        return stream is not None and stream.isatty()
    except (OSError, ValueError):
        return False
