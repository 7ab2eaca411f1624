"""Flagella wrapped round a body, on helices that are put together by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import rotation
from tests.shapes import helix, joined, line
from warpflag.observables.behaviour import wrapping

TURN, PLACE = rotation([0.7, -1.1, 0.4]), np.array([30.0, -8.0, 2.0])
BODY = {"length": 2.5, "width": 0.6}


def found(*flagella, **options):
    """Of flagella given in the body's axes, on a body somewhere in the lab."""
    positions, first_node = joined(*flagella)
    return wrapping((positions @ TURN.T + PLACE)[None], first_node, PLACE[None], TURN[:, 2][None], **BODY, **options)


def coil(handedness=-1, pitch=1.0, radius=0.45, h=0.05, begin=-1.2):
    """A coil round the body from z = -1.2 to 2.2, or elsewhere."""
    contour = 3.4 * np.hypot(2 * np.pi * radius, pitch) / pitch
    nodes = helix(round(contour / h), radius=radius, pitch=pitch, h=h, handedness=handedness)[0]
    return nodes + np.array([0.0, 0.0, begin])


def test_turns_and_their_hand_do_not_depend_on_where_the_flagellum_begins():
    """From z = -1.2 to the other pole, at 1.25, there are 2.45 turns, and 72 % of a coil of 3.4 um."""
    left, right = coil(-1), coil(1)
    wrapped = found(left, right, left[::-1])
    assert wrapped.turns[0] == pytest.approx([-2.45, 2.45, -2.45], abs=0.04)
    assert wrapped.share[0] == pytest.approx([2.45 / 3.4] * 3, abs=0.01)
    assert wrapped.wrapped.all()


def test_what_is_behind_the_body_or_goes_along_one_side_is_not_wrapped():
    behind = coil(begin=2.8)
    along = line(12, x=0.5, h=0.2) - [0.0, 0.0, 1.1]
    far = coil(radius=0.9)
    wrapped = found(behind, along, far)
    assert wrapped.share[0] == pytest.approx([0.0, 1.0, 0.0])
    assert np.abs(wrapped.turns).max() < 1e-9
    assert not wrapped.wrapped.any()
    assert found(far, distance=0.7).wrapped.all()


def test_frames_and_flagella_are_told_apart():
    one, two = coil(), coil(begin=1.3)
    positions, first_node = joined(one, two)
    frames = np.stack([positions, positions + np.array([0.0, 0.0, 9.0])])
    wrapped = wrapping(frames, first_node, np.zeros((2, 3)), [[0.0, 0.0, 1.0]] * 2, **BODY)
    assert wrapped.wrapped.tolist() == [[True, False], [False, False]]
