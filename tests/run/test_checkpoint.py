"""Checkpoints come back exactly, a damaged one costs no more than the step back to the one before, and one whose
checksums are right may still hold what no run can be in: refused in one line, by name."""

from __future__ import annotations

import io
import os
import shutil
import zipfile

import numpy as np
import pytest

from tests.runs import arrays, assert_same_frames, ended_at, executed, small
from warpflag import cli
from warpflag.base.device import DeviceError
from warpflag.run import checkpoint, run
from warpflag.run.carried_values import ALLOWED
from warpflag.run.run_directory import RunError
from warpflag.run.simulation import Simulation
from warpflag.scene import with_values

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


FRAME = 5
VALUES = {
    "implicit": {},
    "rkc": {"numerics.stepper": "rkc"},
    "thermal": {"fluid.temperature": 298.0, "duration": 8e-6},
}


def halved(folder, stepper):
    directory = folder / stepper
    ended_at(run.start(small(VALUES[stepper]), str(directory), "cpu", checkpoint_seconds=0.0), FRAME)
    return directory


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    return halved(tmp_path_factory.mktemp("half"), "implicit")


@pytest.fixture(scope="module", params=VALUES)
def each_half(request, half, tmp_path_factory):
    return half if request.param == "implicit" else halved(tmp_path_factory.mktemp("halves"), request.param)


def forged(half, folder, change, meta_change=lambda meta: None):
    """A copy of a run whose newest checkpoint was changed, the older one taken away."""
    directory = folder / "forged"
    shutil.copytree(half, directory)
    held, meta = checkpoint.load(directory)
    for path in directory.glob("checkpoint-*"):
        path.unlink()
    held = {name: values.copy() for name, values in held.items()}
    change(held)
    meta_change(meta)
    checkpoint.save(directory, held, meta)
    return directory


def refused(directory, name):
    before = arrays(directory)
    with pytest.raises(RunError) as caught:
        run.resume(str(directory))
    line = str(caught.value)
    assert "\n" not in line and str(directory) in line and name in line, line
    after = arrays(directory)
    assert all(np.array_equal(after[key], values, equal_nan=True) for key, values in before.items())


def test_every_value_that_is_not_finite_is_refused(each_half):
    held, _ = checkpoint.load(each_half)
    names = [name for name, values in held.items() if values.dtype.kind == "f" and values.size]
    assert len(names) > 20
    simulation = Simulation(small(VALUES[each_half.name]), device="cpu")
    simulation.restore(held)
    for k, name in enumerate(names):
        values = {**held, name: held[name].copy()}
        values[name].flat[-1] = (np.nan, np.inf, -np.inf)[k % 3]
        with pytest.raises(ValueError, match=name.replace(".", r"\.")):
            simulation.restore(values)


def test_a_checkpoint_holds_nothing_outside_the_table(each_half):
    """And every whole number, which may be an index, has its row."""
    held, _ = checkpoint.load(each_half)
    simulation = Simulation(small(VALUES[each_half.name]), device="cpu")
    for name, values in held.items():
        least, most = ALLOWED.get(name, (-np.inf, np.inf))
        assert ((values >= least) & (values <= most)).all(), name
        assert values.dtype.kind != "i" or name in ALLOWED, name
        for beyond in {least - 1.0, most + 1.0} - {-np.inf, np.inf}:
            changed = {**held, name: values.copy()}
            changed[name].flat[0] = beyond
            with pytest.raises(ValueError, match=name.replace(".", r"\.")):
                simulation.restore(changed)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("control.time", np.nan),
        ("control.time", 1e-9),
        ("control.steps", 0),
        ("control.steps", 1),
        ("frame.index", -1),
        ("frame.index", FRAME - 3),
        ("frame.index", 999),
        ("frame.motor_angle", 1.0),
        ("frame.body_position", 0.5),
        ("chart.base_position", 0.5),
        ("chart.base_tangent", 0.0),
        ("chart.base_director", 2.0),
        ("chart.base_body_orientation", 2.0),
        ("frame.before_tangent", 0.0),
        ("frame.before_director", 2.0),
        ("frame.before_body_orientation", 2.0),
    ],
)
def test_a_forged_value_is_refused_and_the_record_stays(half, name, value, tmp_path):
    def change(held):
        held[name].flat[:3] = value

    def meta_change(meta):
        meta["step"] = value if name == "control.steps" else meta["step"]

    # A time that is too early shows in the frames, which are then ahead of it.
    refused(forged(half, tmp_path, change, meta_change), "frame." if name == "control.time" and value > 0 else name)


@pytest.mark.parametrize("name", ["frame.index", "frame.time"])
def test_frames_ahead_of_the_clock_are_refused(half, name):
    """Of a checkpoint in memory, too, which has no record beside it."""
    held, _ = checkpoint.load(half)
    simulation = Simulation(small(), device="cpu")
    ahead = {**held, name: held[name] + (1 if name == "frame.index" else 1e-5)}
    with pytest.raises(ValueError, match=name.replace(".", r"\.")):
        simulation.restore(ahead)
    simulation.restore(held)


def test_a_frame_of_another_time_is_refused(half, tmp_path):
    """Frame and time moved together: neither agrees with the other alone."""

    def change(held):
        held["frame.time"] *= 0.5

    directory = forged(half, tmp_path, change, lambda meta: meta.update(time=0.5 * meta["time"]))
    with pytest.raises((RunError, checkpoint.CheckpointError), match=r"frame\.index|frame of its record"):
        run.resume(str(directory))


@pytest.mark.parametrize("wall_time", [float("nan"), -1.0, float("inf")])
def test_a_wall_time_that_is_none_is_refused(half, wall_time, tmp_path):
    directory = forged(half, tmp_path, lambda held: None, lambda meta: meta.update(wall_time=wall_time))
    with pytest.raises(checkpoint.CheckpointError):
        run.resume(str(directory))


def test_a_run_goes_on_on_the_device_that_it_ran_on_unless_another_is_named(half, tmp_path):
    directory = forged(half, tmp_path, lambda held: None, lambda meta: meta.update(device="cuda:63"))
    with pytest.raises(DeviceError, match="cuda:63"):
        run.resume(str(directory))
    assert run.resume(str(directory), device="cpu").execute(quiet=True).status == "done"


def test_the_command_ends_with_status_2(half, tmp_path, capsys):
    def change(held):
        held["control.time"][:] = np.nan

    assert cli.main(["run", "--resume", str(forged(half, tmp_path, change))]) == 2
    told = capsys.readouterr().err
    assert told.count("\n") == 1 and "control.time = nan must be finite" in told


def test_the_checkpoint_of_a_run_of_another_duration_is_its_own(each_half, tmp_path):
    """How long a run lasts changes nothing before its end: what it leaves at a time is the same to the last bit."""
    values = VALUES[each_half.name]
    scene = small(values)
    shorter = with_values(scene, {"duration": scene.duration / 2, "frames": 4})
    short = executed(shorter, tmp_path / "short")
    directory = tmp_path / "long"
    shutil.copytree(each_half, directory)
    for path in directory.glob("checkpoint-*"):
        path.unlink()
    for path in short.glob("checkpoint-*"):
        shutil.copy(path, directory)
    resumed = run.resume(str(directory))
    assert 0.0 < resumed.simulation.times[0] < scene.duration
    assert resumed.execute(quiet=True).status == "done"
    assert_same_frames(executed(scene, tmp_path / "whole"), directory)
