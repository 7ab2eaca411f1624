"""Oracles written in NumPy from the model's equations alone: energies, contact distances, mobilities.

Units um, pN, s; shapes and element order as in `tests.helpers`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tests.helpers import carried, displaced, free_nodes, ground_state_frames, helix_axis, matrix, tangents, unit
from warpflag.model.geometry import InitialState
from warpflag.run.simulation import Simulation
from warpflag.scene import FlagellumSpec, Scene

CUTOFF = 2.0 ** (1.0 / 6.0)  # of the steric force, in diameters

# Energies.


def strains(t: np.ndarray, e1: np.ndarray) -> np.ndarray:
    """h Omega of every joint between consecutive frames with tangents t and directors e1, shape [count - 1, 3]."""
    t, u, a, b = t[:-1], t[1:], e1[:-1], e1[1:]
    binormal = 2 * np.cross(t, u) / (1 + np.sum(t * u, axis=1, keepdims=True))
    one = np.sum(binormal * (a + b), axis=1) / 2
    two = np.sum(binormal * (np.cross(t, a) + np.cross(u, b)), axis=1) / 2
    on_u = carried(a, t, u)
    three = np.arctan2(np.sum(np.cross(on_u, b) * u, axis=1), np.sum(on_u * b, axis=1))
    return np.stack([one, two, three], axis=1)


def elastic_energies(scene: Scene, start: InitialState) -> np.ndarray:
    """Bending, twist and stretching energy, of filaments and hooks [pN um], shape [3]."""
    group, total = scene.flagella, np.zeros(3)
    stiffness = np.array([group.bending_rigidity, group.bending_rigidity, group.twist_rigidity])
    frames = zip(tangents(scene, start), start.directors, strict=True)
    for spec, x, (t, e1) in zip(scene.resolved_flagella(), start.positions, frames, strict=True):
        h = spec.segment_length
        joint = strains(t, e1)
        density = stiffness / (2 * h) * (joint[1:] - h * np.array(group.intrinsic_curvature)) ** 2
        hook = group.hook_twist_factor * group.twist_rigidity / (2 * h) * joint[0, 2] ** 2
        stretch = np.linalg.norm(np.diff(x, axis=0), axis=1) / h - 1
        total += [
            density[:, :2].sum() + hook_bending(scene, spec, t, e1),
            density[:, 2].sum() + hook,
            group.stretching_stiffness * h / 2 * stretch @ stretch,
        ]
    return total


def hook_bending(scene: Scene, spec: FlagellumSpec, t: np.ndarray, e1: np.ndarray) -> float:
    """(k/2) (2 tan(beta/2))^2, beta from the motor axis t[0] to the axis of the helix at rest with segment 1."""
    stiffness = scene.hook.stiffness
    if scene.hook.stiffening_torque is not None:
        stiffness *= 1 + abs(spec.torque) / scene.hook.stiffening_torque
    if stiffness == 0.0:
        return 0.0
    frames = ground_state_frames(8, spec.segment_length, scene.flagella.intrinsic_curvature)
    own, _ = helix_axis(np.cumsum(spec.segment_length * frames[:, :, 2], axis=0))
    axis = own[0] * e1[1] + own[1] * np.cross(t[1], e1[1]) + own[2] * t[1]
    beta = math.atan2(np.linalg.norm(np.cross(t[0], axis)), t[0] @ axis)
    return stiffness / 2 * (2 * math.tan(beta / 2)) ** 2


def steric_potential(r: Any, strength: float, diameter: float) -> np.ndarray:
    """Energy at distance r [pN um]: (F_0 sigma/6)[x^-12 - x^-6 + 1/4] below the cutoff, its force linear below 0.7."""
    x = np.asarray(r) / diameter
    y = np.clip(x, 0.7, CUTOFF)
    energy = (y**-12 - y**-6 + 0.25) / 6
    force, slope = 2 * 0.7**-13 - 0.7**-7, 26 * 0.7**-14 - 7 * 0.7**-8
    depth = np.maximum(0.7 - x, 0.0)
    return strength * diameter * (energy + force * depth + slope * depth**2 / 2)


def segment_distances(p: np.ndarray, d: np.ndarray, q: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Distances of all segments p + s d from all q + t e, shape [len(p), len(q)]: the best of five candidates."""
    p, d, q, e = p[:, None], d[:, None], q[None], e[None]

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.sum(a * b, axis=-1)

    def apart(s: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.linalg.norm(p + s[..., None] * d - q - t[..., None] * e, axis=-1)

    dd, ee, de = dot(d, d) + 0 * dot(e, e), dot(e, e) + 0 * dot(d, d), dot(d, e)
    determinant = dd * ee - de * de
    safe = np.where(determinant > 1e-12 * dd * ee, determinant, 1.0)
    s = (de * dot(e, p - q) - ee * dot(d, p - q)) / safe
    t = (dd * dot(e, p - q) - de * dot(d, p - q)) / safe
    inside = (determinant > 1e-12 * dd * ee) & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    best = np.where(inside, apart(s, t), np.inf)
    for end in (0.0, 1.0):
        fixed = np.full_like(dd, end)
        best = np.minimum(best, apart(fixed, np.clip(dot(e, p + end * d - q) / ee, 0, 1)))
        best = np.minimum(best, apart(np.clip(dot(d, q + end * e - p) / dd, 0, 1), fixed))
    return best


def body_gaps(scene: Scene, start: InitialState, x: np.ndarray) -> np.ndarray:
    """Distances of points x from the surface of the body's spherocylinder, negative inside [um]."""
    axis = matrix(start.body_orientation)[:, 2]
    half = (scene.body.length - scene.body.width) / 2
    y = x - start.body_position
    return np.linalg.norm(y - np.clip(y @ axis, -half, half)[:, None] * axis, axis=1) - scene.body.width / 2


def contact_distances(start: InitialState) -> np.ndarray:
    """Distances of all pairs of segments of different flagella [um]."""
    found = [np.empty(0)]
    for k, x in enumerate(start.positions):
        for y in start.positions[k + 1 :]:
            found.append(segment_distances(x[:-1], np.diff(x, axis=0), y[:-1], np.diff(y, axis=0)).ravel())
    return np.concatenate(found)


def own_distances(scene: Scene, start: InitialState) -> list[np.ndarray]:
    """Distances of pairs of segments of one flagellum [um], infinite where they are neighbours, [N, N] each.

    Neighbours are less than two segments, or not more than 3 sigma of contour, apart; every pair stands once.
    """
    diameter = 4 * scene.flagella.filament_radius if scene.steric.diameter is None else scene.steric.diameter
    found = []
    for spec, x in zip(scene.resolved_flagella(), start.positions, strict=True):
        distances = segment_distances(x[:-1], np.diff(x, axis=0), x[:-1], np.diff(x, axis=0))
        between = np.arange(len(distances)) - np.arange(len(distances))[:, None]
        apart = (between >= 2) & (between * spec.segment_length > 3 * diameter)
        found.append(np.where(apart, distances, np.inf))
    return found


def steric_energy(scene: Scene, start: InitialState) -> float:
    """Energy of the contacts between flagella and of nodes r_1..r_N with the body, where the scene has them."""
    strength = scene.steric.strength
    diameter = 4 * scene.flagella.filament_radius if scene.steric.diameter is None else scene.steric.diameter
    total = 0.0
    if scene.steric.enabled:
        total += steric_potential(contact_distances(start), strength, diameter).sum()
    if scene.steric.enabled and scene.steric.self_contact:
        total += sum(steric_potential(r, strength, diameter).sum() for r in own_distances(scene, start))
    if scene.body.contact:
        nodes = np.concatenate([x[1:] for x in start.positions])
        total += steric_potential(body_gaps(scene, start, nodes), strength, diameter).sum()
    return float(total)


def energy(scene: Scene, start: InitialState) -> float:
    """Elastic and steric energy [pN um]."""
    return float(elastic_energies(scene, start).sum()) + steric_energy(scene, start)


def slope(f: Callable[[float], float], step: float) -> float:
    """Derivative at 0 by the five-point rule, exact for polynomials of degree four."""
    return (8 * (f(step) - f(-step)) - (f(2 * step) - f(-2 * step))) / (12 * step)


@dataclass(frozen=True)
class Gradient:
    """Minus an energy's derivatives: forces on nodes r_1..r_N (other rows zero), torques on spins, body's share."""

    forces: np.ndarray
    torques: np.ndarray
    body_force: np.ndarray
    body_torque: np.ndarray


def energy_gradient(
    scene: Scene, start: InitialState, of: Callable[[Scene, InitialState], float], step: float = 1e-5
) -> Gradient:
    """Minus the derivatives of an energy by central differences."""
    count = sum(len(x) for x in start.positions)
    one, nodes = np.eye(count), free_nodes(scene)

    def minus_slope(move: Callable[[float], dict[str, Any]]) -> float:
        return -slope(lambda x: of(scene, displaced(scene, start, **move(x))), step)

    forces = np.zeros((count, 3))
    for i in nodes:
        for axis in range(3):
            forces[i, axis] = minus_slope(lambda x, i=i, axis=axis: {"nodes": x * np.outer(one[i], np.eye(3)[axis])})
    return Gradient(
        forces=forces,
        torques=np.array([minus_slope(lambda x, i=i: {"spins": x * one[i]}) for i in range(count)]),
        body_force=np.array([minus_slope(lambda x, v=v: {"translation": x * v}) for v in np.eye(3)]),
        body_torque=np.array([minus_slope(lambda x, v=v: {"turn": x * v}) for v in np.eye(3)]),
    )


# Mobility.


def drag_coefficients(scene: Scene) -> tuple[float, float, float]:
    """gamma_par, gamma_perp [pN s/um^2], gamma_R [pN s]: the paper's for water, in proportion to the viscosity."""
    fluid, printed = scene.fluid, (1.6e-3, 2.8e-3, 1.26e-6)
    given = (fluid.drag_parallel, fluid.drag_perpendicular, fluid.drag_rotation)
    a, b, c = (p * fluid.viscosity / 1e-3 if g is None else g for p, g in zip(printed, given, strict=True))
    return a, b, c


def rotne_prager(x: np.ndarray, radius: float, viscosity: float) -> np.ndarray:
    """Rotne-Prager tensor between all points x, zero on the diagonal, shape [count, 3, count, 3]."""
    d = x[:, None] - x[None]
    r = np.linalg.norm(d, axis=-1) + np.eye(len(x))
    along = d[..., :, None] * d[..., None, :] / r[..., None, None] ** 2
    near = r <= 2 * radius
    isotropic = np.where(near, (1 - 9 * r / (32 * radius)) / (6 * radius), (1 + 2 * radius**2 / (3 * r**2)) / (8 * r))
    stretched = np.where(near, 3 * r / (32 * radius) / (6 * radius), (1 - 2 * radius**2 / r**2) / (8 * r))
    tensor = isotropic[..., None, None] * np.eye(3) + stretched[..., None, None] * along
    tensor[np.arange(len(x)), np.arange(len(x))] = 0.0
    return tensor.transpose(0, 2, 1, 3) / (math.pi * viscosity)


def whole_mobility(scene: Scene, start: InitialState, points: np.ndarray, bead: float) -> np.ndarray:
    """Mobility of the body (velocity, spin) and of nodes r_1..r_N with flow round it, shape [6 + 3 count] squared.

    Mode all, a free body: beads and nodes have one Rotne-Prager mobility, and the loads on the beads are found with the
    body's motion from the constraint that they move rigidly.

    Args:
        points: beads of the shell in body axes [um].
        bead: their radius [um].
    """
    radius, eta = expected_pair_radius(scene), scene.fluid.viscosity
    x = points @ matrix(start.body_orientation).T
    y = np.concatenate([nodes[1:] for nodes in start.positions]) - start.body_position
    n, count = 3 * len(x), 3 * len(y)
    across = sphere_pairs(x, bead, y, radius, eta).reshape(n, count)
    beads = sphere_pairs(x, bead, x, bead, eta).reshape(n, n)
    turns = np.stack([np.cross(axis, x) for axis in np.eye(3)], axis=2).reshape(n, 3)
    rigid = np.hstack([np.tile(np.eye(3), (len(x), 1)), turns])
    # Loads l and motion U: beads l + across f = rigid U, rigid^T l = F.
    system = np.block([[beads, -rigid], [rigid.T, np.zeros((6, 6))]])
    right = np.zeros((n + 6, 6 + count))
    right[n:, :6], right[:n, 6:] = np.eye(6), -across
    solved = np.linalg.solve(system, right)
    nodes = across.T @ solved[:n]
    nodes[:, 6:] += dense_mobility(scene, start, radius)
    return np.vstack([solved[n:], nodes])


def sphere_pairs(x: np.ndarray, a: float, y: np.ndarray, b: float, eta: float) -> np.ndarray:
    """Rotne-Prager tensors of spheres of radii a at x and b at y, none inside another, shape [len(x), 3, len(y), 3].

    Apart: (1 + (a^2 + b^2)/6 nabla^2) of the Oseen tensor. Overlapping: Zuk et al., J. Fluid Mech. 741, R5 (2014).
    """
    d = x[:, None] - y[None]
    r = np.linalg.norm(d, axis=-1)
    r = np.where(r > 0, r, 1e-30)
    e = d / r[..., None]
    dyad = e[..., :, None] * e[..., None, :]
    s, q = a * a + b * b, (a - b) ** 2
    apart = ((1 + s / (3 * r**2)) / (8 * r), (1 - s / r**2) / (8 * r))
    over = (
        (16 * r**3 * (a + b) - (q + 3 * r**2) ** 2) / (32 * r**3) / (6 * a * b),
        3 * (q - r**2) ** 2 / (32 * r**3) / (6 * a * b),
    )
    isotropic, along = (np.where(r > a + b, far, near)[..., None, None] for far, near in zip(apart, over, strict=True))
    return (isotropic * np.eye(3) + along * dyad).transpose(0, 2, 1, 3) / (math.pi * eta)


def dense_mobility(scene: Scene, start: InitialState, radius: float, drag: tuple | None = None) -> np.ndarray:
    """Mobility of nodes r_1..r_N of all flagella by the paper's law: local drag and the scene's pairs.

    radius: of the pair term [um]; drag: along and across, default gamma_par, gamma_perp [pN s/um^2].
    Shape [3 count, 3 count].
    """
    parallel, perpendicular = drag or drag_coefficients(scene)[:2]
    x = np.concatenate([nodes[1:] for nodes in start.positions])
    owner = np.repeat(np.arange(len(start.positions)), [len(nodes) - 1 for nodes in start.positions])
    mode, same = scene.hydrodynamics.mode, owner[:, None] == owner[None, :]
    wanted = {"none": same & ~same, "within": same, "between": ~same}.get(mode, same | ~same)
    mobility = rotne_prager(x, radius, scene.fluid.viscosity) * wanted[:, None, :, None]
    i = 0
    for spec, nodes in zip(scene.resolved_flagella(), start.positions, strict=True):
        t = unit(np.diff(nodes, axis=0))
        t = np.vstack([unit(t[:-1] + t[1:]), t[-1]])
        for j, tangent in enumerate(t):
            length = spec.segment_length * (0.5 if j + 1 == len(t) else 1.0)
            outer = np.outer(tangent, tangent)
            mobility[i, :, i, :] = (outer / parallel + (np.eye(3) - outer) / perpendicular) / length
            i += 1
    return mobility.reshape(3 * len(x), 3 * len(x))


def expected_pair_radius(scene: Scene) -> float:
    """The smallest radius at which a bead moves no easier than the local drag allows, at least the filament's [um]."""
    h = max(spec.segment_length for spec in scene.resolved_flagella())
    if scene.hydrodynamics.mode == "as_printed":
        return scene.flagella.filament_radius
    bead = drag_coefficients(scene)[1] * h / (6 * math.pi * scene.fluid.viscosity)
    return max(scene.flagella.filament_radius, bead)


def device_mobility(sim: Simulation) -> np.ndarray:
    """The mobility of nodes r_1..r_N that the program's kernel applies, one column per unit force."""
    from warpflag_kernels.fluid import node_velocity

    sim.evaluate()
    model, state = sim.system.model, sim.system.state
    state.data.active.fill_(1)
    nodes = free_nodes(sim.scenes[0])
    columns = []
    for node in nodes:
        for axis in range(3):
            force = np.zeros((model.element_count, 3))
            force[node, axis] = 1.0
            state.data.force.assign(force)
            node_velocity.node_velocities(model, state)
            columns.append(state.data.velocity.numpy()[nodes].astype(np.float64).ravel())
    return np.stack(columns, axis=1)


def device_whole_mobility(sim: Simulation) -> np.ndarray:
    """The mobility of the body and of nodes r_1..r_N that the program's kernels apply, one column per unit force."""
    from warpflag_kernels.fluid import body, node_velocity

    sim.evaluate()
    model, state = sim.system.model, sim.system.state
    state.data.active.fill_(1)
    nodes, columns = free_nodes(sim.scenes[0]), []
    for column in range(6 + 3 * len(nodes)):
        load, force = np.zeros(6), np.zeros((model.element_count, 3))
        if column < 6:
            load[column] = 1.0
        else:
            force[nodes[(column - 6) // 3], column % 3] = 1.0
        on_body = np.zeros((2, model.flagellum_count, 3))
        on_body[:, 0] = load.reshape(2, 3)
        state.data.force.assign(force)
        state.data.flagellum_force.assign(on_body[0])
        state.data.flagellum_torque.assign(on_body[1])
        body.move_bodies(model, state)
        node_velocity.node_velocities(model, state)
        moved = (state.data.body_velocity, state.data.body_spin, state.data.velocity)
        u, w, v = (array.numpy().astype(np.float64) for array in moved)
        columns.append(np.concatenate([u[0], w[0], v[nodes].ravel()]))
    return np.stack(columns, axis=1)
