"""Output files: whole or absent, and errors that name the file that was asked for."""

from __future__ import annotations

import errno
import os

import pytest

from warpflag.base import output
from warpflag.base.output import DiskError, OutputError, machine_error, sync_file_systems, whole


def test_a_file_appears_when_it_is_whole(tmp_path):
    path = tmp_path / "figure.png"
    with whole(path) as temporary:
        assert temporary.suffix == ".png" and temporary.parent == tmp_path
        temporary.write_text("half")
        assert not path.exists()
    assert path.read_text() == "half"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt()])
def test_after_an_error_the_former_file_is_there_and_nothing_else(tmp_path, error):
    path = tmp_path / "figure.png"
    path.write_text("former")
    with pytest.raises(type(error)), whole(path) as temporary:
        temporary.write_text("half")
        raise error
    assert path.read_text() == "former"
    assert list(tmp_path.iterdir()) == [path]


def test_an_absent_folder_is_named_before_anything_is_made(tmp_path):
    path = tmp_path / "absent" / "figure.png"
    with pytest.raises(OutputError, match="can't be written: there is no folder") as caught, whole(path):
        pytest.fail("the block was entered")
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.parametrize("name", ["a_folder.png", "x" * 250 + ".png"])
def test_a_file_that_can_not_take_its_place_is_named_as_it_was_given(tmp_path, name):
    path = tmp_path / name
    if len(name) < 100:
        (path / "inside").mkdir(parents=True)
    else:
        path = tmp_path / ("x" * 300 + ".png")
    with pytest.raises(DiskError) as caught, whole(path) as temporary:
        temporary.write_text("whole")
    assert str(caught.value).startswith(f"{path}: can't be written: ") and ".tmp" not in str(caught.value)
    assert not [item for item in tmp_path.iterdir() if ".tmp" in item.name]


def test_a_full_disk_is_told_of_the_file_and_another_file_of_itself(tmp_path):
    path = tmp_path / "figure.png"
    with pytest.raises(DiskError, match=r"figure\.png: can't be written: No space left on device"), whole(path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with pytest.raises(FileNotFoundError, match=r"other\.txt"), whole(path):
        (tmp_path / "other.txt").read_text()
    with pytest.raises(DiskError, match=r"^inner\.h5: can't be written: full$"), whole(path):
        raise DiskError.of("inner.h5", RuntimeError("full"))


def test_a_device_that_could_not_store_all_is_told(tmp_path, monkeypatch):
    asked: list[int] = []

    class Library:
        @staticmethod
        def syncfs(descriptor: int) -> int:
            asked.append(os.fstat(descriptor).st_dev)
            return -1

    monkeypatch.setattr(output.ctypes, "CDLL", lambda *_, **__: Library)
    monkeypatch.setattr(output.ctypes, "get_errno", lambda: errno.EIO)
    with pytest.raises(OSError) as caught:
        sync_file_systems([tmp_path, tmp_path.parent])
    assert (caught.value.errno, caught.value.filename) == (errno.EIO, str(tmp_path.parent))
    assert asked == [tmp_path.stat().st_dev]  # once for the device


@pytest.mark.parametrize(
    ("place", "advised"),
    [("kernels", True), ("kernels/wp_a/a.o", True), ("", True), ("other", False), ("kept/run.h5", False)],
)
def test_where_kernels_can_not_be_kept_another_folder_is_advised(place, advised, tmp_path, monkeypatch):
    """Also where their folder can't be made for want of the one that it is to lie in."""
    wp = pytest.importorskip("warp")
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path / "kernels"))
    path = str(tmp_path / place)
    line = machine_error(PermissionError(errno.EACCES, "Permission denied", path))
    assert line.startswith(f"{path}: Permission denied") and "\n" not in line
    assert ("let WARP_CACHE_PATH name a folder that can be written" in line) == advised
    assert machine_error(OSError("no file")) == "no file"
