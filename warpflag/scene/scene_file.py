"""Scene files and ``--set`` arguments as plain values by dotted key; sections as TOML text."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from warpflag.scene.settings import SceneError, Section, shown, written


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file; SceneError when it can't be read."""
    try:
        return parsed(path.read_text(encoding="utf-8"))
    except SceneError as error:
        raise error.located(path) from None
    except FileNotFoundError:
        problem = "no such file"
    except UnicodeDecodeError:
        problem = "is not a text file in UTF-8"
    except OSError as error:
        problem = f"can't be read: {error.strerror}"
    raise SceneError(None, None, problem, source=str(path))


def parsed(toml: str) -> dict[str, Any]:
    """The tables of a TOML text; SceneError when it is none."""
    try:
        return tomllib.loads(toml)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(None, None, f"is not valid TOML: {error}") from None


def flattened(table: Mapping[str, Any], sections: Container[str]) -> tuple[dict[str, Any], int]:
    """Values by dotted key, and the number of [[flagellum]] tables (one of them may be empty)."""
    values: dict[str, Any] = {}
    tables = 0
    for key, value in table.items():
        if key == "flagellum" and isinstance(value, list) and all(isinstance(own, dict) for own in value):
            tables = len(value)
            for k, own in enumerate(value):
                values |= {f"flagellum.{k}.{name}": item for name, item in own.items()}
        elif isinstance(value, dict) and (value or key in sections) and key != "flagellum":
            values |= {f"{key}.{name}": item for name, item in value.items()}
        else:
            values[key] = value
    return values, tables


def read_overrides(overrides: Mapping[str, Any] | Sequence[str]) -> dict[str, Any]:
    """Values by dotted key from ``--set`` arguments (``key=value``) or from a mapping.

    A text is read as a TOML value; where it is none it stands for itself, so that ``mode=none`` and
    ``record=runs/zipping`` need no quotes.
    """
    if isinstance(overrides, Mapping):
        pairs = list(overrides.items())
    else:
        pairs = [(key, value if sign else None) for key, sign, value in (o.partition("=") for o in overrides)]
    values = {}
    for key, value in pairs:
        key = key.strip()
        if value is None or not key:
            raise SceneError(None, None, f"{shown(key)} must be written key=value", source="--set")
        values[key] = _typed(value) if isinstance(value, str) else value
    return values


def _typed(value: str) -> Any:
    try:
        table = tomllib.loads(f"value = {value}")
    except tomllib.TOMLDecodeError:
        return value
    # A value with a line break could define further keys.
    return table["value"] if len(table) == 1 else value


def section_lines(section: Section) -> list[str]:
    """TOML lines of a section's settings, each with its meaning, range and unit as a comment."""
    lines = []
    for name, setting in section.settings.items():
        value = getattr(section, name)
        assignment = f"# {name} =" if value is None else f"{name} = {written(value)}"
        lines.append(f"{assignment:<38} # {setting.explained}")
    return lines


def nearest(key: str, known: Iterable[str]) -> str | None:
    """The known dotted key that ``key`` was probably meant to be."""
    known = list(known)
    leaf = key.rpartition(".")[2]
    same_leaf = [other for other in known if other.rpartition(".")[2] == leaf]
    near = difflib.get_close_matches(key, same_leaf or known, 1, 0.0 if same_leaf else 0.6)
    if near:
        return near[0]
    by_leaf = {other.rpartition(".")[2]: other for other in reversed(known)}
    return next((by_leaf[match] for match in difflib.get_close_matches(leaf, by_leaf, 1, 0.6)), None)
