"""Scenes made of files, of TOML texts and of other scenes, and scenes written as TOML."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from warpflag.base.streams import tell
from warpflag.scene import scene_file
from warpflag.scene.errors import Problems, SceneError, shown, written
from warpflag.scene.formats import BEFORE_FORMATS
from warpflag.scene.scene import Scene
from warpflag.scene.sections import Flagella, FlagellumOverride
from warpflag.scene.settings import Section, Setting

__all__ = ["check_key", "dumps", "flagellum_example", "load", "loads", "with_values"]

_SECTIONS: dict[str, type[Section]] = {
    own.name: own.default_factory
    for own in dataclasses.fields(Scene)
    if isinstance(own.default_factory, type) and issubclass(own.default_factory, Section)
}
_KEYS: dict[str, Setting] = {
    f"{cls.key}.{name}".lstrip("."): setting
    for cls in (Scene, *_SECTIONS.values(), FlagellumOverride)
    for name, setting in cls.settings.items()
}


def load(path: str | Path, overrides: Mapping[str, Any] | Sequence[str] = ()) -> Scene:
    """Reads a scene file. A file without a name gets its own file name.

    Args:
        path: the file.
        overrides: values that replace the file's, as texts key=value or as a mapping from dotted key to value;
            flagellum k (from 0) has keys `flagellum.k.torque` and so on.

    Raises:
        SceneError: the scene can't be simulated; it names the file and the keys.
    """
    given = scene_file.read_overrides(overrides)
    try:
        values, tables = scene_file.flattened(scene_file.read_toml(Path(path)), _SECTIONS)
    except SceneError as error:
        raise (error if error.source else error.located(path)) from None
    if isinstance(values.get("base"), str):
        problem = f"is a sweep file, no scene: warpflag sweep {path}"
        raise SceneError(None, None, problem, source=str(path))
    values.setdefault("name", re.sub(r"[^\w.+-]+", "-", Path(path).stem).strip("-.+") or "scene")
    try:
        scene = _built({**_of_format(values), **given}, tables)
    except SceneError as error:
        raise error.located(path, given) from None
    if "format" not in values:
        _tell_format(path, values)
    return scene


def loads(toml: str) -> Scene:
    """The scene of a TOML text, as `dumps` writes it.

    Raises:
        SceneError: the scene can't be simulated.
    """
    values, tables = scene_file.flattened(scene_file.parsed(toml), _SECTIONS)
    return _built(_of_format(values), tables)


def with_values(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """A checked copy with other values.

    Args:
        scene: the original, which stays as it is.
        values: by dotted key, `{"motor.torque": 2.0}`; None makes a value absent.

    Raises:
        SceneError: the copy can't be simulated.
    """
    parts = {"": scene, **{key: getattr(scene, key) for key in _SECTIONS}}
    parts |= {f"flagellum.{k}": own for k, own in enumerate(scene.flagellum)}
    flat = {f"{key}.{name}".lstrip("."): getattr(part, name) for key, part in parts.items() for name in part.settings}
    return _built({**flat, **values}, len(scene.flagellum))


def dumps(scene: Scene) -> str:
    """The scene as TOML text, every default written out; a scene read from it is equal."""
    lines = [
        "# A warpflag scene. Units: um, pN, s (torque pN um, rigidity pN um^2, viscosity pN s/um^2);",
        "# angles in degrees. A commented key is absent; its comment says what is taken instead.",
        "",
        *scene_file.section_lines(scene),
    ]
    for key in _SECTIONS:
        lines += ["", f"[{key}]", *scene_file.section_lines(getattr(scene, key))]
    for k, own in enumerate(scene.flagellum):
        values = {name: getattr(own, name) for name in own.settings}
        lines += ["", f"[[flagellum]] # flagellum {k}; absent keys are the group's"]
        lines += [f"{name} = {written(value)}" for name, value in values.items() if value is not None]
    return "\n".join(lines) + "\n"


def flagellum_example() -> str:
    """All keys of a [[flagellum]] table as comments, for a scene that has none."""
    lines = scene_file.section_lines(FlagellumOverride())
    head = "# One table for each flagellum, or none; --set flagellum.0.torque=1.5 sets a value of a single one."
    return "\n".join([head, "# [[flagellum]]", *lines]) + "\n"


def _of_format(values: Mapping[str, Any]) -> Mapping[str, Any]:
    """The values of a file, with those that a file without a format has where it leaves them out."""
    return values if "format" in values else {**BEFORE_FORMATS, **values}


_told: set[str] = set()  # files without a format that were told of


def _tell_format(path: str | Path, values: Mapping[str, Any]) -> None:
    """Says once of a file without a format which values it has that a new one has not."""
    left_out = [f"{key} = {shown(value)}" for key, value in BEFORE_FORMATS.items() if key not in values]
    if left_out and str(path) not in _told:
        _told.add(str(path))
        said = f"has no format, so it has {', '.join(left_out)}; format = 1 converges"
        tell(f"{path}: {said}")


def _built(values: Mapping[str, Any], tables: int) -> Scene:
    """A scene of values by dotted key, of which `tables` overrides of flagella exist already."""
    problems = Problems()
    own: dict[int, dict[str, Any]] = {}
    sections: dict[str, dict[str, Any]] = {key: {} for key in ("", *_SECTIONS)}
    for key, value in values.items():
        with problems:
            check_key(key, value, problems.full())
            section, _, name = key.rpartition(".")
            if section in sections:
                sections[section][name] = value
            else:
                own.setdefault(int(section.partition(".")[2]), {})[name] = value
    if tables:
        sections["flagella"].setdefault("count", tables)
    built: dict[str, Any] = {}
    for key, cls in _SECTIONS.items():
        with problems:
            built[key] = cls(**sections[key])
    count = tables
    if own and not tables:
        count = built["flagella"].count if "flagella" in built else max(own) + 1
    for k in own:
        if k >= count:
            name, value = next(iter(own[k].items()))
            with problems:
                raise SceneError(f"flagellum.{k}.{name}", value, f"there are flagella 0 to {count - 1}")
    overrides = []
    for k in range(min(count, int(Flagella.settings["count"].high)) if not problems.full() else 0):
        with problems:
            overrides.append(_override(k, own.get(k, {})))
    for name, setting in Scene.settings.items():
        with problems:
            if name in sections[""]:
                setting.checked(name, sections[""][name])
            elif name == "name":
                raise SceneError(name, None, f"must be {setting.allowed}")
    problems.raise_any()
    return Scene(**sections[""], **built, flagellum=tuple(overrides))


def _override(k: int, values: Mapping[str, Any]) -> FlagellumOverride:
    try:
        return FlagellumOverride(**values)
    except SceneError as error:
        # The class doesn't know which of the tables it is.
        told = [
            SceneError(f"flagellum.{k}.{str(e.key).rpartition('.')[2]}", e.value, e.problem)
            for e in (error, *error.others)
        ]
        raise SceneError.joined(told) from None


def _setting(key: str) -> Setting | None:
    return _KEYS.get(re.sub(r"^flagellum\.\d+\.", "flagellum.", key))


def is_whole(key: str) -> bool:
    """Whether a dotted key has whole numbers."""
    setting = _setting(key)
    return setting is not None and setting.kind == "integer"


def keys_of(text: str) -> list[str]:
    """Dotted keys with commas between them, as those that vary together along an axis of a sweep."""
    return [key.strip() for key in text.split(",")]


def unit_of(key: str) -> str:
    """The unit of a dotted key's numbers, as in "pN s/um^2"; empty where they have none, or no scene has the key."""
    setting = _setting(key)
    return "" if setting is None else setting.unit


def check_key(key: str, value: Any, brief: bool = False) -> None:
    """That scenes have a key.

    Args:
        key: dotted; of flagellum k `flagellum.k.torque`.
        value: told beside the key.
        brief: without looking for a key that it resembles.

    Raises:
        SceneError: no scene has it.
    """
    if key in _SECTIONS:
        raise SceneError(key, value, f"is a section: [{key}] with {', '.join(_SECTIONS[key].settings)}")
    if key == "flagellum":
        raise SceneError(key, value, "must be tables [[flagellum]], one per flagellum")
    indexed = re.fullmatch(r"flagellum\.(0|[1-9]\d{0,8})\.(.+)", key)
    plain = f"flagellum.{indexed[2]}" if indexed else key
    if plain in _KEYS and (indexed or not key.startswith("flagellum.")):
        return
    if brief:
        raise SceneError(key, value, "unknown key")
    near = scene_file.nearest(plain, _KEYS if "." in plain else [*_SECTIONS, *_KEYS])
    if near and near.startswith("flagellum."):
        near = near.replace("flagellum.", f"flagellum.{indexed[1] if indexed else 'K'}.")
    section = plain.rpartition(".")[0]
    siblings = [other.rpartition(".")[2] for other in _KEYS if other.rpartition(".")[0] == section]
    hint = f"did you mean {near}?" if near else "known here: " + ", ".join(siblings or _SECTIONS)
    raise SceneError(key, value, f"unknown key; {hint}")
