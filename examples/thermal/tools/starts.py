"""Shapes in equilibrium, sampled joint by joint: without contact joints are independent."""

from __future__ import annotations

import math

import numpy as np

from warpflag import Scene
from warpflag.model.geometry import InitialState
from warpflag.model.start import starting_state


def joint_angles(
    rest: np.ndarray, bend: float, twist: float, count: int, energy: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Curvature binormals in the axes of the segment before, shape [count, 2], and twists [rad], shape [count].

    The strains are normal but for the measure: of directions it is d^2 kappa/(1 + kappa^2/4)^2, and kappa is the bend
    turned by half the twist, over the cosine of that.

    Args:
        rest: the three strains at rest [rad].
        bend, twist: stiffness of strains [pN um].
        count: of joints.
        energy: kT [pN um].
        random: source.
    """
    kappa, angle = np.zeros((count, 2)), np.zeros(count)
    left = np.ones(count, bool)
    while left.any():
        n = int(left.sum())
        w = rest[:2] + math.sqrt(energy / bend) * random.standard_normal((n, 2))
        psi = rest[2] + math.sqrt(energy / twist) * random.standard_normal(n)
        c, s = np.cos(psi / 2), np.sin(psi / 2)
        k = np.stack([c * w[:, 0] - s * w[:, 1], s * w[:, 0] + c * w[:, 1]], axis=1) / c[:, None]
        weight = 1 / (c**2 * (1 + np.sum(k**2, axis=1) / 4) ** 2)
        kept = random.random(n) * 2 < weight  # weights are near 1
        which = np.flatnonzero(left)[kept]
        kappa[which], angle[which] = k[kept], psi[kept]
        left[which] = False
    return kappa, angle


def _turned(v: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    return v * math.cos(angle) + np.cross(axis, v) * math.sin(angle) + axis * (axis @ v) * (1 - math.cos(angle))


def in_equilibrium(scene: Scene, energy: float, random: np.random.Generator) -> InitialState:
    """The cell of a scene with its joints at random angles and segments of random lengths; first segments have the
    directions that they have at rest. energy: kT [pN um]."""
    rest = starting_state(scene)
    positions, directors = [], []
    group = scene.flagella
    shapes = zip(scene.resolved_flagella(), rest.positions, rest.directors, strict=True)
    for spec, x, e1 in shapes:
        h, n = spec.segment_length, spec.segment_count
        kappa, psi = joint_angles(
            h * np.array(group.intrinsic_curvature),
            group.bending_rigidity / h,
            group.twist_rigidity / h,
            n - 1,
            energy,
            random,
        )
        spread = math.sqrt(energy / (group.stretching_stiffness * h))
        lengths = h * (1 + spread * random.standard_normal(n) + 2 * spread**2)  # the weight l^2 shifts the mean
        t, a = (x[1] - x[0]) / np.linalg.norm(x[1] - x[0]), e1[1]
        if scene.body.enabled:
            a = _turned(
                a,
                t,
                math.sqrt(energy * h / (group.hook_twist_factor * group.twist_rigidity)) * random.standard_normal(),
            )
        nodes, frames = [x[0], x[0] + lengths[0] * t], [e1[0], a]
        for i in range(n - 1):
            binormal = kappa[i, 0] * a + kappa[i, 1] * np.cross(t, a)
            size = float(np.linalg.norm(binormal))
            axis, beta = binormal / size, 2 * math.atan(size / 2)
            t, a = _turned(t, axis, beta), _turned(a, axis, beta)
            a = _turned(a, t, float(psi[i]))
            t /= np.linalg.norm(t)
            a -= (a @ t) * t
            a /= np.linalg.norm(a)
            nodes.append(nodes[-1] + lengths[i + 1] * t)
            frames.append(a)
        positions.append(np.array(nodes))
        directors.append(np.array(frames))
    return InitialState(tuple(positions), tuple(directors), rest.body_position, rest.body_orientation)
