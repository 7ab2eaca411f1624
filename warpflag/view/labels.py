"""Labels of runs by what differs between their scenes; ranges and levels of the axes of figures."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from warpflag.observables.arrays import Array
from warpflag.scene import Scene, dumps

__all__ = ["Labels", "in_equal_ratios", "labels_of", "set_levels", "told_apart", "with_error", "with_margin"]

# They label runs only where nothing else differs.
_WEAK_KEYS = ("name", "duration", "frames", "start.record", "start.frame")
_LONGEST_LABEL = 48  # letters of a label
_LONGEST_TICK, _LETTERS_OF_TICKS = 20, 36  # letters of a tick's label, and of all of them side by side


class Labels(NamedTuple):
    """How runs are told apart.

    Attributes:
        title: the setting that differs, where it is a single one; otherwise empty.
        labels: one per run.
        values: the values of that setting where they are numbers, otherwise None.
    """

    title: str
    labels: list[str]
    values: list[float] | None


def labels_of(scenes: Sequence[Scene]) -> Labels:
    """Labels of runs by the settings in which their scenes differ; runs of equal scenes are numbered."""
    settings = [_flattened(tomllib.loads(dumps(scene))) for scene in scenes]
    keys = list(dict.fromkeys(key for each in settings for key in each))
    differing = [key for key in keys if len({str(each.get(key)) for each in settings}) > 1]
    telling = [key for key in differing if key not in _WEAK_KEYS] or [key for key in differing if key != "name"]
    if len(telling) == 1:
        (key,) = telling
        values = [each.get(key) for each in settings]
        numbers = [float(value) for value in values if isinstance(value, int | float) and not isinstance(value, bool)]
        title = " ".join(filter(None, [key, _unit(scenes[0], key)]))
        return Labels(title, [_text(value) for value in values], numbers if len(numbers) == len(values) else None)
    labels = [", ".join(f"{key.rpartition('.')[2]} {_text(each.get(key))}" for key in telling) for each in settings]
    if not telling or max(map(len, labels)) > _LONGEST_LABEL:
        labels = [scene.name for scene in scenes]
    numbered = enumerate(labels, 1)
    return Labels("", [f"{label} ({k})" if labels.count(label) > 1 else label for k, label in numbered], None)


def _unit(scene: Scene, key: str) -> str:
    """The unit of a setting in brackets; empty where it has none."""
    section, _, name = key.rpartition(".")
    owner = scene.flagellum[0] if section.startswith("flagellum.") else getattr(scene, section) if section else scene
    unit = owner.settings[name].unit.replace("um", "µm")
    return f"({unit})" if unit else ""


def _flattened(table: Any, key: str = "") -> dict[str, Any]:
    """Values of nested tables and lists of tables by dotted key."""
    if isinstance(table, dict):
        items = table.items()
    elif isinstance(table, list) and table and isinstance(table[0], dict):
        items = ((str(number), each) for number, each in enumerate(table))
    else:
        return {key: table}
    flat: dict[str, Any] = {}
    for name, value in items:
        flat |= _flattened(value, f"{key}.{name}" if key else name)
    return flat


def _text(value: Any) -> str:
    if value is None:
        return "default"
    return f"{value:g}" if isinstance(value, float) else str(value)


def told_apart(texts: Sequence[str]) -> list[str]:
    """Texts, numbers among them with as few digits, three at least, as tell them apart."""
    for digits in range(3, 17):
        short = [_short(text, digits) for text in texts]
        if len(set(short)) == len(set(texts)):
            return short
    return list(texts)


def set_levels(axis: Any, texts: Sequence[str], at: Sequence[int] | None = None) -> None:
    """Labels the places 0, 1, ... of an axis of matplotlib; long texts lose their middle, and many stand aslant.

    Args:
        axis: x or y axis.
        texts: of all places.
        at: places that are labelled; default: all.
    """
    at = range(len(texts)) if at is None else at
    every = told_apart(texts)
    labels = [every[k] for k in at]
    if max(map(len, labels), default=0) > _LONGEST_TICK:
        cut = [f"{text[:6]}…{text[-13:]}" if len(text) > _LONGEST_TICK else text for text in labels]
        labels = cut if len(set(cut)) == len(cut) else labels
    axis.set_ticks(at, labels)
    if axis.axis_name == "x" and sum(map(len, labels)) > _LETTERS_OF_TICKS:
        for label in axis.get_ticklabels():
            label.set(rotation=40, horizontalalignment="right", rotation_mode="anchor")


def with_error(mean: float, error: float) -> str:
    """A mean and its standard error, two digits of it."""
    return f"{mean:.4g} ± {error:.2g}" if not 99.5 <= error < 1e6 else f"{mean:.4g} ± {error:.0f}"


def _short(text: str, digits: int) -> str:
    try:
        return f"{float(text):.{digits}g}"
    except ValueError:
        return text


def with_margin(position: Array, logarithmic: bool) -> tuple[float, float]:
    """The range of an abscissa, the same in every panel, with room for the markers."""
    low, high = float(np.nanmin(position)), float(np.nanmax(position))
    if logarithmic:
        room = (high / low) ** 0.04
        return low / room, high * room
    room = 0.04 * (high - low) or 0.5
    return low - room, high + room


def in_equal_ratios(position: Array) -> bool:
    """Whether the values of an abscissa, three at least, are spaced as those of a logarithmic axis."""
    places = np.unique(position[np.isfinite(position)])
    if len(places) < 3 or places[0] <= 0.0:
        return False
    ratios = np.diff(np.log(places))
    return bool(np.ptp(ratios) < 1e-6 * ratios.mean())
