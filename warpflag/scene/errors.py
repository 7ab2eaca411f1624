"""What is wrong with a scene, told in one line for each problem, and values as texts."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

__all__ = ["MOST_PROBLEMS", "Problems", "SceneError", "shown", "written"]

MOST_PROBLEMS = 20  # of a scene that are told


class SceneError(ValueError):
    """A scene that can't be simulated: one line for each problem with file, key, value, and what is allowed.

    Attributes:
        key: the setting, dotted; None where the file as a whole is at fault.
        value: what it holds.
        problem: what is wrong, or allowed.
        related: other keys that the problem depends on.
        source: the file; ends in `--set` where an override is at fault; empty for a scene built in Python.
        others: the further problems of the same scene.
    """

    def __init__(
        self,
        key: str | None,
        value: Any,
        problem: str,
        related: Sequence[str] = (),
        source: str = "",
        others: Sequence[SceneError] = (),
    ) -> None:
        super().__init__(key, value, problem, related, source, others)
        self.key, self.value, self.problem, self.related, self.source = key, value, problem, related, source
        self.others = others

    def __str__(self) -> str:
        setting = [] if self.key is None else [f"{_printable(self.key)} = {shown(self.value)}"]
        source = [_printable(self.source, 4096)] if self.source else []
        return "\n".join([": ".join([*source, *setting, self.problem]), *map(str, self.others)])

    @classmethod
    def joined(cls, errors: Sequence[SceneError]) -> SceneError:
        """One error that tells of several problems, at least one."""
        first, *rest = [single for error in errors for single in (error, *error.others)]
        return cls(first.key, first.value, first.problem, first.related, first.source, [e.alone() for e in rest])

    def alone(self) -> SceneError:
        """The same problem without the others."""
        return SceneError(self.key, self.value, self.problem, self.related, self.source)

    def located(self, source: str | Path, overridden: Iterable[str] = ()) -> SceneError:
        """The same error with the file it arose in.

        Args:
            source: the file.
            overridden: keys whose values came from the command line.
        """
        overridden = set(overridden)
        by_override = {self.key, *self.related}.intersection(overridden)
        place = f"{source} --set" if by_override else str(source)
        others = [other.located(source, overridden) for other in self.others]
        return SceneError(self.key, self.value, self.problem, self.related, place, others)


class Problems:
    """Gathers what is wrong with a scene, so that all of it is told at once: what is raised in `with` blocks of it."""

    def __init__(self) -> None:
        self._errors: list[SceneError] = []
        self._count = 0

    def __enter__(self) -> Problems:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        """Keeps a SceneError of the block instead of passing it on."""
        if not isinstance(error, SceneError):
            return False
        self._count += 1 + len(error.others)
        if len(self._errors) < MOST_PROBLEMS:
            self._errors.append(error)
        return True

    def full(self) -> bool:
        """Whether there are so many that further ones are not told."""
        return len(self._errors) >= MOST_PROBLEMS

    def raise_any(self) -> None:
        """Raises one SceneError of all that were gathered, if any were."""
        if not self._errors:
            return
        told = sum(1 + len(error.others) for error in self._errors)
        if self._count > told:
            more = SceneError(None, None, f"and {self._count - told} more problems")
            raise SceneError.joined([*self._errors, more])
        raise SceneError.joined(self._errors)


def shown(value: Any) -> str:
    """A value as it would be typed in TOML, on one line, cut to 60 characters."""
    return _printable(written(value))


def _printable(text: str, length: int = 60) -> str:
    """A text on one line, cut to a length."""
    text = text if len(text) <= length else text[: length - 3] + "..."
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def written(value: Any, depth: int = 0) -> str:
    """A value in TOML syntax, None as `none`. Floats keep every digit; of what no scene has, the first part."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, list | tuple | dict) and depth > 3:
        return "..."
    if isinstance(value, list | tuple):
        return "[" + ", ".join([written(item, depth + 1) for item in value[:30]] + ["..."] * (len(value) > 30)) + "]"
    if isinstance(value, dict):
        items = [f"{key} = {written(item, depth + 1)}" for key, item in itertools.islice(value.items(), 30)]
        return "{" + ", ".join(items) + "}"
    if isinstance(value, int) and abs(value) > 10**30:
        return "a huge whole number"  # Python refuses to write thousands of digits
    return "none" if value is None else " ".join(repr(value).split())
