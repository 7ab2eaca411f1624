"""What ends a run before its time, resumable: a signal, or the wall time that it was given."""

from __future__ import annotations

import re
import signal
import threading
from time import monotonic
from types import TracebackType
from typing import Any

__all__ = ["Ended", "Stop", "wall_seconds"]

_TERMINATING = ("SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2", "SIGXCPU")


class Ended(KeyboardInterrupt):
    """The run is to end now; status "interrupted" for Ctrl-C, "terminated" for the rest."""

    def __init__(self, status: str, reason: str) -> None:
        super().__init__(reason)
        self.status, self.reason = status, reason


class Stop:
    """Notices signals while its `with` block runs; the run asks `check` at moments when it can end in order.

    Ctrl-C (INT) interrupts; TERM, HUP, USR1, USR2 and XCPU terminate, as does the wall time. A second INT ends the
    process wherever it is.

    Args:
        max_wall: wall time from now on after which the run is to end [s]; None: no limit.

    Attributes:
        at_once: whether a signal raises Ended wherever the program is: while it compiles, for instance. Not while
            modules are imported or files written, which would be left half done.
    """

    def __init__(self, max_wall: float | None = None) -> None:
        self._deadline = None if max_wall is None else monotonic() + max_wall
        self._asked: Ended | None = None
        self._handlers: dict[int, Any] = {}
        self.at_once = False

    def __enter__(self) -> Stop:
        if threading.current_thread() is threading.main_thread():
            names = [name for name in ("SIGINT", *_TERMINATING) if hasattr(signal, name)]
            for number in (getattr(signal, name) for name in names):
                self._handlers[number] = signal.signal(number, self._take)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}

    def check(self) -> None:
        """Raises Ended once a signal has come or the wall time is over."""
        if self._asked is None and self._deadline is not None and monotonic() > self._deadline:
            self._asked = Ended("terminated", "the wall time is over")
        if self._asked is not None:
            raise self._asked

    def _take(self, number: int, frame: object) -> None:
        interrupt = number == signal.SIGINT
        again = self._asked is not None
        if not again:
            self._asked = Ended(*(("interrupted", "") if interrupt else ("terminated", signal.Signals(number).name)))
        if self.at_once or (again and interrupt):
            raise self._asked or KeyboardInterrupt


def wall_seconds(text: str) -> float:
    """A wall time in seconds from "90", "1:30:00" or "2-00:00:00" (days-hours:minutes:seconds).

    Raises:
        ValueError: it is neither.
    """
    match = re.fullmatch(r"(?:(\d+)-)?(?:(\d+):)?(?:(\d+):)?(\d+(?:\.\d*)?)", text.strip())
    if not match:
        raise ValueError(f"{text} is no time; write seconds, minutes:seconds, hours:minutes:seconds or days-hours:...")
    days, first, second, seconds = match.groups()
    hours, minutes = (first, second) if second is not None else (None, first)
    return float(seconds) + 60 * int(minutes or 0) + 3600 * int(hours or 0) + 86400 * int(days or 0)
