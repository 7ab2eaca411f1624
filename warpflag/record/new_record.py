"""A new record with its first frame as the bytes of a file, its parameters, and the space that more frames take."""

from __future__ import annotations

import contextlib
import itertools
import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.base.output import DiskError
from warpflag.record.disk import DiskFile
from warpflag.record.layout import (
    BODY_ORIENTATION,
    BODY_POSITION,
    CHECKSUMS,
    E1,
    FORM,
    MOTOR_ANGLE,
    POSITION,
    UNITS,
    FrameRows,
    dataset_path,
    parameters_checksum,
)
from warpflag.record.rows import Rows

__all__ = ["FORMAT", "TEMPLATES", "first_image", "growth", "values_of", "with_new_parameters"]

FORMAT = ("v108", "v108")
"""The format of HDF5 1.8, in which groups and headers of datasets have checksums. Later formats mark a file as open
while it is written, and one whose writer was killed can't be opened again."""

_CHUNK_BYTES = 1 << 20  # of a chunk: HDF5's cache of chunks holds one
_FRAMES_OF_CHUNK = (16, 64)  # at least and at most
_RECORD_NUMBERS = itertools.count()
_MEMORY_BLOCK = 4096  # bytes by which a file in memory grows
_SLACK_BYTES = 4096  # what HDF5 allocates ahead for small things
_TREE_FANOUT = 64  # chunks in a node of HDF5's tree of chunks
_TEMPLATE_BYTES = 1 << 26  # of all templates that are kept: those of a batch, whose texts differ by some letters
TEMPLATES: dict[Any, _Template] = {}
"""Records that new ones of this process begin with, by what such records have in common."""


def values_of(rows: FrameRows) -> dict[str, NDArray[Any]]:
    """A copy of frames by the names of their entries in the file."""
    values = {
        POSITION: rows.positions,
        E1: rows.directors,
        MOTOR_ANGLE: rows.motor_angle,
        BODY_POSITION: rows.body_position,
        BODY_ORIENTATION: rows.body_orientation,
        "time": rows.time,
        **{f"observables/{name}": value for name, value in rows.observables.items()},
    }
    found = {"step": np.array(rows.step, dtype=np.int64)}
    found |= {name: np.array(v, dtype=np.float64, order="C") for name, v in values.items()}
    return found if rows.forms is None else {**found, FORM: np.array(rows.forms, dtype=np.int8, order="C")}


def first_image(rows: Mapping[str, NDArray[Any]], parameters: Mapping[str, Any], expected: int) -> bytes:
    """The bytes of a new record with its first frames.

    Records of cells that are alike differ in a few numbers: they are put in their places in the bytes of one that HDF5
    has made.

    Args:
        rows: of the frames, by entry, frames first, checksums among them.
        parameters: what /parameters holds.
        expected: frames that it will hold: space is taken for no more, unless it gets more.

    Raises:
        ValueError: the frames have other nodes or flagella than the parameters say.
    """
    nodes, flagella = int(parameters["first_node"][-1]), len(parameters["first_node"]) - 1
    for name, shape in {POSITION: (nodes, 3), E1: (nodes, 3), MOTOR_ANGLE: (flagella,)}.items():
        if rows[name].shape[1:] != shape:
            raise ValueError(f"{name} of a frame has shape {rows[name].shape[1:]}, the scene's is {shape}")
    shapes = tuple((name, values.shape) for name, values in rows.items())
    kept = tuple((name, _stored(value).shape, _stored(value).dtype.str) for name, value in _plain(parameters).items())
    most = int(np.clip(expected, *_FRAMES_OF_CHUNK))
    key = (shapes, kept, tuple(parameters["versions"].items()), most)
    template = TEMPLATES.get(key)
    if template is None:
        template = _Template.made(rows, parameters, most)
        if sum(len(other.image) for other in list(TEMPLATES.values())) > _TEMPLATE_BYTES:
            TEMPLATES.clear()
        TEMPLATES[key] = template
    return template.filled(rows, parameters)


def _plain(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters that are datasets."""
    return {name: value for name, value in parameters.items() if name != "versions"}


def _stored(value: Any) -> NDArray[Any]:
    """A parameter as its dataset holds it."""
    return np.asarray(_text(value) if isinstance(value, str) else value)


@dataclass(frozen=True)
class _Template:
    """A record as HDF5 has made it, and where its numbers lie.

    Attributes:
        image: its bytes.
        rows: by entry, the type of its numbers, frames of a chunk, and where each chunk begins.
        parameters: by name, where its bytes begin.
    """

    image: bytes
    rows: dict[str, tuple[np.dtype[Any], int, list[int]]]
    parameters: dict[str, int]

    @classmethod
    def made(cls, rows: Mapping[str, NDArray[Any]], parameters: Mapping[str, Any], most: int) -> _Template:
        """That of records which have frames and parameters of these shapes, and at most so many frames in a chunk."""
        with _in_memory() as file:
            _fill(file, rows, parameters["versions"].get("warpflag", "unknown"), most)
            _add_parameters(file, parameters)
            file.flush()
            found = {}
            for name in rows:
                dataset = file[dataset_path(name)]
                chunks = [dataset.id.get_chunk_info(k) for k in range(dataset.id.get_num_chunks())]
                places = [chunk.byte_offset for chunk in sorted(chunks, key=lambda chunk: chunk.chunk_offset)]
                found[name] = dataset.dtype, dataset.chunks[0], places
            places = {name: file[f"parameters/{name}"].id.get_offset() for name in _plain(parameters)}
            return cls(file.id.get_file_image(), found, places)

    def filled(self, rows: Mapping[str, NDArray[Any]], parameters: Mapping[str, Any]) -> bytes:
        """The bytes of a record with other numbers of these shapes."""
        from h5py import h5a  # pyright: ignore[reportAttributeAccessIssue]

        image = bytearray(self.image)

        def put(place: int, values: NDArray[Any]) -> None:
            content = values.tobytes()
            image[place : place + len(content)] = content

        for name, (dtype, chunk, places) in self.rows.items():
            values = np.ascontiguousarray(rows[name], dtype=dtype)
            for k, place in enumerate(places):
                put(place, values[k * chunk : (k + 1) * chunk])
        for name, place in self.parameters.items():
            put(place, _stored(parameters[name]))
        with _in_memory(bytes(image)) as file:
            total = h5a.open(file["parameters"].id, b"checksum")
            total.write(np.array(parameters_checksum(parameters), dtype=np.uint32))
            file.flush()
            return file.id.get_file_image()


def _fill(file: Any, rows: Mapping[str, NDArray[Any]], version: str, most: int) -> None:
    """Writes a record without /parameters into an empty file of HDF5."""
    file.create_group("h5md").attrs["version"] = np.array([1, 1], dtype=np.int32)
    file.create_group("h5md/author").attrs["name"] = _text("unknown")
    creator = file.create_group("h5md/creator")
    creator.attrs["name"] = _text("warpflag")
    creator.attrs["version"] = _text(version)
    box = file.create_group("particles/flagella/box")
    box.attrs["dimension"] = np.int32(3)
    box.attrs["boundary"] = np.array([_text("none")] * 3)
    # The shared datasets first, under the entry that every record has.
    entries = ["step", "time", *(name for name in rows if name not in ("step", "time", CHECKSUMS))]
    for name in entries:
        _add_dataset(file, name, rows[name], most)
    file.create_group("h5md/modules/units").attrs["version"] = np.array([1, 0], dtype=np.int32)
    time: Any = file[dataset_path("time")]
    time.make_scale("time")
    for name in entries:
        _describe(file[dataset_path(name)], name, time)
    for name in set(entries) - {"step", "time", POSITION}:
        file[f"{name}/step"] = file[dataset_path("step")]
        file[f"{name}/time"] = time
    sums = _add_dataset(file, CHECKSUMS, rows[CHECKSUMS], most)
    sums.attrs["entries"] = np.array([_text(name) for name in rows if name != CHECKSUMS])


def _in_memory(image: bytes | None = None) -> Any:
    """A file of HDF5 in memory, open for writing.

    Args:
        image: its bytes; None: it is empty.
    """
    import h5py
    from h5py import h5f, h5p  # pyright: ignore[reportAttributeAccessIssue]

    name = f"record {next(_RECORD_NUMBERS)}"  # HDF5 takes files of one name for one file, also those of other threads
    if image is None:
        return h5py.File(name, "w", libver=FORMAT, driver="core", backing_store=False, block_size=_MEMORY_BLOCK)
    access = h5p.create(h5p.FILE_ACCESS)
    access.set_fapl_core(_MEMORY_BLOCK, False)
    access.set_libver_bounds(h5f.LIBVER_V18, h5f.LIBVER_V18)
    access.set_file_image(image)
    return h5py.File(h5f.open(name.encode(), h5f.ACC_RDWR, access))


def _add_parameters(file: Any, parameters: Mapping[str, Any]) -> None:
    """Writes /parameters, which must not be there yet, into an open file of HDF5."""
    group = file.create_group("parameters")
    for name, value in parameters.items():
        if name == "versions":
            group.create_group(name).attrs.update({key: _text(version) for key, version in value.items()})
        else:
            group[name] = _text(value) if isinstance(value, str) else value
    group.attrs["checksum"] = np.uint32(parameters_checksum(parameters))


def with_new_parameters(disk: DiskFile, parameters: Mapping[str, Any]) -> DiskFile:
    """Replaces a record by a copy with other parameters: they are changed all together or not at all.

    Args:
        disk: the record.
        parameters: what /parameters is to hold.

    Returns:
        the copy, locked; `disk`, which was the file before, is closed.

    Raises:
        DiskError: there is no room for a copy; the file is as it was.
    """
    import h5py

    temporary = disk.path.with_name(disk.path.name + ".tmp")
    try:
        shutil.copyfile(disk.path, temporary)
        changed = DiskFile(temporary)
        changed.reserve(os.path.getsize(temporary) + len(parameters["scene"]) + (1 << 16))
        with h5py.File(temporary, "r+", locking=False, libver=FORMAT) as file:
            del file["parameters"]
            _add_parameters(file, parameters)
        changed.sync()
        os.replace(temporary, disk.path)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, DiskError):
            error = error.__cause__ or error
        raise DiskError.of(disk.path, error) from None
    finally:
        disk.close()
    return changed


def growth(datasets: Iterable[Rows], before: int, after: int) -> int:
    """Bytes by which the file of a record grows at most.

    Args:
        datasets: all that hold frames.
        before: number of frames that they hold.
        after: number of frames that they are to hold.
    """
    total = _SLACK_BYTES
    for dataset in datasets:
        present, needed = (-(-frames // dataset.chunk) for frames in (before, after))
        if needed > present:
            node = 24 + 8 * _TREE_FANOUT + (_TREE_FANOUT + 1) * 8 * (len(dataset.shape) + 3)
            # A full node of the tree is split, and so may be those above it.
            nodes = 3 + (needed - present) // 16 if needed > _TREE_FANOUT else int(present == 0)
            total += (needed - present) * dataset.chunk * int(
                np.prod(dataset.shape)
            ) * dataset.dtype.itemsize + nodes * node
    return total


def _add_dataset(file: Any, name: str, rows: NDArray[Any], most: int) -> Any:
    """A dataset of frames that begins with some, in chunks of at most so many frames."""
    shape = rows.shape[1:]
    chunk = int(np.clip(_CHUNK_BYTES // max(1, rows[:1].nbytes), _FRAMES_OF_CHUNK[0], most))
    return file.create_dataset(dataset_path(name), data=rows, maxshape=(None, *shape), chunks=(chunk, *shape))


def _describe(dataset: Any, name: str, time: Any) -> None:
    """Gives the frames of an entry their unit and the scale of their first dimension."""
    if name in UNITS:
        dataset.attrs["units"] = UNITS[name]
        if name != POSITION:
            dataset.attrs["unit"] = UNITS[name]
    if name != "time":
        dataset.dims[0].attach_scale(time)


def _text(text: str) -> np.bytes_:
    """A text of fixed length: HDF5 does not return from reading a damaged heap of texts of variable length."""
    return np.bytes_(text.encode() or b"\0")
