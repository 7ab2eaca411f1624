"""A disk that is full, or a file that may not grow: one line, and all that was committed stays and is continued."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

from tests.record.frames import FIRST_NODE, assert_holds_frames, frame, started, written
from warpflag.base.output import DiskError
from warpflag.record import Record, RecordError
from warpflag.record.layout import CHECKSUMS
from warpflag.record.new_record import FORMAT, growth, values_of
from warpflag.record.recorder import Recorder
from warpflag.record.rows import Rows

resource = pytest.importorskip("resource")

FRAMES = 150

WRITER = """
import resource, sys
from pathlib import Path
from tests.record.frames import frame, started
path, limit, frames = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
recorder = started(path)
try:
    for index in range(frames):
        recorder.write(frame(index))
        if index % 10 == 0:
            recorder.flush()
            print(recorder.frame_count, flush=True)
    recorder.close()
except OSError as error:
    print(error, file=sys.stderr)
    try:
        recorder.close()
    except OSError:
        pass
    sys.exit(1)
"""


def limited_writer(path: Path, limit: int) -> tuple[int, str, str]:
    """Exit status, output and errors of a process that writes a record which may have `limit` bytes at most."""
    root = str(Path(__file__).parents[2])
    command = [sys.executable, "-c", WRITER, str(path), str(limit), str(FRAMES)]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=120)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("tenth", range(1, 11))
def test_a_size_limit_anywhere_leaves_every_committed_frame_and_a_record_that_goes_on(tmp_path, tenth):
    full = os.path.getsize(written(tmp_path / "full.h5", FRAMES))
    path = tmp_path / "run.h5"
    status, output, errors = limited_writer(path, full * tenth // 10 - 1)
    assert (status, errors) == (1, f"{path}: can't be written: {os.strerror(errno.EFBIG)}\n")
    if not output:  # not even the first frame
        assert sorted(item.name for item in tmp_path.iterdir()) == ["full.h5"]
        return
    promised = int(output.split()[-1])
    with Record(path) as record:
        count = record.frame_count
        assert count >= promised
        assert_holds_frames(record, range(count))
    recorder = started(path, resume_step=frame(count - 1).step)
    for index in range(count, FRAMES):
        recorder.write(frame(index))
    recorder.close()
    with Record(path) as record:
        assert_holds_frames(record, range(FRAMES))


def full_disk(*_arguments):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.fixture
def no_allocation(monkeypatch):
    """From here on the file system has no space to give."""
    return lambda: monkeypatch.setattr(os, "posix_fallocate", full_disk)


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="no such system call here")
def test_frames_that_found_no_room_are_written_once_there_is_some(tmp_path, monkeypatch):
    path = tmp_path / "run.h5"
    recorder = started(path)
    recorder.write(frame(0))
    with monkeypatch.context() as full, pytest.raises(DiskError, match="No space left on device"):
        full.setattr(os, "posix_fallocate", full_disk)
        for index in range(1, 11):
            recorder.write(frame(index))
    recorder.close()
    with Record(path) as record:
        assert_holds_frames(record, range(11))


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="no such system call here")
def test_other_parameters_are_taken_all_together_or_not_at_all(tmp_path, no_allocation):
    path = written(tmp_path / "run.h5", 25)
    before = path.read_bytes()
    no_allocation()
    recorder = Recorder(path, resume_step=100)
    with pytest.raises(DiskError, match=r"run\.h5: can't be written: No space left"):
        recorder.start("longer", FIRST_NODE, filament_radius=0.01, body_length=2.5, body_width=0.8)
    assert path.read_bytes() == before
    assert [item.name for item in tmp_path.iterdir()] == ["run.h5"]


def test_a_record_that_can_not_be_made_is_told_with_its_path(tmp_path):
    path = tmp_path / "absent" / "run.h5"
    recorder = started(path)
    with pytest.raises(DiskError, match=r"absent/run\.h5: can't be written: No such file or directory"):
        recorder.write(frame(0))


def test_a_record_has_one_writer(tmp_path, monkeypatch):
    monkeypatch.setenv("HDF5_USE_FILE_LOCKING", "FALSE")
    path = written(tmp_path / "run.h5", 5)
    first = started(path, resume_step=10**9)
    with pytest.raises(RecordError, match=r"run\.h5: is being written by another run"):
        started(path, resume_step=10**9)
    first.close()
    started(path, resume_step=10**9).close()


@pytest.mark.parametrize("block", [1, 10, 64, 700])
def test_the_space_reserved_is_enough_for_what_hdf5_takes_and_little_more(tmp_path, block):
    """Up to more chunks than a node of HDF5's tree holds, so that nodes are split."""
    path = written(tmp_path / "run.h5", 1)
    with h5py.File(path, "r+", libver=FORMAT) as file:
        names = [*values_of(frame(0)), CHECKSUMS]
        datasets, every = [Rows(file, name) for name in names], []
        file.visititems(lambda name, item: every.append(name) if getattr(item, "chunks", None) else None)
        assert len(datasets) == len(every) > 8
        count, reserved, start = 1, 0, file.id.get_filesize()
        for _ in range(min(75, 5000 // block)):
            present, expected = file.id.get_filesize(), growth(datasets, count, count + block)
            count += block
            for dataset in datasets:
                dataset.write(count - block, np.ones((block, *dataset.shape)))
            file.flush()
            assert file.id.get_filesize() <= present + expected
            reserved += expected - 4096
        assert reserved < 1.5 * (file.id.get_filesize() - start) + 1e6


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="no such system call here")
def test_space_found_in_part_is_given_back(tmp_path, monkeypatch):
    path = written(tmp_path / "run.h5", 64)  # a full chunk
    size = path.stat().st_size

    def half(descriptor, start, count):
        os.ftruncate(descriptor, start + count // 2)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "posix_fallocate", half)
    recorder = started(path, resume_step=10**9)
    recorder.write(frame(64))
    with pytest.raises(DiskError):
        recorder.flush()
    assert path.stat().st_size == size
    with pytest.raises(DiskError):
        recorder.close()
    with Record(path) as record:
        assert_holds_frames(record, range(64))


@pytest.mark.parametrize("system", ["without the call", "with a file system that refuses it"])
def test_systems_that_can_not_allocate_write_zeros_instead(tmp_path, monkeypatch, system):
    def refused(*_arguments):
        raise OSError(errno.EOPNOTSUPP, "Operation not supported")

    if system == "without the call":
        monkeypatch.delattr(os, "posix_fallocate", raising=False)
    else:
        monkeypatch.setattr(os, "posix_fallocate", refused, raising=False)
    with Record(written(tmp_path / "run.h5", FRAMES)) as record:
        assert_holds_frames(record, range(FRAMES))


@pytest.mark.parametrize("ending", ["flush", "close"])
def test_flushed_frames_are_on_the_disk_before_anything_later_is(tmp_path, monkeypatch, ending):
    path, fsync, synced = tmp_path / "run.h5", os.fsync, []
    recorder = started(path)
    recorder.write(frame(0))

    def watched(descriptor):
        synced.append(os.fstat(descriptor).st_ino)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    recorder.write(frame(1))
    recorder.flush(sync=False)
    assert synced == []
    for _ in range(2):  # what is on the disk is not synced again
        getattr(recorder, ending)()
        assert synced == [path.stat().st_ino]
    with Record(path) as record:
        assert_holds_frames(record, range(2))
    recorder.close()


def test_a_device_that_can_not_store_frames_is_told(tmp_path, monkeypatch):
    recorder = started(tmp_path / "run.h5")
    recorder.write(frame(0))
    recorder.write(frame(1))

    def broken(_descriptor):
        raise OSError(errno.EIO, "Input/output error")

    with monkeypatch.context() as device, pytest.raises(DiskError, match=r"run\.h5: can't be written: Input/output"):
        device.setattr(os, "fsync", broken)
        recorder.flush()
    recorder.close()
