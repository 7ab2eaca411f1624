"""The force terms that scenes ask for: when each is needed, what it takes from a scene, and the power it brings in.

What a term does to a cell is device code, `warpflag_kernels.stepping.terms`; the names there and here are the same.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from warpflag_kernels.base.plan import Flows, Switches
from warpflag_kernels.motor.laws import Law

from warpflag.model.switching import corners, second_intervals
from warpflag.record.cell_state import Evaluation
from warpflag.scene import Scene
from warpflag.scene.helix import rest_shape
from warpflag.scene.resistance import pair_radii

__all__ = ["SCENE_TERMS", "SceneTerm", "supplied_power", "switches_of"]

_NO_KNEE = 1e30  # rate beyond any [rad/s]


@dataclass(frozen=True)
class SceneTerm:
    """What a term of the forces takes from scenes.

    Attributes:
        name: of the device term.
        needed: whether a scene has it.
        fill: fills the struct `Model` of a batch and its optional parts,
            `fill(scenes, precision, device, data, parts)`; None: nothing of its own.
        power: power that it brings into one cell [pN um/s], `power(scene, evaluation)`. None: it stores energy, or
            does no work.
    """

    name: str
    needed: Callable[[Scene], bool]
    fill: Callable[[Sequence[Scene], Any, Any, Any, Any], None] | None = None
    power: Callable[[Scene, Evaluation], float] | None = None


def _fill_motor(scenes: Sequence[Scene], precision: Any, device: Any, data: Any, parts: Any) -> None:
    torques = [spec.torque for scene in scenes for spec in scene.resolved_flagella()]
    data.motor.torque = wp.array(np.array(torques), dtype=precision.real, device=device)


def _motor_power(scene: Scene, found: Evaluation) -> float:
    """Of T_m on each tripod and -T_m m on the body."""
    turns = found.spins[found.first] - found.tangents[found.first] @ found.body_spin
    return float(found.motor_torques @ turns)


def _plain(scene: Scene) -> bool:
    """Whether every motor has a constant torque."""
    return scene.motor.switching == "none" and all(spec.law == "constant" for spec in scene.resolved_flagella())


def _fill_motor_law(scenes: Sequence[Scene], precision: Any, device: Any, data: Any, parts: Any) -> None:
    _fill_motor(scenes, precision, device, data, parts)  # a hook that stiffens reads the torque
    curves, tables = [], []
    specs = [(scene, k, spec) for scene in scenes for k, spec in enumerate(scene.resolved_flagella())]
    for scene, k, spec in specs:
        m, forward = scene.motor, spec.torque
        reverse = -forward if m.reverse_torque is None else -math.copysign(m.reverse_torque, forward)
        ends = (spec.no_load, spec.no_load if m.reverse_no_load is None else m.reverse_no_load)
        for torque, knee, end in zip((forward, -reverse), (spec.knee, m.reverse_knee), ends, strict=True):
            falling = spec.law == "torque_speed"
            slope = abs(torque) / (2 * math.pi * (end - knee)) if falling else 0.0
            curves.append((torque, 2 * math.pi * knee if falling else _NO_KNEE, slope))
        tables.append(corners(scene, k))
    device_array = functools.partial(wp.array, device=device)
    m, real = parts.motor_law, precision.real
    kinds = [Law.PRESCRIBED if spec.law == "rate" else Law.STRAIGHT for _, _, spec in specs]
    m.kind = device_array(np.array(kinds), dtype=wp.int32)
    m.curve = device_array(np.array(curves), dtype=precision.vec3)
    m.rate = device_array(np.array([2 * math.pi * spec.rate for _, _, spec in specs]), dtype=real)
    first = np.concatenate([[0], np.cumsum([len(times) for times, _ in tables])])
    m.first_switch = device_array(first, dtype=wp.int32)
    m.switch_time = device_array(np.concatenate([times for times, _ in tables]), dtype=wp.float64)
    m.switch_drive = device_array(np.concatenate([drives for _, drives in tables]), dtype=real)


def _fill_hook(scenes: Sequence[Scene], precision: Any, device: Any, data: Any, parts: Any) -> None:
    flagella = [(scene, spec) for scene in scenes for spec in scene.resolved_flagella()]
    rest = [
        rest_shape(
            scene.flagella.strain_at_rest(s.segment_length), s.segment_length, s.segment_count, scene.flagella.on_axis
        )
        for scene, s in flagella
    ]
    limits = [scene.hook.stiffening_torque for scene, _ in flagella]
    stiffness = np.array([scene.hook.stiffness for scene, _ in flagella])
    stiffening = np.array([0.0 if limit is None else 1.0 / limit for limit in limits])
    parts.hook.stiffness = wp.array(stiffness, dtype=precision.real, device=device)
    parts.hook.stiffening = wp.array(stiffening, dtype=precision.real, device=device)
    axes = np.array([shape.helix_axes[:, 0] for shape in rest])
    parts.hook.helix_axis = wp.array(axes, dtype=precision.vec3, device=device)


def _fill_polymorphs(scenes: Sequence[Scene], precision: Any, device: Any, data: Any, parts: Any) -> None:
    own = data.rod.rest_strain.numpy().astype(np.float64)
    first = data.first_node.numpy()
    strains = np.repeat(own, 3, axis=0)
    specs = [(scene, k, spec) for scene in scenes for k, spec in enumerate(scene.resolved_flagella())]
    for k, (scene, _, spec) in enumerate(specs):
        for form, name in enumerate((scene.polymorphs.target, scene.polymorphs.second), 1):
            if name == "none":
                continue
            strain = scene.flagella.strain_at_rest(spec.segment_length, getattr(scene.polymorphs, name))
            strain = spec.segment_length * np.array(strain)
            if scene.flagella.ground_strain[2] > 0.0:  # a right-handed filament has the mirror images of all forms
                strain *= (-1.0, 1.0, -1.0)
            strains[3 * first[k] + form : 3 * first[k + 1] : 3] = strain
    forms = [scene.polymorphs for scene, _, _ in specs]
    m, pairs = parts.polymorphs, functools.partial(wp.array, dtype=wp.vec2d, device=device)
    m.rest_strain = wp.array(strains, dtype=precision.vec3, device=device)
    ramps = [f.ramp or spec.segment_length / f.front_speed for f, (_, _, spec) in zip(forms, specs, strict=True)]
    m.ramp = wp.array(ramps, dtype=wp.float64, device=device)
    m.nucleation = pairs(np.array([(f.nucleation, -f.nucleation_back) for f in forms]))
    m.propagation = pairs(np.array([(f.propagation, f.propagation_back) for f in forms]))
    tables = [second_intervals(scene, k) for scene, k, _ in specs]
    first_interval = np.concatenate([[0], np.cumsum([len(own) for own in tables])])
    m.first_second = wp.array(first_interval, dtype=wp.int32, device=device)
    m.second = pairs(np.concatenate([np.reshape(own, (-1, 2)) for own in tables]))


def _external_forces(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    return np.array(scene.external.force_per_length), np.array(scene.external.body_force)


def _fill_external(scenes: Sequence[Scene], precision: Any, device: Any, data: Any, parts: Any) -> None:
    per_length, on_body = zip(*map(_external_forces, scenes), strict=True)
    parts.external.force_per_length = wp.array(np.array(per_length), dtype=precision.vec3, device=device)
    parts.external.body_force = wp.array(np.array(on_body), dtype=precision.vec3, device=device)


def _external_power(scene: Scene, found: Evaluation) -> float:
    """Every node carries half of the reference length of each of its segments."""
    per_length, on_body = _external_forces(scene)
    flagella = scene.resolved_flagella()
    lengths = np.repeat([spec.segment_length for spec in flagella], [spec.segment_count + 1 for spec in flagella])
    last = np.append(found.first[1:], len(lengths)) - 1
    lengths[found.first] /= 2
    lengths[last] /= 2
    return float(lengths @ (found.velocities @ per_length) + on_body @ found.body_velocity)


def _several(scene: Scene) -> bool:
    return len(scene.resolved_flagella()) > 1


SCENE_TERMS = (
    SceneTerm("motor", lambda scene: scene.body.enabled and _plain(scene), fill=_fill_motor, power=_motor_power),
    SceneTerm(
        "motor law",
        lambda scene: scene.body.enabled and not _plain(scene),
        fill=_fill_motor_law,
        power=_motor_power,
    ),
    SceneTerm("polymorphs", lambda scene: scene.polymorphs.enabled, fill=_fill_polymorphs),
    SceneTerm("elastic", lambda scene: True),
    SceneTerm("bearing", lambda scene: scene.motor.bearing_torque and scene.body.enabled),
    SceneTerm("hook", lambda scene: scene.hook.stiffness > 0.0 and scene.body.enabled, fill=_fill_hook),
    SceneTerm(
        "hook that stiffens",
        lambda scene: (
            bool(scene.hook.stiffening_torque and scene.hook.stiffness and scene.body.enabled) and not _plain(scene)
        ),
    ),
    SceneTerm("steric", lambda scene: scene.steric.enabled and not scene.steric.self_contact and _several(scene)),
    SceneTerm("steric with self", lambda scene: scene.steric.enabled and scene.steric.self_contact),
    SceneTerm("body contact", lambda scene: scene.body.contact and scene.body.enabled),
    SceneTerm(
        "external",
        lambda scene: any(map(np.any, _external_forces(scene))),
        fill=_fill_external,
        power=_external_power,
    ),
    SceneTerm("free end", lambda scene: not scene.body.enabled),
)


def switches_of(scene: Scene) -> Switches:
    """The terms that a scene requires: a single flagellum has no contact partner and no pairs between flagella."""
    pairs = {"as_printed": "all", "consistent": "all"}.get(scene.hydrodynamics.mode, scene.hydrodynamics.mode)
    if not _several(scene):
        pairs = {"all": "within", "between": "none"}.get(pairs, pairs)
    if not scene.body.enabled and pairs == "within":
        pairs = "free"
    numerics, segments = scene.numerics, sum(spec.segment_count for spec in scene.resolved_flagella())
    unequal = pairs != "none" and len(set(pair_radii(scene))) > 1
    return Switches(
        flows=Flows(pairs, unequal=unequal, body=scene.has_body_flow),
        terms=tuple(term.name for term in SCENE_TERMS if term.needed(scene)),
        short_pairs=pairs != "none" and numerics.short_pairs(segments),
        noise=scene.fluid.temperature > 0.0,
    )


def supplied_power(scene: Scene, found: Evaluation) -> dict[str, float]:
    """Power that each term of a scene brings into a cell [pN um/s], by the term's name."""
    terms = [term for term in SCENE_TERMS if term.power is not None and term.needed(scene)]
    return {term.name: term.power(scene, found) for term in terms if term.power is not None}
