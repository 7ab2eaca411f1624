"""A damaged record: the right numbers or one line that names it, never other numbers, a crash or another error."""

from __future__ import annotations

import shutil
import struct
import zlib
from pathlib import Path
from typing import Any

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

from examples.reliability.damage import damaged
from tests.record.frames import FIRST_NODE, SCENE, assert_holds_frames, frame, started, written
from warpflag.record import Record, RecordError
from warpflag.record.layout import checksums
from warpflag.record.recorder import Recorder

FRAMES = 70  # more than a chunk of 64
MUTATIONS = 300


def content(path: Path) -> dict[str, Any]:
    """All that a record holds, by name."""
    with Record(path) as record:
        names = ("times", "steps", "positions", "directors", "motor_angle", "body_position", "body_orientation")
        found: dict[str, Any] = {name: np.asarray(getattr(record, name)) for name in names}
        found |= record.observables
        found |= {"last": record.frame(-1).positions, **record.parameters}
    return found


def equal(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def refusal(path: Path) -> str:
    """The line by which a record is refused when all of it is read."""
    with pytest.raises(RecordError) as caught:
        content(path)
    line = str(caught.value)
    assert "\n" not in line and len(line) < 600 and line.startswith(f"{path}: "), line
    return line


def test_seeded_damage_is_found_or_harmless(tmp_path):
    sound = written(tmp_path / "sound.h5", FRAMES)
    original, expected = sound.read_bytes(), content(sound)
    path = tmp_path / "run.h5"
    refused = 0
    for seed in range(MUTATIONS):
        what, changed = damaged(original, seed)
        path.write_bytes(changed)
        try:
            assert equal(content(path), expected), f"seed {seed}, {what}: other numbers"
        except RecordError as error:
            assert "\n" not in str(error) and str(path) in str(error), f"seed {seed}, {what}: {error}"
            refused += 1
    assert refused > MUTATIONS / 3


def chunk_bytes(path: Path, name: str) -> tuple[int, int]:
    """Offset and size of the first chunk of a dataset in its file."""
    with h5py.File(path) as file:
        dataset = file[name]
        assert isinstance(dataset, h5py.Dataset)
        chunk = dataset.id.get_chunk_info(0)
        return chunk.byte_offset, chunk.size


@pytest.mark.parametrize(
    "name",
    [
        *("particles/flagella/position/value", "particles/flagella/e1/value", "cell/motor_angle/value"),
        *("cell/body_position/value", "cell/body_orientation/value", "observables/motor_rate/value"),
        *("particles/flagella/position/step", "particles/flagella/position/time", "checksums"),
    ],
)
def test_one_flipped_bit_of_a_frame_is_found_and_the_other_frames_stay_readable(tmp_path, name):
    path = written(tmp_path / "run.h5", FRAMES)
    offset, size = chunk_bytes(path, name)
    changed = bytearray(path.read_bytes())
    changed[offset + 5 * (size // 64)] ^= 1  # in frame 5 of the 64 in this chunk
    path.write_bytes(changed)
    assert "frame 5 of /" in refusal(path) and "checksum" in refusal(path)
    with Record(path) as record:
        np.testing.assert_array_equal(record.frame(6).positions, frame(6).positions)
        np.testing.assert_array_equal(record.positions[6:9], [frame(i).positions for i in (6, 7, 8)])
        with pytest.raises(RecordError):
            record.frame(5)


def test_the_damaged_frame_is_named_wherever_reading_begins(tmp_path):
    path = written(tmp_path / "run.h5", FRAMES)
    with h5py.File(path, "r+") as file:
        file["observables/bundle_length/value"][67] += 1.0
    with Record(path) as record, pytest.raises(RecordError, match=r"frame 67 of /observables/bundle_length"):
        record.frame(67)
    with h5py.File(path, "r+") as file:
        file["particles/flagella/position/value"][66] += 1.0
    with Record(path) as record, pytest.raises(RecordError, match=r"frame 66 of /particles/flagella/position"):
        _ = record.positions[60:]


def test_other_versions_are_found_and_a_run_that_goes_on_gives_its_own(tmp_path):
    path = written(tmp_path / "run.h5", 3)
    recorder = Recorder(path, resume_step=20)
    sizes = {"filament_radius": 0.01, "body_length": 2.5, "body_width": 0.8}
    recorder.start(SCENE, FIRST_NODE, **sizes, versions={"warpflag": "1.2.4"})
    recorder.close()
    with Record(path) as record:
        assert record.versions == {"warpflag": "1.2.4"}
    with h5py.File(path, "r+") as file:
        file["parameters/versions"].attrs["warpflag"] = "1.2.5"
    assert "/parameters does not agree with its checksum" in refusal(path)


@pytest.mark.parametrize(
    "stored",
    [b'name = "two"', b"1.2.3", struct.pack("<d", 0.01), struct.pack("<d", 2.5), struct.pack("<3q", *FIRST_NODE)],
    ids=["scene", "version", "radius", "length", "first node"],
)
def test_a_changed_parameter_is_found(tmp_path, stored):
    path = written(tmp_path / "run.h5", 3)
    sound = path.read_bytes()
    place = sound.rindex(stored) + len(stored) // 2
    path.write_bytes(sound[:place] + bytes([sound[place] ^ 1]) + sound[place + 1 :])
    refusal(path)


def test_checksums_are_those_of_the_stored_bytes():
    """As another program would find them."""
    assert checksums(np.array([[[1.5], [-2.0]]])) == [zlib.crc32(struct.pack("<2d", 1.5, -2.0))]
    assert checksums(np.array([0.1, -0.1])).tolist() == [zlib.crc32(struct.pack("<d", x)) for x in (0.1, -0.1)]
    assert checksums(np.array([2**40 + 1])) == [zlib.crc32(struct.pack("<q", 2**40 + 1))]


def test_every_truncation_is_refused_in_one_line(tmp_path):
    sound = written(tmp_path / "sound.h5", FRAMES).read_bytes()
    path = tmp_path / "run.h5"
    for length in [*range(0, len(sound), len(sound) // 50), len(sound) - 1]:
        path.write_bytes(sound[:length])
        refusal(path)


def test_a_record_that_claims_more_than_fits_its_file_is_refused_before_it_is_read(tmp_path):
    """Datasets made long take no space in a file, but their checksums alone would take all memory."""
    path = written(tmp_path / "run.h5", 4)
    with h5py.File(path, "r+") as file:
        found = []
        file.visititems(lambda name, own: found.append(own) if isinstance(own, h5py.Dataset) and own.chunks else None)
        for dataset in found:
            dataset.resize(10**12, axis=0)
    with pytest.raises(RecordError, match="beside 1000000000000 frames"):
        _ = Record(path).times


def test_a_record_that_claims_more_frames_than_it_holds_is_refused(tmp_path):
    path = written(tmp_path / "run.h5", 5)
    with h5py.File(path, "r+") as file:
        for name in ("step", "time"):
            file[f"particles/flagella/position/{name}"].resize(10**12, axis=0)
    assert "beside 1000000000000 frames" in refusal(path)


@pytest.mark.parametrize("other", ["directory", "text", "checkpoint"])
def test_another_file_under_the_name_of_a_record_is_refused(tmp_path, other):
    path = tmp_path / "run.h5"
    if other == "directory":
        path.mkdir()
        with pytest.raises(RecordError, match=r"run\.h5"):
            content(path)
        return
    if other == "text":
        path.write_text(SCENE)
    else:
        np.savez(tmp_path / "checkpoint.npz", a=np.zeros(3))
        shutil.move(tmp_path / "checkpoint.npz", path)
    assert "not a readable HDF5 file" in refusal(path)


def test_a_damaged_record_is_not_continued(tmp_path):
    path = written(tmp_path / "run.h5", FRAMES)
    offset, _ = chunk_bytes(path, "particles/flagella/position/step")
    changed = bytearray(path.read_bytes())
    changed[offset + 8] ^= 1
    path.write_bytes(changed)
    with pytest.raises(RecordError, match="checksum"):
        started(path, resume_step=100)
    assert path.read_bytes() == changed


def without_checksums(path: Path) -> Path:
    """Turns a record into one as the first version of this program wrote it."""
    with h5py.File(path, "r+") as file:
        del file["checksums"]
        del file["parameters"].attrs["checksum"]
        for name in ("scene", "scene_sha256"):
            text = file[f"parameters/{name}"][()].decode()  # pyright: ignore
            del file[f"parameters/{name}"]
            file[f"parameters/{name}"] = text  # of variable length
        file["parameters/versions"].attrs["warpflag"] = "1.2.3"
    return path


def test_records_without_checksums_are_read_and_continued(tmp_path):
    path = without_checksums(written(tmp_path / "run.h5", 25))
    with Record(path) as record:
        assert_holds_frames(record, range(25))
        assert record.scene_text == SCENE and record.versions == {"warpflag": "1.2.3"}
        np.testing.assert_array_equal(record.first_node, FIRST_NODE)
    recorder = started(path, resume_step=100)
    for index in range(11, 30):
        recorder.write(frame(index))
    recorder.close()
    with Record(path) as record:
        assert_holds_frames(record, range(30))
