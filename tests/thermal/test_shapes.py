"""Shapes in thermal equilibrium beside exact means: bends of a straight rod, its tip, contact of two, and a body's
diffusion. Seeds are fixed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from tests.oracles import segment_distances, steric_potential
from tests.thermal.test_equilibrium import ERRORS, KT, ensemble

STRAIGHT = {
    "flagella.intrinsic_curvature": (0.0, 0.0, 0.0),
    "flagella.opening_angle": 0.0,
    "motor.axis_angle": 0.0,
    "flagella.count": 1,
    "hydrodynamics.mode": "none",
    "numerics.time_step": 1e-5,
}
HELD = {"body.anchored": True, "hook.stiffness": 4.0}
LOCKED = {"motor.law": "rate", "motor.rate": 0.0}


def told(values: np.ndarray) -> tuple[Any, Any]:
    """Mean over the cells, the first axis, and its standard error."""
    return values.mean(axis=0), values.std(axis=0, ddof=1) / len(values) ** 0.5


@pytest.mark.parametrize(
    ("length", "start", "own_precision"), [(1.2, 3e-4, "float64"), (1.2, 3e-4, "float32"), (6.0, 5e-3, "float64")]
)
def test_bends_of_a_straight_rod(length, start, own_precision, device):
    """1 - <t.t'> is 2.366e-4, a persistence length of 845 um. A linear step alone would leave 4 % less at 6 um, where
    the slowest bend takes 2 ms."""
    sim, _ = ensemble({**STRAIGHT, "body.enabled": False, "flagella.length": length}, own_precision, 64, device)
    sim.advance(start)
    bends = []
    for i in range(40):
        sim.advance(start + 2e-5 * (i + 1))
        t = np.diff(sim.cells().positions.reshape(64, -1, 3), axis=1)
        t /= np.linalg.norm(t, axis=2, keepdims=True)
        bends.append(1 - np.sum(t[:, 1:] * t[:, :-1], axis=2).mean(axis=1))
    value, error = told(np.mean(bends, axis=0))
    assert error < 0.02 * value
    assert abs(value - (1 - 0.9997634)) < ERRORS * error


def test_tip_of_a_rod_on_a_hook(device):
    """Joints stand at h, 2 h, ... from the hook, L - i h of rod beyond each; the hook has the whole length."""
    sim, _ = ensemble({**STRAIGHT, **HELD, **LOCKED}, "float64", 64, device)
    sim.advance(1e-3)
    tips = []
    for i in range(60):
        sim.advance(1e-3 + 5e-5 * (i + 1))
        tips.append(sim.cells().positions.reshape(64, -1, 3)[:, -1, :2])
    value, error = told(((np.array(tips) - np.mean(tips, axis=(0, 1))) ** 2).mean(axis=(0, 2)))
    beyond = 1.2 - 0.2 * np.arange(1, 6)
    exact = KT * (np.sum(beyond**2) * 0.2 / 3.5 + 1.2**2 / 4.0)
    assert error < 0.06 * exact
    assert abs(value - exact) < ERRORS * error


def test_a_body_diffuses_by_its_drags(device):
    """A filament's stub with a hundredth of its drag alone on a body: along and across it, about it and across."""
    light = {"fluid.drag_parallel": 1.6e-5, "fluid.drag_perpendicular": 2.8e-5, "fluid.drag_rotation": 1.26e-8}
    stub = {"flagella.length": 0.1, "flagella.segment_length": 0.05, "hook.stiffness": 100.0}
    values = {**STRAIGHT, **LOCKED, **light, **stub, "numerics.time_step": 1e-4}
    sim, _ = ensemble(values, "float64", 200, device)
    places, axes, sides = [], [], []
    for i in range(13):
        sim.advance(1e-3 * i)
        cells = sim.cells()
        q = cells.body_orientation
        for found, v in ((axes, [0.0, 0.0, 1.0]), (sides, [1.0, 0.0, 0.0])):
            twice = 2 * np.cross(q[:, :3], v)
            found.append(v + q[:, 3:] * twice + np.cross(q[:, :3], twice))
        places.append(cells.body_position.copy())
    places, axes, sides = np.diff(places, axis=0), np.array(axes), np.array(sides)
    along = np.sum(places * axes[:-1], axis=2)
    turned = np.sum(sides[1:] * np.cross(axes[:-1], sides[:-1]), axis=2)
    squares = [
        along**2,
        ((places**2).sum(axis=2) - along**2) / 2,
        turned**2,
        (np.diff(axes, axis=0) ** 2).sum(axis=2) / 2,
    ]
    for square, exact in zip(squares, (0.3844, 0.3104, 1.108, 0.3348), strict=True):
        value, error = told(square.mean(axis=0) / 2e-3)
        assert error < 0.05 * exact
        assert abs(value - exact) < ERRORS * error + 0.005 * exact


def sampled_contact(count: int, apart: float) -> tuple[float, np.ndarray]:
    """Mean contact energy [kT] of two rods of three segments on hooks, and shares of least distances below
    0.0405 um; by sampling their joints, which are independent, and the Boltzmann factor of the contact."""
    random = np.random.default_rng(0)

    def turned(t: np.ndarray, stiffness: float) -> np.ndarray:
        """About t with the energy 2 k tan^2(beta/2), so nearly a square that the sphere does not matter."""
        angle = math.sqrt(KT / stiffness) * random.standard_normal(t.shape)
        u = t + angle - np.sum(angle * t, axis=1, keepdims=True) * t
        return u / np.linalg.norm(u, axis=1, keepdims=True)

    rods = []
    for x in (0.0, apart):
        t, nodes = np.tile([0.0, 0.0, 1.0], (count, 1)), [np.tile([x, 0.0, 0.0], (count, 1))]
        for i in range(3):
            t = turned(t, 4.0 if i == 0 else 3.5 / 0.2)
            nodes.append(nodes[-1] + 0.2 * t)
        rods.append(np.stack(nodes, axis=1))
    return weighed(*rods, boltzmann=True)


def weighed(a: np.ndarray, b: np.ndarray, boltzmann: bool) -> Any:
    """Contact energies [kT] and least distances of rods a and b [um], per sample, or their Boltzmann means."""
    distances = np.array(
        [segment_distances(x[:-1], np.diff(x, axis=0), y[:-1], np.diff(y, axis=0)) for x, y in zip(a, b, strict=True)]
    )
    energy = steric_potential(distances, 0.8, 0.04).sum(axis=(1, 2)) / KT
    near = distances.min(axis=(1, 2)) < 0.0405
    if not boltzmann:
        return energy, near
    weight = np.exp(-energy)
    return np.sum(weight * energy) / np.sum(weight), np.sum(weight * near) / np.sum(weight)


@pytest.mark.parametrize("mode", ["none", "all"])
def test_contact_has_its_boltzmann_factor(mode, device):
    apart = 0.042
    beside = {"flagella.count": 2, "flagellum.0.azimuth": 0.0, "flagella.length": 0.6, "steric.enabled": True}
    beside["flagellum.1.azimuth"] = 2 * math.degrees(math.asin(apart / 0.8))
    values = {**STRAIGHT, **HELD, **beside, "hydrodynamics.mode": mode, "numerics.time_step": 1e-6}
    sim, _ = ensemble(values, "float64", 64, device)
    sim.advance(2e-4)
    energies, shares = [], []
    for i in range(60):
        sim.advance(2e-4 + 5e-6 * (i + 1))
        x = sim.cells().positions.reshape(64, 2, 4, 3)
        energy, near = weighed(x[:, 0], x[:, 1], boltzmann=False)
        energies.append(energy)
        shares.append(near)
    exact = sampled_contact(6000, apart)
    for found, known in zip((energies, shares), exact, strict=True):
        value, error = told(np.mean(np.array(found, float), axis=0))
        assert error < 0.2 * known
        assert abs(value - known) < ERRORS * error
