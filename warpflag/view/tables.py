"""A record as labelled arrays: an xarray.Dataset. Needs xarray (extra `notebook`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from warpflag.base.output import OutputError, missing
from warpflag.record import Record
from warpflag.record.layout import BODY_ORIENTATION, BODY_POSITION, E1, MOTOR_ANGLE, POSITION, UNITS

__all__ = ["dataset"]

# Where it is in the file, dimensions after the frame, and meaning of what is no observable.
_ENTRIES = {
    "position": (POSITION, ("node", "axis"), "nodes in lab axes"),
    "director": (E1, ("node", "axis"), "director e1 of motor tripod and segments"),
    "motor_angle": (MOTOR_ANGLE, ("flagellum",), "turn of each motor relative to the body, accumulated"),
    "body_position": (BODY_POSITION, ("axis",), "centre of the body"),
    "body_orientation": (BODY_ORIENTATION, ("quaternion",), "quaternion from body to lab axes"),
}


def dataset(record: Record) -> Any:
    """A record in memory as an xarray.Dataset.

    Coordinates are time [s], step, the flagellum of each node and its number from the motor on; attributes are the
    scene's text, its hash and the versions. Every variable has its unit in `attrs["units"]`.

    Raises:
        OutputError: xarray is not installed.
    """
    try:
        import xarray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise OutputError(f"labelled arrays need xarray: {missing('xarray', 'notebook')}") from None
    values = {
        "position": record.positions[:],
        "director": record.directors[:],
        "motor_angle": record.motor_angle,
        "body_position": record.body_position,
        "body_orientation": record.body_orientation,
    }
    variables = {}
    for name, (entry, dimensions, meaning) in _ENTRIES.items():
        about = {"units": UNITS.get(entry, ""), "long_name": meaning}
        variables[name] = (("time", *dimensions), values[name], about)
    for name, found in record.observables.items():
        dimensions = ("time", "flagellum")[: found.ndim]
        variables[name] = (dimensions, found, {"units": UNITS.get(f"observables/{name}", "")})
    first_node = record.first_node
    counts = np.diff(first_node)
    coordinates = {
        "time": ("time", record.times, {"units": "s"}),
        "step": ("time", record.steps),
        "axis": list("xyz"),
        "quaternion": list("xyzw"),
        "flagellum": np.arange(len(counts)),
        "flagellum_of_node": ("node", np.repeat(np.arange(len(counts)), counts)),
        "number_in_flagellum": ("node", np.concatenate([np.arange(count) for count in counts])),
    }
    about = {"scene": record.scene_text, "scene_sha256": record.scene_sha256, **record.versions}
    return xarray.Dataset(variables, coordinates, about)
