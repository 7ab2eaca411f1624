"""How a scene's settings are declared and checked.

A section of a scene is a frozen dataclass derived from :class:`Section`. Each of its fields is declared
with :func:`number`, :func:`integer`, :func:`switch`, :func:`choice`, :func:`text` or :func:`vector`, and
that declaration is the only place that says what the field may hold: the check on construction, the
error text, the class's docstring and the comment in a written file all come from it.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar

# What a number far out of range was probably typed in: {unit: (plural, ((other unit, factor), ...))}.
UNIT_SLIPS: dict[str, tuple[str, tuple[tuple[str, float], ...]]] = {
    "um": ("lengths", (("metres", 1e6), ("millimetres", 1e3), ("nanometres", 1e-3))),
    "1/um": ("curvatures", (("1/metre", 1e-6),)),
    "pN": ("forces", (("newtons", 1e12),)),
    "pN um": ("torques", (("newton metres", 1e18),)),
    "pN um^2": ("rigidities", (("newton square metres", 1e24),)),
    "pN s": ("rotational drags per length", (("newton seconds", 1e12),)),
    "s": ("times", (("milliseconds", 1e-3), ("microseconds", 1e-6))),
}


class SceneError(ValueError):
    """A scene that can't be simulated, told in one line: file, key, value, and what is allowed.

    Attributes: ``key`` (dotted, None when the file as a whole is at fault), ``value``, ``problem``,
    ``related`` (other keys that the problem depends on), ``source`` (the file; ends in ``--set`` when an
    override is at fault; empty for a scene built in Python).
    """

    def __init__(
        self, key: str | None, value: Any, problem: str, related: Sequence[str] = (), source: str = ""
    ) -> None:
        super().__init__(key, value, problem, related, source)
        self.key, self.value, self.problem, self.related, self.source = key, value, problem, related, source

    def __str__(self) -> str:
        setting = [] if self.key is None else [f"{self.key} = {shown(self.value)}"]
        return ": ".join([*filter(None, [self.source]), *setting, self.problem])

    def located(self, source: str | Path, overridden: Iterable[str] = ()) -> SceneError:
        """The same error with the file it arose in; keys in ``overridden`` came from the command line."""
        by_override = {self.key, *self.related}.intersection(overridden)
        source = f"{source} --set" if by_override else str(source)
        return SceneError(self.key, self.value, self.problem, self.related, source)


@dataclasses.dataclass(frozen=True)
class Setting:
    """What one field of a scene means and may hold.

    kind: number, integer, switch, choice, text or vector (three numbers). low, high: inclusive bounds.
    smallest: least magnitude of a value other than zero. pattern, pattern_text: regular expression of a
    text, and in words. derived: what stands in for an absent value; empty where a value is required.
    """

    kind: str
    meaning: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    smallest: float = 0.0
    choices: tuple[str, ...] = ()
    pattern: str = r".+"
    pattern_text: str = "a text that is not empty"
    derived: str = ""

    @property
    def bounds(self) -> str:
        """The allowed values in short; empty for a switch."""
        least = f", 0 or at least {self.smallest:g} in magnitude" if self.smallest else ""
        span = f"{self.low:g} to {self.high:g} {self.unit}".rstrip() + least
        words = {"choice": "one of " + ", ".join(self.choices), "text": self.pattern_text, "switch": ""}
        return words.get(self.kind, span)

    @property
    def allowed(self) -> str:
        """The allowed values in words."""
        words = {
            "number": f"a number, {self.bounds}",
            "integer": f"a whole number, {self.bounds}",
            "vector": f"three numbers, each {self.bounds}",
            "switch": "true or false",
        }
        return words.get(self.kind, self.bounds)

    @property
    def explained(self) -> str:
        """Meaning, range, and what stands in for an absent value."""
        bounds = f" ({self.bounds})" if self.bounds else ""
        return self.meaning + bounds + (f"; absent: {self.derived}" if self.derived else "")

    def checked(self, key: str, value: Any) -> Any:
        """``value`` in the field's type (a whole number becomes a float, a list a tuple), or SceneError."""
        if value is None and self.derived:
            return None
        if self.kind == "vector" and isinstance(value, list | tuple) and len(value) == 3:
            return tuple(float(self._number(key, value, item)) for item in value)
        if self.kind == "number":
            return float(self._number(key, value, value))
        if self.kind == "integer" and isinstance(value, int):
            return self._number(key, value, value)
        if (
            (self.kind == "switch" and isinstance(value, bool))
            or (self.kind == "choice" and value in self.choices)
            or (self.kind == "text" and isinstance(value, str) and re.fullmatch(self.pattern, value))
        ):
            return value
        near = difflib.get_close_matches(str(value), self.choices, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        raise SceneError(key, value, f"must be {self.allowed}{hint}")

    def _number(self, key: str, value: Any, item: Any) -> Any:
        # bool is an int in Python; in a scene true is not 1.
        if isinstance(item, bool) or not isinstance(item, int | float):
            raise SceneError(key, value, f"must be {self.allowed}")
        if not self._within(item):
            raise SceneError(key, value, f"{self._unit_slip(item)}must be {self.allowed}")
        return item

    def _within(self, item: float) -> bool:
        # A NaN fails both comparisons.
        return self.low <= item <= self.high and (item == 0 or abs(item) >= self.smallest)

    def _unit_slip(self, item: float) -> str:
        plural, slips = UNIT_SLIPS.get(self.unit, ("", ()))
        for other_unit, factor in slips:
            # Compared before multiplying: a whole number in TOML may be too large for a float.
            if item != 0 and abs(item) < 1e30 and self._within(item * factor):
                return f"looks like {other_unit}; {plural} are in {self.unit}; "
        return ""


def number(default: float | None, unit: str, low: float, high: float, meaning: str, **more: Any) -> Any:
    """Declare a field that holds a float; ``more`` as in Setting."""
    return _declared(default, Setting("number", meaning, unit, low, high, **more))


def integer(default: int | None, low: int, high: int, meaning: str, **more: Any) -> Any:
    """Declare a field that holds a whole number; ``more`` as in Setting."""
    return _declared(default, Setting("integer", meaning, "", low, high, **more))


def vector(default: tuple[float, float, float], unit: str, low: float, high: float, meaning: str) -> Any:
    """Declare a field that holds three floats."""
    return _declared(default, Setting("vector", meaning, unit, low, high))


def switch(default: bool, meaning: str) -> Any:
    """Declare a field that holds true or false."""
    return _declared(default, Setting("switch", meaning))


def choice(default: str, choices: tuple[str, ...], meaning: str) -> Any:
    """Declare a field that holds one of ``choices``."""
    return _declared(default, Setting("choice", meaning, choices=choices))


def text(default: Any, meaning: str, **more: Any) -> Any:
    """Declare a field that holds a text; ``dataclasses.MISSING`` as default makes it required."""
    return _declared(default, Setting("text", meaning, **more))


def _declared(default: Any, setting: Setting) -> Any:
    return dataclasses.field(default=default, metadata={"setting": setting})


class Section:
    """Base of a scene's dataclasses: checks every declared field when an instance is made.

    ``key`` is the section's name in a scene file, ``settings`` the declarations by field name.
    """

    key: ClassVar[str] = ""
    settings: ClassVar[dict[str, Setting]] = {}

    def __init_subclass__(cls, key: str) -> None:
        fields = {name: value for name, value in vars(cls).items() if isinstance(value, dataclasses.Field)}
        cls.key = key
        cls.settings = {name: f.metadata["setting"] for name, f in fields.items() if f.metadata}
        lines = [cls.__doc__ or "", "    Fields, each with its default, meaning and allowed values:", ""]
        for name, setting in cls.settings.items():
            default = fields[name].default
            default = "required" if default is dataclasses.MISSING else shown(default)
            lines.append(f"    - {name} = {default}: {setting.explained}")
        cls.__doc__ = "\n".join(lines)

    def __post_init__(self) -> None:
        prefix = f"{self.key}." if self.key else ""
        for name, setting in self.settings.items():
            # The instance is frozen, but not yet finished.
            object.__setattr__(self, name, setting.checked(prefix + name, getattr(self, name)))


def shown(value: Any) -> str:
    """A value as it would be typed in TOML, on one line, cut to 60 characters."""
    line = written(value) if not isinstance(value, dict) else json.dumps(value, default=str)
    return line if len(line) <= 60 else line[:57] + "..."


def written(value: Any) -> str:
    """A value in TOML syntax, None as ``none``. Floats keep every digit."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple):
        return "[" + ", ".join(written(item) for item in value) + "]"
    if isinstance(value, int) and abs(value) > 10**30:
        return "a huge whole number"  # Python refuses to write thousands of digits
    return "none" if value is None else repr(value)
