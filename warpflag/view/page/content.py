"""What the page shows of a record, small: positions in 16 bits, colours in 8, numbers to five digits."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

from warpflag.base.output import OutputError
from warpflag.record import Record, RecordError
from warpflag.scene import loads
from warpflag.view.coloring import (
    BODY_COLOR,
    DISPLAY_RADIUS,
    FLAGELLUM_COLORS,
    FORM_COLORS,
    QUANTITIES,
    UNDEFINED_COLOR,
    Coloring,
    map_color,
)
from warpflag.view.curves import curves
from warpflag.view.poses import motors
from warpflag.view.usd.camera import Extent, steady_path, view_axes
from warpflag.view.usd.cell import SPOKE_COLORS, SPOKE_LENGTHS, SPOKE_WIDTH

__all__ = ["content"]

_UNDEFINED = 255  # colour number of a value that is not defined; the others are 0 to 254
_COORDINATE_STEPS = 65535  # of a coordinate in 16 bits
_BYTES_PER_NODE = 9  # three coordinates and three quantities


def content(record: Record, color_by: str, follow: bool, most_bytes: int | None) -> dict[str, Any]:
    """Everything the page shows, ready for JSON; see `page_of` for the arguments.

    Positions are those of the nodes relative to the body's middle: unsigned 16-bit shares of the box from `low` to
    `high` [um]. Arrays are base64 of little-endian numbers, frames first.
    """
    if color_by not in QUANTITIES:
        raise OutputError(f"color {color_by}: must be one of {', '.join(QUANTITIES)}")
    if record.frame_count == 0:
        raise RecordError(f"{record.path}: holds no frames to show")
    scene, first_node = loads(record.scene_text), record.first_node
    frames = _kept(record, most_bytes)
    positions = record.positions[frames]
    centres = record.body_position[frames]
    drawn = {"positions": positions, "body positions": centres, "body orientations": record.body_orientation[frames]}
    for name, values in {**drawn, "motor angles": record.motor_angle[frames]}.items():
        if not np.isfinite(values).all():
            raise OutputError(f"the record holds {name} that are not finite, which no page can show")
    relative = positions - centres[:, None]
    low, high = relative.min(axis=(0, 1)), relative.max(axis=(0, 1))
    step = np.where(high > low, (high - low) / _COORDINATE_STEPS, 1.0)
    anchors, tripods = motors(record, scene)
    path = steady_path(centres)
    return {
        "name": scene.name,
        "scene": record.scene_text,
        "version": record.versions.get("warpflag", ""),
        "frameStride": frames.step,
        "times": _numbers(1e3 * record.times[frames], 7),
        "firstNode": first_node.tolist(),
        "positions": {
            "low": low.tolist(),
            "step": step.tolist(),
            "values": _packed(np.rint((relative - low) / step), "<u2"),
        },
        "body": {
            "length": record.body_length,
            "width": record.body_width,
            "color": BODY_COLOR,
            "positions": _packed(centres - centres[0], "<f4"),
            "orientations": _packed(record.body_orientation[frames], "<f4"),
        },
        "motors": {
            "anchors": anchors.tolist(),
            "tripods": tripods.tolist(),
            "angles": _packed(record.motor_angle[frames], "<f4"),
            "lengths": SPOKE_LENGTHS,
            "width": SPOKE_WIDTH,
            "colors": SPOKE_COLORS,
        },
        "radius": record.filament_radius,
        "displayRadius": max(DISPLAY_RADIUS, record.filament_radius),
        "path": _packed(path - centres[0], "<f4"),
        "view": _view(record, positions, centres, path),
        "follow": follow,
        "colorBy": color_by,
        "flagellumColors": FLAGELLUM_COLORS,
        "undefinedColor": UNDEFINED_COLOR,
        "map": [f"#{red:02x}{green:02x}{blue:02x}" for red, green, blue in _map_colors()],
        "colorings": _colorings(record, scene, positions, frames),
        "curves": [
            {"label": curve.label, "lines": [_numbers(line, 5) for line in curve.values[frames].T]}
            for curve in curves(record)
        ],
    }


def _kept(record: Record, most_bytes: int | None) -> slice:
    """The frames to show: all, or every second, third, ... of them."""
    needed = _BYTES_PER_NODE * int(record.first_node[-1]) * record.frame_count
    stride = 1 if most_bytes is None else -(-needed // most_bytes)
    return slice(0, record.frame_count, max(1, stride))


def _view(record: Record, positions: Any, centres: Any, path: Any) -> dict[str, Any]:
    """Where the camera stands at first: its axes as rows, and how far the cell reaches from its path [um]."""
    axes = view_axes(record.body_orientation[0])
    extent = Extent(axes, path)
    extent.add(slice(None), positions, record.filament_radius)
    extent.add(slice(None), centres[:, None], 0.5 * record.body_length)
    right, left, up, down, toward, away = extent.reach
    middle = 0.5 * np.array([right - left, up - down, toward - away]) @ axes
    half = 0.5 * np.array([right + left, up + down, toward + away])
    return {"axes": axes.tolist(), "middle": middle.tolist(), "half": half.tolist()}


def _colorings(record: Record, scene: Any, positions: Any, frames: slice) -> dict[str, Any]:
    """By quantity: its label, the value of the last colour, and the share of it at every node, 0 to 254.

    Of forms their names and colours, and the number of that of every node.
    """
    found = {}
    for name in QUANTITIES[1:]:
        if (name == "phase_difference" and len(record.first_node) == 2) or (name == "form" and record.forms is None):
            continue
        coloring = Coloring(name, record, scene)
        if coloring.names:
            own = {"label": coloring.label, "names": coloring.names, "colors": FORM_COLORS[: len(coloring.names)]}
            found[name] = {**own, "shares": _packed(coloring.values(positions, frames), "u1")}
            continue
        values = coloring.values(positions, frames) / coloring.highest
        shares = np.where(np.isnan(values), _UNDEFINED, np.clip((_UNDEFINED - 1) * values + 0.5, 0.0, _UNDEFINED - 1))
        found[name] = {"label": coloring.label, "highest": coloring.highest, "shares": _packed(shares, "u1")}
    return found


def _map_colors() -> list[list[int]]:
    """The colours of the map, 0 to 255 each, shape [255, 3]."""
    return np.rint(map_color(np.linspace(0.0, 1.0, _UNDEFINED))).astype(int).tolist()


def _packed(values: Any, kind: str) -> str:
    """Base64 of an array's numbers in a type of NumPy's."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()


def _numbers(values: Any, digits: int) -> list[float | None]:
    """Numbers to some digits, 0 where they are nothing beside the largest, and None where there is none."""
    values = np.asarray(values, float)
    least = 1e-12 * np.max(np.abs(values), initial=0.0, where=np.isfinite(values))
    values = np.where(np.abs(values) < least, 0.0, values)
    return [float(f"{value:.{digits}g}") if np.isfinite(value) else None for value in values.tolist()]
