"""How a scene's settings are declared and checked.

A section of a scene is a frozen dataclass derived from `Section`. Each of its fields is declared with `number`,
`integer`, `switch`, `choice`, `text`, `vector` or `numbers`, and that declaration is the only place that says what the
field may hold: the check on construction, the error text, the class's docstring and the comment in a written file all
come from it.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import itertools
import math
import re
from typing import Any, ClassVar

from warpflag.scene.errors import Problems, SceneError, shown

ABSENT = "absent"
"""Given in place of a value, in a sweep or on the command line, it takes the value away."""
# What a number far out of range was probably typed in, the SI unit first:
# {unit: (plural, ((other unit, factor), ...))}.
UNIT_SLIPS: dict[str, tuple[str, tuple[tuple[str, float], ...]]] = {
    "um": ("lengths", (("metres", 1e6), ("millimetres", 1e3), ("nanometres", 1e-3))),
    "1/um": ("curvatures", (("1/metre", 1e-6),)),
    "pN": ("forces", (("newtons", 1e12),)),
    "pN um": ("torques", (("newton metres", 1e18),)),
    "pN um^2": ("rigidities", (("newton square metres", 1e24),)),
    "pN s": ("rotational drags per length", (("newton seconds", 1e12),)),
    "s": ("times", (("milliseconds", 1e-3), ("microseconds", 1e-6))),
}


@dataclasses.dataclass(frozen=True)
class Setting:
    """What one field of a scene means and may hold.

    Attributes:
        kind: number, integer, switch, choice, text, vector (three numbers) or numbers (any count, increasing).
        meaning: what the field is.
        unit: of its numbers.
        low: least value, inclusive.
        high: greatest value, inclusive.
        usual: magnitudes that a number in this unit usually has; a number that has such a magnitude if it is taken in
            the SI unit is refused. For ranges that include zero, whose bounds find no number in the wrong unit.
        choices: what a choice may be, and words that a number may be instead.
        pattern: regular expression of a text.
        pattern_text: the same in words.
        derived: what stands in for an absent value; empty where a value is required.
    """

    kind: str
    meaning: str
    unit: str = ""
    low: float = -math.inf
    high: float = math.inf
    usual: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    pattern: str = r".+"
    pattern_text: str = "a text that is not empty"
    derived: str = ""

    @functools.cached_property
    def bounds(self) -> str:
        """The allowed values in short; empty for a switch."""
        span = f"{self.low:g} to {self.high:g} {self.unit}".rstrip()
        if self.kind == "number" and self.choices:
            span += ", or " + ", ".join(self.choices)
        words = {"choice": "one of " + ", ".join(self.choices), "text": self.pattern_text, "switch": ""}
        return words.get(self.kind, span)

    @property
    def allowed(self) -> str:
        """The allowed values in words."""
        words = {
            "number": f"a number, {self.bounds}",
            "integer": f"a whole number, {self.bounds}",
            "vector": f"three numbers, each {self.bounds}",
            "numbers": f"increasing numbers, each {self.bounds}",
            "switch": "true or false",
        }
        return words.get(self.kind, self.bounds)

    @functools.cached_property
    def explained(self) -> str:
        """Meaning, range, and what stands in for an absent value."""
        bounds = f" ({self.bounds})" if self.bounds else ""
        return self.meaning + bounds + (f"; absent: {self.derived}" if self.derived else "")

    def checked(self, key: str, value: Any) -> Any:
        """A value in the field's type: a whole number becomes a float, a list a tuple, a NumPy number a plain one.

        Args:
            key: the setting, dotted, for the error.
            value: what it is to hold.

        Raises:
            SceneError: the value is not allowed.
        """
        value = _plain(value)
        if self.derived and (value is None or value == ABSENT):
            return None
        if self.kind == "vector" and isinstance(value, list | tuple) and len(value) == 3:
            return tuple(float(self._number(key, value, _plain(item))) for item in value)
        if self.kind == "numbers" and isinstance(value, list | tuple):
            found = tuple(float(self._number(key, value, _plain(item))) for item in value)
            if all(a < b for a, b in itertools.pairwise(found)):
                return found
        if self.kind == "number" and isinstance(value, str) and value in self.choices:
            return value
        if self.kind == "number":
            return float(self._number(key, value, value))
        if self.kind == "integer" and isinstance(value, int):
            return self._number(key, value, value)
        if (self.kind == "switch" and isinstance(value, bool)) or (
            isinstance(value, str)
            and (
                (self.kind == "choice" and value in self.choices)
                or (self.kind == "text" and re.fullmatch(self.pattern, value))
            )
        ):
            return value
        near = difflib.get_close_matches(shown(value).strip('"'), self.choices, 1) if self.choices else []
        hint = f"; did you mean {near[0]}?" if near else ""
        raise SceneError(key, value, f"must be {self.allowed}{hint}")

    def _number(self, key: str, value: Any, item: Any) -> Any:
        # bool is an int in Python; in a scene true is not 1.
        if isinstance(item, bool) or not isinstance(item, int | float):
            raise SceneError(key, value, f"must be {self.allowed}")
        if not self.low <= item <= self.high:  # a NaN fails both comparisons
            raise SceneError(key, value, f"{self._other_unit(item)}must be {self.allowed}")
        if self.usual is not None:
            plural, slips = UNIT_SLIPS[self.unit]
            si_unit, factor = slips[0]
            if self.usual[0] <= abs(item) * factor <= self.usual[1]:
                raise SceneError(key, value, f"looks like {si_unit}; {plural} are in {self.unit}; write 0 for none")
        return item

    def _other_unit(self, item: float) -> str:
        """Words for a number that would be allowed in another unit; empty where there is none."""
        plural, slips = UNIT_SLIPS.get(self.unit, ("", ()))
        for other_unit, factor in slips:
            # Compared before multiplying: a whole number in TOML may be too large for a float.
            if item != 0 and abs(item) < 1e30 and self.low <= item * factor <= self.high:
                return f"looks like {other_unit}; {plural} are in {self.unit}; "
        return ""


def number(default: float | None, unit: str, low: float, high: float, meaning: str, **more: Any) -> Any:
    """Declares a field that holds a float; `more` as in Setting."""
    return _declared(default, Setting("number", meaning, unit, low, high, **more))


def integer(default: int | None, low: int, high: int, meaning: str, **more: Any) -> Any:
    """Declares a field that holds a whole number; `more` as in Setting."""
    return _declared(default, Setting("integer", meaning, "", low, high, **more))


def vector(default: tuple[float, float, float], unit: str, low: float, high: float, meaning: str) -> Any:
    """Declares a field that holds three floats."""
    return _declared(default, Setting("vector", meaning, unit, low, high))


def numbers(default: tuple[float, ...] | None, unit: str, low: float, high: float, meaning: str, **more: Any) -> Any:
    """Declares a field that holds any count of increasing floats; `more` as in Setting."""
    return _declared(default, Setting("numbers", meaning, unit, low, high, **more))


def switch(default: bool | None, meaning: str, **more: Any) -> Any:
    """Declares a field that holds true or false; `more` as in Setting."""
    return _declared(default, Setting("switch", meaning, **more))


def choice(default: str | None, choices: tuple[str, ...], meaning: str, **more: Any) -> Any:
    """Declares a field that holds one of `choices`; `more` as in Setting."""
    return _declared(default, Setting("choice", meaning, choices=choices, **more))


def text(default: Any, meaning: str, **more: Any) -> Any:
    """Declares a field that holds a text; `dataclasses.MISSING` as default makes it required."""
    return _declared(default, Setting("text", meaning, **more))


def _declared(default: Any, setting: Setting) -> Any:
    return dataclasses.field(default=default, metadata={"setting": setting})


class Section:
    """Base of a scene's dataclasses: checks every declared field when an instance is made.

    Attributes:
        key: the section's name in a scene file.
        settings: the declarations by field name.

    Raises:
        SceneError: fields hold what is not allowed; it names all of them.
    """

    key: ClassVar[str] = ""
    settings: ClassVar[dict[str, Setting]] = {}

    def __init_subclass__(cls, key: str) -> None:
        fields = {name: value for name, value in vars(cls).items() if isinstance(value, dataclasses.Field)}
        cls.key = key
        cls.settings = {name: f.metadata["setting"] for name, f in fields.items() if f.metadata}
        lines = [(cls.__doc__ or "").rstrip(), "", "    Attributes:"]
        for name, setting in cls.settings.items():
            default = fields[name].default
            default = "required" if default is dataclasses.MISSING else f"default {shown(default)}"
            lines.append(f"        {name}: {setting.explained}; {default}.")
        cls.__doc__ = "\n".join([*lines, "    "])

    def __post_init__(self) -> None:
        prefix = f"{self.key}." if self.key else ""
        problems = Problems()
        for name, setting in self.settings.items():
            with problems:
                # The instance is frozen, but not yet finished.
                object.__setattr__(self, name, setting.checked(prefix + name, getattr(self, name)))
        problems.raise_any()


def _plain(value: Any) -> Any:
    """A number or short array of NumPy as Python's own; anything else as it is."""
    if hasattr(value, "tolist") and getattr(value, "size", 0) <= 3:
        return value.tolist()
    return value
