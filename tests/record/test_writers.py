"""Writers that are watched, killed, interrupted and resumed: what was committed is there, and goes on."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

from tests.record.frames import FIRST_NODE, SCENE, assert_holds_frames, frame, started, written
from warpflag.base.output import DiskError
from warpflag.record import FrameRows, Record, RecordError, new_record
from warpflag.record.layout import E1, POSITION
from warpflag.record.recorder import Recorder

WRITER = """
import sys
sys.path[:0] = {paths!r}
from pathlib import Path
from tests.record.frames import frame, started
recorder = started(Path({path!r}))
index = 0
while True:
    recorder.write(frame(index))
    index += 1
    if index % 10 == 1:
        recorder.flush()
        print(recorder.frame_count, flush=True)
        if {wait!r}:
            sys.stdin.readline()
"""


def start_writer(path: Path, *, wait: bool) -> subprocess.Popen:
    """A process that writes frames without end and says after every flush how many it has committed."""
    script = WRITER.format(paths=[str(Path(__file__).parents[2])], path=str(path), wait=wait)
    return subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_another_process_reads_while_a_run_writes(tmp_path):
    with start_writer(tmp_path / "run.h5", wait=True) as process:
        assert process.stdin is not None and process.stdout is not None
        try:
            for committed in (1, 11, 21):
                assert int(process.stdout.readline()) == committed
                with Record(tmp_path) as record:
                    assert_holds_frames(record, range(committed))
                process.stdin.write("on\n")
                process.stdin.flush()
        finally:  # or a failure would wait for the writer
            process.kill()


def test_a_record_opens_at_any_moment_of_a_run_that_writes_without_pause(tmp_path):
    path = tmp_path / "run.h5"
    with start_writer(path, wait=False) as process, ThreadPoolExecutor(1) as pool:
        assert process.stdout is not None
        process.stdout.readline()
        said = pool.submit(process.stdout.read)  # or the writer would wait for its reader
        counts = []
        try:
            for _ in range(60):
                with Record(path) as record:
                    counts.append(record.frame_count)
        finally:  # or a failure would wait for the writer
            process.kill()
        said.result()
    assert counts == sorted(counts) and counts[-1] > counts[0]


@pytest.mark.parametrize("blocks", [1, 2, 7, 40, 90])
def test_a_killed_writer_leaves_every_committed_frame(tmp_path, blocks):
    path = tmp_path / "run.h5"
    process = start_writer(path, wait=False)
    try:
        assert process.stdout is not None
        for _ in range(blocks):
            promised = int(process.stdout.readline())
    finally:
        os.kill(process.pid, signal.SIGKILL)
        said_after = process.communicate()[0].splitlines()
    promised = int(said_after[-1]) if said_after else promised
    with Record(path) as record:
        assert record.frame_count >= promised >= 10 * blocks - 9
        assert_holds_frames(record, range(record.frame_count))
    assert process.returncode == -signal.SIGKILL


def test_an_interrupted_commit_is_repeated(tmp_path, monkeypatch):
    recorder = started(tmp_path / "run.h5")
    for index in range(10):
        recorder.write(frame(index))
    flush, calls = h5py.File.flush, []

    def interrupted(file):
        flush(file)
        calls.append(file)
        raise KeyboardInterrupt

    for at in (10, 11):  # between the values and the marker, twice
        monkeypatch.setattr(h5py.File, "flush", interrupted)
        with pytest.raises(KeyboardInterrupt):
            recorder.write(frame(at))
            recorder.flush()
        monkeypatch.setattr(h5py.File, "flush", flush)
        assert Record(tmp_path).frame_count == 1
    assert len(calls) == 2
    recorder.close()
    with Record(tmp_path) as record:
        assert_holds_frames(record, range(12))


def test_resume_cuts_at_the_step_and_appends(tmp_path):
    path = written(tmp_path / "run.h5", 25)
    recorder = Recorder(path, resume_step=105)  # between the steps of frames 10 and 11
    recorder.start("longer", FIRST_NODE, filament_radius=0.01, body_length=2.5, body_width=0.8)
    assert recorder.frame_count == 11
    with Record(path) as record:
        assert_holds_frames(record, range(11))
    for index in range(11, 30):
        recorder.write(frame(index))
    recorder.close()
    with Record(path) as record:
        assert_holds_frames(record, range(30))
        assert record.scene_text == "longer"
        assert record.scene_sha256 == hashlib.sha256(b"longer").hexdigest()


def test_resume_keeps_the_frame_of_its_step(tmp_path):
    path = written(tmp_path / "run.h5", 25)
    started(path, resume_step=100).close()
    with Record(path) as record:
        assert_holds_frames(record, range(11))


def test_resume_takes_observables_in_any_order(tmp_path):
    path = written(tmp_path / "run.h5", 25)
    recorder = started(path, resume_step=100)
    for index in range(11, 25):
        own = frame(index)
        recorder.write(dataclasses.replace(own, observables=dict(reversed(own.observables.items()))))
    recorder.close()
    with Record(path) as record:
        assert_holds_frames(record, range(25))


def test_resume_needs_a_record_of_the_same_flagella(tmp_path):
    with pytest.raises(RecordError, match="no such record"):
        started(tmp_path / "run.h5", resume_step=0)
    path = written(tmp_path / "run.h5", 3)
    other = Recorder(path, resume_step=0)
    with pytest.raises(RecordError, match="other flagella"):
        other.start(SCENE, np.array([0, 5, 9]), filament_radius=0.01, body_length=2.5, body_width=0.8)
    with Record(path) as record:
        assert_holds_frames(record, range(3))


def test_a_record_that_is_cut_to_nothing_begins_anew(tmp_path):
    path = written(tmp_path / "run.h5", 3)
    recorder = started(path, resume_step=-1)
    for index in range(2):
        recorder.write(frame(index))
    recorder.close()
    with Record(tmp_path) as record:
        assert_holds_frames(record, range(2))


@pytest.mark.parametrize("closed", [False, True], ids=["same start", "started again"])
def test_a_record_takes_no_frame_twice_and_none_of_before(tmp_path, closed):
    recorder = started(tmp_path / "run.h5")
    for index in range(4):
        recorder.write(frame(index))
    if closed:
        recorder.close()
        recorder = started(tmp_path / "run.h5", resume_step=frame(3).step)
    for index in (3, 1):
        with pytest.raises(ValueError, match="does not come after the last frame"):
            recorder.write(frame(index))
    with pytest.raises(ValueError, match="does not come after"):
        recorder.write(dataclasses.replace(frame(4), time=float("nan")))
    recorder.write(frame(4))
    recorder.close()
    with Record(tmp_path) as record:
        assert_holds_frames(record, range(5))


def test_a_frame_comes_after_all_that_were_given_together(tmp_path):
    """They wait for a block to be full."""
    several = [FrameRows.of(frame(index)) for index in range(4)]
    names = [field.name for field in dataclasses.fields(FrameRows) if field.name not in ("observables", "forms")]
    rows = FrameRows(
        **{name: np.concatenate([getattr(one, name) for one in several]) for name in names},
        observables={n: np.concatenate([one.observables[n] for one in several]) for n in several[0].observables},
    )
    recorder = started(tmp_path / "run.h5", block_frames=8, keep_open=False)
    recorder.write_rows(rows)
    with pytest.raises(ValueError, match="does not come after the last frame"):
        recorder.write(frame(2))
    recorder.write(frame(4))
    recorder.close()
    with Record(tmp_path) as record:
        assert_holds_frames(record, range(5))


def test_a_record_that_is_closed_between_blocks(tmp_path):
    """So many can be written that they can't all be open; only full blocks and flushes are committed."""
    now, files = [0.0], len(os.listdir("/dev/fd"))
    recorders = [started(tmp_path / f"{k}.h5", block_frames=4, keep_open=False, clock=lambda: now[0]) for k in range(9)]
    for recorder in recorders:
        recorder.write(frame(0))
    first, second = recorders[:2]
    for index in range(1, 7):
        now[0] += 100.0
        first.write(frame(index))
    assert len(os.listdir("/dev/fd")) == files
    with Record(first.path) as record:
        assert_holds_frames(record, range(4))
    first.flush()
    first.flush()
    with Record(first.path) as record:
        assert_holds_frames(record, range(7))
    started(first.path, resume_step=10**9).close()  # it is not locked
    for recorder in recorders:
        recorder.close()
    with pytest.raises(RecordError, match="exists already"):
        first.write(frame(7))
    resumed = started(second.path, resume_step=0, block_frames=4, keep_open=False)
    for index in range(1, 6):
        resumed.write(frame(index))
    resumed.close()
    with Record(second.path) as record:
        assert_holds_frames(record, range(6))


def contents(path: Path) -> dict[str, object]:
    """Everything in a file: values, types and attributes, by path."""
    found: dict[str, object] = {}
    with h5py.File(path) as file:

        def look(name: str, item: object) -> None:
            attributes = {
                key: np.asarray(value).tolist() for key, value in item.attrs.items() if not key.endswith("_LIST")
            }
            data = (item.dtype.str, item.chunks, item[()].tolist()) if isinstance(item, h5py.Dataset) else None
            found[name] = (attributes, data)

        file.visititems(look)
    return found


@pytest.mark.parametrize("count", [1, 3, 64, 65, 150])
def test_records_put_into_the_bytes_of_another_hold_what_hdf5_would_have_written(tmp_path, count):
    """Records of a batch begin with the bytes of the first of them, with their own numbers in place."""
    before = set(new_record.TEMPLATES)
    for k in range(3):
        at_once, each = (
            started(tmp_path / f"{name}-{k}.h5", block_frames=frames, keep_open=False)
            for name, frames in (("at once", count), ("each", 1))
        )
        for recorder in (at_once, each):
            scene, size = f'name = "{k}"  # of a length of its own{"!" * (k // 2)}\n', 1.0 + k
            options = {
                "filament_radius": size,
                "body_length": 2 * size,
                "body_width": 0.5,
                "versions": {"h5py": f"{count}"},
            }
            recorder.start(scene, FIRST_NODE, **options)
            for index in range(count):
                recorder.write(frame(7 * k + index))
            recorder.close()
        assert contents(at_once.path) == contents(each.path)
        with Record(at_once.path) as record:
            assert_holds_frames(record, range(7 * k, 7 * k + count))
            assert record.scene_text == scene and record.filament_radius == size
        more = started(at_once.path, resume_step=10 * (7 * k + count - 1), keep_open=False)
        more.write(frame(7 * k + count))
        more.close()
        with Record(at_once.path) as record:
            assert_holds_frames(record, range(7 * k, 7 * k + count + 1))
    assert len(new_record.TEMPLATES.keys() - before) == (
        2 if count == 1 else 4
    )  # two lengths of the text, all frames and one


def test_a_short_record_that_is_committed_piece_by_piece_is_whole_each_time(tmp_path):
    recorder = started(tmp_path / "run.h5", block_frames=6, keep_open=False)
    for index in range(15):
        recorder.write(frame(index))
        if index in (0, 2, 7):
            recorder.flush(sync=index > 0)
            with Record(recorder.path) as record:
                assert_holds_frames(record, range(index + 1))
    inode = os.stat(recorder.path).st_ino
    recorder.close()
    assert os.stat(recorder.path).st_ino == inode  # no longer short
    with Record(recorder.path) as record:
        assert_holds_frames(record, range(15))
    short = started(tmp_path / "short.h5", block_frames=6, keep_open=False)
    short.write(frame(0))
    short.flush()
    short.write(frame(1))
    content = short.path.read_bytes()
    short.path.with_name("short.h5.tmp").symlink_to("/dev/full")
    with pytest.raises(DiskError, match="No space"):
        short.flush()
    assert short.path.read_bytes() == content  # what was there stays
    short.close()


def test_what_is_small_is_kept_until_a_record_is_long_or_continued(tmp_path):
    recorder = started(tmp_path / "run.h5", block_frames=3)
    for index in range(7):
        recorder.write(frame(index))
    recorder.close()
    with Record(recorder.path) as record:
        kept = recorder.kept()
        assert set(kept) == set(record.entries) - {POSITION, E1, "checksums"}
        assert kept["time"].tolist() == record.times.tolist() and kept["step"].tolist() == record.steps.tolist()
        assert kept["observables/motor_rate"].tolist() == record.observables["motor_rate"].tolist()
    continued = started(recorder.path, resume_step=30)
    continued.write(frame(4))
    continued.close()
    assert continued.kept() is None
    long = started(tmp_path / "long.h5", most_kept=5)
    for index in range(7):
        long.write(frame(index))
    long.close()
    assert long.kept() is None
