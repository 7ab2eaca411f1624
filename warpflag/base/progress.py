"""The progress of long work: a bar of tqdm on a terminal or in a notebook, a line now and then in a log."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Any, TextIO

from warpflag.base.streams import is_terminal, say

__all__ = ["Progress", "bar", "watching"]

_MOST_COLUMNS = 100  # columns of a bar: a wider one reads no better
_WIDE = 79  # columns from which on a bar tells the speed, too: below a terminal's usual 80 it does not fit
_LOG_INTERVAL = 60.0  # s between two lines of a log: a night's run fills some hundred lines
_LOG_SHARE = 0.01  # progress between two lines: a run of months writes no more than a hundred


class Progress:
    """Shows how far a run is: a bar on a terminal; anywhere else a line a minute, a percent apart.

    The first update sets the point from which speed is measured: call it before the first step (after
    compiling, and at the time from which a run is resumed), then as often as is handy. A stream that can't be
    written to, because it is closed, full, or its reader has left, makes it silent; the run goes on.

    Args:
        total: simulated time to reach [s].
        stream: where to write; default: standard error.
        quiet: write nothing.
        clock: seconds that pass, for the lines of a log; for tests.
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
        self._bar: Any = None
        self._start: tuple[float, float] | None = None
        self._shown_at = 0.0
        self._time: float | None = None
        self._shown: float | None = None

    def update(self, time: float) -> None:
        """Reports the simulated time reached [s]."""
        if self._quiet:
            return
        now = self._clock()
        self._time = time
        if self._start is None:
            self._start = (now, time)
            self._shown_at = now
            if is_terminal(self._stream):
                layout = "{percentage:3.0f} % |{bar}| {n:.2f} / {total:.2f} ms  {remaining} left{postfix}"
                self._bar = bar(1e3 * self._total, layout, self._stream, 1e3 * time)
        elif self._bar is not None:
            self._bar.set_postfix_str(self._speed(now) if self._bar.ncols >= _WIDE else "", refresh=False)
            self._bar.update(1e3 * time - self._bar.n)
        elif now - self._shown_at >= _LOG_INTERVAL:
            before = self._start[1] if self._shown is None else self._shown
            if time - before >= _LOG_SHARE * self._total:
                self._show(now)

    def close(self) -> None:
        """Shows the last time reported and ends the line."""
        if self._quiet or self._time is None:
            return
        if self._bar is not None:
            self._bar.close()
        elif self._shown != self._time:
            self._show(self._clock())
        self._bar = self._time = None

    def _show(self, now: float) -> None:
        assert self._start is not None and self._time is not None
        fraction = min(1.0, self._time / self._total) if self._total > 0.0 else 1.0
        line = f"{100.0 * fraction:3.0f} %  {1e3 * self._time:.2f} / {1e3 * self._total:.2f} ms"
        speed = self._speed(now)
        if speed:
            cost = (now - self._start[0]) / (self._time - self._start[1])
            left = f"  {_duration(cost * (self._total - self._time))} left" if self._time < self._total else ""
            line += f"  {speed}{left}"
        self._quiet = not say(line + "\n", self._stream)
        self._shown_at = now
        self._shown = self._time

    def _speed(self, now: float) -> str:
        """Computing time of a simulated ms: 2.1 ms, 130 ms, 1.5 s per simulated ms; empty before anything was run."""
        assert self._start is not None and self._time is not None
        simulated = self._time - self._start[1]
        if simulated <= 0.0:
            return ""
        cost = (now - self._start[0]) / simulated
        value, unit = (cost, "ms") if cost < 1000.0 else (cost / 1000.0, "s")
        return f"{value:.{0 if value >= 100.0 else 1}f} {unit} per simulated ms"


def bar(total: float, layout: str, stream: TextIO | None = None, done: float = 0.0) -> Any:
    """A bar of tqdm that fits the terminal and is silent once its stream can't be written to.

    Args:
        total: what is to be done.
        layout: of the line, as the bar_format of tqdm.
        stream: where to write; default: standard error.
        done: what is done already.
    """
    from tqdm import tqdm

    columns = min(_MOST_COLUMNS, shutil.get_terminal_size().columns) - 1
    file: Any = _Silent(sys.stderr if stream is None else stream)
    return tqdm(total=total, initial=done, file=file, ncols=columns, bar_format=layout, smoothing=0.0, miniters=0)


class _Silent:
    """A stream that is not written to again after it once could not be."""

    def __init__(self, stream: TextIO) -> None:
        self._stream, self._works = stream, True

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self._works = self._works and say(text, self._stream)
        return len(text)

    def flush(self) -> None:
        """`write` does it."""


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
    """A bar in a notebook or on a terminal; nothing is written to a log.

    Args:
        shown: whether there is one.
        time: gives the simulated time reached [s].
        end: simulated time to reach [s].

    Returns:
        What is to be called now and then; None without a bar.
    """
    if not shown:
        yield None
        return
    from tqdm.auto import tqdm

    in_notebook = any(kind.__module__ == "tqdm.notebook" for kind in tqdm.__mro__)
    begin = time()
    # disable=None: shown on a terminal only.
    with tqdm(total=round(1e3 * (end - begin), 6), unit="ms", disable=False if in_notebook else None) as shown_bar:

        def watch() -> None:
            shown_bar.update(round(1e3 * (time() - begin) - shown_bar.n, 6))

        yield watch
        watch()
