"""What movies colour nodes by: known values, and agreement with what a run records."""

from __future__ import annotations

import numpy as np
import pytest

from tests.contacts import steric_force
from tests.films import THREE, made_record
from tests.oracles import segment_distances
from tests.runs import executed, small
from warpflag.model.geometry import ground_state
from warpflag.observables import local_phase_difference, phase_difference, segment_tangents
from warpflag.record import Record
from warpflag.view.coloring import FLAGELLUM_COLORS, FORM_COLORS, Coloring, linear
from warpflag.view.node_quantities import contact_load, curvature, nearest_phase_difference

STRENGTH, DIAMETER = 0.8, 0.04


def rods(*flagella) -> tuple[np.ndarray, np.ndarray]:
    """One frame of these nodes, and first_node."""
    return np.concatenate(flagella)[None].astype(float), np.cumsum([0, *map(len, flagella)])


def crossed(distance: float, *, place: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    """A rod of two segments along x, and one across it at `distance` above a point of its first segment."""
    first = [[0, 0, 0], [0.2, 0, 0], [0.4, 0, 0]]
    second = [[0.2 * place, -0.15, distance], [0.2 * place, 0.05, distance], [0.2 * place, 0.25, distance]]
    return rods(first, second)


@pytest.mark.parametrize(
    "ratio, force",
    [(1.0, 1.0), (1.05, 2 * 1.05**-13 - 1.05**-7), (2 ** (1 / 6) + 1e-9, 0.0), (0.7, 2 * 0.7**-13 - 0.7**-7)],
)
def test_load_is_the_paper_s_force(ratio, force):
    positions, first_node = crossed(ratio * DIAMETER, place=0.25)
    load = contact_load(positions, first_node, STRENGTH, DIAMETER)[0]
    # At a quarter of one segment, at three quarters of the other.
    expected = STRENGTH * force * np.array([0.75, 0.25, 0.0, 0.25, 0.75, 0.0])
    np.testing.assert_allclose(load, expected, rtol=1e-9, atol=1e-12)


def test_load_goes_on_along_the_tangent_below_seven_tenths():
    loads = [contact_load(*crossed(x * DIAMETER), STRENGTH, DIAMETER).sum() for x in (0.7, 0.69, 0.3, 0.2)]
    slope = (loads[1] - loads[0]) / 0.01
    assert slope == pytest.approx((loads[3] - loads[2]) / 0.1)
    assert slope / 2 == pytest.approx(STRENGTH * (26 * 0.7**-14 - 7 * 0.7**-8))


def test_load_of_many_contacts_is_the_sum_over_all_pairs():
    rng = np.random.default_rng(3)
    flagella = [np.cumsum(0.1 * rng.standard_normal((n, 3)), axis=0) * 0.4 for n in (12, 5, 9, 12)]
    first, first_node = rods(*flagella)
    positions = np.concatenate([first, first + 0.01 * rng.standard_normal(first.shape), 5.0 - first])
    together = contact_load(positions, first_node, STRENGTH, DIAMETER)
    assert (together > 0.0).sum() > 20
    for frame in range(3):
        pairwise = np.zeros(first_node[-1])
        for a in range(4):
            for b in range(a):
                # Every pair of segments by itself, as a record of two flagella of one segment.
                for i in range(first_node[a] + 1, first_node[a + 1]):
                    for j in range(first_node[b] + 1, first_node[b + 1]):
                        two = positions[frame, [i - 1, i, j - 1, j]][None]
                        pairwise[[i - 1, i, j - 1, j]] += contact_load(two, np.array([0, 2, 4]), STRENGTH, DIAMETER)[0]
        np.testing.assert_allclose(together[frame], pairwise, rtol=1e-9, atol=1e-12)


def test_no_contact_of_a_crowd_is_left_out():
    """Short rods in a box many times as wide as the distance in which contacts are looked for."""
    rng = np.random.default_rng(4)
    starts = rng.uniform(0.0, 0.6, (400, 3))
    vectors = rng.uniform(-0.01, 0.01, (400, 3))
    positions = np.stack([starts, starts + vectors], axis=1).reshape(1, -1, 3)
    distances = segment_distances(starts, vectors, starts, vectors)
    forces = steric_force(distances, STRENGTH)[np.triu_indices(400, 1)]
    assert (forces > 0.0).sum() > 100
    load = contact_load(positions, 2 * np.arange(401), STRENGTH, DIAMETER)
    assert 0.5 * load.sum() == pytest.approx(forces.sum(), rel=1e-9)


def test_a_flagellum_does_not_touch_itself():
    positions, _ = crossed(0.5 * DIAMETER)
    assert contact_load(positions, np.array([0, 6]), STRENGTH, DIAMETER).sum() == 0.0


def test_loads_add_up_to_the_recorded_force(tmp_path):
    # Two flagella side by side, so near that they touch all along.
    apart = 2 * np.degrees(np.arcsin(0.041 / 0.8))
    scene = small(
        {
            "flagella.opening_angle": 0.0,
            "flagellum.0.azimuth": 0.0,
            "flagellum.1.azimuth": apart,
            "frames": 2,
            "duration": 2e-5,
        }
    )
    with Record(executed(scene, tmp_path / "run")) as record:
        load = contact_load(record.positions[:], record.first_node, STRENGTH, DIAMETER)
        recorded = record.observables["steric_force_density"] * scene.flagella.length
        assert recorded.min() > 0.1
        np.testing.assert_allclose(0.5 * load.sum(axis=1), recorded, rtol=1e-6)
        theta = nearest_phase_difference(record.positions[:], record.directors[:], record.first_node)
        mean = theta.reshape(3, 2, -1)[:, :, 1:].mean(axis=(1, 2))
        np.testing.assert_allclose(mean, record.observables["phase_difference"], atol=1e-12)


def test_curvature_of_a_circle_and_of_the_ground_state():
    angle = np.linspace(0.0, 2.0, 21)
    circle, first_node = rods(
        3.0 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1), np.eye(3)[[0, 1, 1]] * 9
    )
    values = curvature(circle[:, :21], first_node[:2])
    np.testing.assert_allclose(values, 1 / 3.0, rtol=2e-3)
    np.testing.assert_allclose(values, values[0, 0], rtol=1e-12)
    # Every joint of the ground state: |kb| = h |(Omega_1, Omega_2)| / cos(h Omega_3 / 2).
    helix = ground_state((0.0, 1.3, -2.1), 0.2)
    turn = helix.angle * np.arange(15)
    nodes = np.stack([helix.radius * np.cos(turn), helix.radius * np.sin(turn), helix.rise * np.arange(15)], axis=1)
    np.testing.assert_allclose(curvature(nodes[None], np.array([0, 15])), 1.3 / np.cos(0.21), rtol=1e-9)


def test_curvature_at_a_joint_of_unequal_segments():
    """2 tan(angle/2), 2 at a right angle, over the mean length; the ends take their neighbour's."""
    bent, first_node = rods([[0, 0, 0], [0.1, 0, 0], [0.1, 0.3, 0], [0.1, 0.3, 0.5]])
    np.testing.assert_allclose(curvature(bent, first_node), [[2 / 0.2, 2 / 0.2, 2 / 0.4, 2 / 0.4]], rtol=1e-12)


def test_phase_difference_is_with_the_nearest_flagellum(tmp_path):
    with made_record(tmp_path, 1) as record:  # flagella of 30, 20 and 30 segments
        positions, directors, first_node = record.positions[:], record.directors[:], record.first_node
    # Bring the third beside the first: the second is far away then.
    positions[0, 52:] = positions[0, :31] + [0.0, 0.1, 0.0]
    theta = nearest_phase_difference(positions, directors, first_node)[0]
    pair = np.r_[0:31, 52:83]
    alone = nearest_phase_difference(positions[:, pair], directors[:, pair], np.array([0, 31, 62]))[0]
    np.testing.assert_array_equal(theta[pair], alone)
    assert alone[1:31].mean() == pytest.approx(
        phase_difference(positions[0, pair], directors[0, pair], np.array([0, 31, 62]))
    )
    # The second one's partner is whichever is nearer, segment by segment.
    tangents = [segment_tangents(positions[0, a:b]) for a, b in ((0, 31), (31, 52), (52, 83))]
    candidates = [
        local_phase_difference(directors[0, 32:52], tangents[1], directors[0, a + 1 : a + 21], tangents[k][:20])
        for k, a in ((0, 0), (2, 52))
    ]
    distance = [np.linalg.norm(positions[0, 32:52] - positions[0, a + 1 : a + 21], axis=1) for a in (0, 52)]
    np.testing.assert_allclose(theta[32:52], np.where(distance[0] < distance[1], *candidates))
    assert theta[31] == theta[32]


def test_phase_difference_is_undefined_without_a_partner():
    positions, _ = crossed(0.1)
    longer = np.concatenate([positions, positions[:, -1:] + 0.2], axis=1)
    directors = np.broadcast_to([0.0, 0.0, 1.0], longer.shape)
    theta = nearest_phase_difference(longer, directors, np.array([0, 3, 7]))
    assert np.isfinite(theta[0, :6]).all() and np.isnan(theta[0, 6])
    assert np.isnan(nearest_phase_difference(positions[:, :3], directors[:, :3], np.array([0, 3]))).all()


def test_forms_have_a_colour_each_and_ends_that_of_their_neighbour(tmp_path):
    record = made_record(tmp_path, 4)
    coloring = Coloring("form", record, THREE)
    values = coloring.values(record.positions[:], slice(0, 4))
    assert coloring.names == ["ground state", "semicoiled"]
    for first in record.first_node[:-1]:
        assert values[:, first : first + 8].tolist() == [
            [i >= 1] * 2 + [n <= 2 * i for n in range(2, 8)] for i in range(4)
        ]
    with made_record(tmp_path / "whole", 16) as whole:
        shown = Coloring("form", whole, THREE).values(whole.positions[:], slice(0, 16))
    for end in record.first_node[1:]:
        assert np.array_equal(shown[:, end - 1], shown[:, end - 2])
    assert shown[-1].all()
    colors = coloring.colors(values)
    assert np.array_equal(
        np.unique(colors.reshape(-1, 3), axis=0), np.unique([linear(c) for c in FORM_COLORS[:2]], axis=0)
    )


def test_more_flagella_than_colours_begin_again_with_the_first(tmp_path):
    coloring, count = Coloring("flagellum", made_record(tmp_path), THREE), len(FLAGELLUM_COLORS)
    found = coloring.colors([0, 1, count, count + 1, 2 * count + 1])
    np.testing.assert_array_equal(found[2:], found[[0, 1, 1]])
