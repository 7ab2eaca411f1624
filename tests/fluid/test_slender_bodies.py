"""Rods, ring and helices in mode consistent beside theory, far field of a swimmer, positive eigenvalues.

Tolerances: 1 % of slender-body values in both precisions, 3 % of Johnson's helices.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "hydrodynamics" / "tools"))
import cells  # type: ignore[import-not-found]
import helices  # type: ignore[import-not-found]

from warpflag import Simulation, paper_scene, with_values

ETA = 1e-3


@pytest.mark.parametrize("segments", [39, 160])
def test_helix_has_the_drag_of_slender_body_theory(segments):
    """Johnson's drag, thrust and torque within 3 %, from 23 to 6 radii per segment."""
    nodes, length = helices.nodes(1.0, 10.2, 30.9, segments)
    found = helices.resistance(nodes, length, 0.04, 1.0, "consistent")
    assert found == pytest.approx([41.58, 11.93, 87.77], rel=0.03)


def test_rod_and_ring_have_the_drag_of_slender_bodies():
    """2 pi eta L/(ln(2 L/a) - 3/2) along, 4 pi eta L/(ln(2 L/a) - 1/2) across; ring 8 pi^2 eta R/(ln(8 R/a) + 1/2)."""
    log = math.log(2 * 10.0 / 0.01)
    exact = 2 * math.pi * ETA * 10.0 / (log - 1.5), 4 * math.pi * ETA * 10.0 / (log - 0.5)
    assert helices.rod_drag(10.0, 0.2, 0.01, ETA) == pytest.approx(exact, rel=0.01)
    ring = 8 * math.pi**2 * ETA / (math.log(8 / 0.01) + 0.5)
    assert helices.ring_drag(1.0, 0.2, 0.01, ETA) == pytest.approx(ring, rel=0.01)
    assert helices.two_rods(6.0, 0.2, 0.01, ETA, 0.5) > helices.two_rods(6.0, 0.2, 0.01, ETA, 2.0) > 1.0


def middle_velocity(count: int, force: list[float], precision: str) -> np.ndarray:
    """Velocity of the middle node of the first of straight rods of 8 um, 1.6 um apart, all pulled alike [um/s]."""
    straight = {"flagella.intrinsic_curvature": [0, 0, 0], "flagella.length": 8.0, "flagella.opening_angle": 0.0}
    side_by_side = {"flagella.count": count, "flagella.anchor_offset": 0.0, "body.width": 1.6, "body.contact": False}
    pulled = {"motor.torque": 0.0, "external.force_per_length": force, "numerics.precision": precision}
    scene = with_values(paper_scene("rods"), straight | side_by_side | pulled | {"hydrodynamics.mode": "consistent"})
    return Simulation(scene, device="cpu").evaluate().velocities[20]


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("along", range(3))
def test_a_rod_is_carried_by_one_beside_it(along, precision):
    """The flow of a line of Stokeslets of length L = 2 s at the distance d of its middle, with S = asinh(s/d).

    f/(8 pi eta) times 2 S + 2 s/(s^2 + d^2)^(1/2) towards it, 2 S across, 4 S - 2 s/(s^2 + d^2)^(1/2) along.
    """
    force = [0.5 * (axis == along) for axis in range(3)]
    half, d = 4.0, 1.6
    log, end = 2 * math.asinh(half / d), 2 * half / math.hypot(half, d)
    exact = 0.5 / (8 * math.pi * ETA) * (log + end, log, 2 * log - end)[along]
    carried = middle_velocity(2, force, precision) - middle_velocity(1, force, precision)
    assert carried[along] == pytest.approx(exact, rel=0.01)


def test_a_swimmer_is_a_force_dipole_far_away():
    near, far = cells.far_field(np.array([200.0, 2000.0]))
    assert near / far == pytest.approx(100.0, rel=0.02)


@pytest.mark.parametrize("kind", cells.KINDS)
def test_eigenvalues_are_positive(kind):
    for mode in ("all", "consistent"):
        assert min(cells.smallest(mode, kind, seed, beads=30) for seed in range(3)) > 0.0
