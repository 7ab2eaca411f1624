"""Speeds and rates of constructed paths, of which only a part or a mean counts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.shapes import helix
from warpflag import observables
from warpflag.base import rotations


def test_helix_rate_is_that_of_the_outer_two_thirds():
    """The inner third, near the hook, stands still."""
    frames = []
    for k in range(12):
        inner, outer = (np.diff(helix(61, phase=phase)[0], axis=0) for phase in (0.0, np.radians(40.0 * k)))
        edges = np.concatenate([inner[:20], outer[20:]])
        frames.append(np.concatenate([np.zeros((1, 3)), np.cumsum(edges, axis=0)]))
    rates = observables.helix_rate(1e-3 * np.arange(12), np.array(frames), np.array([0, 61]))
    np.testing.assert_allclose(rates, 40.0 / 360.0 / 1e-3, rtol=1e-6)


def test_speed_along_the_axis_of_a_body_that_swims_in_a_circle():
    """From frame to frame it moves along the mean of its axes, 0.4 rad apart."""
    turned = 0.4 * np.arange(6)
    places = 5.0 * np.stack([np.cos(turned), np.sin(turned), 0 * turned], axis=1)
    rearward = rotations.product(
        np.stack([0 * turned, 0 * turned, np.sin(turned / 2), np.cos(turned / 2)], axis=1),
        np.array([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]),  # e_b3 against y
    )
    speed = observables.body_speed(0.1 * np.arange(6), places, rearward)
    assert speed == pytest.approx(2 * 5.0 * math.sin(0.2) / 0.1)
