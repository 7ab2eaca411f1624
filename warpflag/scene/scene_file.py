"""Scene files and `--set` arguments as plain values by dotted key; sections as TOML text."""

from __future__ import annotations

import difflib
import os
import re
import stat
import tomllib
from collections.abc import Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from warpflag.scene.errors import SceneError, shown, written
from warpflag.scene.settings import Section

__all__ = ["flattened", "nearest", "parsed", "read_overrides", "read_toml", "section_lines"]

# Beyond any sensible scene, and below what the parser of TOML takes much time or memory for. Ten thousand flagella
# with every key of their own, as `dumps` writes them, are 3 MB.
_LARGEST_FILE = 4 * 2**20
_LONGEST_QUOTE = 80  # characters of a line that an error shows: a line of a terminal
_DEEPEST_NESTING = 16  # levels of arrays, inline tables and dotted keys: a scene has four
_ALIKE = 0.51  # of the letters of two names, beyond which one may be meant by the other
_MOST_DIGITS = 1000  # of a number: far beyond any float, and few enough for the parser's quadratic time

# Strings, also those without an end, and comments: what looks like brackets or dots there is none.
_STRING = re.compile(
    r'''"""(?:[^"\\]|\\.|"(?!""))*+(?:"""|\Z)|\'{3}(?:[^']|'(?!''))*+(?:\'{3}|\Z)|'''
    r""""(?:[^"\\\n]|\\[^\n])*+"?|'[^'\n]*+'?|\#[^\n]*+""",
    re.DOTALL,
)
_BRACKET = re.compile(r"[\[\]{}]")
_LONG_DOTTED_KEY = re.compile(rf"(?<![\w-])[\w-]++(?:[ \t]*+\.[ \t]*+[\w-]++){{{_DEEPEST_NESTING}}}")
_LONG_NUMBER = re.compile(rf"(?<!\w)(?:0[xob])?[\da-fA-F_]{{{_MOST_DIGITS}}}")


def read_toml(path: Path) -> dict[str, Any]:
    """The tables of a TOML file.

    Raises:
        SceneError: it can't be read, is no regular file, is too large, or is not TOML; it names the file.
    """
    try:
        mode = path.stat().st_mode  # before it is opened: a pipe would wait for its writer
        if stat.S_ISDIR(mode):
            inside = path / "scene.toml"  # of a run
            problem = "can't be read: it is a directory" + (f"; did you mean {inside}?" if inside.is_file() else "")
        elif not stat.S_ISREG(mode):
            problem = "can't be read: it is not a regular file"
        else:
            with path.open("rb") as file:
                content = file.read(_LARGEST_FILE + 1)
            _refuse_size(len(content))
            return parsed(content.decode("utf-8-sig"))
    except SceneError as error:
        raise error.located(path) from None
    except FileNotFoundError:
        meant = path.with_name(f"{path.name}.toml")
        problem = "no such file" + (f"; did you mean {meant}?" if meant.is_file() else "")
    except UnicodeDecodeError:
        problem = "is not a text file in UTF-8"
    except OSError as error:
        problem = f"can't be read: {os.strerror(error.errno) if error.errno else error}"
    except ValueError:  # of a path with a zero byte
        problem = "no such file"
    raise SceneError(None, None, problem, source=str(path))


def parsed(toml: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        SceneError: it is too large or nested too deeply, or no TOML.
    """
    _refuse_extremes(toml)
    try:
        return tomllib.loads(toml)
    except (ValueError, RecursionError) as error:  # of TOML, and of numbers and dates beyond Python's
        problem = f"is not valid TOML: {' '.join(str(error).split())[:200]}"
        raise SceneError(None, None, problem + _line_of(toml, str(error))) from None


def _line_of(toml: str, message: str) -> str:
    """The line in which the parser found something wrong, and what it often is."""
    place = re.search(r"at line (\d+)", message)
    if place is None or not toml.splitlines()[int(place[1]) - 1 : int(place[1])]:
        return ""
    line = toml.splitlines()[int(place[1]) - 1].strip()
    hint = ""
    if re.fullmatch(r"[\w.-]+\s*=\s*[A-Za-z_][^\"'\[{]*", line) and not re.search(r"=\s*(true|false|inf|nan)\b", line):
        hint = "; a text needs quotes"
    elif re.search(r"=\s*[-+]?\d+,\d", line):
        hint = "; numbers have a decimal point"
    return f": {line[:_LONGEST_QUOTE]}{hint}" if line.isprintable() else ""


def _refuse_size(size: int) -> None:
    if size > _LARGEST_FILE:
        raise SceneError(None, None, f"is larger than {_LARGEST_FILE // 2**20} MiB, which no scene needs")


def _refuse_extremes(toml: str) -> None:
    """Refuses what the parser would take minutes, gigabytes or Python's whole stack for."""
    _refuse_size(len(toml))
    bare = _STRING.sub("s", toml)
    depth = 0
    for bracket in _BRACKET.finditer(bare):
        depth = depth + 1 if bracket[0] in "[{" else max(depth - 1, 0)
        if depth > _DEEPEST_NESTING:
            raise SceneError(None, None, f"has arrays or tables nested more than {_DEEPEST_NESTING} deep")
    if _LONG_DOTTED_KEY.search(bare):
        raise SceneError(None, None, f"has a dotted key of more than {_DEEPEST_NESTING} parts")
    if _LONG_NUMBER.search(bare):
        raise SceneError(None, None, f"has a number or key of {_MOST_DIGITS} digits or more")


def flattened(table: Mapping[str, Any], sections: Container[str]) -> tuple[dict[str, Any], int]:
    """The tables of a scene file as values by dotted key.

    Args:
        table: tables as TOML nests them.
        sections: names of tables that may be empty.

    Returns:
        The values, and the number of [[flagellum]] tables.

    Raises:
        SceneError: a key is given twice, as with "motor.torque" in quotes beside [motor].
    """
    values: dict[str, Any] = {}
    tables = 0

    def add(key: str, value: Any) -> None:
        if key in values:
            raise SceneError(key, value, f"is given twice; the other value is {shown(values[key])}")
        values[key] = value

    for key, value in table.items():
        if key == "flagellum" and isinstance(value, list) and all(isinstance(own, dict) for own in value):
            tables = len(value)
            for k, own in enumerate(value):
                for name, item in own.items():
                    add(f"flagellum.{k}.{name}", item)
        elif isinstance(value, dict) and (value or key in sections) and key != "flagellum":
            for name, item in value.items():
                add(f"{key}.{name}", item)
        else:
            add(key, value)
    return values, tables


def read_overrides(overrides: Mapping[str, Any] | Sequence[str]) -> dict[str, Any]:
    """Values by dotted key from `--set` arguments (key=value) or from a mapping; of two for one key the last counts.

    A text is read as a TOML value; where it is none it stands for itself, so that mode=none and
    record=runs/zipping need no quotes.

    Raises:
        SceneError: an argument has no key or no equals sign.
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
        table = parsed(f"value = {value}")
    except SceneError:
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


def _alike(one: str, other: str) -> bool:
    return difflib.SequenceMatcher(None, one, other).ratio() >= _ALIKE


def nearest(key: str, known: Iterable[str]) -> str | None:
    """The known dotted key that `key` was probably meant to be; None where none is near."""
    if len(key) > 200:
        return None
    known = list(known)
    section, _, leaf = key.rpartition(".")
    same_leaf = [other for other in known if other.rpartition(".")[2] == leaf]
    sections = {other.rpartition(".")[0] for other in same_leaf}
    if len(sections) > 1 and section and not difflib.get_close_matches(section, sections, 1):
        return None  # wall.enabled: several sections have it, and none has a name like that
    near = same_leaf or [other for other in known if _alike(leaf, other.rpartition(".")[2])]
    near = difflib.get_close_matches(key, near, 1, 0.0 if same_leaf else 0.6)
    if near:
        return near[0]
    by_leaf = {other.rpartition(".")[2]: other for other in reversed(known)}
    return next((by_leaf[match] for match in difflib.get_close_matches(leaf, by_leaf, 1, 0.6)), None)
