"""A cell with flow round its body: shells, the mobility in many poses, and the flow far away."""

from __future__ import annotations

import math

import numpy as np

from warpflag.model.geometry import initial_state
from warpflag.model.shell import body_shell, rotne_prager
from warpflag.scene import Scene, with_values
from warpflag.scene.resistance import filament_mobility, pair_radii, spheroid_mobility

ETA = 1e-3
KINDS = ("random", "in contact", "hairpin", "mixed mesh")


def shell_drags(beads: int) -> np.ndarray:
    """Drags of the shell over the spheroid's less one: along, across, about and across the axis."""
    m = spheroid_mobility(2.5, 0.8, 1 / (8 * math.pi))
    r = np.diagonal(body_shell(2.5, 0.8, beads).resistance)
    found = np.array([r[2], (r[0] + r[1]) / 2, r[5], (r[3] + r[4]) / 2])
    return found * [m.along, m.across, m.spin, m.tumble] - 1


def response(beads: int, x: np.ndarray, radii: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of nodes x [um] in body axes, over 1/(8 pi eta): what the body takes away from their mobility, what their forces
    do to the body, and the body's own mobility."""
    shell = body_shell(2.5, 0.8, beads)
    n = 3 * beads
    across = rotne_prager(shell.points, shell.radius, x, radii).reshape(n, -1)
    inverse, rigid = shell.inverse.reshape(n, n), shell.rigid.reshape(n, 6)
    own = np.linalg.inv(shell.resistance)
    pushed = rigid.T @ across
    return -across.T @ inverse @ across + pushed.T @ own @ pushed, own @ pushed, own


def radial_mobility(beads: int, gap: float, radius: float = 0.0297) -> float:
    """Of a node beside the equator toward the body over that in free fluid, the mean over the azimuth."""
    found = []
    for azimuth in np.arange(24) * math.pi / 12:
        normal = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
        taken, _, _ = response(beads, (0.4 + gap) * normal[None], np.array([radius]))
        found.append(1 + normal @ taken @ normal * 3 * radius / 4)
    return float(np.mean(found))


def pose(mode: str, kind: str, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Nodes, tangents, pair radii, and local mobilities along and across of two flagella in a pose of a kind."""
    random = np.random.default_rng(seed)
    values = {"flagella.length": 2.0, "hydrodynamics.mode": mode}
    if kind == "mixed mesh":
        values |= {
            "flagellum.0.segments": int(random.integers(4, 11)),
            "flagellum.1.segments": int(random.integers(20, 66)),
        }
    scene = with_values(Scene(name="pose"), values)
    specs, radii = scene.resolved_flagella(), pair_radii(scene)
    shapes = [x[1:].copy() for x in initial_state(scene).positions]
    if kind == "random":
        shapes = [x + random.uniform(-0.5, 0.5, x.shape) for x in shapes]
    elif kind == "hairpin":
        for x in shapes:
            half = len(x) // 2
            x[half:] = x[: len(x) - half][::-1] + random.uniform(-0.02, 0.02, (len(x) - half, 3))
    if kind != "random":  # the second beside the first, node on node where both have as many
        at = np.linspace(0, len(shapes[0]) - 1, len(shapes[1]))
        beside = np.stack([np.interp(at, np.arange(len(shapes[0])), shapes[0][:, i]) for i in range(3)], axis=1)
        shapes[1] = beside + random.uniform(-0.04, 0.04, 3) + random.uniform(-0.01, 0.01, beside.shape)
    x, tangents = np.concatenate(shapes), [np.gradient(s, axis=0) for s in shapes]
    t = np.concatenate(tangents)
    counts = [len(s) for s in shapes]
    local = [filament_mobility(scene, spec.segment_length) for spec in specs]
    repeat = lambda values: np.repeat(values, counts)  # noqa: E731
    return (
        x,
        t / np.linalg.norm(t, axis=1, keepdims=True),
        repeat(radii),
        repeat([m.along for m in local]),
        repeat([m.across for m in local]),
    )


def smallest(mode: str, kind: str, seed: int, beads: int = 60) -> float:
    """Smallest eigenvalue of the mobility of body and nodes [um/(s pN)]; the body's spin counts per um^2."""
    x, t, radii, along, across = pose(mode, kind, seed)
    count = len(x)
    pairs = rotne_prager(x, radii, x, radii)
    i = np.arange(count)
    outer = t[:, :, None] * t[:, None, :]
    scale = 8 * math.pi * ETA
    pairs[i, :, i, :] = scale * (across[:, None, None] * np.eye(3) + (along - across)[:, None, None] * outer)
    taken, pushed, own = response(beads, x, radii)
    nodes = pairs.reshape(3 * count, -1) + taken
    return float(np.linalg.eigvalsh(np.block([[own, pushed], [pushed.T, nodes]])).min() / scale)


def far_field(distance: np.ndarray, beads: int = 60) -> np.ndarray:
    """Flow far from a free swimmer under random internal forces [um/s], root mean square over directions.

    Forces on nodes are balanced by the body, which is free: what is left far away is a force dipole.
    """
    x, _, radii, _, _ = pose("all", "in contact", 0)
    force = np.random.default_rng(1).standard_normal(x.shape)
    load = np.concatenate([-force.sum(axis=0), -np.cross(x, force).sum(axis=0)])
    shell = body_shell(2.5, 0.8, beads)
    n = 3 * beads
    across = rotne_prager(shell.points, shell.radius, x, radii).reshape(n, -1)
    _, pushed, own = response(beads, x, radii)
    motion = own @ load + pushed @ force.ravel()
    loads = shell.rigid.reshape(n, 6) @ motion - shell.inverse.reshape(n, n) @ across @ force.ravel()
    ways = np.random.default_rng(2).standard_normal((64, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    sources, forces = np.vstack([x, shell.points]), np.concatenate([force.ravel(), loads])
    found = []
    for r in distance:
        tensor = rotne_prager(r * ways, 1e-6, sources, 1e-6).reshape(192, -1)
        found.append(np.sqrt(np.mean((tensor @ forces) ** 2) * 3) / (8 * math.pi * ETA))
    return np.array(found)
