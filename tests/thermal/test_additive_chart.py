"""The chart of thermal steps: nodes go where they are told, lengths become what they shall be, by forces in pairs."""

import numpy as np
import pytest
from warpflag_kernels.fluid import noise
from warpflag_kernels.rod import chain_chart, comoving_chart, free_end
from warpflag_kernels.thermal import additive_chart

from tests.helpers import anchors, attachment, cell, free_nodes, matrix, shaken, tangents
from warpflag.run.simulation import Simulation

TOLERANCE = {"float64": 1e-7, "float32": 3e-5}  # of a length [um]
KT = 1.380649e-5 * 300.0
BALANCE = {"float64": 5e-3, "float32": 3e-2}  # of forces, over their sum


def test_lengths_are_restored_by_forces_in_pairs(precision, device):
    """Every segment turns by some 0.1 rad; what restores the lengths does not push the cell as a whole."""
    scene = cell({"numerics.stepper": "implicit", "fluid.temperature": 300.0}, precision)
    start = shaken(scene, 4)
    sim = Simulation(scene, device=device, starts=start)
    s, random = sim.system, np.random.default_rng(5)
    model, state = s.model, s.state
    x, work = chain_chart.allocate(model), additive_chart.allocate(model)
    nodes, body = 0.01 * random.standard_normal((model.element_count, 4)), 0.003 * random.standard_normal((1, 6))
    nodes[anchors(scene), :3] = 0.0
    x.node.assign(nodes)
    x.body.assign(body)
    sim.evaluate()
    state.data.active.fill_(1)
    additive_chart.retract(model, state, s.chart, x, work)
    pose = state.data.pose
    end = pose.position.numpy().astype(np.float64) + pose.body_position.numpy()
    moving, first = free_nodes(scene), anchors(scene)
    old = np.concatenate(start.positions)
    turn, shift = body[0, 3:], body[0, :3]
    moved = old + nodes[:, :3]
    linear = moved.copy()  # r_0 as the linear step has it
    linear[first] = old[first] + shift + np.cross(turn, old[first] - start.body_position)
    t = np.concatenate(tangents(scene, start))
    lengths = np.linalg.norm(end[moving] - end[moving - 1], axis=1)
    before = np.linalg.norm(old[moving] - old[moving - 1], axis=1)
    wanted = before + np.sum(t[moving] * (linear[moving] - linear[moving - 1] - old[moving] + old[moving - 1]), axis=1)
    plain = np.linalg.norm(moved[moving] - moved[moving - 1], axis=1)
    assert abs(plain - wanted).max() > 1e-3
    assert abs(lengths - wanted).max() < TOLERANCE[precision]
    assert np.allclose(pose.length.numpy()[moving], lengths, atol=TOLERANCE[precision])

    # Forces (times the step) from the displacements beyond those asked for, by the local drag.
    along, across = model.data.drag.mobility_along.numpy(), model.data.drag.mobility_across.numpy()
    forces = []
    for e in moving:
        mean = t[e] if e + 1 in first or e + 1 == len(old) else (t[e] + t[e + 1]) / np.linalg.norm(t[e] + t[e + 1])
        beyond = end[e] - moved[e]
        part = (mean @ beyond) * mean
        forces.append(part / along[e] + (beyond - part) / across[e])
    axis = matrix(start.body_orientation)[:, 2]
    beyond = pose.body_position.numpy()[0] - start.body_position - shift
    m = model.data.body
    part = (axis @ beyond) * axis
    on_body = part / m.mobility_along.numpy()[0] + (beyond - part) / m.mobility_across.numpy()[0]
    scale = np.abs(forces).sum(axis=0).max()
    assert abs(np.sum(forces, axis=0) + on_body).max() < BALANCE[precision] * scale
    assert abs(np.sum(forces, axis=0)).max() > 1e-2 * scale  # the body takes its share
    for spec, e in zip(scene.resolved_flagella(), first, strict=True):
        anchor, motor = attachment(scene, spec)
        rotation = matrix(pose.body_orientation.numpy()[0])
        assert np.allclose(pose.position.numpy()[e], rotation @ anchor, atol=1e-6)
        assert np.allclose(pose.tangent.numpy()[e], rotation @ motor, atol=1e-6)


@pytest.mark.parametrize("body", [True, False])
def test_the_next_step_takes_back_what_restored_the_lengths(body, precision, device):
    """As velocities along the segments where they are then, by the local drag there, of nodes, body and free ends: over
    a step of the same length, minus the displacements that the last one added."""
    values = {"numerics.stepper": "implicit", "fluid.temperature": 300.0, "flagella.length": 1.2, "body.enabled": body}
    scene = cell({**values, "flagella.count": 2 if body else 1}, precision)
    sim = Simulation(scene, device=device, starts=shaken(scene, 4))
    s, random, step = sim.system, np.random.default_rng(5), 1e-6
    model, state = s.model, s.state
    x, work, drawn = chain_chart.allocate(model), additive_chart.allocate(model), noise.allocate(model, [KT], [0])
    nodes, motion = 0.003 * random.standard_normal((model.element_count, 4)), 0.001 * random.standard_normal((1, 6))
    if not body:
        motion[0, 3:] = 0.0
    x.node.assign(nodes)
    x.body.assign(motion)
    sim.evaluate()
    state.data.active.fill_(1)
    s.control.step.fill_(step)
    begun = pose(state) + state.data.pose.body_position.numpy()[0]
    at = state.data.pose.body_position.numpy()[0].copy()
    additive_chart.retract(model, state, s.chart, x, work)
    ended, moving = pose(state) + state.data.pose.body_position.numpy()[0], free_nodes(scene)
    beyond = (ended - begun - nodes[:, :3])[moving]
    of_body = state.data.pose.body_position.numpy()[0] - at - motion[0, :3]
    comoving_chart.commit(model, state, s.chart)
    if not body:
        free_end.align_axes(model, state)
    additive_chart.give_back(model, state, s.chart, work, s.control.step, drawn)
    back = step * drawn.node.numpy()[moving, :3].astype(np.float64)
    assert abs(beyond).max() > 1e-5
    assert abs(back + beyond).max() < 0.05 * abs(beyond).max()  # the drag turns with the segments
    back = step * drawn.body.numpy()[0, :3].astype(np.float64)
    assert abs(back + of_body).max() < 0.05 * max(abs(beyond).max(), abs(of_body).max())


def pose(state):
    """Nodes relative to the body's centre."""
    return state.data.pose.position.numpy().astype(np.float64)
