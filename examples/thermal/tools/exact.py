"""Exact values: energies of joints, rigid bodies, clamped filaments, and contact by direct sampling."""

from __future__ import annotations

import math

import numpy as np
from warpflag_kernels.contact.constants import CUTOFF

from warpflag import Scene
from warpflag.model.shell import rotne_prager
from warpflag.observables import closest_parameters
from warpflag.scene.resistance import filament_mobility, pair_radius, spheroid_mobility

from .ensembles import KT

JOINT = np.array([0.99977, 0.50006, 0.50002])  # bend, twist, stretch of a joint over kT, by quadrature


def energies(scene: Scene) -> np.ndarray:
    """Mean bending, twist and stretching energy of a cell over kT; joints are independent but for contact."""
    hook = np.zeros(3)
    if scene.body.enabled:
        hook[1] = 0.5
        if scene.hook.stiffness:  # 2 k u with u = tan^2(beta/2), on the sphere: weight 1/(1 + u)^2
            u = np.linspace(0.0, 40 * KT / scene.hook.stiffness, 100_000)
            weight = np.exp(-2 * scene.hook.stiffness * u / KT) / (1 + u) ** 2
            hook[0] = np.sum(weight * 2 * scene.hook.stiffness * u) / np.sum(weight) / KT
    segments = [spec.segment_count for spec in scene.resolved_flagella()]
    return sum((JOINT * [n - 1, n - 1, n] + hook for n in segments), np.zeros(3))


def rigid(scene: Scene, flagella: list[np.ndarray], centre: np.ndarray | None) -> np.ndarray:
    """Diffusion matrix of a cell as a rigid body, in lab axes: its velocity at the origin, its rotation [6, 6].

    Modes none and all. Flagella do not turn against the body.

    Args:
        flagella: nodes r_0 to r_N of each [um].
        centre: of the body, its axis along z; None: a free filament, whose r_0 is a node.
    """
    points, blocks, spins, h = [], [], [], 0.0
    for spec, x in zip(scene.resolved_flagella(), flagella, strict=True):
        h = spec.segment_length
        m = filament_mobility(scene, h)
        t = np.diff(x, axis=0)
        t /= np.linalg.norm(t, axis=1, keepdims=True)
        nodes = t[:-1] + t[1:]
        nodes = np.vstack([t[:1], nodes / np.linalg.norm(nodes, axis=1, keepdims=True), t[-1:]])
        ends = np.ones(len(x))
        ends[[0, -1]] = 2.0
        first = 0 if centre is None else 1
        outer = nodes[:, :, None] * nodes[:, None, :]
        local = ends[:, None, None] * (m.across * np.eye(3) + (m.along - m.across) * outer)
        points.append(x[first:])
        blocks.append(local[first:])
        spins.append(np.vstack([t, t[:1]] if centre is not None else [t]) / math.sqrt(m.spin))
    x = np.concatenate(points)
    dense = np.zeros((len(x), 3, len(x), 3))
    if scene.hydrodynamics.mode != "none":
        radius = pair_radius(scene)
        dense = rotne_prager(x, radius, x, radius) / (8 * math.pi * scene.fluid.viscosity)
    i = np.arange(len(x))
    dense[i, :, i, :] = np.concatenate(blocks)
    motion = np.zeros((len(x), 3, 6))
    motion[:, :, :3] = np.eye(3)
    motion[:, :, 3:] = np.stack([np.cross(axis, x) for axis in np.eye(3)], axis=2)
    motion = motion.reshape(-1, 6)
    resistance = motion.T @ np.linalg.solve(dense.reshape(len(motion), -1), motion)
    tangents = np.concatenate(spins)
    resistance[3:, 3:] += tangents.T @ tangents
    if centre is not None:
        body = spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity)
        own = np.diag([body.across, body.across, body.along, body.tumble, body.tumble, body.spin])
        shift = np.eye(6)  # from velocities at the origin to those at the centre
        shift[:3, 3:] = -np.array([np.cross(axis, centre) for axis in np.eye(3)])
        resistance += shift.T @ np.linalg.inv(own) @ shift
    return KT * np.linalg.inv(resistance)


def clamped_tip(scene: Scene, x: np.ndarray, axis: np.ndarray) -> float:
    """Variance of the tip of a filament on a hook that resists bending, per direction across `axis` [um^2].

    Every joint turns at random about all three axes alike (A = C); so does the hook, by its own stiffnesses.
    """
    spec = scene.resolved_flagella()[0]
    h, f = spec.segment_length, scene.flagella
    arms = x[-1] - x[:-1]
    squares = np.sum(arms**2, axis=1)
    along = arms @ axis
    # Rotations about all axes: a displacement (w x d).n has the variance |d|^2 - (d.n)^2 of that of w.
    per_direction = (2 * squares - (squares - along**2)) / 2
    found = KT * h / f.bending_rigidity * per_direction[1:].sum()
    turned = KT * h / (f.hook_twist_factor * f.twist_rigidity) * (squares[0] - along[0] ** 2) / 2
    return float(found + turned + KT / scene.hook.stiffness * along[0] ** 2)


def potential(r: np.ndarray, strength: float, diameter: float) -> np.ndarray:
    """Energy of a contact [pN um]; not for distances below 0.7 sigma, which thermal motion does not reach."""
    x = np.minimum(r / diameter, CUTOFF)
    return strength * diameter * (x**-12 - x**-6 + 0.25) / 6


def sampled_contact(scene: Scene, apart: float, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two straight filaments on hooks that resist bending, `apart` from each other, sampled joint by joint.

    Returns: least distances [um], contact energies [kT], and Boltzmann weights of the samples, shape [count].
    """
    random = np.random.default_rng(seed)
    spec, f = scene.resolved_flagella()[0], scene.flagella
    h, n = spec.segment_length, spec.segment_count

    def turned(t: np.ndarray, stiffness: float) -> np.ndarray:
        """Unit vectors about t with the energy 2 k u, u = tan^2(beta/2): the weight on the sphere is du/(1 + u)^2."""
        u = random.exponential(KT / (2 * stiffness), len(t))
        rejected = random.random(len(t)) * (1 + u) ** 2 > 1
        while rejected.any():
            u[rejected] = random.exponential(KT / (2 * stiffness), int(rejected.sum()))
            rejected[rejected] = random.random(int(rejected.sum())) * (1 + u[rejected]) ** 2 > 1
        cosine = (1 - u) / (1 + u)
        side = np.cross(t, random.standard_normal(t.shape))
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        return cosine[:, None] * t + np.sqrt(1 - cosine**2)[:, None] * side

    starts, vectors = [], []
    for k in range(2):
        at = np.tile([k * apart, 0.0, 0.0], (count, 1))
        t = turned(np.tile([0.0, 0.0, 1.0], (count, 1)), scene.hook.stiffness)
        points, segments = [], []
        for i in range(n):
            if i:
                t = turned(t, f.bending_rigidity / h)
            length = h * (1 + math.sqrt(KT / (f.stretching_stiffness * h)) * random.standard_normal(count))
            points.append(at)
            segments.append(length[:, None] * t)
            at = at + segments[-1]
        starts.append(points)
        vectors.append(segments)
    energy, least = np.zeros(count), np.full(count, np.inf)
    diameter = 4 * f.filament_radius
    for p, d in zip(starts[0], vectors[0], strict=True):
        for q, e in zip(starts[1], vectors[1], strict=True):
            s, t = closest_parameters(p, d, q, e)
            distance = np.linalg.norm(p + s[:, None] * d - q - t[:, None] * e, axis=1)
            least = np.minimum(least, distance)
            energy += potential(np.maximum(distance, 0.5 * diameter), scene.steric.strength, diameter) / KT
    return least, energy, np.exp(-energy)
