"""What a sweep runs: a base scene, the axes of a grid, random draws and repeats, and the members that they make.

A sweep file:

    base = "zipping.toml"                 # from the folder of the sweep file
    repeats = 1                           # of every point, with everything random drawn anew but the draws

    [set]                                 # replaces values of the base
    duration = 0.01

    [axes]                                # all combinations
    motor.torque = { from = 0.4, to = 3.4, count = 8 }    # spacing = "log": equal ratios
    flagella.opening_angle = [23, 44, 90]
    "motor.knee, motor.no_load" = [[100, 200], [175, 300]]  # these two together

    [random]
    seed = 1
    draws = 16                            # of every combination
    fluid.viscosity = { low = 1e-3, high = 3e-3 }     # one value per draw, the same in its repeats
    flagellum.torque = { mean = 3.4, deviation = 0.3 }  # one value per flagellum and repeat
    anchors = { placement = "random", least_distance = 0.15 }
"""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from warpflag.run.sweep import axes, draws
from warpflag.scene import Scene, SceneError, dumps, load, with_values
from warpflag.scene.errors import MOST_PROBLEMS, written
from warpflag.scene.scene_file import nearest, read_overrides, read_toml

__all__ = ["BASE_NAME", "BadMembers", "Member", "Sweep", "check_members", "read"]

BASE_NAME = "base.toml"
_SWEEP_KEYS = ("base", "name", "repeats", "set", "axes", "random")


class BadMembers(ValueError):
    """Members that can't be simulated: one line each, of the first."""


def check_members(bad: Mapping[str, SceneError]) -> None:
    """That nothing is wrong with any member.

    Args:
        bad: what is wrong, by the name of the member.

    Raises:
        BadMembers: a line for each of the first problems, with the first member that has it.
    """
    members: dict[str, list[str]] = {}
    for name, error in bad.items():
        for problem in str(error).splitlines():
            members.setdefault(problem, []).append(name)
    lines = [
        f"{own[0]}{f' and {len(own) - 1} more' if len(own) > 1 else ''}: {problem}" for problem, own in members.items()
    ]
    if len(lines) > MOST_PROBLEMS:
        named = set(itertools.chain(*list(members.values())[:MOST_PROBLEMS]))
        left = len(bad.keys() - named)
        lines[MOST_PROBLEMS:] = [f"and {left} more members" if left else "and more of the same members"]
    if lines:
        raise BadMembers("\n".join(lines))


@dataclass(frozen=True)
class Member:
    """One run of a sweep.

    Attributes:
        number: from 0; the name of its directory.
        point: number of its combination of axes and draw; repeats share it.
        repeat: from 0.
        values: what it has of its own, by dotted key.
        scene: to run.
    """

    number: int
    point: int
    repeat: int
    values: dict[str, Any]
    scene: Scene


@dataclass(frozen=True)
class Sweep:
    """A base scene and what varies.

    Attributes:
        base: the scene that all members share but for their values.
        axes: values by dotted key, or from, to, count and spacing; the members are all combinations, the last axis
            fastest. "key, other": lists of values of keys that vary together. None takes a value of the base away. What
            is given as arrays of NumPy is kept as lists.
        random: as the table [random] of a sweep file, dotted keys flat.
        repeats: of every combination and draw.
        name: of the sweep's directory; empty: that of the base.

    Raises:
        SceneError: one of them is of another kind.
    """

    base: Scene
    axes: Mapping[str, Any] = field(default_factory=dict)
    random: Mapping[str, Any] = field(default_factory=dict)
    repeats: int = 1
    name: str = ""

    def __post_init__(self) -> None:
        if not isinstance(self.base, Scene):
            raise SceneError("base", _plain(self.base), "must be a scene; warpflag.load reads one")
        for name in ("axes", "random"):
            given = getattr(self, name)
            if not isinstance(given, Mapping):
                raise SceneError(name, _plain(given), "must be values by dotted key")
            object.__setattr__(self, name, {str(key): _plain(value) for key, value in given.items()})
        object.__setattr__(self, "axes", axes.named(self.axes))
        object.__setattr__(self, "repeats", axes.count("repeats", _plain(self.repeats)))
        object.__setattr__(self, "name", self.name or self.base.name)
        with_values(self.base, {"name": self.name})  # whether it can be one

    def members(self) -> list[Member]:
        """Every member, in order.

        Raises:
            BadMembers: some scenes can't be simulated; one line for each.
            SceneError: the sweep itself is not sound.
        """
        axes.check(self.axes)
        varied = axes.values_by_key(self.axes)
        random = draws.Draws(self.random, self.base)
        repeats = self.repeats
        noise = self.base.fluid.temperature > 0.0 or "fluid.temperature" in {*varied, *self.random}
        seeded = noise or "markov" in (self.base.motor.switching, *varied.get("motor.switching", ()))
        if repeats > 1 and not random.differs_in_repeats and not seeded:
            problem = "would be the same run again and again: nothing is random in a repeat"
            raise SceneError("repeats", repeats, problem, ["random"])
        if random.count > 1 and not (random.differs or seeded):
            raise SceneError("random.draws", random.count, "would be the same run again and again: nothing is drawn")
        size = repeats * random.count * int(np.prod([len(values) for values in self.axes.values()], dtype=float))
        if size > axes.MOST_MEMBERS:
            raise SceneError("axes", list(self.axes), f"make {size} members; at most {axes.MOST_MEMBERS} are allowed")
        members: list[Member] = []
        bad: dict[str, SceneError] = {}
        width = max(4, len(str(size - 1)))
        combinations = itertools.product(*self.axes.values())
        for point, (combination, draw) in enumerate(itertools.product(combinations, range(random.count))):
            for repeat in range(repeats):
                number = f"{point * repeats + repeat:0{width}d}"
                try:
                    name = f"{self.base.name}-{number}"
                    values, scene = self._varied(random, combination, draw, repeat, name)
                except SceneError as error:
                    bad[f"member {number}"] = error
                    continue
                members.append(Member(int(number), point, repeat, values, scene))
        check_members(bad)
        return _with_seeds(members)

    def _varied(
        self, random: draws.Draws, combination: Sequence[Any], draw: int, repeat: int, name: str
    ) -> tuple[dict[str, Any], Scene]:
        """The values of one member by dotted key, and its scene."""
        own: dict[str, Any] = {}
        for axis, value in zip(self.axes, combination, strict=True):
            own |= axes.point(axis, value)
        named = {"name": name}
        scene = with_values(self.base, own | named)
        drawn = random.values(scene, draw, repeat)
        for key in own.keys() & drawn.keys():
            values = axes.values_by_key(self.axes)[key]
            raise SceneError(f"axes.{key}", values, "is drawn at random, too: leave out one of both")
        values = own | drawn
        return values, with_values(self.base, values | named) if drawn else scene

    def first_scene(self) -> Scene | None:
        """That of the first member, without a look at the others; None where it can't be simulated."""
        with contextlib.suppress(SceneError, IndexError):
            first = [values[0] for values in self.axes.values()]
            return self._varied(draws.Draws(self.random, self.base), first, 0, 0, self.base.name)[1]
        return None

    def dumps(self) -> str:
        """The sweep as TOML beside its base scene; a sweep read from it has the same members."""
        lines = ["# A sweep of warpflag; its base scene lies beside it.", "", f"base = {written(BASE_NAME)}"]
        lines += [f"name = {written(self.name)}", f"repeats = {self.repeats}", "", "[axes]"]
        lines += [f"{written(key)} = {_inline(list(values))}" for key, values in self.axes.items()]
        lines += ["", "[random]", *(f"{written(key)} = {_inline(value)}" for key, value in self.random.items())]
        return "\n".join(lines) + "\n"

    def base_text(self) -> str:
        """The base scene as TOML."""
        return dumps(self.base)


def read(path: str | Path, overrides: Sequence[str] = (), grid: Sequence[str] = ()) -> Sweep:
    """The sweep of a file; a scene file is a sweep without axes.

    Args:
        path: of a sweep file or a scene file.
        overrides: "key=value" texts that replace values of the base scene.
        grid: axes as in `axes.grid_axes`; they replace those of the same key.

    Raises:
        SceneError: a file can't be read or holds what is not allowed.
    """
    path = Path(path)
    table = read_toml(path)
    try:
        given = axes.grid_axes(grid)
        if not {"base", "axes"} & table.keys():
            base = load(path, overrides)
            axes.refuse_overrides(given, overrides)
            return Sweep(base, given, name=base.name)
        return _built(path, table, overrides, given)
    except SceneError as error:
        raise (error if error.source else error.located(path)) from None


def _built(path: Path, table: Mapping[str, Any], overrides: Sequence[str], grid: Mapping[str, list[Any]]) -> Sweep:
    for key in table.keys() - set(_SWEEP_KEYS):
        near = nearest(key, _SWEEP_KEYS)
        hint = f"did you mean {near}?" if near else "known here: " + ", ".join(_SWEEP_KEYS)
        raise SceneError(key, table[key], f"unknown key; {hint}")
    base = table.get("base")
    if not isinstance(base, str):
        raise SceneError("base", base, "must be the path of a scene file")
    for key in ("set", "axes", "random"):
        if not isinstance(table.get(key, {}), dict):
            raise SceneError(key, table[key], f"must be a table [{key}]")
    found = axes.named(_flat(table.get("axes", {}))) | dict(grid)
    axes.refuse_overrides(found, overrides)
    name = table.get("name", path.stem)
    if not isinstance(name, str):
        raise SceneError("name", name, "must be a text")
    scene = load(path.parent / base, {**_flat(table.get("set", {})), **read_overrides(overrides)})
    scene = with_values(scene, {"name": name})
    return Sweep(scene, found, _flat(table.get("random", {})), axes.count("repeats", table.get("repeats", 1)), name)


def _with_seeds(members: list[Member]) -> list[Member]:
    """Members that all tell their seed where some have drawn one: the first repeat has that of its scene."""
    seeds = {"fluid.seed": lambda scene: scene.fluid.seed, "motor.seed": lambda scene: scene.motor.seed}
    for key, seed in seeds.items():
        if any(key in member.values for member in members):
            members = [replace(own, values={**own.values, key: seed(own.scene)}) for own in members]
    return members


def _plain(value: Any) -> Any:
    """A value as TOML has it: numbers and arrays of NumPy as Python's, sequences as lists, None as "absent"."""
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, Iterable) and not isinstance(value, str | bytes):
        return [_plain(item) for item in value]
    return "absent" if value is None else value


_SPREAD_KEYS = {"from", "to", "low", "high", "mean", "deviation"}  # of a table that says what a value may be


def _flat(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Values by dotted key: a table within is more of the key, unless it says which values are taken."""
    flat: dict[str, Any] = {}
    for name, value in table.items():
        key = prefix + name
        inner = isinstance(value, dict) and key != "anchors" and not value.keys() & _SPREAD_KEYS
        flat |= _flat(value, f"{key}.") if inner else {key: value}
    return flat


def _inline(value: Any) -> str:
    """A value, list or table as TOML on one line."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_inline(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_inline(item) for item in value) + "]"
    return written(value)
