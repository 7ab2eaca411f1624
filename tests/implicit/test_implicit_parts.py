"""The parts of the implicit step, each against NumPy: stiffness, chain chart, linear solves, full equations.

Kernels are driven by hand from one pose, with the buffers of the scene's own stepper. Contacts: `test_contact_solve`.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from warpflag_kernels.fluid import node_velocity
from warpflag_kernels.implicit import linearised, step_flow
from warpflag_kernels.rod import elastic
from warpflag_kernels.stepping.right_hand_side import launch_right_hand_side

from tests.bench import FLOW_TOLERANCE, TOLERANCE, Bench, bench, close, dense_system, displacements, flat, spins
from tests.helpers import (
    carried,
    matrix,
    product,
    quaternion,
    rotation,
    tangents,
    unit,
)

UNEQUAL = {"flagella.count": 3, "flagellum.1.length": 1.2, "flagellum.1.segments": 5, "flagellum.2.length": 0.8}
ABLATIONS = {
    "free": {},
    "anchored": {"body.anchored": True},
    "no axial rotation": {"body.axial_rotation": False},
    "no bearing torque": {"motor.bearing_torque": False},
}


# Stiffness.


def joint_arrays(b: Bench, nodes: np.ndarray, m: np.ndarray, spins: np.ndarray) -> list[np.ndarray]:
    """Energy gradients of every joint of one flagellum at r + nodes, motor axis m, frames carried and spun."""
    base_t, e1 = tangents(b.scene, b.start)[0], b.start.directors[0]
    segments = np.diff(b.start.positions[0] + nodes, axis=0)
    t = np.vstack([unit(m), unit(segments)])
    followed = carried(e1, base_t, t)
    followed = followed * np.cos(spins)[:, None] + np.cross(t, followed) * np.sin(spins)[:, None]
    b.data.pose.tangent.assign(t)
    b.data.pose.director.assign(followed)
    b.data.pose.length.assign(np.concatenate([[1.0], np.linalg.norm(segments, axis=1)]))
    elastic.joint_gradients(b.model, b.state)
    d = b.data
    found = (d.joint_before, d.joint_after, d.joint_spin_before, d.joint_spin_after)
    return [a.numpy().astype(np.float64)[:-1] for a in found]


def test_joint_stiffness_is_the_derivative_of_the_joint_gradients(device, precision):
    values = {"flagella.count": 1, "flagella.segment_length": 0.25}
    shake = {"node": 0.02, "spin": 0.3}
    oracle, b = (bench(values, p, device, **shake) for p in ("float64", precision))
    b.factorise(1e-5, 1.0)
    k, step, n = b.stepper.stiffness, 1e-6, b.count
    m = tangents(oracle.scene, oracle.start)[0][0]

    def derivative(segment: int, axis: int) -> list[np.ndarray]:
        """With respect to a segment vector (axis 0..2: the nodes from its end on move) or its spin (axis 3)."""
        ends = []
        for sign in (step, -step):
            nodes, spins, motor = np.zeros((n, 3)), np.zeros(n), m.copy()
            if axis == 3:
                spins[segment] = sign
            elif segment == 0:
                motor[axis] += sign
            else:
                nodes[segment:, axis] = sign
            ends.append(joint_arrays(oracle, nodes, motor, spins))
        return [(x - y) / (2 * step) for x, y in zip(*ends, strict=True)]

    for i in range(n - 1):
        of_e, of_f = ([derivative(s, axis) for axis in range(4)] for s in (i, i + 1))
        ee, fe, ff, ef = (
            np.stack([column[row][i] for column in columns[:3]], axis=1)
            for columns, row in ((of_e, 0), (of_e, 1), (of_f, 1), (of_f, 0))
        )
        found = {name: getattr(k, name).numpy()[i].astype(np.float64) for name in ("ee", "ff", "fe")}
        if i == 0:
            # The motor axis keeps its length: only what turns it means anything.
            across = np.eye(3) - np.outer(m, m)
            ee, found["ee"] = across @ ee @ across, across @ found["ee"] @ across
        scale = max(np.abs(ee).max(), np.abs(ff).max())
        for name, exact in (("ee", (ee + ee.T) / 2), ("ff", (ff + ff.T) / 2), ("fe", fe), ("fe", ef.T)):
            assert np.abs(found[name] - exact).max() < TOLERANCE[precision] * scale, (i, name)
        mixed = {"e_first": of_e[3][0], "e_second": of_f[3][0], "f_first": of_e[3][1], "f_second": of_f[3][1]}
        for name, values in mixed.items():
            assert close(getattr(k, name).numpy()[i], values[i], precision), (i, name)
        assert close(k.spins.numpy()[i], [of_e[3][2][i], of_f[3][2][i], of_f[3][3][i]], precision), i


def test_stiffness_times_increment_is_the_change_of_the_forces_along_the_chain_chart(device, precision):
    """To the last term: H x; the antisymmetric part that H leaves out, half the net spin torque of a segment across
    it; and the turn of the body's lever arms and motor axes, which H leaves out, too."""
    exact, b = (bench(UNEQUAL, p, device) for p in ("float64", precision))
    random = np.random.default_rng(5)
    nodes, body = random.uniform(-1, 1, (b.count, 4)), random.uniform(-1, 1, 6)
    nodes[b.first, :3] = 0.0
    b.factorise(1e-5, 1.0)
    found_body, found_forces, found_torques = b.force_change(body, nodes)

    def forces(scale: float) -> list[np.ndarray]:
        exact.retract(exact.increment(body, nodes), scale)
        smooth = tuple(term for term in exact.model.terms if not term.contact)
        launch_right_hand_side(dataclasses.replace(exact.model, terms=smooth), exact.state)
        d = exact.data
        return [a.numpy().copy() for a in (d.flagellum_force, d.flagellum_torque, d.force, d.spin_torque)]

    step = 1e-6
    ends = zip(forces(step), forces(-step), strict=True)
    force, torque, node_forces, spin_torques = ((x - y) / (2 * step) for x, y in ends)
    _, _, forces_now, torques_now = forces(0.0)
    d, first = exact.data, b.first
    t, y, length, bearing = (a.numpy() for a in (d.pose.tangent, d.pose.position, d.pose.length, d.joint_before))
    m, w, motor = t[first], body[3:], np.array([spec.torque for spec in b.scene.resolved_flagella()])
    torques_now[first] -= motor  # what is left is of the joints

    moved = nodes[:, :3].copy()
    moved[first] = body[:3] + np.cross(w, y[first])
    segments = np.diff(moved, axis=0, prepend=0.0)
    segments[first] = np.cross(w, m)
    across = 0.5 * (torques_now / length**2)[:, None] * np.cross(t, segments)
    inner = np.setdiff1d(np.arange(b.count), first)
    found_forces[inner] += across[inner]
    found_forces[inner - 1] -= across[inner]
    found_body[:3] -= across[first + 1].sum(axis=0)
    turned = np.cross(m, across[first]) - np.cross(y[first], across[first + 1])
    turned += np.cross(np.cross(w, y[first]), forces_now[first])
    turned -= np.cross(np.cross(w, m), bearing[first]) + motor[:, None] * np.cross(w, m)
    found_body[3:] += turned.sum(axis=0)
    assert np.abs(across).max() > 1e-3 * np.abs(node_forces).max()  # it tells right from wrong
    assert close(found_forces, node_forces, precision)
    assert close(found_torques, spin_torques, precision)
    assert close(found_body[:3], force.sum(axis=0), precision)
    assert close(found_body[3:], torque.sum(axis=0), precision)


# The chain chart.


def numpy_retraction(b: Bench, body: np.ndarray, nodes: np.ndarray, carry: np.ndarray) -> list[np.ndarray]:
    """Nodes relative to the body, directors, body pose, and what the carried displacements become."""
    start = b.start
    u, w = body[:3], body[3:]
    orientation = product(quaternion(w), start.body_orientation)
    turn = matrix(orientation) @ matrix(start.body_orientation).T
    positions, directors, moved, first = [], [], [], 0
    for x, e1, t in zip(start.positions, start.directors, tangents(b.scene, start), strict=True):
        arm = x[0] - start.body_position
        m = turn @ t[0]
        tripod = carried(e1[:1], t[:1], m[None])[0]
        spin = rotation(nodes[first, 3] * m)
        y, e, z = [turn @ arm], [spin @ tripod], [u + np.cross(w, turn @ arm)]
        steps = np.diff(np.vstack([u + np.cross(w, arm), nodes[first + 1 : first + len(x), :3]]), axis=0)
        carries = np.diff(np.vstack([u + np.cross(w, arm), carry[first + 1 : first + len(x), :3]]), axis=0)
        for i, (step, carried_step) in enumerate(zip(steps, carries, strict=True), start=1):
            segment = x[i] - x[i - 1]
            length = np.linalg.norm(segment)
            r = rotation(np.cross(t[i], step) / length + nodes[first + i, 3] * t[i])
            y.append(y[-1] + (1 + t[i] @ step / length) * (r @ segment))
            e.append(r @ e1[i])
            z.append(z[-1] + r @ carried_step)
        positions, directors, moved = positions + y, directors + e, moved + z
        first += len(x)
    return [np.array(positions), np.array(directors), start.body_position + u, orientation, np.array(moved)]


def test_retraction_and_transport_are_those_of_a_chain_of_rotations(device, precision):
    b = bench(UNEQUAL, precision, device, node=0.01, spin=0.3)
    random = np.random.default_rng(2)
    nodes = random.uniform(-1, 1, (b.count, 4)) * [0.1, 0.1, 0.1, 1.0]
    body = random.uniform(-1, 1, 6) * [0.1, 0.1, 0.1, 0.5, 0.5, 0.5]
    others = random.uniform(-1, 1, (b.count, 4))
    positions, directors, centre, orientation, moved = numpy_retraction(b, 0.7 * body, 0.7 * nodes, others)
    # The body's own part is carried unchanged, so a carried body that moves as the pose does.
    out = b.retract(b.increment(body, nodes), 0.7, b.increment(0.7 * body, others))
    d = b.data.pose
    for found, exact in (
        (d.position.numpy(), positions),
        (d.director.numpy(), directors),
        (d.body_position.numpy()[0], centre),
        (d.body_orientation.numpy()[0], orientation),
        (out.body.numpy()[0], 0.7 * body),
    ):
        assert close(found, exact, precision)
    free = np.setdiff1d(np.arange(b.count), b.first)
    assert close(out.node.numpy()[free, :3], moved[free], precision)
    assert close(out.node.numpy()[:, 3], others[:, 3], precision)
    segments = np.diff(positions, axis=0, prepend=0.0)
    lengths = np.linalg.norm(segments, axis=1)
    assert close(d.length.numpy()[free], lengths[free], precision)
    assert close(d.tangent.numpy()[free], segments[free] / lengths[free, None], precision)


def test_a_rigid_rotation_of_everything_is_exact_and_strains_nothing(device, precision):
    """Turned by more than a radian at once. The tripod alone follows the minimal rotation of its axis, as its spin
    asks: what it misses is of third order in the angle."""
    b = bench(UNEQUAL, precision, device, node=0.01, spin=0.3)
    t = np.concatenate(tangents(b.scene, b.start))
    y = np.concatenate(b.start.positions) - b.start.body_position
    w, u = np.array([0.9, -0.5, 0.8]), np.array([0.3, -2.0, 1.0])
    body, nodes = np.concatenate([u, w]), np.hstack([u + np.cross(w, y), (t @ w)[:, None]])
    turn, free = rotation(w), np.setdiff1d(np.arange(b.count), b.first)
    # A rigid motion that is carried stays one of the chain: its differences turn along.
    out = b.retract(b.increment(body, nodes), 1.0, b.increment(body, nodes))
    d, e1 = b.data.pose, np.concatenate(b.start.directors)
    assert close(d.position.numpy(), y @ turn.T, precision)
    assert close(d.director.numpy()[free], e1[free] @ turn.T, precision)
    assert close(out.node.numpy()[free, :3], u + np.cross(w, y[free] @ turn.T), precision)

    def twist_missed(scale: float) -> float:
        b.retract(b.increment(body, nodes), scale)
        return float(np.abs(d.director.numpy()[b.first] - e1[b.first] @ rotation(scale * w).T).max())

    large, small = twist_missed(0.2), twist_missed(0.1)
    assert large < 0.2**3 and 7 < large / small < 9


# The linear system.


@pytest.mark.parametrize("ablation", list(ABLATIONS))
@pytest.mark.parametrize("h", [0.2, 0.1, 0.05])
def test_band_solve_is_the_dense_one(h, ablation, device, precision):
    values = {"flagella.segment_length": h, "flagellum.1.length": 0.8, **ABLATIONS[ablation]}
    exact, b = (bench(values, p, device, seed=3, node=1e-3 * h, spin=0.05) for p in ("float64", precision))
    step, weight = 1e-5, 0.9
    exact.factorise(step, weight)
    band = b.factorise(step, weight)
    random = np.random.default_rng(4)
    x = random.uniform(-1, 1, 6 + 4 * b.count) * np.tile([1, 1, 1, 10], b.count + 2)[: 6 + 4 * b.count]
    x[(6 + 4 * b.first[:, None] + np.arange(3)).ravel()] = 0.0
    if ablation == "anchored":
        x[:6] = 0.0
    system = dense_system(exact, step, weight)
    right = system @ x
    y = b.increment(right[:6], right[6:].reshape(-1, 4))
    linearised.solve(b.model, b.state, band, y)
    assert band.singular.numpy()[0] == 0
    # The condition of the matrix grows as h^-4, which leaves float32 two digits on the finest mesh.
    digits = max(1.0, (0.1 / h) ** 4) if precision == "float32" else 1.0
    for part in (slice(0, 6), displacements(b), spins(b)):
        assert close(flat(y)[part], np.linalg.solve(system, right)[part], precision, digits)


# The full equations.


@pytest.mark.parametrize("mode", ["all", "between", "none"])
def test_linearised_equations_are_the_dense_ones_and_the_matrix_leads_to_their_solution(mode, device, precision):
    """D^-1 (1/dt + g M H) x, whatever the weight in the matrix."""
    values = {"hydrodynamics.mode": mode, "steric.enabled": False, "body.contact": False, "flagellum.1.length": 0.8}
    exact, b = (bench(values, p, device) for p in ("float64", precision))
    step, gain = 1e-5, 2 / 3
    exact.factorise(step, 1.3 * gain)
    band = b.factorise(step, 1.3 * gain)
    random, fixed = np.random.default_rng(6), (6 + 4 * b.first[:, None] + np.arange(3)).ravel()
    system = np.eye(6 + 4 * b.count) / step + gain * exact.mobility() @ exact.hessian()
    inverse, s = exact.local_inverse(), b.stepper
    s.law.gain.fill_(gain)

    def applied(x: np.ndarray) -> np.ndarray:
        out = b.increment()
        given = b.increment(x[:6], x[6:].reshape(-1, 4))
        linearised.apply(b.model, b.state, s.stiffness, band, s.law.gain, given, out)
        return flat(out)

    x = random.uniform(-1, 1, 6 + 4 * b.count)
    x[fixed] = 0.0
    parts, expected = (slice(0, 6), displacements(b), spins(b)), inverse @ system @ x
    for part in parts:
        assert close(applied(x)[part], expected[part], precision, 1.0, FLOW_TOLERANCE)
    velocities = random.uniform(-1, 1, 6 + 4 * b.count)
    velocities[fixed] = 0.0
    solution, x = np.linalg.solve(system, velocities), np.zeros(6 + 4 * b.count)
    for _ in range(50):
        missing = inverse @ velocities - applied(x)
        y = b.increment(missing[:6], missing[6:].reshape(-1, 4))
        linearised.solve(b.model, b.state, band, y)
        x += flat(y)
    for part in parts:
        assert close(x[part], solution[part], precision, 1.0, FLOW_TOLERANCE)


@pytest.mark.parametrize("mode", ["all", "within", "between"])
def test_first_velocities_are_those_of_the_pair_sum_in_single_precision(mode, device, precision):
    b = bench({**UNEQUAL, "hydrodynamics.mode": mode}, precision, device)
    if not step_flow.stores_pairs(b.model):
        pytest.skip("where a thread does not sum a whole cell, no coefficients are kept")
    step_flow.build(b.model, b.state, b.stepper.flow)
    b.data.force.assign(np.random.default_rng(8).uniform(-1, 1, (b.count, 3)))
    node_velocity.node_velocities(b.model, b.state)
    free = np.setdiff1d(np.arange(b.count), b.first)
    exact = b.data.velocity.numpy()[free].copy()
    b.data.velocity.zero_()
    step_flow.single_velocities(b.model, b.state, b.stepper.flow)
    found = b.data.velocity.numpy()[free]
    assert 0.0 < np.abs(found - exact).max() < 2e-6 * np.abs(exact).max()
