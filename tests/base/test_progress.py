"""The progress line, on a stream and a clock made for the test."""

from __future__ import annotations

import io

import pytest

from warpflag.base.progress import Progress
from warpflag.base.streams import tell


class Screen(io.StringIO):
    def isatty(self):
        return True


class Clock:
    now = 1000.0

    def __call__(self):
        return self.now


def run(stream, clock, *, total=0.015, start=0.0, updates=150, seconds_per_update=0.06, quiet=False):
    """A run that takes 9 s for 15 ms: 600 ms for each."""
    progress = Progress(total, stream, quiet, clock)
    progress.update(start)
    for i in range(1, updates + 1):
        clock.now += seconds_per_update
        progress.update(start + (0.015 - start) * i / 150)
    return progress


def test_a_file_gets_a_line_a_minute():
    stream = io.StringIO()
    run(stream, Clock(), seconds_per_update=5.0).close()  # 750 s
    lines = stream.getvalue().splitlines()
    assert [line[:5] for line in lines[:3]] == ["  8 %", " 16 %", " 24 %"] and len(lines) == 13
    assert "\r" not in stream.getvalue()
    assert "100 %" in lines[-1] and "15.00 / 15.00 ms" in lines[-1] and "left" not in lines[-1]


def test_a_file_gets_a_line_a_percent_where_that_takes_longer():
    stream, clock = io.StringIO(), Clock()
    progress = Progress(100.0, stream, clock=clock)
    progress.update(0.0)
    for i in range(1, 81):
        clock.now += 50.0
        progress.update(i / 4)  # a quarter of a percent in 50 s
    assert [line[:5] for line in stream.getvalue().splitlines()] == [f"{k:3d} %" for k in range(1, 21)]


def test_speed_and_time_left():
    stream, clock = io.StringIO(), Clock()
    run(stream, clock, updates=51, seconds_per_update=6.0)
    line = stream.getvalue().splitlines()[-1]
    assert (
        "33 %" in line and "5.00 / 15.00 ms" in line and "60.0 s per simulated ms" in line and "10:00 min left" in line
    )


@pytest.mark.parametrize(
    ("seconds_per_update", "expected"),
    [(2.0, "3:20 min left"), (60.0, "1:40 h left"), (0.001, "10.0 ms per simulated ms")],
)
def test_time_left_reads_well(seconds_per_update, expected):
    stream = io.StringIO()
    run(stream, Clock(), updates=50, seconds_per_update=seconds_per_update).close()
    assert expected in stream.getvalue().splitlines()[-1]


def test_a_terminal_gets_one_line_redrawn(monkeypatch):
    monkeypatch.setenv("COLUMNS", "120")
    stream = Screen()
    run(stream, Clock()).close()
    text = stream.getvalue()
    assert text.count("\n") == 1 and text.endswith("\n")
    drawn = [line for line in text[:-1].split("\r") if line]
    assert drawn[0].startswith("  0 % |") and " 0.00 / 15.00 ms" in drawn[0]
    assert drawn[-1].startswith("100 % |") and "15.00 / 15.00 ms" in drawn[-1]
    assert "600 ms per simulated ms" in drawn[-1]


@pytest.mark.parametrize("columns", [30, 50, 70])
def test_a_narrow_terminal_gets_a_line_that_fits(columns, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    stream = Screen()
    run(stream, Clock(), updates=75).close()
    drawn = [line.rstrip() for line in stream.getvalue()[:-1].split("\r")]
    assert max(map(len, drawn)) < columns and drawn[-1].startswith(" 50 % |")
    assert ("7.50 / 15.00 ms" in drawn[-1] and "left" in drawn[-1]) == (columns > 30)


def test_a_resumed_run_starts_its_bar_where_it_was(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    stream = Screen()
    run(stream, Clock(), start=0.009, updates=1).close()
    drawn = [line for line in stream.getvalue().split("\r") if line]
    assert drawn[0].startswith(" 60 % |") and "9.00 / 15.00 ms" in drawn[0] and "9.04 / 15.00 ms" in drawn[-1]


def test_a_resumed_run_counts_its_own_speed():
    stream = io.StringIO()
    run(stream, Clock(), start=0.009, updates=75).close()
    line = stream.getvalue().splitlines()[-1]
    assert "80 %" in line and "1.5 s per simulated ms" in line and "4 s left" in line  # 3 ms in 4.5 s, 3 ms to go


def test_quiet_and_unused_are_silent():
    for stream in (io.StringIO(), Screen()):
        run(stream, Clock(), quiet=True).close()
        Progress(1.0, stream).close()
        assert stream.getvalue() == ""


def test_closing_early_shows_where_it_stopped():
    stream = io.StringIO()
    progress = run(stream, Clock(), updates=10)
    assert stream.getvalue() == ""
    progress.close()
    progress.close()
    assert stream.getvalue().splitlines()[0].startswith("  7 %  1.00 / 15.00 ms")
    assert stream.getvalue().count("\n") == 1


def test_a_line_is_told_above_the_bar(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    for stream in (Screen(), io.StringIO()):
        monkeypatch.setattr("sys.stderr", stream)
        progress = run(None, Clock(), updates=75)
        assert tell("one member failed", 3) == 3
        progress.close()
        told = [line for line in stream.getvalue().split("\n") if "failed" in line]
        assert [line.rpartition("\r")[2] for line in told] == ["warpflag: one member failed"]
