"""Checkpoints come back exactly, and a damaged one costs no more than the step back to the one before."""

from __future__ import annotations

import io
import os
import zipfile

import numpy as np
import pytest

from warpflag.run import checkpoint

ARRAYS = {
    "positions": np.linspace(0.0, 1.0, 12).reshape(4, 3),
    "step": np.array([3, 5], dtype=np.int32),
    "file": np.array(1.5, dtype=np.float32),  # names that np.savez has taken for itself
    "meta": np.zeros((0, 3)),
}


def save(directory, number):
    return checkpoint.save(directory, {"step": np.array(number)}, {"time": number * 1e-3, "number": number})


def test_arrays_and_meta_come_back_exactly(tmp_path):
    checkpoint.save(tmp_path, ARRAYS, {"time": 0.1 + 0.2, "step": 7, "stepper": "rkc", "list": [1, None]})
    arrays, meta = checkpoint.load(tmp_path)
    assert meta == {"time": 0.1 + 0.2, "step": 7, "stepper": "rkc", "list": [1, None]}
    assert set(arrays) == set(ARRAYS)
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype and arrays[name].shape == array.shape
        np.testing.assert_array_equal(arrays[name], array)


def test_the_last_two_are_kept(tmp_path):
    paths = [save(tmp_path, number) for number in range(13)]
    assert sorted(tmp_path.iterdir()) == sorted(paths[-2:])
    assert checkpoint.load(tmp_path)[1]["number"] == 12


@pytest.mark.parametrize("damage", ["cut", "empty", "flipped", "text"])
def test_a_damaged_newest_falls_back_to_the_one_before(tmp_path, damage):
    save(tmp_path, 1)
    newest = save(tmp_path, 2)
    content = bytearray(newest.read_bytes())
    if damage == "cut":
        content = content[: len(content) // 2]
    elif damage == "empty":
        content = bytearray()
    elif damage == "text":
        content = bytearray(b"hello")
    else:
        at = content.index((2).to_bytes(8, "little"), content.index(b"NUMPY", content.index(b"array.step")))
        content[at] ^= 0xFF
    newest.write_bytes(content)
    arrays, meta = checkpoint.load(tmp_path)
    assert meta["number"] == 1 and arrays["step"] == 1
    save(tmp_path, 3)
    assert checkpoint.load(tmp_path)[1]["number"] == 3


def test_an_interrupted_save_leaves_what_was_there(tmp_path, monkeypatch):
    save(tmp_path, 1)

    def killed(*_):
        raise KeyboardInterrupt

    for name in ("fsync", "replace"):
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(os, name, killed)
            save(tmp_path, 2)
        assert checkpoint.load(tmp_path)[1]["number"] == 1
    save(tmp_path, 3)
    assert checkpoint.load(tmp_path)[1]["number"] == 3
    assert len(list(tmp_path.iterdir())) == 2


def test_no_checkpoint_is_an_error_of_one_line(tmp_path):
    with pytest.raises(checkpoint.CheckpointError, match="it holds none"):
        checkpoint.load(tmp_path)
    save(tmp_path, 1).write_bytes(b"")
    with pytest.raises(checkpoint.CheckpointError, match="none of its 1 can be read"):
        checkpoint.load(tmp_path)


def test_objects_are_refused_when_saved(tmp_path):
    with pytest.raises(ValueError, match="positions"):
        checkpoint.save(tmp_path, {"positions": np.array([None])}, {})
    assert list(tmp_path.iterdir()) == []


def test_a_checkpoint_is_a_file_as_numpy_writes_it(tmp_path):
    random = np.random.default_rng(3)
    arrays = {
        "a.µ": random.standard_normal((3, 4)),
        "none": np.zeros((0, 3)),
        "one": np.array(7),
        "turned": np.asfortranarray(random.standard_normal((4, 5)))[::2],
        "text": np.array(["x", "yz"]),
        "flags": np.array([True, False]),
    }
    path = checkpoint.save(tmp_path, arrays, {"step": 1})
    with zipfile.ZipFile(path) as file:
        assert file.testzip() is None
    own_file, other = (io.BytesIO(checkpoint.npz_bytes(arrays, longest)) for longest in (checkpoint.LONGEST_ZIP, 100))
    with np.load(own_file) as own, np.load(other) as numpys:
        assert own.files == numpys.files
        for name in own.files:
            assert own[name].dtype == numpys[name].dtype and own[name].shape == numpys[name].shape
            np.testing.assert_array_equal(own[name], numpys[name])
    arrays_again, meta = checkpoint.load(tmp_path)
    assert meta == {"step": 1} and arrays_again["one"] == 7
