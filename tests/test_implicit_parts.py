"""The parts of the implicit step, each against NumPy: stiffness, chain chart, linear solves, contacts, corrections.

Kernels are driven by hand from one pose, with the buffers of the scene's own stepper. Dense matrices have six
unknowns of the body first, then four of every element: displacement (none for r_0, which moves with the body) and spin.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import warp as wp
from warpflag_kernels import banded, chain, contacts, correction, elastic, hessian, response

from tests.helpers import anchors, carried, cell, matrix, product, quaternion, rotation, shaken, tangents, touching_cell, unit
from tests.oracles import (
    CUTOFF,
    body_gaps,
    dense_mobility,
    drag_coefficients,
    expected_pair_radius,
    segment_distances,
)
from warpflag.drag import spheroid_mobility
from warpflag.geometry import InitialState
from warpflag.scene import Scene, with_values
from warpflag.simulation import Simulation
from warpflag.stages import launch_right_hand_side

# Relative to the largest value of its kind, unless said otherwise: float64, float32.
TOLERANCE = {"float64": 1e-8, "float32": 2e-3}

UNEQUAL = {"flagella.count": 3, "flagellum.1.length": 1.2, "flagellum.1.segments": 5, "flagellum.2.length": 0.8}
ABLATIONS = {
    "free": {},
    "anchored": {"body.anchored": True},
    "no axial rotation": {"body.axial_rotation": False},
    "no bearing torque": {"motor.bearing_torque": False},
}


def close(found: Any, exact: Any, precision: str, factor: float = 1.0) -> bool:
    found, exact = np.asarray(found, dtype=np.float64), np.asarray(exact, dtype=np.float64)
    return float(np.abs(found - exact).max()) <= factor * TOLERANCE[precision] * float(np.abs(exact).max())


class Bench:
    """A scene at rest in its start, its stepper's buffers, and the kernels on them. Vectors are (body, nodes)."""

    def __init__(self, scene: Scene, start: InitialState | None, device: str) -> None:
        scene = with_values(scene, {"numerics.stepper": "implicit"})
        self.scene, self.sim = scene, Simulation(scene, device=device, starts=start)
        self.sim.evaluate()
        s, self.stepper = self.sim.system, self.sim.stepper
        self.model, self.state, self.data = s.model, s.state, s.state.data
        self.count = self.model.element_count
        self.first = anchors(scene)
        self.start = start
        self.data.active.fill_(1)

    def increment(self, body: Any = 0.0, nodes: Any = 0.0) -> Any:
        x = chain.types(self.model.precision).Increment()
        node = np.zeros((self.count, 4)) + nodes
        x.node = wp.array(node, dtype=self.model.precision.vec4, device=self.model.device)
        x.body = wp.array(np.zeros((1, 6)) + body, dtype=chain.types(self.model.precision).vec6, device=self.model.device)
        return x

    def retract(self, x: Any, scale: float = 1.0, carry: Any = None) -> Any:
        """Moves the state to the pose that scale * x leads to from the start; returns what `carry` became."""
        out, unused = self.increment(), self.increment()
        scales = wp.full(1, scale, dtype=wp.float64, device=self.model.device)
        carry = (carry or self.increment(), self.increment(), out, unused)
        chain.retract(self.model, self.state, self.stepper._base, scales, x, self.stepper._now, carry)
        return out

    def factorise(self, step: float, weight: float) -> Any:
        band, stiffness = self.stepper._band, self.stepper._stiffness
        band.step.fill_(step)
        band.weight.fill_(weight)
        band.singular.zero_()
        hessian.joint_stiffness(self.model, self.state, stiffness)
        banded.factorise(self.model, self.state, stiffness, band)
        return band

    def force_change(self, body: Any, nodes: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """-H x: change of the body's force and torque, of the forces, and of the spin torques."""
        x = self.increment(body, nodes)
        k = correction._kernels(self.model.precision, self.model.switches.bearing_torque, False)
        inputs = [self.model.data, self.stepper._stiffness, x, self.data]
        for kernel in (k.joint_changes, k.gather_changes):
            wp.launch(kernel, self.count, inputs=inputs, device=self.model.device)
        forces, torques = self.data.force.numpy().astype(float), self.data.spin_torque.numpy().astype(float)
        arms, m = self.data.position.numpy()[self.first], self.data.tangent.numpy()[self.first]
        on_body = forces[self.first].sum(axis=0)
        torque = np.cross(arms, forces[self.first]).sum(axis=0)
        if self.model.switches.bearing_torque:
            torque -= np.cross(m, self.data.joint_before.numpy()[self.first]).sum(axis=0)
        return np.concatenate([on_body, torque]), forces, torques

    def hessian(self) -> np.ndarray:
        """Dense H, shape [6 + 4 count, 6 + 4 count]; rows and columns of the displacement of r_0 are zero."""
        columns = []
        for i in range(6 + 4 * self.count):
            x = np.zeros(6 + 4 * self.count)
            x[i] = 1.0
            nodes = x[6:].reshape(-1, 4)
            if i >= 6 and (i - 6) % 4 < 3 and (i - 6) // 4 in self.first:
                nodes[:] = 0.0
            body, forces, torques = self.force_change(x[:6], nodes)
            forces[self.first] = 0.0
            columns.append(-np.concatenate([body, np.hstack([forces, torques[:, None]]).ravel()]))
        return np.stack(columns, axis=1)

    def mobility(self, mode: str | None = None) -> np.ndarray:
        """Dense M of (body, nodes); the displacement of r_0 has none. mode: other hydrodynamics than the scene's."""
        scene = self.scene if mode is None else with_values(self.scene, {"hydrodynamics.mode": mode})
        size = 6 + 4 * self.count
        mobility = np.zeros((size, size))
        free = np.setdiff1d(np.arange(self.count), self.first)
        where = (6 + 4 * free[:, None] + np.arange(3)).ravel()
        mobility[np.ix_(where, where)] = dense_mobility(scene, self.start, expected_pair_radius(self.scene))
        spins = np.arange(9, size, 4)
        h = np.repeat([s.segment_length for s in scene.resolved_flagella()], [len(x) for x in self.start.positions])
        mobility[spins, spins] = 1 / (drag_coefficients(scene)[2] * h)
        b, body = spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity), scene.body
        axis = matrix(self.start.body_orientation)[:, 2]
        if not body.anchored:
            turn = b.spin * body.axial_rotation
            for i, along, across in ((0, b.along, b.across), (3, turn, b.tumble)):
                mobility[i : i + 3, i : i + 3] = across * np.eye(3) + (along - across) * np.outer(axis, axis)
        return mobility

    def local_inverse(self, mode: str = "none") -> np.ndarray:
        """D^-1 of the nodes, 1 for the body: what `solve` wants the velocities multiplied by. Pseudo-inverse."""
        d = self.mobility(mode)
        d[:6] = d[:, :6] = 0.0
        inverse = np.linalg.pinv(d, hermitian=True)
        inverse[:6, :6] = np.eye(6)
        return inverse


def flat(x: Any) -> np.ndarray:
    """An increment as one vector (body, nodes)."""
    return np.concatenate([x.body.numpy().ravel(), x.node.numpy().ravel()]).astype(np.float64)


def bench(values: dict[str, Any], precision: str, device: str, seed: int = 1, **shake: float) -> Bench:
    scene = cell({"flagella.length": 1.0, **values}, precision)
    return Bench(scene, shaken(scene, seed, **{"node": 2e-3, "spin": 0.05, **shake}), device)


# Stiffness.


def joint_arrays(b: Bench, nodes: np.ndarray, m: np.ndarray, spins: np.ndarray) -> list[np.ndarray]:
    """Energy gradients of every joint of one flagellum at r + nodes, motor axis m, frames carried and spun."""
    base_t, e1 = tangents(b.scene, b.start)[0], b.start.directors[0]
    segments = np.diff(b.start.positions[0] + nodes, axis=0)
    t = np.vstack([unit(m), unit(segments)])
    followed = carried(e1, base_t, t)
    followed = followed * np.cos(spins)[:, None] + np.cross(t, followed) * np.sin(spins)[:, None]
    b.data.tangent.assign(t)
    b.data.director.assign(followed)
    b.data.length.assign(np.concatenate([[1.0], np.linalg.norm(segments, axis=1)]))
    elastic.joint_gradients(b.model, b.state)
    d = b.data
    found = (d.joint_before, d.joint_after, d.joint_spin_before, d.joint_spin_after)
    return [a.numpy().astype(np.float64)[:-1] for a in found]


def test_joint_stiffness_is_the_derivative_of_the_joint_gradients(device, precision):
    values = {"flagella.count": 1, "flagella.segment_length": 0.25}
    shake = {"node": 0.02, "spin": 0.3}
    oracle, b = (bench(values, p, device, **shake) for p in ("float64", precision))
    b.factorise(1e-5, 1.0)
    k, step, n = b.stepper._stiffness, 1e-6, b.count
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
        exact = {"e_first": of_e[3][0], "e_second": of_f[3][0], "f_first": of_e[3][1], "f_second": of_f[3][1]}
        exact["spins"] = np.array([[of_e[3][2][i], of_f[3][2][i], of_f[3][3][i]]] * (n - 1))
        for name, values in exact.items():
            assert np.abs(getattr(k, name).numpy()[i] - values[i]).max() < TOLERANCE[precision] * scale, (i, name)


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
        launch_right_hand_side(exact.stepper._free, exact.state)
        d = exact.data
        return [a.numpy().copy() for a in (d.flagellum_force, d.flagellum_torque, d.force, d.spin_torque)]

    step = 1e-6
    ends = zip(forces(step), forces(-step), strict=True)
    force, torque, node_forces, spin_torques = ((x - y) / (2 * step) for x, y in ends)
    _, _, forces_now, torques_now = forces(0.0)
    d, first = exact.data, b.first
    t, y, length, bearing = (a.numpy() for a in (d.tangent, d.position, d.length, d.joint_before))
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
    d = b.data
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
    d, e1 = b.data, np.concatenate(b.start.directors)
    assert close(d.position.numpy(), y @ turn.T, precision)
    assert close(d.director.numpy()[free], e1[free] @ turn.T, precision)
    assert close(out.node.numpy()[free, :3], u + np.cross(w, y[free] @ turn.T), precision)

    def twist_missed(scale: float) -> float:
        b.retract(b.increment(body, nodes), scale)
        return float(np.abs(d.director.numpy()[b.first] - e1[b.first] @ rotation(scale * w).T).max())

    large, small = twist_missed(0.2), twist_missed(0.1)
    assert large < 0.2**3 and 7 < large / small < 9


# The linear system.


def dense_system(b: Bench, step: float, weight: float) -> np.ndarray:
    """1/dt + s M_0 H with the local mobility, multiplied by D^-1 in the rows of the nodes."""
    system = b.local_inverse() / step
    system[:6, :6] = np.eye(6) / step
    h, mobility = b.hessian(), b.mobility("none")
    system[6:] += weight * h[6:]
    system[:6] += weight * mobility[:6, :6] @ h[:6]
    pinned = (6 + 4 * b.first[:, None] + np.arange(3)).ravel()
    system[:, pinned] = system[pinned] = 0.0
    system[pinned, pinned] = 1.0
    return system


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
    banded.solve(b.model, b.state, band, y)
    assert band.singular.numpy()[0] == 0
    condition = {"float64": 1.0, "float32": 1.0}[precision]
    print(h, ablation, precision, np.abs(flat(y) - x).max(), np.abs(np.linalg.solve(system, right) - x).max(), np.linalg.cond(system))
    assert close(flat(y), np.linalg.solve(system, right), precision, condition)
