"""Fills the device model and state from scenes and initial shapes. A batch is a list of scenes, one per cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from warpflag_kernels.base import clock, simd
from warpflag_kernels.base.plan import Plan, choose_plan
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, allocate_state, attach, optional, structs
from warpflag_kernels.contact import neighbours
from warpflag_kernels.fluid import rotne_prager, shell
from warpflag_kernels.rod import comoving_chart
from warpflag_kernels.stepping.terms import terms_named

from warpflag.base import rotations
from warpflag.model.geometry import InitialState
from warpflag.model.shell import shell_mobility, shells_of
from warpflag.model.terms import SCENE_TERMS, switches_of
from warpflag.scene import Flagella, FlagellumSpec, Scene, SceneError, attachment
from warpflag.scene.helix import rest_shape
from warpflag.scene.resistance import filament_mobility, pair_radii, spheroid_mobility, steric_diameter

__all__ = ["build_chart", "build_control", "build_model", "build_state", "plan_of"]


def plan_of(scenes: Sequence[Scene], device: Any, strict: bool = False) -> Plan:
    """How a batch of scenes is executed on a device.

    Args:
        scenes: one per cell.
        device: Warp's device.
        strict: kernels without reassociation or contraction, for comparisons to the last bit.

    Raises:
        ValueError: there is no scene.
    """
    if not scenes:
        raise ValueError("a simulation is of one scene at least")
    precision = Precision(scenes[0].numerics.precision, strict)
    moving = [sum(spec.segment_count for spec in scene.resolved_flagella()) for scene in scenes]
    return choose_plan(device, precision, switches_of(scenes[0]), max(moving))


def build_model(scenes: Sequence[Scene], plan: Plan) -> DeviceModel:
    """Device arrays of everything that stays constant during a run.

    Args:
        scenes: one per cell.
        plan: how they are executed.

    Raises:
        SceneError: the scenes of a batch do not share the same switches and precision.
    """
    switches, precisions = switches_of(scenes[0]), {scene.numerics.precision for scene in scenes}
    if len(precisions) > 1:
        raise SceneError("numerics.precision", sorted(precisions), "must be the same in every scene of a batch")
    for scene in scenes[1:]:
        if switches_of(scene) != switches:
            raise SceneError(None, None, f"{scene.name}: a batch needs the same terms in every scene")
    flagella = [spec for scene in scenes for spec in scene.resolved_flagella()]
    owner = [c for c, scene in enumerate(scenes) for _ in scene.resolved_flagella()]
    nodes = np.array([spec.segment_count + 1 for spec in flagella])
    first_node = np.concatenate([[0], np.cumsum(nodes)])
    flagellum_of = np.repeat(np.arange(len(flagella)), nodes)
    counts = [len(scene.resolved_flagella()) for scene in scenes]
    p, device = plan.precision, plan.device

    def ints(values: Any) -> wp.array:
        return wp.array(np.asarray(values), dtype=wp.int32, device=device)

    def reals(values: Any) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.float64), dtype=p.real, device=device)

    def vectors(values: Any) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.float64), dtype=p.vec3, device=device)

    m, parts = structs(p).Model(), optional(structs(p).Model)
    m.cell_of, m.flagellum_of, m.first_node = ints(np.array(owner)[flagellum_of]), ints(flagellum_of), ints(first_node)
    m.first_flagellum = ints(np.concatenate([[0], np.cumsum(counts)]))

    group = [scenes[c].flagella for c in owner]
    h = np.array([spec.segment_length for spec in flagella])
    m.rod.segment_length = reals(h)
    m.rod.bending_rigidity = reals([g.bending_rigidity for g in group])
    m.rod.twist_rigidity = reals([g.twist_rigidity for g in group])
    m.rod.hook_rigidity = reals(
        [scenes[c].body.enabled * g.hook_twist_factor * g.twist_rigidity for c, g in zip(owner, group, strict=True)]
    )
    m.rod.stretching_stiffness = reals([g.stretching_stiffness for g in group])
    m.rod.rest_strain = vectors(
        np.concatenate([_rest_strain(g, spec) for g, spec in zip(group, flagella, strict=True)])
    )

    m.motor.axis = vectors([attachment.motor_axis(spec) for spec in flagella])
    m.motor.anchor = vectors([attachment.anchor(scenes[c], spec) for c, spec in zip(owner, flagella, strict=True)])

    mobility = [filament_mobility(scenes[c], s.segment_length) for c, s in zip(owner, flagella, strict=True)]
    weight = np.ones(len(flagellum_of))
    weight[first_node[1:] - 1] = 2.0  # the free end carries half a segment
    m.drag.mobility_along = reals(weight * np.array([x.along for x in mobility])[flagellum_of])
    m.drag.mobility_across = reals(weight * np.array([x.across for x in mobility])[flagellum_of])
    m.drag.spin_mobility = reals([x.spin for x in mobility])

    if switches.pairs != "none":
        m.pairs.radius = reals([a for scene in scenes for a in pair_radii(scene)])
        m.pairs.mobility = reals([1 / (8 * np.pi * scene.fluid.viscosity) for scene in scenes])
    m.steric.strength = reals([scene.steric.strength for scene in scenes])
    m.steric.diameter = reals([steric_diameter(scene) for scene in scenes])

    m.body.half_length = reals([(scene.body.length - scene.body.width) / 2 for scene in scenes])
    m.body.radius = reals([scene.body.width / 2 for scene in scenes])
    if switches.flows.body:
        m.body.shell_mobility = reals(np.concatenate([np.ravel(shell_mobility(scene)) for scene in scenes]))
    else:
        along, across, spin, tumble = zip(*map(_body_mobility, scenes), strict=True)
        m.body.mobility_along, m.body.mobility_across = reals(along), reals(across)
        m.body.spin_mobility, m.body.tumble_mobility = reals(spin), reals(tumble)

    for term in SCENE_TERMS:
        if term.fill is not None and switches.has(term.name):
            term.fill(scenes, p, device, m, parts)
    attach(parts, m, device)
    return DeviceModel(
        plan=plan,
        switches=switches,
        terms=terms_named(switches.terms),
        cell_count=len(scenes),
        flagellum_count=len(flagella),
        element_count=len(flagellum_of),
        data=m,
        optional=parts,
        groups=simd.build(p, m.first_flagellum.numpy(), m.first_node.numpy(), device),
        shells=shells_of(scenes) if switches.flows.body else None,
    )


def build_state(model: DeviceModel) -> DeviceState:
    """Device arrays of one evaluation of the right-hand side, zero; a term that is off gets none."""
    beads = shell.allocate(model, model.plan.pair_precision)
    return DeviceState(*allocate_state(model), rotne_prager.allocate(model), beads, neighbours.allocate(model))


def build_chart(model: DeviceModel, starts: Sequence[InitialState]) -> Any:
    """The struct `Chart` with the initial shapes as the start of the first step.

    Args:
        model: of the batch.
        starts: initial shapes, one per cell.

    Raises:
        ValueError: a shape does not have the model's nodes.
    """
    chart = comoving_chart.allocate(model)
    positions, tangents, directors = [], [], []
    axes, first_flagellum = model.data.motor.axis.numpy().astype(np.float64), model.data.first_flagellum.numpy()
    for c, start in enumerate(starts):
        to_lab = rotations.matrix(start.body_orientation)
        for k, (nodes, e1) in enumerate(zip(start.positions, start.directors, strict=True)):
            segments = np.diff(nodes, axis=0)
            t = segments / np.linalg.norm(segments, axis=1, keepdims=True)
            m = to_lab @ axes[first_flagellum[c] + k]
            positions.append(nodes - start.body_position)
            tangents.append(np.vstack([m, t]))
            directors.append(e1)
    if sum(map(len, positions)) != model.element_count or len(positions) != model.flagellum_count:
        raise ValueError(f"the start has {sum(map(len, positions))} nodes, the scene needs {model.element_count}")
    chart.base.position.assign(np.concatenate(positions))
    chart.base.tangent.assign(np.concatenate(tangents))
    chart.base.director.assign(np.concatenate(directors))
    chart.base.body_position.assign(np.array([start.body_position for start in starts]))
    chart.base.body_orientation.assign(np.array([start.body_orientation for start in starts]))
    return chart


def begin_forms(model: DeviceModel, state: DeviceState, starts: Sequence[InitialState]) -> None:
    """Sets the forms of polymorphs to those of the starts, all ramps over; nothing in scenes without polymorphs."""
    if model.switches.has("polymorphs") and any(start.forms is not None for start in starts):
        joined = []
        for start in starts:
            count = sum(map(len, start.positions))
            joined.append(np.zeros(count, np.int32) if start.forms is None else start.forms.astype(np.int32))
        state.optional.forms.form.assign(np.concatenate(joined))
        state.optional.forms.before.assign(state.optional.forms.form)


def build_control(model: DeviceModel, starts: Sequence[InitialState]) -> Any:
    """The struct `Control`: the clocks of every cell, at the times of their starts."""
    control = clock.allocate(model.cell_count, model.device)
    control.time.assign([start.time for start in starts])
    return control


def _rest_strain(group: Flagella, spec: FlagellumSpec) -> np.ndarray:
    """h Omega^0 of the joint after every segment [rad], shape [N + 1, 3]; the hook's and the last segment's unused."""
    h, joints = spec.segment_length, np.zeros((spec.segment_count + 1, 3))
    joints[1:-1] = h * rest_shape(group.strain_at_rest(h), h, spec.segment_count, group.on_axis).strain
    return joints


def _body_mobility(scene: Scene) -> tuple[float, float, float, float]:
    """Translational mobility along and across the axis [um/(s pN)], rotational about and across it [1/(pN um s)].

    A motion that a switch of the scene prevents has zero.
    """
    if not scene.body.enabled:  # r_0 is a free end, which carries half a segment
        (spec,) = scene.resolved_flagella()
        own = filament_mobility(scene, spec.segment_length)
        return 2.0 * own.along, 2.0 * own.across, 0.0, 0.0
    m = spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity)
    moves = scene.body.translation and not scene.body.anchored
    spins = scene.body.axial_rotation and not scene.body.anchored
    tumbles = not scene.body.anchored
    return m.along * moves, m.across * moves, m.spin * spins, m.tumble * tumbles
