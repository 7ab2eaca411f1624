"""Fills the device model and state from scenes and initial shapes. A batch is a list of scenes, one per cell."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from warpflag_kernels.base import clock as control_stage
from warpflag_kernels.base import simd
from warpflag_kernels.base.types import DeviceModel, DeviceState, Precision, Switches, structs
from warpflag_kernels.contact import neighbours
from warpflag_kernels.fluid import node_velocity
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.stepping import health

from warpflag.model.geometry import InitialState
from warpflag.scene import Scene, SceneError
from warpflag.scene.resistance import filament_mobility, pair_radius, spheroid_mobility

__all__ = ["build_chart", "build_control", "build_guard", "build_model", "build_state", "switches_of"]

_PAIRS = {"as_printed": "all", "consistent": "all"}


def switches_of(scene: Scene) -> Switches:
    """The terms that a scene requires: a single flagellum has no contact partner and no pairs between flagella."""
    alone = len(scene.resolved_flagella()) == 1
    pairs = _PAIRS.get(scene.hydrodynamics.mode, scene.hydrodynamics.mode)
    if alone:
        pairs = {"all": "within", "between": "none"}.get(pairs, pairs)
    numerics = scene.numerics
    return Switches(
        pairs=pairs,
        steric=scene.steric.enabled and not alone,
        body_contact=scene.body.contact,
        bearing_torque=scene.motor.bearing_torque,
        short_pairs=pairs != "none" and (numerics.precision, numerics.pair_precision) == ("float64", "float32"),
    )


def build_model(scenes: Sequence[Scene], device: Any, precision: Precision) -> DeviceModel:
    """Device arrays of everything that stays constant during a run.

    Errors:
        SceneError: the scenes of a batch do not share the same switches.
    """
    switches = switches_of(scenes[0])
    for scene in scenes[1:]:
        if switches_of(scene) != switches:
            raise SceneError(None, None, f"{scene.name}: a batch needs the same terms in every scene")
    flagella = [spec for scene in scenes for spec in scene.resolved_flagella()]
    owner = [c for c, scene in enumerate(scenes) for _ in scene.resolved_flagella()]
    nodes = np.array([spec.segment_count + 1 for spec in flagella])
    first_node = np.concatenate([[0], np.cumsum(nodes)])
    flagellum_of = np.repeat(np.arange(len(flagella)), nodes)
    cell_of = np.array(owner)[flagellum_of]
    counts = [len(scene.resolved_flagella()) for scene in scenes]
    mobility = [filament_mobility(scenes[c], s.segment_length) for c, s in zip(owner, flagella, strict=True)]
    # The free end carries half a segment.
    weight = np.ones(len(flagellum_of))
    weight[first_node[1:] - 1] = 2.0
    group = [scenes[c].flagella for c in owner]
    h = np.array([spec.segment_length for spec in flagella])
    motor_axis, anchor = _attachment(scenes, flagella, owner)
    body = [_body_mobility(scene) for scene in scenes]

    p = precision
    m = structs(p).Model()

    def ints(values: Any) -> wp.array:
        return wp.array(np.asarray(values), dtype=wp.int32, device=device)

    def reals(values: Any) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.float64), dtype=p.real, device=device)

    def vectors(values: Any) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.float64), dtype=p.vec3, device=device)

    m.cell_of, m.flagellum_of, m.first_node = ints(cell_of), ints(flagellum_of), ints(first_node)
    m.first_flagellum = ints(np.concatenate([[0], np.cumsum(counts)]))
    m.segment_length = reals(h)
    m.bending_rigidity = reals([g.bending_rigidity for g in group])
    m.twist_rigidity = reals([g.twist_rigidity for g in group])
    m.hook_rigidity = reals([g.hook_twist_factor * g.twist_rigidity for g in group])
    m.stretching_stiffness = reals([g.stretching_stiffness for g in group])
    m.rest_strain = vectors(h[:, None] * np.array([g.intrinsic_curvature for g in group]))
    m.motor_torque = reals([spec.torque for spec in flagella])
    m.motor_axis, m.anchor = vectors(motor_axis), vectors(anchor)
    m.mobility_along = reals(weight * np.array([x.along for x in mobility])[flagellum_of])
    m.mobility_across = reals(weight * np.array([x.across for x in mobility])[flagellum_of])
    m.spin_mobility = reals([x.spin for x in mobility])
    if switches.pairs != "none":
        m.pair_radius = reals([pair_radius(scene) for scene in scenes])
        m.pair_mobility = reals([1 / (8 * np.pi * scene.fluid.viscosity) for scene in scenes])
    m.steric_strength = reals([scene.steric.strength for scene in scenes])
    m.steric_diameter = reals([_steric_diameter(scene) for scene in scenes])
    m.body_half_length = reals([(scene.body.length - scene.body.width) / 2 for scene in scenes])
    m.body_radius = reals([scene.body.width / 2 for scene in scenes])
    m.body_mobility_along = reals([b[0] for b in body])
    m.body_mobility_across = reals([b[1] for b in body])
    m.body_spin_mobility = reals([b[2] for b in body])
    m.body_tumble_mobility = reals([b[3] for b in body])
    return DeviceModel(
        precision=p,
        switches=switches,
        device=wp.get_device(device),
        cell_count=len(scenes),
        flagellum_count=len(flagella),
        element_count=len(flagellum_of),
        largest_cell=int(np.bincount(owner, nodes - 1).max()),
        data=m,
        groups=simd.build(p, m.first_flagellum.numpy(), m.first_node.numpy(), device),
    )


def build_state(model: DeviceModel) -> DeviceState:
    """Device arrays of the evaluation point and its forces, zero; a stage that is off gets none."""
    p, device = model.precision, model.device
    cells, flagella, elements = model.cell_count, model.flagellum_count, model.element_count
    s = structs(p).State()

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=device)

    s.position, s.force = zeros(elements, p.vec3), zeros(elements, p.vec3)
    s.tangent, s.director, s.velocity = (zeros(elements, p.vec3) for _ in range(3))
    s.length = wp.ones(elements, dtype=p.real, device=device)
    s.body_position, s.body_orientation = zeros(cells, wp.vec3d), zeros(cells, wp.quatd)
    s.body_axis = zeros(cells, p.vec3)
    s.active = zeros(cells, wp.int32)
    s.joint_before, s.joint_after = zeros(elements, p.vec3), zeros(elements, p.vec3)
    s.joint_spin_before, s.joint_spin_after = zeros(elements, p.real), zeros(elements, p.real)
    if model.switches.steric:
        s.steric_first, s.steric_second = zeros(elements, p.vec3), zeros(elements, p.vec3)
    if model.switches.body_contact:
        s.body_contact = zeros(elements, p.vec3)
    s.spin_torque = zeros(elements, p.real)
    s.flagellum_force, s.flagellum_torque = zeros(flagella, p.vec3), zeros(flagella, p.vec3)
    s.body_velocity, s.body_spin = zeros(cells, p.vec3), zeros(cells, p.vec3)
    pairs, real = structs(model.pair_precision).PairSum(), model.pair_precision.real
    if model.switches.pairs != "none":
        for name in ("x", "y", "z", "fx", "fy", "fz"):
            setattr(pairs, name, zeros(elements, real))
        if node_velocity.sums_by_halves(model):
            pairs.ux, pairs.uy, pairs.uz = (zeros(elements, real) for _ in range(3))
            if model.switches.short_pairs:
                pairs.total_x, pairs.total_y, pairs.total_z = (zeros(elements, wp.float64) for _ in range(3))
    near = structs(p).Neighbours()
    if model.switches.steric:
        near.position = wp.full(elements, p.vec3(1.0e30, 0.0, 0.0), dtype=p.vec3, device=device)  # far off: stale
        near.left, near.stale = zeros(flagella, wp.int32), zeros(cells, wp.int32)
        near.x, near.y, near.z, near.half = (zeros(elements + neighbours.BLOCK, wp.float32) for _ in range(4))
        near.extent = zeros(flagella, p.real)
        near.count, near.earlier = zeros(elements, wp.int32), zeros(elements, wp.int32)
        near.segment = zeros(elements * neighbours.SLOTS, wp.int32)
    return DeviceState(s, pairs, near)


def build_chart(model: DeviceModel, starts: Sequence[InitialState]) -> Any:
    """The chart's arrays with the initial shapes as the start of the first step.

    Errors:
        ValueError: a shape does not have the model's nodes.
    """
    p, device = model.precision, model.device
    cells, flagella, elements = model.cell_count, model.flagellum_count, model.element_count
    chart = chart_stage.struct(p)()
    positions, tangents, directors = [], [], []
    axes, first_flagellum = model.data.motor_axis.numpy().astype(np.float64), model.data.first_flagellum.numpy()
    for c, start in enumerate(starts):
        rotation = _lab_axes(start.body_orientation)
        for k, (nodes, e1) in enumerate(zip(start.positions, start.directors, strict=True)):
            segments = np.diff(nodes, axis=0)
            t = segments / np.linalg.norm(segments, axis=1, keepdims=True)
            m = rotation @ axes[first_flagellum[c] + k]
            positions.append(nodes - start.body_position)
            tangents.append(np.vstack([m, t]))
            directors.append(e1)
    if sum(len(x) for x in positions) != elements or len(positions) != flagella:
        raise ValueError(f"the start has {sum(map(len, positions))} nodes, the scene needs {elements}")

    def vectors(values: list[np.ndarray]) -> wp.array:
        return wp.array(np.concatenate(values), dtype=p.vec3, device=device)

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=device)

    chart.base_position, chart.base_tangent = vectors(positions), vectors(tangents)
    chart.base_director = vectors(directors)
    centres, orientations = [s.body_position for s in starts], [s.body_orientation for s in starts]
    chart.base_body_position = wp.array(np.array(centres), dtype=wp.vec3d, device=device)
    chart.base_body_orientation = wp.array(np.array(orientations), dtype=wp.quatd, device=device)
    chart.flagellum_spin, chart.flagellum_turn = zeros(flagella, p.vec3), zeros(flagella, p.mat33)
    chart.elapsed = zeros(cells, wp.float64)
    chart.commit, chart.rest = zeros(cells, wp.int32), zeros(cells, wp.int32)
    chart.increment, chart.rate = zeros(elements, p.vec4), zeros(elements, p.vec4)
    chart.body_increment = zeros(cells, chart_stage.vec6d)
    chart.body_rate = zeros(cells, chart_stage.vec6d)
    chart.motor_angle, chart.body_angle = zeros(flagella, wp.float64), zeros(cells, wp.float64)
    return chart


def build_control(model: DeviceModel, starts: Sequence[InitialState]) -> Any:
    """The clocks of every cell, at the times of their starts."""
    cells, device = model.cell_count, model.device
    c = control_stage.Control()
    c.time = wp.array([start.time for start in starts], dtype=wp.float64, device=device)
    c.target, c.longest_step, c.step = (wp.zeros(cells, dtype=wp.float64, device=device) for _ in range(3))
    c.steps = wp.zeros(cells, dtype=wp.int32, device=device)
    c.fault = wp.full(cells, control_stage.NO_FAULT, dtype=wp.int32, device=device)
    c.unfinished, c.at_rest, c.budget, c.proceed = (wp.zeros(1, dtype=wp.int32, device=device) for _ in range(4))
    return c


def build_guard(model: DeviceModel, chart: Any) -> Any:
    """What the guards remember between two looks."""
    g = health.struct(model.precision)()
    g.interval = wp.ones(model.cell_count, dtype=wp.int32, device=model.device)
    if model.switches.steric:
        g.position = wp.clone(chart.base_position)
        g.longest, g.moved, g.strayed, g.shifted = (
            wp.zeros(model.flagellum_count, dtype=model.precision.real, device=model.device) for _ in range(4)
        )
    return g


def _lab_axes(q: np.ndarray) -> np.ndarray:
    """Body axes in the lab as columns, of the orientation quaternion (x, y, z, w), shape [3, 3]."""
    x, y, z, w = np.asarray(q, dtype=np.float64)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _attachment(scenes: Sequence[Scene], flagella: Sequence[Any], owner: Sequence[int]) -> tuple[Any, Any]:
    """Motor axis and anchor of every flagellum in body axes: m = cos e_b3 + sin n, r_0 = d e_b3 + (width/2) n."""
    azimuth = np.radians([spec.azimuth for spec in flagella])
    normal = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)], axis=1)
    angle = np.radians([spec.motor_axis_angle for spec in flagella])
    rear = np.array([0.0, 0.0, 1.0])
    axis = np.cos(angle)[:, None] * rear + np.sin(angle)[:, None] * normal
    offset = np.array([spec.anchor_offset for spec in flagella])
    radius = np.array([scenes[c].body.width / 2 for c in owner])
    return axis, offset[:, None] * rear + radius[:, None] * normal


def _body_mobility(scene: Scene) -> tuple[float, float, float, float]:
    """Mobility along, across, about and across the axis; an ablated motion has none."""
    m = spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity)
    moves = scene.body.translation and not scene.body.anchored
    spins = scene.body.axial_rotation and not scene.body.anchored
    tumbles = not scene.body.anchored
    return m.along * moves, m.across * moves, m.spin * spins, m.tumble * tumbles


def _steric_diameter(scene: Scene) -> float:
    given = scene.steric.diameter
    return 4 * scene.flagella.filament_radius if given is None else given
