"""A progress line: simulated time, milliseconds of computing per simulated millisecond, time left."""

from __future__ import annotations

import sys
from collections.abc import Callable
from time import monotonic
from typing import TextIO

__all__ = ["Progress"]

_BAR_CELLS = 16
_TERMINAL_INTERVAL = 0.1
_LOG_INTERVAL = 60.0
_LOG_SHARE = 0.01
_TELLING_SECONDS = 2.0
_TELLING_SHARE = 0.01


class Progress:
    """Shows how far a run is: a bar that is redrawn on a terminal; anywhere else a line a minute, a percent apart.

    The first update sets the point from which speed is measured: call it before the first step (after
    compiling, and at the time from which a run is resumed), then as often as is handy.

    total: time to reach [s, simulated]. stream: where to write. quiet: write nothing. clock: seconds that
    pass, for tests.
    """

    def __init__(
        self,
        total: float,
        stream: TextIO | None = None,
        quiet: bool = False,
        clock: Callable[[], float] = monotonic,
    ):
        self._total = total
        self._stream = sys.stderr if stream is None else stream
        self._quiet = quiet
        self._clock = clock
        self._terminal = self._stream.isatty()
        self._start: tuple[float, float] | None = None
        self._shown_at = 0.0
        self._time: float | None = None
        self._shown: float | None = None
        self._width = 0

    def update(self, time: float) -> None:
        """Reports the simulated time reached [s]."""
        if self._quiet:
            return
        now = self._clock()
        self._time = time
        if self._start is None:
            self._start = (now, time)
            self._shown_at = now
            if self._terminal:
                self._show(now)
        elif now - self._shown_at >= (_TERMINAL_INTERVAL if self._terminal else _LOG_INTERVAL):
            before = self._start[1] if self._shown is None else self._shown
            if self._terminal or time - before >= _LOG_SHARE * self._total:
                self._show(now)

    def close(self) -> None:
        """Shows the last time reported and ends the line."""
        if self._quiet or self._time is None:
            return
        if self._shown != self._time:
            self._show(self._clock())
        if self._terminal:
            self._write("\n")
        self._time = None

    def _show(self, now: float) -> None:
        line = self._line(now)
        if self._terminal:
            self._write("\r" + line.ljust(self._width))
            self._width = len(line)
        else:
            self._write(line + "\n")
        self._shown_at = now
        self._shown = self._time

    def _line(self, now: float) -> str:
        assert self._start is not None and self._time is not None
        fraction = min(1.0, self._time / self._total) if self._total > 0.0 else 1.0
        line = f"{100.0 * fraction:3.0f} %  {1e3 * self._time:.2f} / {1e3 * self._total:.2f} ms"
        if self._terminal:
            filled = int(_BAR_CELLS * fraction)
            line = f"[{'#' * filled}{'.' * (_BAR_CELLS - filled)}] {line}"
        simulated = self._time - self._start[1]
        # What the first moments cost says nothing of the run.
        telling = now - self._start[0] > _TELLING_SECONDS or simulated >= _TELLING_SHARE * self._total
        if simulated > 0.0 and telling:
            cost = (now - self._start[0]) / simulated
            line += f"  {cost:.{0 if cost >= 100.0 else 1}f} ms per ms"
            if self._time < self._total:
                line += f"  {_duration(cost * (self._total - self._time))} left"
        return line

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def _duration(seconds: float) -> str:
    """A span of time to read at a glance: 42 s, 3:07 min, 5:03 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"
