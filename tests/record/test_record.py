"""The record: what is written is what is read, whatever happens to the writer in between."""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from types import SimpleNamespace

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

from tests.record.frames import ENTRIES, FIRST_NODE, SCENE, assert_holds_frames, frame, started, written
from warpflag.record import Record, RecordError
from warpflag.view import sweep_figures
from warpflag.view.curves import curves
from warpflag.view.sweep_figures import Table


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


def test_file_has_units_and_scales(tmp_path):
    with h5py.File(written(tmp_path / "run.h5", 12)) as file:
        assert list(file["h5md/modules/units"].attrs["version"]) == [1, 0]
        time = file["particles/flagella/position/time"]
        assert time.attrs["unit"] == "s" and time.is_scale
        for entry in ENTRIES:
            scale = file[entry]["value"].dims[0][0]
            assert scale == time and len(scale) == 12, entry
        units = {entry: file[entry]["value"].attrs.get("unit") for entry in ENTRIES}
        assert units["cell/body_position"] == "um" and units["cell/motor_angle"] == "rad"
        assert units["observables/motor_rate"] == "Hz" and units["observables/bundle_length"] is None
        position = file["particles/flagella/position/value"].attrs
        assert position["units"] == "um" and "unit" not in position  # MDAnalysis does not know um


def test_every_observable_has_its_unit(tmp_path):
    units = {"phase_difference": "", "bundle_length": "", "steric_force_density": "pN um-1", "elastic_energy": "pN um"}
    units |= {"body_speed": "um s-1", "body_rate": "Hz", "motor_rate": "Hz", "motor_torque": "pN um"}
    recorder = started(tmp_path / "run.h5")
    recorder.write(replace(frame(0), observables=dict.fromkeys(units, 1.0)))
    recorder.close()
    with h5py.File(tmp_path / "run.h5") as file:
        assert {name: own["value"].attrs.get("unit", "") for name, own in file["observables"].items()} == units
    # Figures say the same, each from a table of its own.
    words = {"pN um-1": "pN/µm", "pN um": "pN µm", "um s-1": "µm/s"}
    units = {name: words.get(unit, unit) for name, unit in units.items() if name != "bundle_length"}
    curved = curves(SimpleNamespace(observables=dict.fromkeys(units, np.ones(2)), first_node=FIRST_NODE))
    assert {curve.name: curve.unit for curve in curved} == units
    table = Table("swept", (), {"member": ["0"], **{f"observables.{name}": ["1.0"] for name in units}})
    labels = [axes.get_ylabel() for axes in sweep_figures.curves(table, numbers=list(units)).axes]
    assert labels == [name.replace("_", " ") + (f" [{unit}]" if unit else "") for name, unit in units.items()]


def test_other_readers_open_a_record_that_was_read(tmp_path):
    """HDF5 refuses to open a file twice in a process with and without a lock."""
    path = written(tmp_path / "run.h5", 12)
    record = Record(path)
    positions = record.positions
    np.testing.assert_array_equal(positions[3], frame(3).positions)
    with h5py.File(path) as file:
        np.testing.assert_array_equal(file["particles/flagella/position/value"][5], frame(5).positions)
        np.testing.assert_array_equal(positions[4], frame(4).positions)


def test_a_window_is_between_two_numbers(tmp_path):
    record = Record(written(tmp_path / "run.h5", 5))
    assert record.window(1e-4, 3e-4) == slice(1, 4)
    for times in ((float("nan"), 3e-4), (1e-4, float("nan"))):
        with pytest.raises(ValueError, match="nan"):
            record.window(*times)


def test_a_closed_record_sees_what_came_since(tmp_path):
    recorder = started(tmp_path / "run.h5")
    recorder.write(frame(0))
    record = Record(tmp_path)
    assert record.frame_count == 1
    recorder.write(frame(1))
    recorder.flush()
    assert record.frame_count == 1
    record.close()
    assert_holds_frames(record, range(2))
    recorder.close()


def test_mdanalysis_opens_it(tmp_path):
    mdanalysis = pytest.importorskip("MDAnalysis")
    written(tmp_path / "run.h5", 12)
    universe = mdanalysis.Universe.empty(9)
    universe.load_new(str(tmp_path / "run.h5"), format="H5MD", convert_units=False, dt=1e-4)
    assert len(universe.trajectory) == 12
    assert universe.trajectory.units["time"] == "s" and universe.trajectory.dt == 1e-4
    assert universe.trajectory[7].time == frame(7).time
    universe.trajectory[7]
    np.testing.assert_allclose(universe.atoms.positions, frame(7).positions, rtol=1e-6)


@pytest.mark.parametrize(
    "key",
    [
        *(0, -1, slice(None), slice(3, 9), slice(-4, None), slice(2, 20, 5), slice(None, None, -2), slice(9, 3)),
        *(..., (slice(3, 9), 0), (4, slice(None), 2), (..., 2), [7, 2, 2], (slice(0, 4), [0, 3])),
        *(
            None,
            (None, 4),
            ([7, 2], [0, 3]),
            ([7, 2], 3),
            (np.arange(23) > 20, [4, 4]),
            [[1, 2], [3, 4]],
            (3, [1, 0]),
            (True, 4),
        ),
    ],
    ids=str,
)
def test_frame_arrays_index_like_arrays(tmp_path, key):
    record = Record(written(tmp_path / "run.h5", 23))
    everything = np.stack([frame(index).positions for index in range(23)])
    np.testing.assert_array_equal(record.positions[key], everything[key])
    record.close()
    with pytest.raises(AttributeError, match=r"have no mean; \[:\] reads all"):
        record.positions.mean()  # pyright: ignore[reportAttributeAccessIssue]
    assert np.mean(record.positions) == everything.mean() and not hasattr(record.positions, "mean")


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
