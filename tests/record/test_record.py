"""The record: what is written is what is read, whatever happens to the writer in between."""

from __future__ import annotations

import hashlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

from warpflag.record import Frame, Record, RecordError
from warpflag.record.recorder import Recorder

FIRST_NODE = np.array([0, 4, 9])  # two flagella, of 3 and 4 segments
SCENE = 'name = "two"  # \u03a6 = 90\n'
ENTRIES = [
    "particles/flagella/position",
    "particles/flagella/e1",
    "cell/motor_angle",
    "cell/body_position",
    "cell/body_orientation",
    "observables/bundle_length",
    "observables/motor_rate",
]


def frame(index: int) -> Frame:
    """A frame whose every number tells the frame it belongs to."""
    nodes = np.arange(27.0).reshape(9, 3)
    return Frame(
        time=index * 1e-4,
        step=10 * index,
        positions=index + nodes / 100,
        directors=-index - nodes / 100,
        motor_angle=np.array([index, -index], float),
        body_position=np.array([index, 0.0, -index]) / 7,
        body_orientation=np.array([0.0, 0.0, np.sin(index), np.cos(index)]),
        observables={"bundle_length": index / 3, "motor_rate": np.array([index, 2.0 * index])},
    )


def started(path: Path, **options) -> Recorder:
    recorder = Recorder(path, **options)
    recorder.start(
        SCENE, FIRST_NODE, filament_radius=0.01, body_length=2.5, body_width=0.8, versions={"warpflag": "1.2.3"}
    )
    return recorder


def written(path: Path, count: int) -> Path:
    recorder = started(path)
    for index in range(count):
        recorder.write(frame(index))
    recorder.close()
    return path


def assert_holds_frames(record: Record, indices) -> None:
    """Every dataset of the record holds exactly these frames, to the last bit."""
    expected = [frame(index) for index in indices]
    assert record.frame_count == len(expected)
    np.testing.assert_array_equal(record.times, [f.time for f in expected])
    np.testing.assert_array_equal(record.steps, [f.step for f in expected])
    for name in ("positions", "directors", "motor_angle", "body_position", "body_orientation"):
        np.testing.assert_array_equal(np.asarray(getattr(record, name)), [getattr(f, name) for f in expected])
    assert set(record.observables) == {"bundle_length", "motor_rate"}
    for name, values in record.observables.items():
        np.testing.assert_array_equal(values, [f.observables[name] for f in expected])


def test_what_is_written_is_what_is_read(tmp_path):
    written(tmp_path / "run.h5", 37)
    with Record(tmp_path) as record:  # the directory, as a user would name it
        assert_holds_frames(record, range(37))
        assert record.scene_text == SCENE
        assert record.scene_sha256 == hashlib.sha256(SCENE.encode()).hexdigest()
        np.testing.assert_array_equal(record.first_node, FIRST_NODE)
        assert (record.filament_radius, record.body_length, record.body_width) == (0.01, 2.5, 0.8)
        assert record.versions == {"warpflag": "1.2.3"}
        for index in (0, 20, -1):
            one, expected = record.frame(index), frame(index % 37)
            assert (one.time, one.step) == (expected.time, expected.step)
            np.testing.assert_array_equal(one.positions, expected.positions)
            np.testing.assert_array_equal(one.body_orientation, expected.body_orientation)
            np.testing.assert_array_equal(one.observables["motor_rate"], expected.observables["motor_rate"])
        with pytest.raises(RecordError, match="no frame 37"):
            record.frame(37)


def test_file_is_h5md(tmp_path):
    with h5py.File(written(tmp_path / "run.h5", 12)) as file:
        np.testing.assert_array_equal(file["h5md"].attrs["version"], [1, 1])
        assert "name" in file["h5md/author"].attrs
        assert file["h5md/creator"].attrs["name"] == b"warpflag"
        assert file["h5md/creator"].attrs["version"] == b"1.2.3"
        assert list(file["particles"]) == ["flagella"]
        box = file["particles/flagella/box"].attrs
        assert box["dimension"] == 3 and list(box["boundary"]) == [b"none"] * 3
        for entry in ENTRIES:
            assert set(file[entry]) == {"value", "step", "time"}, entry
            assert len(file[entry]["value"]) == 12
            # One sampling for all: the very same datasets.
            assert file[entry]["step"] == file["particles/flagella/position/step"]
            assert file[entry]["time"] == file["particles/flagella/position/time"]
        assert file["particles/flagella/position/value"].shape == (12, 9, 3)
        assert set(file["observables"]) == {"bundle_length", "motor_rate"}


def test_mdanalysis_opens_it(tmp_path):
    mdanalysis = pytest.importorskip("MDAnalysis")
    written(tmp_path / "run.h5", 12)
    universe = mdanalysis.Universe.empty(9)
    universe.load_new(str(tmp_path / "run.h5"), format="H5MD", convert_units=False)
    assert len(universe.trajectory) == 12
    universe.trajectory[7]
    np.testing.assert_allclose(universe.atoms.positions, frame(7).positions, rtol=1e-6)


@pytest.mark.parametrize(
    "key",
    [
        *(0, -1, slice(None), slice(3, 9), slice(-4, None), slice(2, 20, 5), slice(None, None, -2), slice(9, 3)),
        *(..., (slice(3, 9), 0), (4, slice(None), 2), (..., 2), [7, 2, 2], (slice(0, 4), [0, 3])),
    ],
    ids=str,
)
def test_frame_arrays_index_like_arrays(tmp_path, key):
    record = Record(written(tmp_path / "run.h5", 23))
    everything = np.stack([frame(index).positions for index in range(23)])
    np.testing.assert_array_equal(record.positions[key], everything[key])
    record.close()


def test_frame_arrays_end_with_the_committed_frames(tmp_path):
    with Record(written(tmp_path / "run.h5", 5)) as record:
        assert len(record.positions) == 5
        for index in (5, -6):
            with pytest.raises(IndexError):
                record.positions[index]


def test_reader_sees_committed_frames_of_a_run_that_goes_on(tmp_path):
    recorder = started(tmp_path / "run.h5")
    recorder.write(frame(0))
    assert_holds_frames(Record(tmp_path), range(1))  # the first frame is committed at once
    for index in range(1, 8):
        recorder.write(frame(index))
    assert recorder.frame_count == 8
    assert Record(tmp_path).frame_count == 1
    recorder.flush()
    assert_holds_frames(Record(tmp_path), range(8))
    for index in range(8, 18):
        recorder.write(frame(index))
    assert_holds_frames(Record(tmp_path), range(18))  # ten frames are a block
    recorder.close()


def test_slow_frames_are_committed_by_the_clock(tmp_path):
    now = [100.0]
    recorder = started(tmp_path / "run.h5", clock=lambda: now[0])
    recorder.write(frame(0))
    now[0] += 1.0
    recorder.write(frame(1))
    assert Record(tmp_path).frame_count == 1
    now[0] += 1.5
    recorder.write(frame(2))
    assert Record(tmp_path).frame_count == 3
    recorder.close()


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
        assert_holds_frames(record, range(5))
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


def test_everything_is_cut_to_the_commit_marker(tmp_path):
    """A writer that died between the values and `step` leaves longer datasets behind."""
    path = written(tmp_path / "run.h5", 12)
    with h5py.File(path, "r+") as file:
        for entry in ENTRIES:
            file[entry]["value"].resize(22, axis=0)
        file["particles/flagella/position/time"].resize(22, axis=0)
    with Record(path) as record:
        assert_holds_frames(record, range(12))
    recorder = started(path, resume_step=10**9)
    recorder.write(frame(12))
    recorder.close()
    with Record(path) as record:
        assert_holds_frames(record, range(13))


WRITER = """
import sys
sys.path[:0] = {paths!r}
from pathlib import Path
from test_record import frame, started
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
    here = Path(__file__).parent
    script = WRITER.format(paths=[str(here.parents[1]), str(here)], path=str(path), wait=wait)
    return subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def test_another_process_reads_while_a_run_writes(tmp_path):
    with start_writer(tmp_path / "run.h5", wait=True) as process:
        assert process.stdin is not None and process.stdout is not None
        for committed in (1, 11, 21):
            assert int(process.stdout.readline()) == committed
            with Record(tmp_path) as record:
                assert_holds_frames(record, range(committed))
            process.stdin.write("on\n")
            process.stdin.flush()
        process.kill()


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


def test_resume_needs_a_record_of_the_same_flagella(tmp_path):
    with pytest.raises(RecordError, match="no such record"):
        started(tmp_path / "run.h5", resume_step=0)
    path = written(tmp_path / "run.h5", 3)
    other = Recorder(path, resume_step=0)
    with pytest.raises(RecordError, match="other flagella"):
        other.start(SCENE, np.array([0, 5, 9]), filament_radius=0.01, body_length=2.5, body_width=0.8)
    with Record(path) as record:
        assert_holds_frames(record, range(3))


def test_a_record_is_never_overwritten(tmp_path):
    path = written(tmp_path / "run.h5", 3)
    with pytest.raises(RecordError, match=r"run\.h5: exists already"):
        started(path)
    closed = started(tmp_path / "second.h5")
    closed.write(frame(0))
    closed.close()
    with pytest.raises(RecordError, match="exists already"):
        closed.write(frame(1))
    with Record(tmp_path / "second.h5") as record:
        assert_holds_frames(record, range(1))


def test_frames_must_fit_the_record(tmp_path):
    recorder = started(tmp_path / "run.h5")
    short = frame(0)
    object.__setattr__(short, "positions", short.positions[:-1])
    with pytest.raises(ValueError, match="position"):
        recorder.write(short)
    recorder.write(frame(0))
    for name, value in (("motor_angle", np.zeros(3)), ("observables", {"bundle_length": 0.0})):
        wrong = frame(1)
        object.__setattr__(wrong, name, value)
        with pytest.raises(ValueError, match="motor_"):
            recorder.write(wrong)
    recorder.write(frame(1))
    recorder.close()
    with Record(tmp_path) as record:
        assert_holds_frames(record, range(2))


def test_frames_are_copied(tmp_path):
    recorder = started(tmp_path / "run.h5")
    recorder.write(frame(0))
    reused = frame(1)
    recorder.write(reused)
    reused.positions[:] = np.nan
    recorder.close()
    with Record(tmp_path) as record:
        assert_holds_frames(record, range(2))


def test_a_run_without_frames_leaves_no_file(tmp_path):
    started(tmp_path / "run.h5").close()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"not HDF5 at all", None], ids=["empty", "text", "foreign HDF5"])
def test_foreign_files_are_refused_in_one_line(tmp_path, content):
    path = tmp_path / "run.h5"
    if content is None:
        with h5py.File(path, "w") as file:
            file.create_group("particles/atoms")
    else:
        path.write_bytes(content)
    with pytest.raises(RecordError) as error:
        _ = Record(path).times
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(RecordError):
        started(path, resume_step=0)


def test_missing_record_is_named(tmp_path):
    with pytest.raises(RecordError, match=r"run\.h5: no such record"):
        Record(tmp_path)


def test_damaged_frames_are_reported_in_one_line(tmp_path):
    path = written(tmp_path / "run.h5", 40)
    with h5py.File(path) as file:
        offset = file["particles/flagella/position/value"].id.get_chunk_info(0).byte_offset
    os.truncate(path, offset)
    with pytest.raises(RecordError) as error:
        _ = Record(path).positions[:]
    assert str(path) in str(error.value) and "\n" not in str(error.value)
