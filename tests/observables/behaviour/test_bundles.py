"""Bundles, their members and axes, on flagella that are put together by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import rotation
from tests.shapes import bent_helix, helix, joined, line
from warpflag.observables.behaviour import bundle_axes, bundle_counts, bundle_membership


def cell(*columns, turn=(0.2, 0.4, -0.3)):
    """Straight flagella at the given x [um], turned and moved as a whole."""
    positions, first_node = joined(*(line(31, x=x) for x in columns))
    return positions @ rotation(turn).T + [40.0, -7.0, 3.0], first_node


def test_members_of_two_bundles_and_one_alone():
    positions, first_node = cell(0.0, 5.0, 0.4, 10.0, 0.8, 5.3)  # 0-2-4 in a chain, of which 0 and 4 are apart
    found = bundle_membership(positions[None], first_node)
    assert found.tolist() == [[0, 1, 0, -1, 0, 1]]
    assert bundle_counts(found).tolist() == [2]
    assert bundle_membership(positions[None], first_node, distance=0.35).tolist() == [[-1, 1, -1, -1, -1, 1]]


def test_membership_over_time():
    """A flagellum goes from one bundle to the other, by way of none."""
    frames = [cell(0.0, 0.3, 3.0, 3.3, x)[0] for x in (0.6, 1.6, 2.7)]
    first_node = cell(0.0, 0.3, 3.0, 3.3, 0.6)[1]
    found = bundle_membership(np.array(frames), first_node)
    assert found.tolist() == [[0, 0, 2, 2, 0], [0, 0, 2, 2, -1], [0, 0, 2, 2, 2]]
    assert bundle_counts(found).tolist() == [2, 2, 2]
    every_other = bundle_membership(np.array(frames)[::2], first_node)
    assert every_other.tolist() == found[::2].tolist()


def test_a_crossing_and_a_shared_quarter_make_no_bundle_but_two_fifths_do():
    first_node = np.array([0, 31, 62])
    crossing = np.concatenate([line(31), line(31, x=-3.0, y=0.1, tilt=1.0)])
    assert bundle_membership(crossing[None], first_node).tolist() == [[-1, -1]]
    for shared, expected in ((7, [-1, -1]), (12, [0, 0])):
        one, two = line(31), line(31, x=0.3)
        two[: 31 - shared, 0] = 2.0
        assert bundle_membership(np.concatenate([one, two])[None], first_node).tolist() == [expected]


def test_a_short_flagellum_along_a_long_one_is_of_its_bundle():
    positions, first_node = joined(line(61), line(11, x=0.2))
    assert bundle_membership(positions[None], first_node).tolist() == [[0, 0]]


def test_one_flagellum_is_alone():
    assert bundle_membership(line(31)[None], [0, 31]).tolist() == [[-1]]
    assert bundle_counts(np.array([[-1]])).tolist() == [0]


def test_axis_of_a_bundle_of_helices():
    turn = rotation([0.5, -0.2, 0.1])
    positions, first_node = joined(helix(31)[0], helix(31, axis_offset=(0.3, 0, 0))[0], bent_helix(31, bend=5.0))
    axes = bundle_axes(np.array([positions, positions @ turn.T]), first_node, members=[0, 1])
    np.testing.assert_allclose(axes, [[0, 0, 1], turn @ [0, 0, 1]], atol=1e-9)
    # The axes of whole turns of the outer two thirds, 20 segments, lie from 7.5 to 22.5 segments on an arc.
    bent = bundle_axes(positions[None], first_node, members=[2])[0]
    along = 0.2 * 0.838 * 20.0 / 5.0  # rad at the middle of the outer two thirds
    assert np.degrees(np.arccos(bent @ [np.sin(along), 0, np.cos(along)])) == pytest.approx(0.0, abs=2.0)
