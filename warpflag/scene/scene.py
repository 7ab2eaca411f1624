"""What is simulated: a bacterium, its flagella, the fluid, and which terms of the model act.

A scene is made from a file by :func:`load` or in Python, and is checked when it is made: one that can't be
simulated raises :class:`SceneError`. Units are um, pN, s; angles are in degrees.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpflag.base.above import method_from
from warpflag.scene import scene_file
from warpflag.scene.sections import (
    Body,
    External,
    Flagella,
    FlagellumOverride,
    Fluid,
    Hydrodynamics,
    Motor,
    Numerics,
    Start,
    Steric,
)
from warpflag.scene.settings import SceneError, Section, Setting, integer, number, text, written

__all__ = [
    "Body",
    "External",
    "Flagella",
    "FlagellumOverride",
    "FlagellumSpec",
    "Fluid",
    "Hydrodynamics",
    "Motor",
    "Numerics",
    "Scene",
    "SceneError",
    "Start",
    "Steric",
    "dumps",
    "load",
    "with_values",
]


@dataclass(frozen=True)
class FlagellumSpec:
    """One flagellum with every choice resolved. Angles in deg, lengths in um, torque in pN um.

    phase is None where the initial shape chooses it (see Flagella.phase_difference).
    """

    azimuth: float
    anchor_offset: float
    motor_axis_angle: float
    tilt: float
    torque: float
    length: float
    segment_count: int
    phase: float | None

    @property
    def segment_length(self) -> float:
        """Rest length h of a segment [um]: the contour length over the number of segments."""
        return self.length / self.segment_count


@dataclass(frozen=True)
class Scene(Section, key=""):
    """Everything that a run depends on.

    Sections are attributes of the same names as in a scene file; ``flagellum`` holds either nothing or
    one override per flagellum. Raises SceneError for values that exclude each other.
    """

    name: str = text(
        dataclasses.MISSING,
        "names the run directory",
        pattern=r"\w[\w .+-]*",
        pattern_text="letters, digits, space and . _ + -, starting with a letter or digit",
    )
    duration: float = number(0.015, "s", 1e-12, 10, "simulated time")
    frames: int = integer(300, 1, 10_000_000, "recorded intervals; frames + 1 values are kept")
    flagella: Flagella = dataclasses.field(default_factory=Flagella)
    flagellum: tuple[FlagellumOverride, ...] = ()
    motor: Motor = dataclasses.field(default_factory=Motor)
    fluid: Fluid = dataclasses.field(default_factory=Fluid)
    hydrodynamics: Hydrodynamics = dataclasses.field(default_factory=Hydrodynamics)
    steric: Steric = dataclasses.field(default_factory=Steric)
    body: Body = dataclasses.field(default_factory=Body)
    external: External = dataclasses.field(default_factory=External)
    numerics: Numerics = dataclasses.field(default_factory=Numerics)
    start: Start = dataclasses.field(default_factory=Start)

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "flagellum", tuple(self.flagellum))
        self._check_sections()
        self._check_flagella()
        self._check_phases()

    _repr_html_ = method_from("warpflag.view.scene_table", "scene_table", "Tables of the settings, for notebooks.")

    def resolved_flagella(self) -> tuple[FlagellumSpec, ...]:
        """Every flagellum with the group's values filled in, in order."""
        group = self.flagella
        specs = []
        for k, own in enumerate(self.flagellum or (FlagellumOverride(),) * group.count):
            length = _own(own.length, group.length)
            specs.append(
                FlagellumSpec(
                    azimuth=_own(own.azimuth, 360.0 * k / group.count),
                    anchor_offset=_own(own.anchor_offset, group.anchor_offset),
                    motor_axis_angle=_own(own.motor_axis_angle, self.motor.axis_angle),
                    tilt=_own(own.tilt, group.opening_angle / 2),
                    torque=_own(own.torque, self.motor.torque),
                    length=length,
                    segment_count=_own(own.segments, math.floor(length / group.segment_length + 0.5)),
                    phase=own.phase,
                )
            )
        return tuple(specs)

    def _check_sections(self) -> None:
        if self.body.width > self.body.length:
            problem = f"must not be above body.length = {self.body.length:g} um"
            raise SceneError("body.width", self.body.width, problem, ["body.length"])
        step = self.numerics.time_step
        if step is not None and step > self.duration:
            problem = f"must not be above duration = {self.duration:g} s"
            raise SceneError("numerics.time_step", step, problem, ["duration"])
        radius, mode = self.hydrodynamics.pair_radius, self.hydrodynamics.mode
        if radius is not None and mode in ("none", "as_printed"):
            why = "sums no pairs" if mode == "none" else "takes flagella.filament_radius"
            problem = f"must be absent: hydrodynamics.mode = {mode} {why}"
            raise SceneError("hydrodynamics.pair_radius", radius, problem, ["hydrodynamics.mode"])
        if self.start.record is None and self.start.frame != -1:
            raise SceneError("start.frame", self.start.frame, "needs start.record, which is absent")

    def _check_flagella(self) -> None:
        if self.flagellum and len(self.flagellum) != self.flagella.count:
            problem = f"must be {len(self.flagellum)}, the number of [[flagellum]] tables, or absent"
            raise SceneError("flagella.count", self.flagella.count, problem)
        anchors: dict[tuple[float, float], int] = {}
        for k, spec in enumerate(self.resolved_flagella()):
            self._check_segments(k, spec)
            self._check_anchor(k, spec)
            place = (round(spec.azimuth % 360.0, 9), spec.anchor_offset)
            if self.steric.enabled and anchors.setdefault(place, k) != k:
                problem = f"puts flagellum {k} on the anchor of flagellum {anchors[place]}"
                raise SceneError(f"flagellum.{k}.azimuth", spec.azimuth, problem)

    def _check_segments(self, k: int, spec: FlagellumSpec) -> None:
        key, value = "flagella.segment_length", self.flagella.segment_length
        if self.flagellum and self.flagellum[k].segments is not None:
            key, value = f"flagellum.{k}.segments", spec.segment_count
        lengths = ["flagella.length", f"flagellum.{k}.length"]
        if not 2 <= spec.segment_count <= 10_000:
            problem = f"makes {spec.segment_count} of {spec.length:g} um; 2 to 10000 segments are allowed"
            raise SceneError(key, value, problem, lengths)
        twist = spec.segment_length * abs(self.flagella.intrinsic_curvature[2])
        if twist >= math.pi:
            problem = (
                f"makes segments of {spec.segment_length:g} um; with flagella.intrinsic_curvature the frame "
                f"turns by {twist:.3g} rad from one to the next, which must be below pi"
            )
            raise SceneError(key, value, problem, [*lengths, "flagella.intrinsic_curvature"])

    def _check_anchor(self, k: int, spec: FlagellumSpec) -> None:
        cylinder = (self.body.length - self.body.width) / 2
        if abs(spec.anchor_offset) > cylinder + 1e-9:
            own = self.flagellum and self.flagellum[k].anchor_offset is not None
            key = f"flagellum.{k}.anchor_offset" if own else "flagella.anchor_offset"
            problem = f"is beyond the cylinder part of the body, {-cylinder:g} to {cylinder:g} um"
            raise SceneError(key, spec.anchor_offset, problem, ["body.length", "body.width"])

    def _check_phases(self) -> None:
        key, wanted = "flagella.phase_difference", self.flagella.phase_difference
        if wanted is None:
            return
        if self.flagella.count < 2:
            raise SceneError(key, wanted, "needs two flagella; leave it out for one", ["flagella.count"])
        for k, own in enumerate(self.flagellum[:2]):
            if own.phase is not None:
                given = f"flagellum.{k}.phase"
                raise SceneError(key, wanted, f"must be absent where {given} is given", [given])


def _own(own: Any, group: Any) -> Any:
    return group if own is None else own


_SECTIONS: dict[str, type[Section]] = {
    cls.key: cls for cls in (Flagella, Motor, Fluid, Hydrodynamics, Steric, Body, External, Numerics, Start)
}
_KEYS: dict[str, Setting] = {
    f"{cls.key}.{name}".lstrip("."): setting
    for cls in (Scene, *_SECTIONS.values(), FlagellumOverride)
    for name, setting in cls.settings.items()
}


def load(path: str | Path, overrides: Mapping[str, Any] | Sequence[str] = ()) -> Scene:
    """Read a scene file.

    overrides: values that replace the file's, as ``key=value`` texts or as a mapping from dotted key to
    value; flagellum k (from 0) has keys ``flagellum.k.torque`` and so on. A file without a name gets its
    own file name. Raises SceneError, which names the file and the key.
    """
    given = scene_file.read_overrides(overrides)
    values, tables = scene_file.flattened(scene_file.read_toml(Path(path)), _SECTIONS)
    values.setdefault("name", re.sub(r"[^\w.+-]+", "-", Path(path).stem).strip("-.+") or "scene")
    try:
        return _built({**values, **given}, tables)
    except SceneError as error:
        raise error.located(path, given) from None


def loads(toml: str) -> Scene:
    """The scene of a TOML text, as `dumps` writes it. Raises SceneError."""
    return _built(*scene_file.flattened(scene_file.parsed(toml), _SECTIONS))


def with_values(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """A checked copy with other values by dotted key, ``{"motor.torque": 2.0}``; None makes one absent."""
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


def _built(values: Mapping[str, Any], tables: int) -> Scene:
    """A scene from values by dotted key; ``tables`` overrides of flagella exist already."""
    own: dict[int, dict[str, Any]] = {}
    sections: dict[str, dict[str, Any]] = {key: {} for key in ("", *_SECTIONS)}
    for key, value in values.items():
        _check_known(key, value)
        section, _, name = key.rpartition(".")
        if section in sections:
            sections[section][name] = value
        else:
            own.setdefault(int(section.partition(".")[2]), {})[name] = value
    if tables:
        sections["flagella"].setdefault("count", tables)
    built: dict[str, Any] = {key: cls(**sections[key]) for key, cls in _SECTIONS.items()}
    count = tables or (built["flagella"].count if own else 0)
    for k in own:
        if k >= count:
            name, value = next(iter(own[k].items()))
            raise SceneError(f"flagellum.{k}.{name}", value, f"there are flagella 0 to {count - 1}")
    built["flagellum"] = tuple(_override(k, own.get(k, {})) for k in range(count))
    return Scene(**sections[""], **built)


def _override(k: int, values: Mapping[str, Any]) -> FlagellumOverride:
    try:
        return FlagellumOverride(**values)
    except SceneError as error:
        # The class doesn't know which of the tables it is.
        leaf = str(error.key).rpartition(".")[2]
        raise SceneError(f"flagellum.{k}.{leaf}", error.value, error.problem) from None


def _check_known(key: str, value: Any) -> None:
    if key in _SECTIONS:
        raise SceneError(key, value, f"is a section: [{key}] with {', '.join(_SECTIONS[key].settings)}")
    if key == "flagellum":
        raise SceneError(key, value, "must be tables [[flagellum]], one per flagellum")
    indexed = re.fullmatch(r"flagellum\.(\d{1,9})\.(.+)", key)
    plain = f"flagellum.{indexed[2]}" if indexed else key
    if plain in _KEYS and (indexed or not key.startswith("flagellum.")):
        return
    near = scene_file.nearest(plain, _KEYS if "." in plain else [*_SECTIONS, *_KEYS])
    if near and near.startswith("flagellum."):
        near = near.replace("flagellum.", f"flagellum.{indexed[1] if indexed else 'K'}.")
    section = plain.rpartition(".")[0]
    siblings = [other.rpartition(".")[2] for other in _KEYS if other.rpartition(".")[0] == section]
    hint = f"did you mean {near}?" if near else "known here: " + ", ".join(siblings or _SECTIONS)
    raise SceneError(key, value, f"unknown key; {hint}")
