"""Rigid filaments in mode none, all or consistent: resistance from a dense mobility."""

from __future__ import annotations

import math

import numpy as np

from warpflag.model.shell import rotne_prager
from warpflag.scene import Scene, with_values
from warpflag.scene.resistance import filament_mobility, pair_radius


def nodes(radius: float, pitch: float, axial: float, count: int) -> tuple[np.ndarray, float]:
    """Nodes of a left-handed helix about z at equal arc length, shape [count + 1, 3], and the contour length."""
    turns = 2 * math.pi * axial / pitch
    length = axial * math.hypot(1.0, 2 * math.pi * radius / pitch)
    angle = np.linspace(0, turns, count + 1)
    return np.stack([radius * np.cos(angle), -radius * np.sin(angle), pitch * angle / (2 * math.pi)], axis=1), length


def mobility(
    x: np.ndarray, t: np.ndarray, h: float, radius: float, viscosity: float, mode: str, ends: float, turn: float = 1.0
) -> np.ndarray:
    """Dense mobility of nodes x with tangents t and drag length h, `ends` times that at both ends; turn: contour length
    of a helical turn."""
    # The laws scale with lengths: h is put in the range of a scene, the viscosity is linear.
    scale = 0.2 / h
    values = {"hydrodynamics.mode": mode, "flagella.filament_radius": radius * scale, "flagella.count": 1}
    if mode != "consistent":  # Lighthill's coefficients for a helix
        log = math.log(0.18 * turn / radius)
        drags = 2 * math.pi / log, 4 * math.pi / (log + 0.5)
        values |= {"fluid.drag_parallel": 1e-3 * drags[0], "fluid.drag_perpendicular": 1e-3 * drags[1]}
    scene = with_values(Scene(name="rigid"), {**values, "flagella.segment_length": 0.2})
    local = filament_mobility(scene, 0.2)
    along, across = (1e-3 / viscosity * m * scale for m in (local.along, local.across))
    outer = t[:, :, None] * t[:, None, :]
    weight = np.ones(len(x))
    weight[[0, -1]] = 1 / ends
    blocks = weight[:, None, None] * (across * np.eye(3) + (along - across) * outer)
    found = np.zeros((len(x), 3, len(x), 3))
    if mode != "none":
        found = rotne_prager(x, pair_radius(scene) / scale, x, pair_radius(scene) / scale) / (8 * math.pi * viscosity)
    i = np.arange(len(x))
    found[i, :, i, :] = blocks
    return found.reshape(3 * len(x), 3 * len(x))


def resistance(x: np.ndarray, length: float, radius: float, viscosity: float, mode: str) -> np.ndarray:
    """Drag A, thrust B and torque D of a rigid helix about z: F = A U + B W, T = B U + D W."""
    h = length / (len(x) - 1)
    chords = np.diff(x, axis=0)
    around = math.hypot(x[0, 0], x[0, 1])
    turns = abs(x[-1, 2] - x[0, 2]) / max(2 * math.pi * around * abs(chords[0, 2]) / math.hypot(*chords[0, :2]), 1e-12)
    t = np.gradient(x, axis=0)
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    dense = mobility(x, t, h, radius, viscosity, mode, 0.5, length / turns)
    motion = np.stack([np.tile([0.0, 0.0, 1.0], (len(x), 1)), np.cross([0.0, 0.0, 1.0], x)], axis=2).reshape(-1, 2)
    found = motion.T @ np.linalg.solve(dense, motion)
    return np.array([found[0, 0], abs(found[0, 1]), found[1, 1]])


def rod_drag(length: float, h: float, radius: float, viscosity: float) -> tuple[float, float]:
    """Drag of a straight rod along and across."""
    count = round(length / h)
    x = np.outer((np.arange(count) + 0.5) * h, [0.0, 0.0, 1.0])
    dense = mobility(x, np.tile([0.0, 0.0, 1.0], (count, 1)), h, radius, viscosity, "consistent", 1.0)
    found = np.linalg.inv(dense).reshape(count, 3, count, 3).sum(axis=(0, 2))
    return float(found[2, 2]), float(found[0, 0])


def ring_drag(radius: float, h: float, thickness: float, viscosity: float) -> float:
    """Drag of a ring that moves along its axis."""
    count = round(2 * math.pi * radius / h)
    angle = np.arange(count) * 2 * math.pi / count
    x = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    t = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    dense = mobility(x, t, 2 * math.pi * radius / count, thickness, viscosity, "consistent", 1.0)
    return float(np.linalg.inv(dense).reshape(count, 3, count, 3).sum(axis=(0, 2))[2, 2])


def two_rods(length: float, h: float, radius: float, viscosity: float, apart: float) -> float:
    """Speed of two parallel rods that sink along themselves, side by side, over that of one alone."""
    count = round(length / h)
    x = np.outer((np.arange(count) + 0.5) * h, [0.0, 0.0, 1.0])
    both = np.vstack([x, x + np.array([apart, 0.0, 0.0])])
    t = np.tile([0.0, 0.0, 1.0], (2 * count, 1))
    force = np.tile([0.0, 0.0, h], 2 * count)
    pair = mobility(both, t, h, radius, viscosity, "consistent", 1.0) @ force
    one = mobility(x, t[:count], h, radius, viscosity, "consistent", 1.0) @ force[: 3 * count]
    return float(pair.reshape(-1, 3)[:count, 2].mean() / one.reshape(-1, 3)[:, 2].mean())
