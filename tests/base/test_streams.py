"""Streams that can't be written to: what is said to them is lost, and nothing else."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest

from warpflag.base.progress import Progress
from warpflag.base.streams import is_terminal, protected_streams, say


def closed() -> io.TextIOWrapper:
    stream = io.TextIOWrapper(io.BytesIO(), encoding="utf-8")
    stream.close()
    return stream


def without_reader() -> io.TextIOWrapper:
    reader, writer = os.pipe()
    os.close(reader)
    return os.fdopen(writer, "w")


def full() -> io.TextIOWrapper:
    return open("/dev/full", "w")


BROKEN = [closed, without_reader, *([full] if os.path.exists("/dev/full") else [])]


def let_go(stream: io.TextIOWrapper) -> None:
    """Closes a broken stream without the error that its unwritten text would raise."""
    with contextlib.suppress(OSError, ValueError):
        stream.close()


@pytest.mark.parametrize("broken", BROKEN)
def test_progress_goes_on_in_silence_where_its_stream_is_broken(broken):
    stream = broken()
    assert not is_terminal(stream) and not say("a line\n", stream)
    now = [0.0]
    progress = Progress(1e-3, stream, clock=lambda: now[0])
    for step in range(4):
        now[0] += 100.0
        progress.update(1e-4 * step)
    progress.close()
    let_go(stream)


def test_progress_tries_a_broken_stream_once():
    class Broken(io.StringIO):
        tried = 0

        def write(self, text):
            self.tried += 1
            raise BrokenPipeError

    stream, now = Broken(), [0.0]
    progress = Progress(1e-3, stream, clock=lambda: now[0])
    for step in range(8):
        now[0] += 100.0
        progress.update(1e-4 * step)
    progress.close()
    assert stream.tried == 1


def test_what_a_stream_can_not_encode_is_escaped():
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding="ascii", errors="strict")
    assert say("22 µm/s\n", stream)
    assert raw.getvalue() == rb"22 \xb5m/s" + b"\n"


SCRIPT = """
from warpflag.base.device import start_warp
from warpflag.base.progress import Progress
start_warp()
progress = Progress(1.0, clock=iter(range(0, 10000, 100)).__next__)
for step in range(5):
    progress.update(0.2 * step)
progress.close()
open({path!r}, "w").write("reached the end")
"""


@pytest.mark.parametrize("redirection", ["2>&-", "2>/dev/full", "2>&1 | true"])
def test_a_process_with_a_broken_standard_error_reaches_its_end(tmp_path, redirection):
    script, end = tmp_path / "script.py", tmp_path / "end"
    script.write_text(SCRIPT.format(path=str(end)))
    command = f"'{sys.executable}' '{script}' {redirection}"
    subprocess.run(["bash", "-c", command], cwd=Path(__file__).parents[2], check=False, timeout=120)
    assert end.read_text() == "reached the end"


COMMAND = """
import contextlib, os, sys
from warpflag.base.streams import protected_streams

@protected_streams()
def command():
    with open({path!r}, "w") as end:
        assert end.fileno() > 2, "takes the place of a standard stream"
        for _ in range({lines}):
            print("µ" * 10_000)
            print("µ" * 10_000, file=sys.stderr, flush=True)
        print("last")  # not before the process ends
        with contextlib.suppress(OSError):
            os.write(2, b"as a library of another language does")
        end.write("reached the end")
    return 5

sys.exit(command())
"""


@pytest.mark.parametrize(
    "redirection",
    [
        *(">&-", "2>&-", "<&- >&- 2>&-", ">/dev/full", ">/dev/full 2>/dev/full"),
        *("2>&1 | head -c 3", "| true", ">/dev/null 2>/dev/null"),
    ],
)
@pytest.mark.parametrize("lines", [0, 20])
def test_a_command_prints_to_broken_streams_and_keeps_its_status(tmp_path, redirection, lines):
    script, end = tmp_path / "script.py", tmp_path / "end"
    script.write_text(COMMAND.format(path=str(end), lines=lines))
    shell = (
        f"PYTHONIOENCODING=ascii PYTHONUNBUFFERED= '{sys.executable}' '{script}' {redirection}; exit ${{PIPESTATUS[0]}}"
    )
    done = subprocess.run(
        ["bash", "-c", shell], cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, end.read_text()) == (5, "reached the end")
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr


def test_what_is_printed_to_sound_streams_arrives(capsys):
    with protected_streams():
        print("out")
        print("error", file=sys.stderr)
    assert capsys.readouterr() == ("out\n", "error\n")


def test_a_cache_that_warp_cannot_read_is_one_line(tmp_path):
    """A kernel's description that is damaged: no kernel is compiled or run."""
    from warpflag.base.device import start_warp
    from warpflag.base.streams import explained_cache

    wp = start_warp()
    code = "def load(): b'\\xb8'.decode()\nload()\n"
    place = compile(code, str(Path("warp", "_src", "context.py")), "exec")
    with pytest.raises(UnicodeDecodeError):
        exec(compile(code, "elsewhere.py", "exec"), {})
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        assert explained_cache(lambda: exec(place, {}) or 0)() == 1
    assert str(wp.config.kernel_cache_dir) in said.getvalue() and said.getvalue().count("\n") == 1
    with pytest.raises(KeyError):
        explained_cache(lambda: {}["x"])()
