"""What a simulation holds and what a scene says, walked: a new array or setting needs no line here."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import warp as wp

from warpflag.run.simulation import Simulation
from warpflag.scene import Scene


def settings_of(scene: Scene) -> dict[str, Any]:
    """Every setting of a scene by its key, those of single flagella as of one for all."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(scene):
        section = getattr(scene, field.name)
        if dataclasses.is_dataclass(section):
            found |= {f"{field.name}.{name}": value for name, value in vars(section).items()}
        elif field.name != "flagellum":
            found[field.name] = section
    overrides = [vars(own) for own in scene.flagellum] or [{}]
    names = {name for own in overrides for name in own}
    return found | {f"flagellum.{name}": tuple(own[name] for own in overrides) for name in names}


def leaves(part: Any, path: str, seen: dict[int, Any]) -> Iterator[tuple[str, Any]]:
    """Numbers and arrays in whatever a simulation consists of, by where they are; lists of one per cell as they are."""
    if isinstance(part, int | float | np.ndarray) or (isinstance(part, wp.array) and not hasattr(part.dtype, "vars")):
        yield path, part if isinstance(part, wp.array) else np.atleast_1d(part)
    elif isinstance(part, list | tuple) and part and isinstance(part[0], int | float | tuple | np.ndarray):
        yield path, part
    elif id(part) not in seen:
        seen[id(part)] = part  # kept, or another may get its number
        inside: Mapping[Any, Any] = {}
        if isinstance(part, dict):
            inside = part
        elif isinstance(part, list | tuple):
            inside = dict(enumerate(part))
        elif type(part).__module__.startswith("warp._src.codegen"):  # a struct of device arrays
            inside = {name: value for name, value in vars(part).items() if name[0] != "_"}
        elif type(part).__module__.startswith(("warpflag", "types")) and hasattr(part, "__dict__"):
            inside = vars(part)
        for name, value in inside.items():
            if not isinstance(value, type | Scene) and not callable(value):
                yield from leaves(value, f"{path}.{name}", seen)


def numbers_of(simulation: Simulation) -> dict[str, Any]:
    found = dict(leaves(simulation, "", {}))
    return {name.lstrip("."): x.numpy() if isinstance(x, wp.array) else x for name, x in found.items()}
