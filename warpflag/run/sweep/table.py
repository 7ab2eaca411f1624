"""The table of a sweep: a row per member, and means over its repeats; as CSV and in HDF5."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from warpflag.base.output import whole
from warpflag.run.run_directory import SCENE_NAME, summary_of

__all__ = ["MEANS_NAME", "TABLE_NAME", "mean_speed", "status_of", "write"]

TABLE_NAME, MEANS_NAME, HDF5_NAME = "table.csv", "means.csv", "table.h5"
# Entries of a summary that the table takes; what the machine took for them is no result.
_RESULTS = ("time", "frames", "steps", "rejected_steps", "evaluations", "observables", "rates", "events", "behaviour")


def status_of(directory: Path) -> str:
    """The status of a member: that of its summary, "begun" before there is one, "missing" before it began."""
    begun = "begun" if (directory / SCENE_NAME).exists() else "missing"
    return str(summary_of(directory).get("status", begun))


def mean_speed(directories: Sequence[Path]) -> str:
    """The mean net speed of members that are done, with its standard error, in words; empty without two of them."""
    found = [_flat(summary_of(path).get("rates") or {}).get("net_speed", math.nan) for path in directories]
    speeds = np.array([speed for speed in found if isinstance(speed, float) and math.isfinite(speed)])
    if len(speeds) < 2:
        return ""
    error = speeds.std(ddof=1) / math.sqrt(len(speeds))
    return f"net_speed {speeds.mean():.4g} +- {error:.2g} um/s (standard error of {len(speeds)})"


def write(directory: Path, members: Sequence[Any], names: Sequence[str]) -> None:
    """Writes table.csv, means.csv where there are repeats, and table.h5 with both.

    Args:
        directory: of the sweep.
        members: of the sweep, as `Sweep.members` gives them.
        names: of the members' directories.
    """
    rows = [_row(member, directory / name) for member, name in zip(members, names, strict=True)]
    columns = _columns(rows)
    tables = {"members": (columns, rows)}
    _write_csv(directory / TABLE_NAME, columns, rows)
    if any(member.repeat for member in members):
        varied = list(dict.fromkeys(key for member in members for key in member.values))
        means = _means(rows, varied)
        tables["means"] = (_columns(means), means)
        _write_csv(directory / MEANS_NAME, *tables["means"])
    _write_hdf5(directory / HDF5_NAME, tables)


def _row(member: Any, directory: Path) -> dict[str, Any]:
    summary = summary_of(directory)
    row: dict[str, Any] = {"member": member.number, "point": member.point, "repeat": member.repeat, **member.values}
    row["status"] = status_of(directory)
    results = _flat({name: summary[name] for name in _RESULTS if name in summary})
    # `frames` as an axis is the scene's number of intervals, and not that of the frames in the record.
    return row | {name: value for name, value in results.items() if name not in row}


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Numbers by dotted name; lists by index, and their mean under the name itself."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{name}.")
        elif isinstance(value, list):
            numbers = [float(item) if isinstance(item, int | float) else math.nan for item in value]
            flat[f"{prefix}{name}"] = float(np.mean(numbers)) if numbers else math.nan
            flat |= {f"{prefix}{name}.{k}": item for k, item in enumerate(numbers)}
        else:
            flat[f"{prefix}{name}"] = math.nan if value is None else value
    return flat


def _columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Every column that some row has; what varies stands before the status, numbers after it."""
    names = dict.fromkeys(name for row in rows for name in row)
    before = dict.fromkeys(name for row in rows for name in list(row)[: list(row).index("status")] if "status" in row)
    return [*before, *(name for name in names if name not in before)]


def _means(rows: Sequence[Mapping[str, Any]], varied: Sequence[str]) -> list[dict[str, Any]]:
    """A row per point: what its repeats share, how many are done, and mean and standard error of every number."""
    points: dict[int, list[Mapping[str, Any]]] = {}
    for row in rows:
        points.setdefault(row["point"], []).append(row)
    numbers = [name for name in _columns(rows) if name not in ("member", "point", "repeat", "status", *varied)]
    means = []
    for point, repeats in points.items():
        done = [row for row in repeats if row["status"] == "done"]
        shared = {key: repeats[0][key] for key in varied if len({str(row.get(key)) for row in repeats}) == 1}
        mean: dict[str, Any] = {"point": point, **shared, "status": f"{len(done)} of {len(repeats)} done"}
        mean["count"] = len(done)
        for name in numbers:
            values = np.array([row[name] for row in done if name in row], dtype=float)
            values = values[np.isfinite(values)]
            mean[name] = float(values.mean()) if len(values) else math.nan
            mean[f"{name}.error"] = float(values.std(ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.nan
            if name.startswith("events."):
                mean[f"{name}.count"] = len(values)  # the others had not got there when they ended
        means.append(mean)
    return means


def _write_csv(path: Path, columns: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    with whole(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(columns)
        for row in rows:
            writer.writerow([_cell(row.get(name)) for name in columns])


def _cell(value: Any) -> Any:
    """A value as it stands in the file: what there is not is empty, numbers keep every digit."""
    return "" if value is None or (isinstance(value, float) and math.isnan(value)) else value


def _write_hdf5(path: Path, tables: Mapping[str, tuple[Sequence[str], Sequence[Mapping[str, Any]]]]) -> None:
    """One compound dataset per table: whole numbers as int64, other numbers as float64, all else as text."""
    import h5py

    with whole(path) as temporary, h5py.File(temporary, "w") as file:
        for name, (columns, rows) in tables.items():
            kinds = [(column, _kind([row.get(column) for row in rows])) for column in columns]
            table = np.zeros(len(rows), dtype=kinds)
            for column, kind in kinds:
                values = [row.get(column) for row in rows]
                if kind is np.int64:
                    table[column] = values
                elif kind is np.float64:
                    table[column] = [math.nan if value is None else value for value in values]
                else:
                    table[column] = ["" if value is None else str(value) for value in values]
            file[name] = table


def _kind(values: Sequence[Any]) -> Any:
    import h5py

    if all(isinstance(value, int) and not isinstance(value, bool) for value in values):
        return np.int64
    numbers = all(value is None or (isinstance(value, int | float) and not isinstance(value, bool)) for value in values)
    return np.float64 if numbers else h5py.string_dtype()
