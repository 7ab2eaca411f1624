"""The progress line of a run: simulated time, computing time per simulated millisecond, time left."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import TextIO

from warpflag.base.streams import is_terminal, say

__all__ = ["Progress", "watching"]

_BAR_CELLS = 10
_NARROWEST = 30  # columns: percentage and times stand in any case
_TERMINAL_INTERVAL = 0.1
_LOG_INTERVAL = 60.0
_LOG_SHARE = 0.01
# The speed is shown once this much has been run, in seconds or as a share of the whole: the first moments cost more.
_SECONDS_BEFORE_SPEED = 2.0
_SHARE_BEFORE_SPEED = 0.01


class Progress:
    """Shows how far a run is: a bar that is redrawn on a terminal; anywhere else a line a minute, a percent apart.

    The first update sets the point from which speed is measured: call it before the first step (after
    compiling, and at the time from which a run is resumed), then as often as is handy. A stream that can't be
    written to, because it is closed, full, or its reader has left, makes it silent; the run goes on.

    Args:
        total: simulated time to reach [s].
        stream: where to write; default: standard error.
        quiet: write nothing.
        clock: seconds that pass, for tests.
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
        self._terminal = is_terminal(self._stream)
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
        filled = int(_BAR_CELLS * fraction)
        bar = f"[{'#' * filled}{'.' * (_BAR_CELLS - filled)}] " if self._terminal else ""
        simulated = self._time - self._start[1]
        elapsed = now - self._start[0]
        known = elapsed > _SECONDS_BEFORE_SPEED or simulated >= _SHARE_BEFORE_SPEED * self._total
        if simulated > 0.0 and known:
            cost = elapsed / simulated
            speed = f"  {_cost(cost)} per simulated ms"
            left = f"  {_duration(cost * (self._total - self._time))} left" if self._time < self._total else ""
            return next(x for x in (bar + line + speed + left, bar + line + left, line + left, line) if self._fits(x))
        return bar + line if self._fits(bar + line) else line

    def _fits(self, line: str) -> bool:
        """Whether the terminal is wide enough for a line; the last choice is taken in any case."""
        return not self._terminal or len(line) < shutil.get_terminal_size().columns or len(line) < _NARROWEST

    def _write(self, text: str) -> None:
        if not say(text, self._stream):
            self._quiet = True


def _cost(cost: float) -> str:
    """Computing time of a simulated ms: 2.1 ms, 130 ms, 1.5 s.

    Args:
        cost: in seconds per simulated second.
    """
    value, unit = (cost, "ms") if cost < 1000.0 else (cost / 1000.0, "s")
    return f"{value:.{0 if value >= 100.0 else 1}f} {unit}"


def _duration(seconds: float) -> str:
    """A span of time as it is read most easily: 42 s, 3:07 min, 5:03 h."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02d} min"
    return f"{whole // 3600}:{whole % 3600 // 60:02d} h"


@contextmanager
def watching(shown: bool, time: Callable[[], float], end: float) -> Iterator[Callable[[], None] | None]:
    """A bar of tqdm, in a notebook or on a terminal; nothing is written to a log.

    Args:
        shown: whether there is one.
        time: gives the simulated time reached [s].
        end: simulated time to reach [s].

    Returns:
        What is to be called now and then; None without a bar.

    Raises:
        ModuleNotFoundError: tqdm is not installed.
    """
    if not shown:
        yield None
        return
    try:
        from tqdm.auto import tqdm
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("progress=True needs tqdm: pip install 'warpflag[notebook]'", name="tqdm") from error
    in_notebook = any(kind.__module__ == "tqdm.notebook" for kind in tqdm.__mro__)
    begin = time()
    # disable=None: shown on a terminal only.
    with tqdm(total=round(1e3 * (end - begin), 6), unit="ms", disable=False if in_notebook else None) as bar:

        def watch() -> None:
            bar.update(round(1e3 * (time() - begin) - bar.n, 6))

        yield watch
        watch()
