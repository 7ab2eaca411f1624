"""What is simulated: a bacterium, its flagella, the fluid, and which terms of the model act.

A scene is made from a file by `load` or in Python, and is checked when it is made: one that can't be simulated raises
`SceneError`. Units are um, pN, s; angles are in degrees.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpflag.scene import scene_file
from warpflag.scene.errors import Problems, SceneError, written
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
from warpflag.scene.settings import Section, Setting, integer, number, text

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
    """One flagellum with every choice resolved.

    Attributes:
        azimuth: of the anchor about e_b3, counted from e_b1 [deg].
        anchor_offset: distance of the anchor from the body's middle toward the rear [um].
        motor_axis_angle: of the motor axis to e_b3, toward the outward normal [deg].
        tilt: of the helix axis to e_b3, toward the outward normal [deg].
        torque: of the motor about its axis [pN um].
        length: of the contour [um].
        segment_count: number of segments.
        phase: angle of the anchor about the helix axis [deg]; None where the initial shape chooses it (see
            Flagella.phase_difference).
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

    Sections are attributes of the same names as in a scene file; `flagellum` holds either nothing or
    one override per flagellum. Values that exclude each other raise SceneError, like values out of range.
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
        problems = Problems()
        for check in (self._check_body, self._check_step, self._check_pair_radius, self._check_start):
            with problems.gathered():
                check()
        self._check_flagella(problems)
        with problems.gathered():
            self._check_phases()
        problems.raise_any()

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

    def _check_body(self) -> None:
        if self.body.width > self.body.length:
            problem = f"must not be above body.length = {self.body.length:g} um"
            raise SceneError("body.width", self.body.width, problem, ["body.length"])

    def _check_step(self) -> None:
        step = self.numerics.time_step
        if step is not None and step > self.duration:
            problem = f"must not be above duration = {self.duration:g} s"
            raise SceneError("numerics.time_step", step, problem, ["duration"])

    def _check_pair_radius(self) -> None:
        radius, mode = self.hydrodynamics.pair_radius, self.hydrodynamics.mode
        if radius is not None and mode in ("none", "as_printed"):
            why = "sums no pairs" if mode == "none" else "takes flagella.filament_radius"
            problem = f"must be absent: hydrodynamics.mode = {mode} {why}"
            raise SceneError("hydrodynamics.pair_radius", radius, problem, ["hydrodynamics.mode"])

    def _check_start(self) -> None:
        if self.start.record is None and self.start.frame != -1:
            raise SceneError("start.frame", self.start.frame, "needs start.record, which is absent")

    def _check_flagella(self, problems: Problems) -> None:
        if self.flagellum and len(self.flagellum) != self.flagella.count:
            problem = f"must be {len(self.flagellum)}, the number of [[flagellum]] tables, or absent"
            with problems.gathered():
                raise SceneError("flagella.count", self.flagella.count, problem)
            return
        anchors: dict[tuple[float, float], int] = {}
        told: set[str | None] = set()  # a value of the group is at fault once, not for every flagellum
        for k, spec in enumerate(self.resolved_flagella()):
            if problems.full():
                return
            for check in (self._check_segments, self._check_anchor):
                try:
                    check(k, spec)
                except SceneError as error:
                    if error.key not in told:
                        told.add(error.key)
                        with problems.gathered():
                            raise
            place = (round(spec.azimuth % 360.0, 9), spec.anchor_offset)
            if self.steric.enabled and anchors.setdefault(place, k) != k:
                problem = f"puts flagellum {k} on the anchor of flagellum {anchors[place]}"
                with problems.gathered():
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
        if 0 <= cylinder < abs(spec.anchor_offset) - 1e-9:
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
    values.setdefault("name", re.sub(r"[^\w.+-]+", "-", Path(path).stem).strip("-.+") or "scene")
    try:
        return _built({**values, **given}, tables)
    except SceneError as error:
        raise error.located(path, given) from None


def loads(toml: str) -> Scene:
    """The scene of a TOML text, as `dumps` writes it.

    Raises:
        SceneError: the scene can't be simulated.
    """
    return _built(*scene_file.flattened(scene_file.parsed(toml), _SECTIONS))


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


def _built(values: Mapping[str, Any], tables: int) -> Scene:
    """A scene of values by dotted key, of which `tables` overrides of flagella exist already."""
    problems = Problems()
    own: dict[int, dict[str, Any]] = {}
    sections: dict[str, dict[str, Any]] = {key: {} for key in ("", *_SECTIONS)}
    for key, value in values.items():
        with problems.gathered():
            _check_known(key, value, problems.full())
            section, _, name = key.rpartition(".")
            if section in sections:
                sections[section][name] = value
            else:
                own.setdefault(int(section.partition(".")[2]), {})[name] = value
    if tables:
        sections["flagella"].setdefault("count", tables)
    built: dict[str, Any] = {}
    for key, cls in _SECTIONS.items():
        with problems.gathered():
            built[key] = cls(**sections[key])
    count = tables
    if own and not tables:
        count = built["flagella"].count if "flagella" in built else max(own) + 1
    for k in own:
        if k >= count:
            name, value = next(iter(own[k].items()))
            with problems.gathered():
                raise SceneError(f"flagellum.{k}.{name}", value, f"there are flagella 0 to {count - 1}")
    overrides = []
    for k in range(min(count, int(Flagella.settings["count"].high)) if not problems.full() else 0):
        with problems.gathered():
            overrides.append(_override(k, own.get(k, {})))
    for name, setting in Scene.settings.items():
        with problems.gathered():
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


def _check_known(key: str, value: Any, brief: bool) -> None:
    """Raises SceneError for a key that no scene has; `brief`: without looking for one that it resembles."""
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
