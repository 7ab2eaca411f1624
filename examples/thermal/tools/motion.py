"""Drift of what has none; diffusion of a helix, of a body, of a swimmer."""

from __future__ import annotations

import math

import numpy as np

from warpflag import Simulation

from . import exact
from .ensembles import FREE, KT, LOCKED, ensemble, looks, mean, shown
from .joints import FLOW, HOOKED


def drift(share: float) -> None:
    """Mean velocity of a passive helix along its own axis [um/s], exactly zero."""
    print("\n| cell | step [s] | drift [µm/s] |\n|---|---|---|")
    cases = (
        ("free, 6 µm", FREE, 1e-5, 1000),
        ("free, 6 µm", FREE, 1e-6, 2500),
        ("on a body, 6 µm", {}, 1e-5, 4500),
        ("on a body, 6 µm", {}, 1e-6, 2500),
        ("on a body with its flow and a hook, 6 µm", {**FLOW, **HOOKED}, 1e-5, 1600),
    )
    for row, (name, values, step, steps) in enumerate(cases, 1):
        _, sim = ensemble({**values, "numerics.time_step": step}, 64, True, 64 * row)
        way, before = np.zeros(64), None
        count = max(20, int(share * steps))
        for cells in looks(sim, 2e-4, step, count):
            x = cells.positions.reshape(64, 31, 3)
            axis = x[:, -1] - x[:, 1]
            axis /= np.linalg.norm(axis, axis=1, keepdims=True)
            now = (x[:, 1:].mean(axis=1), axis)
            if before is not None:
                way += np.sum((now[0] - before[0]) * (now[1] + before[1]) / 2, axis=1)
            before = now
        print(f"| {name} | {step:g} | {shown(*mean(way / (count * step)))} |", flush=True)


def fitted(x: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Rotations that take a reference shape onto shapes x [cells, nodes, 3], by Kabsch's method."""
    centred = x - x.mean(axis=1, keepdims=True)
    u, _, v = np.linalg.svd(np.einsum("ni,bnj->bij", reference, centred))
    sign = np.linalg.det(u @ v)
    flip = np.zeros((len(x), 3, 3))
    flip[:, 0, 0] = flip[:, 1, 1] = 1.0
    flip[:, 2, 2] = sign
    return np.swapaxes(u @ flip @ v, 1, 2)


def rates(middles: np.ndarray, axes: np.ndarray, sides: np.ndarray, lags: tuple[int, int], interval: float) -> list:
    """Diffusion along and across an axis, about and across it, from mean squares at two lags; per cell.

    Args:
        middles, axes, sides: points, their body's axis and a vector across it, shape [looks, cells, 3].
        lags: in intervals [s]; the first may be 0.
    """
    squares = []
    for lag in lags:
        if lag == 0:
            squares.append(np.zeros((4, middles.shape[1])))
            continue
        moved = middles[lag:] - middles[:-lag]
        along = np.sum(moved * axes[:-lag], axis=2)
        tilt = axes[lag:] - axes[:-lag]
        # Spin: of the side vector about the axis, both carried back onto the old axis.
        third = np.cross(axes[:-lag], sides[:-lag])
        angle = np.arctan2(np.sum(sides[lag:] * third, axis=2), np.sum(sides[lag:] * sides[:-lag], axis=2))
        squares.append(
            np.stack(
                [
                    (along**2).mean(axis=0) / 2,
                    ((moved**2).sum(axis=2) - along**2).mean(axis=0) / 4,
                    (angle**2).mean(axis=0) / 2,
                    (tilt**2).sum(axis=2).mean(axis=0) / 4,
                ]
            )
        )
    return list((squares[1] - squares[0]) / ((lags[1] - lags[0]) * interval))


NAMES = ("along [µm²/s]", "across [µm²/s]", "spin [rad²/s]", "tumble [rad²/s]")


def diffusion(share: float) -> None:
    """A free helix of 6 um: mean square displacements in its own axes, between lags of 0.5 and 1.5 ms."""
    _, sim = ensemble({**FREE, "numerics.time_step": 1e-5}, 96)
    interval, count = 5e-4, max(16, int(share * 160))
    shapes = np.array([c.positions.reshape(96, 31, 3) for c in looks(sim, 2e-3, interval, count)])
    reference = Simulation(sim.scenes[0], device="cpu").state.positions
    second = reference[1:-3] + reference[3:-1] - 2 * reference[2:-2]
    axis = np.cross(second[0], second[1])
    axis /= np.linalg.norm(axis)
    reference = reference - reference.mean(axis=0)
    across = np.cross(axis, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    turns = np.array([fitted(x, reference) for x in shapes])
    print("\n| free helix, 6 µm | exact, rigid | simulated |\n|---|---|---|")
    found = rates(shapes.mean(axis=2), turns @ axis, turns @ across, (1, 3), interval)
    for name, known, value in zip(NAMES, (0.689, 0.446, 7.56, 0.168), found, strict=True):
        print(f"| {name} | {known} | {shown(*mean(value))} |", flush=True)


def turned(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """v, turned by unit quaternions (x, y, z, w), shape [..., 3]."""
    twice = 2 * np.cross(q[..., :3], v)
    return v + q[..., 3:] * twice + np.cross(q[..., :3], twice)


def body(share: float) -> None:
    """The body alone: with a stub of a filament whose drag is a three-hundredth of its own."""
    values = {
        "flagella.length": 0.1,
        "flagella.segment_length": 0.05,
        "hydrodynamics.mode": "none",
        "fluid.drag_parallel": 1.6e-5,
        "fluid.drag_perpendicular": 2.8e-5,
        "fluid.drag_rotation": 1.26e-8,
        "hook.stiffness": 100.0,
        "numerics.time_step": 1e-4,
        **LOCKED,
    }
    count, interval = 256, 1e-3
    _, sim = ensemble(values, count)
    found = [
        (c.body_position.copy(), c.body_orientation.copy())
        for c in looks(sim, 0.0, interval, max(30, int(120 * share)))
    ]
    place, turn = (np.array(x) for x in zip(*found, strict=True))
    axes, sides = turned(turn, np.array([0.0, 0.0, 1.0])), turned(turn, np.array([1.0, 0.0, 0.0]))
    print("\n| body alone | exact | simulated |\n|---|---|---|")
    for name, known, value in zip(
        NAMES, (0.3844, 0.3104, 1.108, 0.3348), rates(place, axes, sides, (0, 1), interval), strict=True
    ):
        print(f"| {name} | {known} | {shown(*mean(value))} |", flush=True)


def swimmer(share: float) -> None:
    """A whole cell at rest, two flagella of 6 um 0.05 um apart at its pole: how its body's axis tumbles."""
    cap = 0.85 + math.sqrt(0.4**2 - 0.025**2)
    values = {
        "flagella.count": 2,
        "flagella.anchor_offset": cap,
        "flagella.opening_angle": 0.0,
        "motor.axis_angle": 0.0,
        "flagella.on_axis": True,
        "flagella.phase_difference": 0.0,
        "hook.stiffness": 100.0,
        "numerics.time_step": 5e-5,
        **LOCKED,
    }
    count, interval = 64, 0.02
    scene, sim = ensemble(values, count)
    rest = Simulation(scene, device="cpu").state
    nodes = [x - rest.body_position for x in np.split(rest.positions, 2)]
    known = exact.rigid(scene, nodes, np.zeros(3))
    found = [c.body_orientation.copy() for c in looks(sim, 0.05, interval, max(12, int(60 * share)))]
    axes = turned(np.array(found), np.array([0.0, 0.0, 1.0]))
    squares = [((axes[lag:] - axes[:-lag]) ** 2).sum(axis=2).mean(axis=0) / 4 for lag in (1, 3)]
    value = mean((squares[1] - squares[0]) / (2 * interval))
    tumble = np.mean(np.linalg.eigvalsh(known[3:, 3:])[:2])
    print(f"\nswimmer, two flagella of 6 µm: tumble {shown(*value)} rad²/s, rigid {tumble:.4f}; kT {KT:.4g} pN µm")
