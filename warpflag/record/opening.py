"""Opens the file of a record and checks what it holds before any frame is read."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.record.frame_array import reading
from warpflag.record.layout import (
    BODY_ORIENTATION,
    BODY_POSITION,
    CHECKSUMS,
    E1,
    ENTRIES,
    FORM,
    MOTOR_ANGLE,
    PARAMETERS,
    POSITION,
    RecordError,
    dataset_path,
    parameters_checksum,
    summed_entries,
    text_of,
)

__all__ = ["Contents", "open_file", "read_contents"]

# Looks at a record that is being written, and the time between two: a block of frames is written in a few ms.
_ATTEMPTS, _SECONDS_BETWEEN = 10, 0.01


@dataclass(frozen=True)
class Contents:
    """What a record holds beside its frames, as it was when it was looked at.

    Attributes:
        parameters: what /parameters holds, by name.
        shapes: of one frame, by the name of what is kept frame by frame: step, time, the entries, the observables, and
            checksums if any.
        frame_count: number of committed frames.
        sums: checksums of the committed frames by entry, shape [frame_count]; empty for a record without.
    """

    parameters: dict[str, Any]
    shapes: dict[str, tuple[int, ...]]
    frame_count: int
    sums: dict[str, NDArray[np.uint32]]


def read_contents(path: Path, stays_open: bool = False) -> tuple[Contents, Any]:
    """Looks into a record, also into one that a run is writing: then once more where a block was written meanwhile.

    Returns:
        what it holds, and the file of h5py, if it is to stay open, or None.

    Raises:
        RecordError: the file is damaged, or no record of this program.
    """
    for attempt in range(_ATTEMPTS):
        before = _state(path)
        file = None
        try:
            file = open_file(path)
            contents = _checked(path, file)
            if stays_open:
                return contents, file
            file.close()
            return contents, None
        except RecordError:
            if file is not None:
                file.close()
            time.sleep(_SECONDS_BETWEEN)
            if attempt + 1 == _ATTEMPTS or _state(path) == before:
                raise
    raise AssertionError("the last attempt returns or raises")


def _state(path: Path) -> tuple[int, int]:
    """What changes when a file is written."""
    with reading(path, "can't be read"):
        found = path.stat()
    return found.st_mtime_ns, found.st_size


def open_file(path: Path) -> Any:
    """The file of h5py, open for reading; it is the caller's to close.

    Raises:
        RecordError: it can't be opened.
    """
    import h5py

    with reading(path, "not a readable HDF5 file"):
        try:
            # Without a lock, or a run that is still writing would keep its readers out.
            return h5py.File(path, "r", locking=False)
        except OSError as error:
            # A file that this process has open with a lock can't be opened without.
            if "locking" not in str(error):
                raise
            return h5py.File(path, "r")


def _checked(path: Path, file: Any) -> Contents:
    """What a file holds; shapes are compared with each other and with the flagella, the parameters with their sum."""
    with reading(path, "is damaged"):
        missing = [entry for entry in (*ENTRIES, "parameters/first_node") if entry not in file]
        if missing:
            raise RecordError(f"{path}: not a record of warpflag, it has no /{missing[0]}")
        frames = len(file[dataset_path("step")])
        parameters = _parameters(path, file["parameters"])
        forms = [FORM] if FORM in file else []
        entries = ["step", "time", *ENTRIES, *forms, *(f"observables/{name}" for name in file.get("observables", ()))]
        shapes = _shapes(path, file, entries, frames, parameters["first_node"])
        sums: dict[str, NDArray[np.uint32]] = {}
        if CHECKSUMS in file:
            listed, dataset = summed_entries(file[CHECKSUMS]), file[CHECKSUMS]
            if sorted(listed) != sorted(entries) or dataset.shape[1:] != (len(entries),) or len(dataset) < frames:
                raise RecordError(f"{path}: is damaged: /{CHECKSUMS} does not list the entries of the record")
            sums = dict(zip(listed, dataset[:frames].T, strict=True))
            shapes[CHECKSUMS] = (len(entries),)
    return Contents(parameters, shapes, frames, sums)


def _shapes(
    path: Path, file: Any, entries: list[str], frames: int, first_node: NDArray[np.int64]
) -> dict[str, tuple[int, ...]]:
    """The shape of one frame of every entry, compared with the flagella and with the number of frames."""
    nodes, flagella, size = int(first_node[-1]), len(first_node) - 1, path.stat().st_size
    found = {}
    shapes = {POSITION: (nodes, 3), E1: (nodes, 3), MOTOR_ANGLE: (flagella,), "step": (), "time": ()}
    shapes |= {BODY_POSITION: (3,), BODY_ORIENTATION: (4,), FORM: (nodes,)}
    for name in entries:
        dataset = file[dataset_path(name)]
        found[name] = tuple(dataset.shape[1:])
        allowed = [shapes[name]] if name in shapes else [(), (flagella,)]
        fits = found[name] in allowed and dataset.dtype.kind == ("i" if name in ("step", FORM) else "f")
        if not fits or len(dataset) < frames or frames * dataset.dtype.itemsize > size:
            problem = f"/{dataset_path(name)} has the shape {dataset.shape}, type {dataset.dtype}"
            raise RecordError(f"{path}: is damaged: {problem} beside {frames} frames, {nodes} nodes")
    return found


def _parameters(path: Path, group: Any) -> dict[str, Any]:
    with reading(path, "is damaged: /parameters can't be read"):
        if any(np.prod(group[name].shape, dtype=int) > path.stat().st_size for name in PARAMETERS):
            raise RecordError(f"{path}: is damaged: /parameters is larger than the file")
        found = {name: group[name][()] for name in PARAMETERS}
        found |= {name: text_of(found[name]) for name in ("scene", "scene_sha256")}
        found |= {name: float(found[name]) for name in ("filament_radius", "body_length", "body_width")}
        found["first_node"] = np.asarray(found["first_node"]).astype(np.int64)
        found["versions"] = {name: text_of(value) for name, value in group["versions"].attrs.items()}
        expected = group.attrs.get("checksum")
        sound = expected is None or int(expected) == parameters_checksum(found)
        sound = sound and hashlib.sha256(found["scene"].encode()).hexdigest() == found["scene_sha256"]
        bounds = found["first_node"].tolist()
        if not sound or len(bounds) < 2 or bounds[0] != 0 or any(b - a < 2 for a, b in pairwise(bounds)):
            raise RecordError(f"{path}: is damaged: /parameters does not agree with its checksum")
    return found
