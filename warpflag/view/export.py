"""A record for other programs: VTKHDF for ParaView, extended XYZ for OVITO, CSV for tables. Units um, pN, s, rad."""

from __future__ import annotations

import csv
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from warpflag.base.output import whole
from warpflag.record import Record, RecordError
from warpflag.scene import loads
from warpflag.view.coloring import Coloring

__all__ = ["write_csv", "write_vtkhdf", "write_xyz"]

_BLOCK_POINTS = 1 << 16  # nodes that are taken from the record at once: some MB
_KINDS = ("Vertices", "Lines", "Polygons", "Strips")


def write_vtkhdf(record: Record, path: str | Path) -> None:
    """Writes the flagella as lines over time; ParaView opens the file without a plugin.

    The file holds a PolyData with time steps.
    Points have the order of the record's nodes and its precision. Each carries its flagellum, curvature [1/um],
    phase_difference with the nearest other flagellum and steric_force [pN] (see `Coloring`); each time step
    body_position [um], body_orientation (x, y, z, w), motor_angle [rad] and the observables as field data.

    Raises:
        RecordError: a record without frames.
        OSError: the file can't be written.
    """
    import h5py

    _check_frames(record)
    frames, nodes = record.positions.shape[:2]
    counts = np.diff(record.first_node)
    with whole(Path(path)) as temporary, h5py.File(temporary, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = np.array([2, 3])
        root.attrs["Type"] = np.bytes_("PolyData")
        root["NumberOfPoints"] = [nodes]
        for kind in _KINDS:
            has = kind == "Lines"
            cells = root.create_group(kind)
            cells["NumberOfCells"] = [len(counts) if has else 0]
            cells["NumberOfConnectivityIds"] = [nodes if has else 0]
            cells["Connectivity"] = np.arange(nodes if has else 0, dtype=np.int64)
            cells["Offsets"] = record.first_node if has else np.zeros(1, dtype=np.int64)
        steps = root.create_group("Steps")
        steps.attrs["NSteps"] = frames
        steps["Values"] = record.times
        for name in ("PartOffsets", "NumberOfParts"):
            steps[name] = np.full(frames, name == "NumberOfParts", dtype=np.int64)
        for name in ("CellOffsets", "ConnectivityIdOffsets"):
            steps[name] = np.zeros((frames, len(_KINDS)), dtype=np.int64)  # the lines are the same at all times
        first_points = nodes * np.arange(frames, dtype=np.int64)
        steps["PointOffsets"] = first_points
        _write_points(root, record, first_points)
        _write_fields(root, record)


def _write_points(root: Any, record: Record, first_points: np.ndarray) -> None:
    frames, nodes = record.positions.shape[:2]
    scene = loads(record.scene_text)
    quantities = ["curvature", "steric_force"] + ["phase_difference"] * (len(record.first_node) > 2)
    points = root.create_dataset("Points", (frames * nodes, 3), np.float64)
    data, offsets = root.create_group("PointData"), root.create_group("Steps/PointDataOffsets")
    data["flagellum"] = np.repeat(np.arange(len(record.first_node) - 1), np.diff(record.first_node))
    offsets["flagellum"] = np.zeros(frames, dtype=np.int64)
    for name in quantities:
        data.create_dataset(name, (frames * nodes,), np.float32)
        offsets[name] = first_points
    block = max(1, _BLOCK_POINTS // nodes)
    for first in range(0, frames, block):
        part = slice(first, min(first + block, frames))
        rows = slice(part.start * nodes, part.stop * nodes)
        positions = record.positions[part]
        points[rows] = positions.reshape(-1, 3)
        for name in quantities:
            data[name][rows] = Coloring(name, record, scene).values(positions, part).ravel()


def _write_fields(root: Any, record: Record) -> None:
    frames = record.frame_count
    fields, offsets, sizes = (
        root.create_group(name) for name in ("FieldData", "Steps/FieldDataOffsets", "Steps/FieldDataSizes")
    )
    for name, values in _by_frame(record).items():
        fields[name] = values
        offsets[name] = np.arange(frames, dtype=np.int64)
        sizes[name] = np.tile([values[0].size, 1], (frames, 1))  # components and tuples


def write_xyz(record: Record, path: str | Path) -> None:
    """Writes an extended XYZ file, which OVITO and ASE read: the nodes as particles N, the body as a particle B.

    Each node has its radius [um], flagellum, curvature [1/um], steric_force [pN] and, of two flagella or more,
    phase_difference, -1 where it is not defined. The body is an ellipsoid with half axes in aspherical_shape [um] and
    its orientation (x, y, z, w); its flagellum is -1. The comment of each frame has the time [s] and the observables.

    Raises:
        RecordError: a record without frames.
        OSError: the file can't be written.
    """
    _check_frames(record)
    scene, first_node = loads(record.scene_text), record.first_node
    quantities = ["curvature", "steric_force"] + ["phase_difference"] * (len(first_node) > 2)
    flagellum = np.repeat(np.arange(len(first_node) - 1), np.diff(first_node))
    columns = ["species:S:1", "pos:R:3", "radius:R:1", "aspherical_shape:R:3", "orientation:R:4", "flagellum:I:1"]
    properties = ":".join([*columns, *(f"{name}:R:1" for name in quantities)])
    half_axes = 0.5 * np.array([record.body_width, record.body_width, record.body_length])
    body = " ".join(f"{value:.6g}" for value in half_axes)
    thin = f"{record.filament_radius:.6g} 0 0 0 0 0 0 1"
    single = {name: values for name, values in record.observables.items() if values.ndim == 1}
    with whole(Path(path)) as temporary, temporary.open("w") as file:
        for frame, time in enumerate(record.times.tolist()):
            block = slice(frame, frame + 1)
            positions = record.positions[block]
            found = [Coloring(name, record, scene).values(positions, block)[0] for name in quantities]
            values = np.nan_to_num(np.stack(found, axis=1), nan=-1.0)
            known = [f"{name}={each[frame]:.9g}" for name, each in single.items() if np.isfinite(each[frame])]
            file.write(f"{len(flagellum) + 1}\n")
            file.write(f'Properties={properties} pbc="F F F" Time={time:.9g} {" ".join(known)}\n')
            place, turn = record.body_position[frame], record.body_orientation[frame]
            row = [*_texts(place), f"{half_axes.max():.6g}", body, *_texts(turn), "-1", *["0"] * len(quantities)]
            file.write(f"B {' '.join(row)}\n")
            for node, own, k in zip(positions[0], values, flagellum.tolist(), strict=True):
                file.write(f"N {' '.join(_texts(node))} {thin} {k} {' '.join(_texts(own))}\n")


def _texts(values: np.ndarray) -> list[str]:
    return [f"{value:.9g}" for value in values.tolist()]


def write_csv(record: Record, path: str | Path) -> None:
    """Writes two tables: `path` with a row per frame, and NAME_nodes.csv beside it with a row per node and frame.

    The first has time, step, body_position_x ..., body_orientation_x ... _w, motor_angle_0 ... and the observables;
    what a frame does not have (a rate in the first) is empty. The second has time, flagellum, node, x, y, z.

    Raises:
        RecordError: a record without frames.
        OSError: a file can't be written.
    """
    _check_frames(record)
    path = Path(path)
    columns: dict[str, Any] = {"time": record.times, "step": record.steps}
    for name, values in _by_frame(record).items():
        if values.ndim == 1:
            columns[name] = values
        else:
            axes = "xyzw"[: values.shape[1]] if name.startswith("body_") else range(values.shape[1])
            columns |= {f"{name}_{axis}": values[:, i] for i, axis in enumerate(axes)}
    with whole(path) as temporary, temporary.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(columns)
        for row in zip(*(column.tolist() for column in columns.values()), strict=True):
            table.writerow("" if value != value else value for value in row)
    with whole(path.with_stem(f"{path.stem}_nodes")) as temporary, temporary.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(("time", "flagellum", "node", "x", "y", "z"))
        labels = [(k, i) for k, (first, end) in enumerate(pairwise(record.first_node)) for i in range(end - first)]
        for frame, time in enumerate(record.times.tolist()):
            positions = record.positions[frame].tolist()
            table.writerows((time, *label, *position) for label, position in zip(labels, positions, strict=True))


def _by_frame(record: Record) -> dict[str, np.ndarray]:
    """What is recorded once per frame, not per node, by name; shape [frame] or [frame, ...]."""
    return {
        "body_position": record.body_position,
        "body_orientation": record.body_orientation,
        "motor_angle": record.motor_angle,
        **record.observables,
    }


def _check_frames(record: Record) -> None:
    if record.frame_count == 0:
        raise RecordError(f"{record.path}: holds no frames to export")
