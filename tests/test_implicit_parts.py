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

from tests.helpers import (
    anchors,
    carried,
    cell,
    matrix,
    product,
    quaternion,
    rotation,
    shaken,
    tangents,
    touching_cell,
    unit,
)
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
    """Within `factor` times the tolerance."""
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
        p, device = self.model.precision, self.model.device
        x = chain.types(p).Increment()
        x.node = wp.array(np.zeros((self.count, 4)) + nodes, dtype=p.vec4, device=device)
        x.body = wp.array(np.zeros((1, 6)) + body, dtype=chain.types(p).vec6, device=device)
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

    def local_inverse(self) -> np.ndarray:
        """D^-1 of the nodes (pseudo-inverse: r_0 has none), 1 for the body: what `solve` wants its velocities times."""
        d = self.mobility("none")
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
    # The condition of the matrix grows as h^-4, which leaves float32 two digits on the finest mesh.
    digits = max(1.0, (0.1 / h) ** 4) if precision == "float32" else 1.0
    for part in (slice(0, 6), displacements(b), spins(b)):
        assert close(flat(y)[part], np.linalg.solve(system, right)[part], precision, digits)


def displacements(b: Bench) -> np.ndarray:
    """Where the displacements of nodes r_1..r_N stand in a dense vector."""
    free = np.setdiff1d(np.arange(b.count), b.first)
    return (6 + 4 * free[:, None] + np.arange(3)).ravel()


def spins(b: Bench) -> np.ndarray:
    return np.arange(9, 6 + 4 * b.count, 4)


def dense_solver(b: Bench, step: float, weight: float) -> np.ndarray:
    """P: from velocities of (body, nodes) to the increment, with the local mobility in the matrix."""
    return np.linalg.solve(dense_system(b, step, weight), b.local_inverse())


@pytest.mark.parametrize("mode", ["all", "between"])
def test_corrections_lead_to_the_solution_with_the_full_mobility(mode, device, precision):
    """(1/dt + g M H) e = v without contact, whatever the weight in the matrix."""
    values = {"hydrodynamics.mode": mode, "steric.enabled": False, "body.contact": False, "flagellum.1.length": 0.8}
    exact, b = (bench(values, p, device) for p in ("float64", precision))
    step, gain = 1e-5, 2 / 3
    exact.factorise(step, 1.3 * gain)
    band = b.factorise(step, 1.3 * gain)
    velocities = np.random.default_rng(6).uniform(-1, 1, 6 + 4 * b.count)
    velocities[(6 + 4 * b.first[:, None] + np.arange(3)).ravel()] = 0.0
    system = np.eye(6 + 4 * b.count) / step + gain * exact.mobility() @ exact.hessian()
    solution = np.linalg.solve(system, velocities)
    drive = b.increment(velocities[:6], velocities[6:].reshape(-1, 4))
    x, s = b.increment(), b.stepper
    s._response.gain.fill_(gain)
    inputs = (b.model, b.state, s._stiffness, band, s._contacts, s._response, drive, x, s._defect, s._scratch)
    for _ in range(25):
        correction.correct(*inputs)
    for part in (slice(0, 6), displacements(b), spins(b)):
        assert close(flat(x)[part], solution[part], precision)


# Contacts.


def contact_list(b: Bench) -> dict[tuple[int, int], dict[str, Any]]:
    """What the search found, by (segment, other segment or -1 for the body)."""
    c, count = b.stepper._contacts, b.stepper._contacts.count.numpy()[0]
    assert c.overflow.numpy()[0] == 0
    names = ("segment", "other", "at", "at_other", "normal", "gap")
    columns = {name: getattr(c, name).numpy()[:count] for name in names}
    found = {}
    for i in range(count):
        row = {name: column[i] for name, column in columns.items()}
        found[int(row["segment"]), int(row["other"])] = row
    assert len(found) == count  # none twice
    return found


def expected_contacts(b: Bench, reach: float) -> dict[tuple[int, int], float]:
    """Every pair of segments of different flagella, and of a node and the body, nearer than `reach`: its gap."""
    near, ends = {}, np.append(b.first, b.count)
    for k, x in enumerate(b.start.positions):
        for j, y in list(enumerate(b.start.positions))[k + 1 :]:
            distances = segment_distances(x[:-1], np.diff(x, axis=0), y[:-1], np.diff(y, axis=0))
            for e, o in np.argwhere(distances < reach):
                near[int(ends[k] + 1 + e), int(ends[j] + 1 + o)] = distances[e, o]
        for e, gap in enumerate(body_gaps(b.scene, b.start, x[1:]), start=1):
            if gap < reach:
                near[int(ends[k] + e), -1] = gap
    return near


def touching(values: dict[str, Any], precision: str, device: str, seed: int = 1) -> Bench:
    scene = touching_cell({"flagella.length": 1.0, **values}, precision)
    return Bench(scene, shaken(scene, seed, node=2e-3, spin=0.05), device)


CROWD = {"flagella.count": 3, "flagellum.2.azimuth": 357.0, "flagellum.1.length": 1.2, "flagella.opening_angle": 90.0}


@pytest.mark.parametrize("values", [{}, CROWD], ids=["two", "three"])
def test_search_finds_every_contact_and_nothing_else(values, device, precision):
    total = 0
    for seed in range(4):
        b = touching(values, precision, device, seed)
        contacts.find(b.model, b.state, b.stepper._now, b.stepper._contacts)
        found, reach = contact_list(b), (CUTOFF + contacts.MARGIN) * 0.04
        exact = expected_contacts(b, reach + 1e-6)
        assert found.keys() <= exact.keys()
        assert all(gap > reach - 1e-6 for pair, gap in exact.items() if pair not in found)
        x = b.data.position.numpy().astype(np.float64)
        for (e, other), row in found.items():
            assert abs(row["gap"] - exact[e, other]) < 1e-6
            if other >= 0:
                here = x[e - 1] + row["at"] * (x[e] - x[e - 1])
                there = x[other - 1] + row["at_other"] * (x[other] - x[other - 1])
                assert np.abs(here - there - row["gap"] * row["normal"]).max() < 1e-6
            else:
                # Straight off the surface: along the normal the gap grows as fast as the node moves.
                away = b.start.body_position + x[e] + np.array([[0.0], [0.01]]) * row["normal"]
                assert np.diff(body_gaps(b.scene, b.start, away))[0] == pytest.approx(0.01, abs=1e-6)
        total += len(found)
    assert total > 40


def dense_levers(b: Bench) -> np.ndarray:
    """B: unit contact forces on (body, nodes), shape [6 + 4 count, contacts]."""
    columns = []
    arms = np.concatenate(b.start.positions) - b.start.body_position
    for (e, other), row in contact_list(b).items():
        forces = np.zeros((b.count, 3))
        n = row["normal"].astype(np.float64)
        body = np.zeros(6)
        if other < 0:
            forces[e] = n
            body = -np.concatenate([n, np.cross(arms[e], n)])
        else:
            for sign, second, at in ((1, e, row["at"]), (-1, other, row["at_other"])):
                forces[second] += sign * at * n
                forces[second - 1] += sign * (1 - at) * n
        on_anchor = forces[b.first]
        body += np.concatenate([on_anchor, np.cross(arms[b.first], on_anchor)], axis=1).sum(axis=0)
        forces[b.first] = 0.0
        columns.append(np.concatenate([body, np.hstack([forces, np.zeros((b.count, 1))]).ravel()]))
    return np.stack(columns, axis=1)


def steric_force(gap: np.ndarray) -> np.ndarray:
    """F_0 [2 (sigma/r)^13 - (sigma/r)^7] below the cutoff, along its tangent below 0.7 sigma [pN]."""
    x = np.asarray(gap, dtype=np.float64) / 0.04
    y = 1 / np.clip(x, 0.7, CUTOFF)
    slope = 26 * 0.7**-14 - 7 * 0.7**-8
    return np.where(x < CUTOFF, 0.8 * (2 * y**13 - y**7 + slope * np.maximum(0.7 - x, 0.0)), 0.0)


@dataclass
class Responded:
    """A step's answer at the contacts: dense B, P, Y = P(g M B), free increment e_0, and the stepper's e_0 + Y F."""

    bench: Bench
    levers: np.ndarray
    columns: np.ndarray
    free: Any
    step: Any

    def own(self, name: str) -> np.ndarray:
        arrays = self.bench.stepper._contacts if name == "gap" else self.bench.stepper._response
        return getattr(arrays, name).numpy()[: self.levers.shape[1]].astype(np.float64)


def responded(b: Bench, push: float, step: float = 1e-5, gain: float = 2 / 3) -> Responded:
    """push: displacement toward each other of all that is near [um]."""
    s, band = b.stepper, b.factorise(step, 1.3 * gain)
    s._response.gain.fill_(gain)
    s._response.failed.zero_()
    contacts.find(b.model, b.state, s._now, s._contacts)
    levers, solver = dense_levers(b), dense_solver(b, step, 1.3 * gain)
    free, out = b.increment(0.0, -push * levers.sum(axis=1)[6:].reshape(-1, 4)), b.increment()
    hessian.joint_stiffness(b.model, b.state, s._stiffness)
    response.respond(b.model, b.state, s._contacts, band, s._response, s._groups, free, out)
    assert s._response.failed.numpy()[0] == 0
    local = b.mobility("none") @ levers
    flows = near_field(b, levers.shape[1]) * (b.mobility() @ levers - local)
    return Responded(b, levers, solver @ (gain * (local + flows)), free, out)


def near_field(b: Bench, count: int) -> np.ndarray:
    """1 where the columns take the flow of a contact's pair of forces into account, 0 beyond, by (unknown, contact)."""
    c, x = b.stepper._contacts, b.state.data.position.numpy().astype(np.float64)
    away = np.linalg.norm(x[:, None] - x[c.segment.numpy()[:count]], axis=2)
    near = (away < response.NEAR_FIELD) | (c.other.numpy()[:count] < 0)
    return np.vstack([np.ones((6, count)), np.repeat(near, 4, axis=0)])


RESPONSES = {"all": {}, "none": {"hydrodynamics.mode": "none"}, "within": {"hydrodynamics.mode": "within"}}
RESPONSES |= {"between": {"hydrodynamics.mode": "between"}, "three": CROWD, "anchored": {"body.anchored": True}}


@pytest.mark.parametrize("name", list(RESPONSES))
def test_contacts_answer_as_dense_matrices_do_and_obey_the_law(name, device, precision):
    """Columns, compliance W = B^T Y and gap = free + W F(gap), at loads of several pN, where contacts are stiffer than
    what they rest on: W is not symmetric, and a solution must not take it to be."""
    r = responded(touching(RESPONSES[name], precision, device, seed=0), push=2e-3)
    count, free = r.levers.shape[1], flat(r.free)
    compliance = r.bench.stepper._response.compliance.numpy()[: count**2].reshape(count, count)
    exact = r.levers.T @ r.columns
    assert close(compliance, exact, precision)
    gaps, force = r.own("solved_gap"), r.own("force")
    assert np.abs(force - steric_force(gaps)).max() < 1e-4 * force.max()
    free_gaps = r.own("gap") + r.levers.T @ free
    assert np.abs(free_gaps - r.own("free_gap")).max() < 1e-6
    assert np.abs(free_gaps + exact @ force - gaps).max() < 1.1 * response.ROUGH * 0.04
    assert close(flat(r.step), free + r.columns @ force, precision)
    assert 3 < (force > 0).sum() < count and force.max() > 2.0


@pytest.mark.parametrize("name", ["all", "three"])
def test_refined_gaps_are_those_of_the_pose_they_lead_to(name, device, precision):
    r = responded(touching(RESPONSES[name], precision, device, seed=0), push=1e-3)
    b, s = r.bench, r.bench.stepper

    def measured(x: Any) -> np.ndarray:
        carry = tuple(b.increment() for _ in range(4))
        chain.retract(b.model, b.state, s._now, s.data.one, x, s._trial, carry)
        contacts.measure(b.model, b.state, s._trial, s._contacts, s._groups * response.GROUP)
        return r.own("gap")

    rough, solved = measured(r.step), r.own("solved_gap")
    caused = r.levers.T @ r.columns @ r.own("force")
    response.refine(b.model, b.state, s._contacts, s._response, s._groups, r.free, r.step)
    assert s._response.failed.numpy()[0] == 0
    force = r.own("force")
    assert np.abs(rough - caused - r.own("free_gap")).max() < 1e-6
    assert (
        np.abs(rough - caused + r.levers.T @ r.columns @ force - r.own("solved_gap")).max() < 1.5 * response.FINE * 0.04
    )
    assert close(flat(r.step), flat(r.free) + r.columns @ force, precision)
    left, before = (np.abs(x - y).max() for x, y in ((measured(r.step), r.own("solved_gap")), (rough, solved)))
    assert left < 0.2 * before and before > 1e-5


def test_a_contact_list_that_overflows_is_noticed(device, precision):
    b = touching({}, precision, device)
    contacts.find(b.model, b.state, b.stepper._now, b.stepper._contacts)
    count = len(contact_list(b))
    b.stepper._contacts.first.assign([0, count - 1])
    contacts.find(b.model, b.state, b.stepper._now, b.stepper._contacts)
    assert b.stepper._contacts.overflow.numpy()[0] == 1
    assert b.stepper._contacts.count.numpy()[0] < count
