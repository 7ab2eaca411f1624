"""What is simulated: a bacterium, its flagella, the fluid, and which terms of the model act.

A scene is checked when it is made: one that can't be simulated raises `SceneError`. Units are um, pN, s; angles are in
degrees. `warpflag.scene.reading` makes scenes of files and of other scenes.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from dataclasses import dataclass
from typing import Any

from warpflag.base.above import method_from
from warpflag.scene import attachment
from warpflag.scene.errors import Problems, SceneError
from warpflag.scene.run_sections import Numerics, Start
from warpflag.scene.sections import Flagella, FlagellumOverride, Sections
from warpflag.scene.settings import Section, integer, number, switch, text
from warpflag.scene.smooth_helix import TAPER

__all__ = ["FlagellumSpec", "Scene"]


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
        law: of the motor, as `Motor.law`.
        knee, no_load, rate: of the motor's law [Hz].
        switch_times: when the motor reverses by a schedule [s].
    """

    azimuth: float
    anchor_offset: float
    motor_axis_angle: float
    tilt: float
    torque: float
    length: float
    segment_count: int
    phase: float | None
    law: str
    knee: float
    no_load: float
    rate: float
    switch_times: tuple[float, ...]

    @property
    def forward(self) -> float:
        """Of the sign in which the motor turns forward, right-handed about its axis; 0 for one that is never driven."""
        return self.rate if self.law == "rate" else self.torque

    @property
    def segment_length(self) -> float:
        """Rest length h of a segment [um]: the contour length over the number of segments."""
        return self.length / self.segment_count


@dataclass(frozen=True)
class Scene(Sections, Section, key=""):
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
    behaviour: bool = switch(False, "runs and tumbles, bundles, wrapping, wobble and motor loads in the summary")
    flagellum: tuple[FlagellumOverride, ...] = ()
    numerics: Numerics = dataclasses.field(default_factory=Numerics)
    start: Start = dataclasses.field(default_factory=Start)
    format: int = integer(1, 1, 1, "which defaults the file has; without it those of the paper's model")

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_sections()
        object.__setattr__(self, "flagellum", tuple(self.flagellum))
        problems = Problems()
        for check in (
            self._check_body,
            self._check_step,
            self._check_flows,
            self._check_start,
            self._check_hook,
            self._check_helix,
            self._check_forms,
            self._check_noise,
        ):
            with problems:
                check()
        self._check_flagella(problems)
        with problems:
            self._check_phases()
        problems.raise_any()

    _repr_html_ = method_from("warpflag.view.scene_table", "scene_table", "Tables of the settings, for notebooks.")

    def resolved_flagella(self) -> tuple[FlagellumSpec, ...]:
        """Every flagellum with the group's values filled in, in order."""
        return self._resolved

    @functools.cached_property
    def _resolved(self) -> tuple[FlagellumSpec, ...]:
        group = self.flagella
        specs = []
        for k, own in enumerate(self.flagellum or (FlagellumOverride(),) * group.count):
            length, tilt = _own(own.length, group.length), _own(own.tilt, group.opening_angle / 2)
            specs.append(
                FlagellumSpec(
                    azimuth=_own(own.azimuth, 360.0 * k / group.count),
                    anchor_offset=_own(own.anchor_offset, group.anchor_offset),
                    motor_axis_angle=_own(own.motor_axis_angle, self.motor.axis_angle) if self.body.enabled else tilt,
                    tilt=tilt,
                    torque=_own(own.torque, self.motor.torque),
                    length=length,
                    segment_count=_own(own.segments, math.floor(length / group.segment_length + 0.5)),
                    phase=own.phase,
                    law=_own(own.law, self.motor.law),
                    knee=_own(own.knee, self.motor.knee),
                    no_load=_own(own.no_load, self.motor.no_load),
                    rate=_own(own.rate, self.motor.rate),
                    switch_times=_own(own.switch_times, self.motor.switch_times),
                )
            )
        return tuple(specs)

    def _check_sections(self) -> None:
        """Every section is of its own kind, which a file can't get wrong but Python can."""
        for field in dataclasses.fields(self):
            value, kind = getattr(self, field.name), field.default_factory
            if isinstance(kind, type) and not isinstance(value, kind):
                raise SceneError(field.name, repr(value), f"must be a {kind.__name__}")
        own = self.flagellum
        if not isinstance(own, list | tuple) or not all(isinstance(one, FlagellumOverride) for one in own):
            raise SceneError("flagellum", repr(own), "must be a sequence of FlagellumOverride, one per flagellum")

    def _check_body(self) -> None:
        if not self.body.enabled:
            if self.flagella.count > 1:
                problem = "must be 1 where body.enabled = false: a free filament is alone"
                raise SceneError("flagella.count", self.flagella.count, problem, ["body.enabled"])
            if any(self.external.body_force):
                problem = "must be zero where body.enabled = false"
                raise SceneError("external.body_force", self.external.body_force, problem, ["body.enabled"])
            return
        if self.body.width > self.body.length:
            problem = f"must not be above body.length = {self.body.length:g} um"
            raise SceneError("body.width", self.body.width, problem, ["body.length"])

    def _check_step(self) -> None:
        step = self.numerics.time_step
        if step is not None and step > self.duration:
            problem = f"must not be above duration = {self.duration:g} s"
            raise SceneError("numerics.time_step", step, problem, ["duration"])

    @property
    def has_body_flow(self) -> bool:
        """Whether the flow round the body is part of the model: as the scene says, else wherever it can be."""
        if self.hydrodynamics.body_flow is not None:
            return self.hydrodynamics.body_flow
        return self.hydrodynamics.mode in ("all", "consistent") and self.body.enabled

    def _check_flows(self) -> None:
        radius, mode = self.hydrodynamics.pair_radius, self.hydrodynamics.mode
        if radius is not None and mode in ("none", "as_printed"):
            why = "sums no pairs" if mode == "none" else "takes flagella.filament_radius"
            problem = f"must be absent: hydrodynamics.mode = {mode} {why}"
            raise SceneError("hydrodynamics.pair_radius", radius, problem, ["hydrodynamics.mode"])

        if self.hydrodynamics.body_flow and mode not in ("all", "consistent"):
            problem = f"needs hydrodynamics.mode all or consistent, not {mode}"
            raise SceneError("hydrodynamics.body_flow", True, problem, ["hydrodynamics.mode"])
        if self.hydrodynamics.body_flow and not self.body.enabled:
            raise SceneError("hydrodynamics.body_flow", True, "needs a body: body.enabled = false", ["body.enabled"])

    def _check_hook(self) -> None:
        if self.hook.stiffness and not self.motor.bearing_torque:
            problem = "needs motor.bearing_torque: a hook that resists bending hands its torque to the body"
            raise SceneError("hook.stiffness", self.hook.stiffness, problem, ["motor.bearing_torque"])
        if self.hook.stiffening_torque is not None and not self.hook.stiffness:
            problem = "must be absent where hook.stiffness = 0"
            raise SceneError("hook.stiffening_torque", self.hook.stiffening_torque, problem, ["hook.stiffness"])

    def _check_helix(self) -> None:
        """Either strains, or radius and pitch; and a pitch that leaves room to grow on the axis."""
        group = self.flagella
        given = {"helix_radius": group.helix_radius, "helix_pitch": group.helix_pitch}
        for (key, value), (other, missing) in zip(given.items(), reversed(given.items()), strict=True):
            if value is not None and missing is None:
                raise SceneError(f"flagella.{key}", value, f"needs flagella.{other}", [f"flagella.{other}"])
        if group.helix_radius is not None and group.intrinsic_curvature != Flagella().intrinsic_curvature:
            problem = "must be absent where flagella.helix_radius and helix_pitch are given"
            raise SceneError("flagella.intrinsic_curvature", group.intrinsic_curvature, problem)
        bend, twist = math.hypot(*group.ground_strain[:2]), abs(group.ground_strain[2])
        pitch = 2.0 * math.pi * twist / (bend * bend + twist * twist) if bend else math.inf
        if group.on_axis and pitch < TAPER:
            problem = f"needs a pitch of {TAPER:g} um or more, in which the helix grows; it is {pitch:.3g} um"
            raise SceneError(
                "flagella.on_axis", True, problem, ["flagella.intrinsic_curvature", "flagella.helix_pitch"]
            )

    def _check_noise(self) -> None:
        """What thermal noise does not go with."""
        key, temperature, related = "fluid.temperature", self.fluid.temperature, ["fluid.temperature"]
        if temperature == 0.0:
            if self.fluid.noise_tolerance is not None:
                raise SceneError("fluid.noise_tolerance", self.fluid.noise_tolerance, f"needs {key} above 0", related)
            return
        mode, numerics = self.hydrodynamics.mode, self.numerics
        plain = self.motor.switching == "none" and all(spec.law == "constant" for spec in self.resolved_flagella())
        if numerics.stepper != "implicit" and not plain:
            problem = f"must be implicit with {key} and motors that switch or whose law is not constant"
            raise SceneError("numerics.stepper", numerics.stepper, problem, [key, "motor.law", "motor.switching"])
        if self.polymorphs.enabled:
            problem = (
                f"must be false with {key}: forms change by moments without noise, which alone is 0.3 pN um a joint"
            )
            raise SceneError("polymorphs.enabled", True, problem, related)
        if mode in ("between", "as_printed"):
            problem = f"must be none, within, all or consistent with {key}: its mobility is not positive definite"
            raise SceneError("hydrodynamics.mode", mode, problem, related)
        if numerics.accuracy is not None:
            problem = f"must be absent with {key}: steps with noise are fixed, numerics.time_step"
            raise SceneError("numerics.accuracy", numerics.accuracy, problem, related)
        if not self.motor.bearing_torque:
            problem = f"must be true with {key}: without it forces have no energy, and no equilibrium"
            raise SceneError("motor.bearing_torque", False, problem, related)

    def _check_start(self) -> None:
        if self.start.record is None and self.start.frame != -1:
            raise SceneError("start.frame", self.start.frame, "needs start.record, which is absent")

    def _check_forms(self) -> None:
        """Moments count against a handedness; a joint must not flip back under that at which it flips, to and fro."""
        forms = self.polymorphs
        if not forms.enabled:
            return
        if self.flagella.ground_strain[2] == 0.0:
            key = "intrinsic_curvature" if self.flagella.helix_pitch is None else "helix_pitch"
            part = "the third component of " if self.flagella.helix_pitch is None else ""
            problem = "must be false where filaments have no handedness, against which motors could wind them up: "
            raise SceneError("polymorphs.enabled", True, f"{problem}{part}flagella.{key} is 0", [f"flagella.{key}"])
        for name, back, limit in (
            ("propagation", forms.propagation_back, forms.propagation),
            ("nucleation", -forms.nucleation_back, forms.nucleation),
        ):
            if back > limit:
                key, value = f"polymorphs.{name}_back", getattr(forms, f"{name}_back")
                problem = f"flips joints back below a moment of {back:g}, above that of polymorphs.{name}, {limit:g}"
                raise SceneError(key, value, problem, [f"polymorphs.{name}"])

    def _check_flagella(self, problems: Problems) -> None:
        if self.flagellum and len(self.flagellum) != self.flagella.count:
            problem = f"must be {len(self.flagellum)}, the number of [[flagellum]] tables, or absent"
            with problems:
                raise SceneError("flagella.count", self.flagella.count, problem)
            return
        told: set[str | None] = set()  # a value of the group is at fault once, not for every flagellum
        for k, spec in enumerate(self.resolved_flagella()):
            if problems.full():
                return
            for check in (self._check_segments, self._check_anchor, self._check_motor):
                try:
                    check(k, spec)
                except SceneError as error:
                    if error.key not in told:
                        told.add(error.key)
                        with problems:
                            raise
        if self.steric.enabled and self.body.enabled and not any(key and key.endswith("anchor_offset") for key in told):
            with problems:
                self._check_distances()

    def _check_distances(self) -> None:
        """Two anchors nearer than a filament is thick have flagella inside each other, which no step can part."""
        thick = 2 * self.flagella.filament_radius
        boxes: dict[tuple[int, ...], list[int]] = {}  # flagella by the box of that size that their anchor is in
        anchors: list[tuple[float, float, float]] = []
        for k, spec in enumerate(self.resolved_flagella()):
            anchors.append(attachment.anchor(self, spec))
            box = tuple(math.floor(x / thick) for x in anchors[k])
            for step in itertools.product((-1, 0, 1), repeat=3):
                for j in boxes.get((box[0] + step[0], box[1] + step[1], box[2] + step[2]), ()):
                    self._check_distance(j, k, math.dist(anchors[j], anchors[k]), thick)
            boxes.setdefault(box, []).append(k)

    def _check_distance(self, j: int, k: int, distance: float, thick: float) -> None:
        if distance >= thick * (1 - 1e-9):
            return
        if distance < 1e-9:
            problem = f"puts flagellum {k} on the anchor of flagellum {j}"
        else:
            problem = (
                f"puts the anchors of flagella {j} and {k} {distance:.3g} um apart, nearer than a filament is thick, "
                f"{thick:.3g} um"
            )
        if self.flagellum and self.flagellum[k] != FlagellumOverride():
            raise SceneError(f"flagellum.{k}.azimuth", self.resolved_flagella()[k].azimuth, problem)
        raise SceneError("flagella.count", self.flagella.count, problem, ["body.width", "flagella.filament_radius"])

    def _check_segments(self, k: int, spec: FlagellumSpec) -> None:
        key, value = "flagella.segment_length", self.flagella.segment_length
        if self.flagellum and self.flagellum[k].segments is not None:
            key, value = f"flagellum.{k}.segments", spec.segment_count
        lengths = ["flagella.length", f"flagellum.{k}.length"]
        if not 2 <= spec.segment_count <= 10_000:
            problem = f"makes {spec.segment_count} of {spec.length:g} um; 2 to 10000 segments are allowed"
            raise SceneError(key, value, problem, lengths)
        forms: dict[str, tuple[float, float, float] | None] = {"flagella.intrinsic_curvature": None}
        names = (self.polymorphs.target, self.polymorphs.second) if self.polymorphs.enabled else ()
        forms |= {f"polymorphs.{name}": getattr(self.polymorphs, name) for name in names if name != "none"}
        for form, own in forms.items():
            try:
                strain = self.flagella.strain_at_rest(spec.segment_length, own)
            except ValueError as error:
                of = f" of {form}" if own else ""
                raise SceneError(key, value, f"{error}{of}, with flagella.nodes_on_helix", [*lengths, form]) from None
            twist = spec.segment_length * abs(strain[2])
            if twist >= math.pi:
                problem = (
                    f"makes segments of {spec.segment_length:g} um; with {form} the frame "
                    f"turns by {twist:.3g} rad from one to the next, which must be below pi"
                )
                raise SceneError(key, value, problem, [*lengths, form])

    def _check_anchor(self, k: int, spec: FlagellumSpec) -> None:
        pole = self.body.length / 2
        if self.body.enabled and self.body.width <= self.body.length and pole < abs(spec.anchor_offset) - 1e-9:
            own = self.flagellum and self.flagellum[k].anchor_offset is not None
            key = f"flagellum.{k}.anchor_offset" if own else "flagella.anchor_offset"
            problem = f"is beyond the ends of the body, {-pole:g} to {pole:g} um"
            raise SceneError(key, spec.anchor_offset, problem, ["body.length", "body.width"])

    def _check_motor(self, k: int, spec: FlagellumSpec) -> None:
        own = self.flagellum[k] if self.flagellum else FlagellumOverride()
        if spec.no_load <= spec.knee:
            key = f"flagellum.{k}.no_load" if own.no_load is not None else "motor.no_load"
            problem = f"must be above the knee, {spec.knee:g} Hz"
            raise SceneError(key, spec.no_load, problem, ["motor.knee", f"flagellum.{k}.knee"])
        end = spec.no_load if self.motor.reverse_no_load is None else self.motor.reverse_no_load
        if end <= self.motor.reverse_knee:
            problem = f"must be below the rate without load in reverse, {end:g} Hz"
            raise SceneError("motor.reverse_knee", self.motor.reverse_knee, problem, ["motor.reverse_no_load"])
        if self.motor.switching != "schedule" and spec.switch_times:
            key = f"flagellum.{k}.switch_times" if own.switch_times else "motor.switch_times"
            raise SceneError(key, spec.switch_times, "needs motor.switching = schedule", ["motor.switching"])

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
