"""The axes of a sweep: which keys vary, over which values, and which of them together.

An axis of several keys, with commas between them, has a list of values of them at each of its points:

    "motor.knee, motor.no_load" = [[100, 200], [175, 300], [250, 400]]
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from warpflag.scene import SceneError
from warpflag.scene.errors import written
from warpflag.scene.reading import check_key, is_whole, keys_of
from warpflag.scene.scene_file import read_overrides

__all__ = ["MOST_MEMBERS", "check", "count", "grid_axes", "named", "point", "refuse_overrides", "values_by_key"]

MOST_MEMBERS = 1_000_000  # of a sweep: more is a slip in its axes, and their scenes would take gigabytes
_OUTER_COMMA = re.compile(r",(?![^\[]*\])")  # one that is not within brackets


def named(given: Mapping[str, Any]) -> dict[str, list[Any]]:
    """The values of all axes, each by its keys with a comma and a space between them.

    Raises:
        SceneError: an axis is given twice, or its values are of another form.
    """
    found: dict[str, list[Any]] = {}
    for axis, values in given.items():
        name = ", ".join(keys_of(axis))
        if name in found:
            raise SceneError(f"axes.{name}", values, "is given twice")
        found[name] = _values(f"axes.{name}", values)
    return found


def point(axis: str, value: Any) -> dict[str, Any]:
    """Values by dotted key at one point of an axis."""
    keys = keys_of(axis)
    return {axis: value} if len(keys) == 1 else dict(zip(keys, value, strict=True))


def values_by_key(axes: Mapping[str, Sequence[Any]]) -> dict[str, list[Any]]:
    """All values that a key has along its axis, by dotted key."""
    found: dict[str, list[Any]] = {key: [] for axis in axes for key in keys_of(axis)}
    for axis, values in axes.items():
        for value in values:
            for key, own in point(axis, value).items():
                found[key].append(own)
    return found


def refuse_overrides(axes: Mapping[str, Any], overrides: Sequence[str]) -> None:
    """That no value of the command line is one that an axis would replace in every member."""
    for key, value in read_overrides(overrides).items():
        for axis in axes:
            if key not in keys_of(axis):
                continue
            problem = f"varies along an axis of the sweep, {axis}"
            if key == axis:
                problem = f"is an axis of the sweep as well; --grid {key}={written(value)} takes the place of that axis"
            raise SceneError(key, value, problem, source="--set")


def grid_axes(arguments: Sequence[str]) -> dict[str, list[Any]]:
    """Axes from the command line, written in one of these ways:

        key=from:to:count
        key=from:to:count:log
        key=a,b,c
        key,other=[a,b],[c,d]     of keys that vary together

    Raises:
        SceneError: an argument has another form.
    """
    axes: dict[str, list[Any]] = {}
    for argument in arguments:
        key, sign, text = argument.partition("=")
        key = ", ".join(keys_of(key))
        parts = text.split(":")
        try:
            if not sign or not key or len(parts) not in (1, 3, 4):
                raise ValueError
            if len(parts) > 1:
                table = {"from": float(parts[0]), "to": float(parts[1]), "count": int(parts[2])}
                table |= {"spacing": parts[3]} if len(parts) == 4 else {}
                found = _values(key, table)
            elif len(keys_of(key)) > 1:
                found = _values(key, read_overrides([f"{key}=[{text}]"])[key])
            else:
                items = filter(None, _OUTER_COMMA.split(text))
                found = [read_overrides([f"{key}={item}"])[key] for item in items]
        except ValueError as error:
            if isinstance(error, SceneError):
                raise error.located("--grid") from None
            problem = "must be written key=from:to:count, key=from:to:count:log, key=a,b,c or key,other=[a,b],[c,d]"
            raise SceneError(key, text, problem, source="--grid") from None
        if not found:
            raise SceneError(key, text, "has no values", source="--grid")
        if key in axes:
            raise SceneError(key, text, "is given twice", source="--grid")
        axes[key] = found
    return axes


def _values(key: str, values: Any) -> list[Any]:
    """The values of an axis: a list, or from, to, count and perhaps spacing."""
    together = len(keys_of(key.removeprefix("axes.")))
    if isinstance(values, list) and values:
        for value in values if together > 1 else ():
            if not isinstance(value, list) or len(value) != together:
                raise SceneError(key, value, f"must be a list of {together} values, one for each key")
        return values
    if together > 1:
        raise SceneError(key, values, f"must be a list of lists of {together} values, one for each key")
    if isinstance(values, dict) and values.keys() | {"spacing"} == {"from", "to", "count", "spacing"}:
        ends, spacing = [values["from"], values["to"]], values.get("spacing", "linear")
        if spacing not in ("linear", "log"):
            raise SceneError(f"{key}.spacing", spacing, "must be one of linear, log")
        if not all(isinstance(end, int | float) and not isinstance(end, bool) and np.isfinite(end) for end in ends):
            raise SceneError(key, values, "must have finite numbers as from and to")
        if values["count"] == 1 and ends[0] != ends[1]:
            raise SceneError(f"{key}.count", 1, "must be 2 or more where from and to differ")
        if spacing == "log" and min(ends) <= 0.0:
            raise SceneError(key, values, "must have from and to above 0 where spacing is log")
        spaced = np.geomspace if spacing == "log" else np.linspace
        found = [float(value) for value in spaced(ends[0], ends[1], count(f"{key}.count", values["count"]))]
        if is_whole(key.removeprefix("axes.")):
            return [round(value) if math.isclose(value, round(value), rel_tol=1e-12) else value for value in found]
        return found
    raise SceneError(key, values, "must be a list of values, or { from = , to = , count = }")


def check(axes: Mapping[str, Sequence[Any]]) -> None:
    """That scenes have the keys of all axes, each in one alone, and that no two values of one make the same members.

    Raises:
        SceneError: they have not, or they do.
    """
    taken: dict[str, str] = {}
    for axis, values in axes.items():
        for key in keys_of(axis):
            if not key:
                raise SceneError(f"axes.{axis}", list(values), "has no key before or after a comma")
            check_key(key, list(values))
            if key == "name":
                problem = "is no axis: members are named after the sweep and their numbers"
                raise SceneError(f"axes.{axis}", list(values), problem)
            if key in taken:
                where = "twice in one axis" if taken[key] == axis else f"in another axis as well, {taken[key]}"
                raise SceneError(f"axes.{axis}", list(values), f"has {key}, which is {where}")
            taken[key] = axis
        found: set[str] = set()
        for value in values:
            number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300
            text = written(float(value) if number else value)
            if text in found:
                raise SceneError(f"axes.{axis}", list(values), f"has {text} twice, which makes the same members twice")
            found.add(text)


def count(key: str, value: Any) -> int:
    """A whole number that is given for a key.

    Raises:
        SceneError: it is none, or below 1.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MOST_MEMBERS:
        raise SceneError(key, value, f"must be a whole number, 1 to {MOST_MEMBERS}")
    return value
