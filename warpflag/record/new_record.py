"""A new record with its first frame as the bytes of a file, its parameters, and the space that more frames take."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from warpflag.record.layout import (
    BODY_ORIENTATION,
    BODY_POSITION,
    CHECKSUMS,
    E1,
    FORM,
    MOTOR_ANGLE,
    POSITION,
    UNITS,
    Frame,
    checksums,
    dataset_path,
    parameters_checksum,
)
from warpflag.record.rows import Rows

__all__ = ["FORMAT", "add_parameters", "first_image", "growth", "values_of"]

FORMAT = ("v108", "v108")
"""The format of HDF5 1.8, in which groups and headers of datasets have checksums. Later formats mark a file as open
while it is written, and one whose writer was killed can't be opened again."""

_CHUNK_BYTES = 1 << 20  # of a chunk, for 16 to 64 frames: HDF5's cache of chunks holds one
_WHOLE = {"step": np.int64, FORM: np.int8}  # types of whole numbers by entry
_NUMBERS = itertools.count()
_MEMORY_BLOCK = 4096  # bytes by which a file in memory grows
_SLACK_BYTES = 4096  # what HDF5 allocates ahead for small things
_TREE_FANOUT = 64  # chunks in a node of HDF5's tree of chunks


def values_of(frame: Frame) -> dict[str, Any]:
    """A copy of a frame by the names of its entries in the file."""
    values = {
        POSITION: frame.positions,
        E1: frame.directors,
        MOTOR_ANGLE: frame.motor_angle,
        BODY_POSITION: frame.body_position,
        BODY_ORIENTATION: frame.body_orientation,
        "time": frame.time,
        **{f"observables/{name}": value for name, value in frame.observables.items()},
    }
    found = {"step": np.int64(frame.step), **{name: np.array(v, dtype=np.float64) for name, v in values.items()}}
    return found if frame.forms is None else {**found, FORM: np.array(frame.forms, dtype=np.int8)}


def first_image(values: Mapping[str, Any], parameters: Mapping[str, Any]) -> bytes:
    """The bytes of a record of one frame.

    Args:
        values: of the frame, by entry, as `values_of` gives them.
        parameters: what /parameters holds.

    Raises:
        ValueError: the frame has other nodes or flagella than the parameters say.
    """
    nodes, flagella = int(parameters["first_node"][-1]), len(parameters["first_node"]) - 1
    for name, shape in {POSITION: (nodes, 3), E1: (nodes, 3), MOTOR_ANGLE: (flagella,)}.items():
        if np.shape(values[name]) != shape:
            raise ValueError(f"{name} of a frame has shape {np.shape(values[name])}, the scene's is {shape}")
    sums = np.array([checksums(np.asarray(value)[None])[0] for value in values.values()], dtype=np.uint32)
    version = parameters["versions"].get("warpflag", "unknown")
    with _in_memory(_empty_image(tuple((name, np.shape(value)) for name, value in values.items()), version)) as file:
        for name, value in {**values, CHECKSUMS: sums}.items():
            Rows(file, name).write(0, np.asarray(value)[None])
        add_parameters(file, parameters)
        file.flush()
        return file.id.get_file_image()


@functools.lru_cache(maxsize=16)
def _empty_image(shapes: tuple[tuple[str, tuple[int, ...]], ...], version: str) -> bytes:
    """A record of one frame of zeros without /parameters: the same for all cells of a batch that are alike.

    Args:
        shapes: of the entries of a frame, by name.
        version: of this program.
    """
    with _in_memory() as file:
        file.create_group("h5md").attrs["version"] = np.array([1, 1], dtype=np.int32)
        file.create_group("h5md/author").attrs["name"] = _text("unknown")
        creator = file.create_group("h5md/creator")
        creator.attrs["name"] = _text("warpflag")
        creator.attrs["version"] = _text(version)
        box = file.create_group("particles/flagella/box")
        box.attrs["dimension"] = np.int32(3)
        box.attrs["boundary"] = np.array([_text("none")] * 3)
        empty = {name: np.zeros(shape, dtype=_WHOLE.get(name, np.float64)) for name, shape in shapes}
        # The shared datasets first, under the entry that every record has.
        for name in ("step", "time", *(name for name in empty if name not in ("step", "time"))):
            _add_dataset(file, name, empty[name])
        file.create_group("h5md/modules/units").attrs["version"] = np.array([1, 0], dtype=np.int32)
        time: Any = file[dataset_path("time")]
        time.make_scale("time")
        for name in empty:
            _describe(file[dataset_path(name)], name, time)
        for name in empty.keys() - {"step", "time", POSITION}:
            file[f"{name}/step"] = file[dataset_path("step")]
            file[f"{name}/time"] = time
        sums = _add_dataset(file, CHECKSUMS, np.zeros(len(empty), dtype=np.uint32))
        sums.attrs["entries"] = np.array([_text(name) for name in empty])
        file.flush()
        return file.id.get_file_image()


def _in_memory(image: bytes | None = None) -> Any:
    """A file of HDF5 in memory, open for writing.

    Args:
        image: its bytes; None: it is empty.
    """
    import h5py
    from h5py import h5f, h5p  # pyright: ignore[reportAttributeAccessIssue]

    name = f"record {next(_NUMBERS)}"  # HDF5 takes files of one name for one file, also those of other threads
    if image is None:
        return h5py.File(name, "w", libver=FORMAT, driver="core", backing_store=False, block_size=_MEMORY_BLOCK)
    access = h5p.create(h5p.FILE_ACCESS)
    access.set_fapl_core(_MEMORY_BLOCK, False)
    access.set_libver_bounds(h5f.LIBVER_V18, h5f.LIBVER_V18)
    access.set_file_image(image)
    return h5py.File(h5f.open(name.encode(), h5f.ACC_RDWR, access))


def add_parameters(file: Any, parameters: Mapping[str, Any]) -> None:
    """Writes /parameters, which must not be there yet, into an open file of HDF5."""
    group = file.create_group("parameters")
    for name, value in parameters.items():
        if name == "versions":
            group.create_group(name).attrs.update({key: _text(version) for key, version in value.items()})
        else:
            group[name] = _text(value) if isinstance(value, str) else value
    group.attrs["checksum"] = np.uint32(parameters_checksum(parameters))


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


def _add_dataset(file: Any, name: str, value: Any) -> Any:
    """A dataset of frames whose first is `value`, in chunks of 16 to 64 frames."""
    first = np.asarray(value)[None]
    chunk = int(np.clip(_CHUNK_BYTES // max(1, first.nbytes), 16, 64))
    shape = first.shape[1:]
    return file.create_dataset(dataset_path(name), data=first, maxshape=(None, *shape), chunks=(chunk, *shape))


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
