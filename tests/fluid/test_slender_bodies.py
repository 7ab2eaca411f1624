"""examples/hydrodynamics: rods, ring and helices in mode consistent, far field of a swimmer, positive eigenvalues."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "hydrodynamics" / "tools"))
import cells  # type: ignore[import-not-found]
import helices  # type: ignore[import-not-found]

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


def test_a_swimmer_is_a_force_dipole_far_away():
    near, far = cells.far_field(np.array([200.0, 2000.0]))
    assert near / far == pytest.approx(100.0, rel=0.02)


@pytest.mark.parametrize("kind", cells.KINDS)
def test_eigenvalues_are_positive(kind):
    for mode in ("all", "consistent"):
        assert min(cells.smallest(mode, kind, seed, beads=30) for seed in range(3)) > 0.0
