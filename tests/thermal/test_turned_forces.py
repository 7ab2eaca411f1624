"""What elastic forces do by the turn of their segments, and the shapes of equilibrium that need it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from warpflag_kernels.thermal import additive_chart, turned_forces

from tests.helpers import anchors, tangents
from tests.thermal.test_end_strains import STRAIGHT, Step, scene_of
from tests.thermal.test_equilibrium import ERRORS, ensemble
from warpflag.model.geometry import InitialState

# Of virtual work, over that of the forces at the end alone: round-off of small differences.
TOLERANCE = {"float64": 1e-4, "float32": 3e-2}
SHARE = {"float64": 1e-4, "float32": 1e-2}  # of an increment, for differences
HELIX = 0.0349387  # 1 - <t.t'>, by quadrature over rotations of the joint


def pose_of(step: Step) -> InitialState:
    """The cell as the pose has it now."""
    pose, first = step.state.data.pose, anchors(step.scene)
    centre = pose.body_position.numpy()[0]
    nodes = pose.position.numpy().astype(np.float64) + centre
    return InitialState(
        tuple(np.split(nodes, first[1:])),
        tuple(np.split(pose.director.numpy().astype(np.float64), first[1:])),
        centre,
        pose.body_orientation.numpy()[0],
    )


def loads(scene: Any, w: np.ndarray) -> np.ndarray:
    """k (w - w_0) of the joints of one filament [pN um], its hook first if it has one."""
    spec, group = scene.resolved_flagella()[0], scene.flagella
    h = spec.segment_length
    k = np.array([group.bending_rigidity, group.bending_rigidity, group.twist_rigidity]) / h
    load = (w - h * np.array(group.intrinsic_curvature)) * k
    if scene.body.enabled:
        load[0] = [0.0, 0.0, group.hook_twist_factor * group.twist_rigidity / h * w[0, 2]]
    return load


def strains_of(step: Step) -> np.ndarray:
    """Strains where the step starts."""
    step.assign(0.0)
    return step.ended()


def work(step: Step, load: np.ndarray, nodes: np.ndarray, axis: np.ndarray, share: float) -> float:
    """load . J d, by small differences, d the nodes' displacements and spins, the anchor fixed, m turned by `axis`."""
    m = step.state.data.pose.tangent.numpy()[0].astype(np.float64)
    turn = np.cross(m, axis)
    y = step.state.data.pose.position.numpy()[0].astype(np.float64)
    step.nodes[:], step.body[0, 3:], step.body[0, :3] = nodes, turn, -np.cross(turn, y)
    ends = []
    for sign in (1.0, -1.0):
        step.assign(sign * share)
        ends.append(step.ended())
    return float(np.sum(load * (ends[0] - ends[1])) / (2 * share))


@pytest.mark.parametrize("values", [{}, STRAIGHT, {"body.enabled": False}])
def test_it_is_the_change_of_the_virtual_work_of_the_end_s_moments(values, precision, device):
    """(J' - J)^T k (w' - w_0) by small differences at both poses, for random displacements."""
    scene = scene_of({"flagella.count": 1, **values}, precision)
    step = Step(scene, device, 1e-5)
    system, turned = step.sim.system, turned_forces.allocate(step.model)
    system.control.steps.fill_(0)
    w, m = step.ended(), step.state.data.pose.tangent.numpy()[0].astype(np.float64)
    additive_chart.retract(step.model, step.state, step.chart, step.x, step.work)
    inputs = step.stepper.strains, step.x, system.control.steps, turned
    turned_forces.find(step.model, step.state, step.chart, *inputs)
    pose = step.state.data.pose
    t, a = (x.numpy().astype(np.float64) for x in (pose.tangent, pose.director))
    axes = np.stack([t, a, np.cross(t, a)], axis=1)  # rows
    lengths = pose.length.numpy().astype(np.float64)
    before = np.einsum("eij,ei->ej", axes, turned.before.numpy().astype(np.float64))
    after = np.einsum("eij,ei->ej", axes[1:], turned.after.numpy().astype(np.float64)[:-1])
    spins = [x.numpy().astype(np.float64) for x in (turned.spin_before, turned.spin_after)]

    random = np.random.default_rng(6)
    nodes = 0.01 * random.standard_normal((len(t), 4))
    nodes[0, :3] = 0.0
    axis = np.cross(m, t[0])
    axis *= 0.05 / (np.linalg.norm(axis) or 1.0)
    if not scene.body.enabled:
        nodes[0], axis = 0.0, np.zeros(3)
    share, other = SHARE[precision], Step(scene, device, 1e-5, pose_of(step))
    start_tangents = np.concatenate(tangents(scene, step.start))
    later = work(other, loads(scene, strains_of(other)), nodes, axis, share)
    expected = later - work(step, loads(scene, w), nodes, axis, share)
    spec = scene.resolved_flagella()[0]
    vectors = np.vstack([axis, np.diff(nodes[:, :3], axis=0)])
    tension = scene.flagella.stretching_stiffness * (lengths / spec.segment_length - 1)
    expected += np.sum((tension[:, None] * (t - start_tangents) * vectors)[1:])
    found = np.sum(before[:-1] * vectors[:-1]) + np.sum(after * vectors[1:])
    found += np.sum(spins[0][:-1] * nodes[:-1, 3]) + np.sum(spins[1][:-1] * nodes[1:, 3])
    assert abs(expected) > 0.01 * abs(later)
    assert abs(found - expected) < TOLERANCE[precision] * abs(later)


def test_bends_of_a_helix_are_those_of_rotations(precision, device):
    """1 - <t.t'>: forces that do not turn would make it 5.4e-5 too large, at any step."""
    values = {"body.enabled": False, "flagella.count": 1, "hydrodynamics.mode": "none", "numerics.time_step": 1e-5}
    sim, _ = ensemble(values, precision, 192, device)
    sim.advance(5e-4)
    bends = []
    for i in range(200):
        sim.advance(5e-4 + 2e-5 * (i + 1))
        t = np.diff(sim.cells().positions.reshape(192, -1, 3), axis=1)
        t /= np.linalg.norm(t, axis=2, keepdims=True)
        bends.append(1 - np.sum(t[:, 1:] * t[:, :-1], axis=2).mean(axis=1))
    bends = np.mean(bends, axis=0)
    error = bends.std(ddof=1) / len(bends) ** 0.5
    assert error < 1e-5
    assert abs(bends.mean() - HELIX) < ERRORS * error
