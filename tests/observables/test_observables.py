"""Observables on constructed shapes and motions whose answers are known."""

from itertools import pairwise

import numpy as np
import pytest

from tests.shapes import helix, joined, line
from warpflag import observables


def rotation(axis, angle):
    """Rodrigues' matrix."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def quaternion(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.array([*(np.sin(angle / 2) * axis), np.cos(angle / 2)])


def quaternion_product(a, b):
    return np.array([*(a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])), a[3] * b[3] - a[:3] @ b[:3]])


# Phase difference
# ------------------------------------------------------------------------------------------------


def random_frames(rng, count):
    tangents = rng.normal(size=(count, 3))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    e1 = np.cross(rng.normal(size=(count, 3)), tangents)
    return e1 / np.linalg.norm(e1, axis=1, keepdims=True), tangents


def test_local_phase_difference_is_the_definition_for_arbitrary_frames():
    rng = np.random.default_rng(1)
    e1_a, t_a = random_frames(rng, 50)
    e1_b, t_b = random_frames(rng, 50)
    theta = observables.local_phase_difference(e1_a, t_a, e1_b, t_b)
    for i in range(50):
        minimal = rotation(np.cross(t_b[i], t_a[i]), np.arccos(t_b[i] @ t_a[i]))
        np.testing.assert_allclose(minimal @ t_b[i], t_a[i], atol=1e-12)
        assert theta[i] == pytest.approx(np.arccos(e1_a[i] @ minimal @ e1_b[i]) / np.pi, abs=1e-10)
    np.testing.assert_allclose(observables.local_phase_difference(e1_b, t_b, e1_a, t_a), theta, atol=1e-12)
    turn = rotation([1, 2, 3], 1.0).T
    turned = observables.local_phase_difference(e1_a @ turn, t_a @ turn, e1_b @ turn, t_b @ turn)
    np.testing.assert_allclose(turned, theta, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, np.pi / 2, np.pi - 1e-9, np.pi])
def test_local_phase_difference_of_equal_tangents_is_the_angle_to_round_off(angle):
    tangent = np.array([[0.0, 0.6, 0.8]])
    e1 = np.array([[1.0, 0.0, 0.0]])
    theta = observables.local_phase_difference(e1, tangent, e1 @ rotation(tangent[0], angle).T, tangent)
    assert theta[0] == pytest.approx(angle / np.pi, abs=1e-15, rel=1e-6)


@pytest.mark.parametrize("delta", [0.0, 0.4, 2.0, 3.0])
def test_phase_difference_of_two_parallel_helices(delta):
    # All segments stand at alpha to the axis and are turned about it by delta: their tangents are two points
    # of one latitude. Transport along the great circle between them turns a director by pi - 2 beta against
    # the latitude, beta the base angle of the isosceles spherical triangle with the pole.
    a, e1_a = helix(31)
    b, e1_b = helix(31, phase=delta, axis_offset=(0.5, 0.0, 0.0))
    cos_alpha = observables.segment_tangents(a)[0, 2]
    expected = (np.pi - 2 * np.arctan2(1.0, cos_alpha * np.tan(delta / 2))) / np.pi
    positions, first_node = joined(a, b)
    directors = np.concatenate([e1_a, e1_b])
    assert observables.phase_difference(positions, directors, first_node) == pytest.approx(expected, abs=1e-12)
    # The row of the motor tripod has no say.
    directors[[0, 31]] = [0.0, 1.0, 0.0]
    assert observables.phase_difference(positions, directors, first_node) == pytest.approx(expected, abs=1e-12)


def spun(node_count, degrees):
    e1 = [np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0.0]
    return np.tile(e1, (node_count, 1))


def test_phase_difference_averages_over_pairs_and_common_segments():
    positions, first_node = joined(line(11), line(11, x=1.0), line(11, x=2.0))
    directors = np.concatenate([spun(11, 0), spun(11, 36), spun(11, 90)])
    assert observables.phase_difference(positions, directors, first_node) == pytest.approx((0.2 + 0.5 + 0.3) / 3)

    positions, first_node = joined(line(11), line(31, x=1.0))
    directors = np.concatenate([spun(11, 0), spun(11, 36), spun(20, 90)])
    assert observables.phase_difference(positions, directors, first_node) == pytest.approx(0.2)


def test_antiparallel_tangents_are_undefined_and_left_out():
    up, down = np.array([[0.0, 0.0, 1.0]]), np.array([[0.0, 0.0, -1.0]])
    assert np.isnan(observables.local_phase_difference([[1.0, 0.0, 0.0]], up, [[1.0, 0.0, 0.0]], down)[0])

    # Nearly antiparallel ones are defined: turned about e1, they leave it alone.
    for angle in (1e-3, 1e-5):
        tilted = np.array([[0.0, np.sin(angle), -np.cos(angle)]])
        theta = observables.local_phase_difference([[1.0, 0.0, 0.0]], up, [[1.0, 0.0, 0.0]], tilted)
        assert theta[0] == pytest.approx(0.0, abs=1e-6)

    straight = line(5)
    hairpin = np.array([[1, 0, 0], [1, 0, 1], [1, 0, 2], [1, 0, 1], [1, 0, 0]], float)
    positions, first_node = joined(straight, hairpin)
    directors = np.concatenate([spun(5, 0), spun(5, 45)])
    assert observables.phase_difference(positions, directors, first_node) == pytest.approx(0.25)
    assert np.isnan(observables.phase_difference(*_all_antiparallel()))


def _all_antiparallel():
    positions, first_node = joined(line(5), line(5, x=1.0)[::-1])
    return positions, np.concatenate([spun(5, 0), spun(5, 0)]), first_node


def test_phase_difference_needs_two_flagella():
    with pytest.raises(ValueError, match="two flagella"):
        observables.phase_difference(line(5), spun(5, 0), np.array([0, 5]))


# Bundle
# ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("distance", "expected"), [(0.43, 1.0), (0.45, 0.0)])
def test_bundle_length_of_parallel_lines(distance, expected):
    positions, first_node = joined(line(31), line(31, x=distance))
    assert observables.bundle_length(positions, first_node) == expected
    # Far from the origin too, where squares of coordinates would lose the difference.
    assert observables.bundle_length(positions + np.array([3e7, -2e7, 1e7]), first_node) == expected


def test_parallel_helices_are_bundled_by_distance_not_by_phase():
    first, _ = helix(31)
    for offset, phase, expected in ((0.3, 0.0, 1.0), (0.0, np.pi, 1.0), (1.0, 0.0, 0.0)):
        second, _ = helix(31, phase=phase, axis_offset=(offset, 0.0, 0.0))
        assert observables.bundle_length(*joined(first, second)) == expected


def test_half_zipped_pair():
    # Lines 0.2 apart up to z = 2.9, then one leaves at 45 degrees. A node of the straight one at height z is
    # 0.2/sqrt(2) + (z - 2.9)/sqrt(2) from it, beyond 0.44 from z = 3.33 on; the other's are
    # x from it, beyond 0.44 from z = 3.14 on.
    straight = line(31)
    leaving = line(31, x=0.2)
    beyond = leaving[:, 2] > 2.9
    leaving[beyond, 0] += leaving[beyond, 2] - 2.9
    fractions = observables.bundled_fraction(*joined(straight, leaving))
    np.testing.assert_allclose(fractions, [16 / 30, 15 / 30])
    assert observables.bundle_length(*joined(straight, leaving)) == pytest.approx(15.5 / 30)


def test_bundle_ends_at_the_first_gap_and_may_start_behind_the_anchors():
    straight, other = line(31), line(31, x=0.3)
    other[:4, 0], other[15:19, 0] = 2.0, 2.0  # nodes 5..13 of the straight one are surely near
    fractions = observables.bundled_fraction(*joined(straight, other))
    near = observables.bundled_nodes(*joined(straight, other))
    assert not near[:2].any() and near[5:14].all() and not near[16:18].any() and near[20:31].all()
    assert 13 / 30 <= fractions[0] <= 15 / 30
    assert fractions[1] == pytest.approx(14 / 30)


def test_a_gap_may_be_passed_over():
    """Bundled but for a stretch of 0.8 um, and some near the motor that touch before the bundle begins."""
    straight, other = line(31), line(31, x=0.3)
    other[3:7, 0], other[24:, 0] = 2.0, 2.0
    plain = observables.bundled_fraction(*joined(straight, other))
    assert (plain < 0.2).all()
    steady = observables.bundled_fraction(*joined(straight, other), gap=1.0)
    np.testing.assert_allclose(steady, [24 / 30, 23 / 30], atol=1 / 30)
    np.testing.assert_array_equal(observables.bundled_fraction(*joined(straight, other), gap=0.2), plain)
    # The gap is a length: with half the segment length it is the same stretch.
    fine = joined(
        *(np.array([np.interp(np.arange(61) / 2, np.arange(31), x) for x in f.T]).T for f in (straight, other))
    )
    np.testing.assert_allclose(observables.bundled_fraction(*fine, gap=1.0), steady, atol=1 / 30)


@pytest.mark.parametrize("stretch", [0.999, 1.0, 1.001])
def test_a_gap_is_as_many_segments_as_it_is_nearest_to(stretch):
    """Five nodes of segments that are 0.2 um but for their strain."""
    straight, other = stretch * line(31), stretch * line(31, x=0.3)
    other[10:15, 0] = 2.0
    assert observables.bundled_fraction(*joined(straight, other), gap=1.0)[1] == 1.0
    assert observables.bundled_fraction(*joined(straight, other), gap=0.85)[1] == pytest.approx(9 / 30)


def test_zip_is_complete_once_it_holds():
    times = 1e-4 * np.arange(10)
    lengths = np.array([0.1, 0.98, 0.5, 1.0, 1.0, 0.9, 1.0, 1.0, 1.0, 1.0])
    for hold, expected in ((0.0, 1e-4), (1e-4, 3e-4), (2e-4, 6e-4), (3e-4, 6e-4)):
        assert observables.zip_time(times, lengths, hold) == pytest.approx(expected)
    assert np.isnan(observables.zip_time(times, lengths, 4e-4))
    assert np.isnan(observables.zip_time(times, np.full(10, 0.979)))


def test_distance_is_to_segments_not_to_nodes():
    first = line(6, h=1.0)
    second = line(6, h=1.0, x=0.4) + np.array([0.0, 0.0, 0.5])
    nodes_apart = np.linalg.norm(first[:, None] - second[None], axis=-1).min()
    assert nodes_apart > 0.6
    near = observables.bundled_nodes(*joined(first, second))
    np.testing.assert_array_equal(near, [False] + [True] * 5 + [True] * 5 + [False])


def test_any_other_flagellum_counts_but_not_the_flagellum_itself():
    coil, _ = helix(31, radius=0.1, pitch=0.3)  # near itself everywhere
    far, near = line(31, x=5.0), line(31, x=5.3)
    np.testing.assert_array_equal(observables.bundled_fraction(*joined(coil, far, near)), [0.0, 1.0, 1.0])
    assert observables.bundle_length(coil, np.array([0, 31])) == 0.0


def test_no_segment_joins_one_flagellum_to_the_next():
    """A segment from the tip of the first to the start of the second would pass through the third."""
    first, second = line(11), line(11, x=10.0) + np.array([0.0, 0.0, 2.0])
    third = line(11, x=5.0) + np.array([0.0, 0.0, 1.0])
    assert not observables.bundled_nodes(*joined(first, second, third)).any()


def test_bundled_nodes_agree_with_a_plain_search_in_any_block_size():
    rng = np.random.default_rng(3)
    flagella = [np.cumsum(rng.normal(scale=0.12, size=(n, 3)), axis=0) for n in (9, 30, 17)]
    positions, first_node = joined(*flagella)
    expected = []
    for k, nodes in enumerate(flagella):
        others = [segment for j, other in enumerate(flagella) if j != k for segment in pairwise(other)]
        for node in nodes:
            along = [np.clip((node - p) @ (q - p) / ((q - p) @ (q - p)), 0, 1) for p, q in others]
            nearest = min(np.linalg.norm(node - p - s * (q - p)) for s, (p, q) in zip(along, others, strict=True))
            expected.append(nearest <= 0.44)
    assert 0 < sum(expected) < len(expected)
    for block in (1, 40, 1 << 20):
        np.testing.assert_array_equal(observables.bundled_nodes(positions, first_node, pairs_at_once=block), expected)


# Rates
# -----------------------------------------------------------------------------------------------------------


def test_rates_of_a_swimming_spinning_and_precessing_body():
    """Spin about e_b3 at -175 Hz while e_b3 turns about the lab x axis, across itself, at 10 Hz."""
    times = np.linspace(0.0, 0.03, 601)
    orientations = np.array(
        [
            quaternion_product(quaternion([1, 0, 0], 2 * np.pi * 10 * t), quaternion([0, 0, 1], -2 * np.pi * 175 * t))
            for t in times
        ]
    )
    orientations[1::3] *= -1.0  # the same rotations
    assert observables.body_rate(times, orientations) == pytest.approx(-175.0, rel=1e-4)

    # Forward along -e_b3 = -(0, -sin, cos) at 190 um/s, drifting across the plane of the axis at 50 um/s.
    angle = 2 * np.pi * 10 * times
    path = 190.0 * np.stack([0 * times, 1 - np.cos(angle), -np.sin(angle)], axis=-1) / (2 * np.pi * 10)
    path[:, 0] += 50.0 * times
    assert observables.body_speed(times, path, orientations) == pytest.approx(190.0, rel=1e-5)
    net = np.hypot(50.0 * 0.03, np.hypot(*(path[-1, 1:] - path[0, 1:]))) / 0.03
    assert observables.net_speed(times, path) == pytest.approx(net)


def test_pure_spin_is_counted_exactly_over_many_turns():
    times = np.array([1.0, 1.001, 1.0025, 1.004])
    orientations = [quaternion([0, 0, 1], 2 * np.pi * 300 * (t - 1.0)) for t in times]
    assert observables.body_rate(times, np.array(orientations)) == pytest.approx(300.0, rel=1e-12)
    assert observables.body_rate(times, np.array([orientations[0]] * 4)) == 0.0


def test_motor_rate_is_per_flagellum():
    times = np.array([0.0, 1e-3, 3e-3])
    angles = 2 * np.pi * np.outer(times, [1250.0, -80.0])
    np.testing.assert_allclose(observables.motor_rate(times, angles), [1250.0, -80.0])


@pytest.mark.parametrize("times", [[0.0], [1.0, 1.0], [2.0, 1.0]])
def test_a_window_must_span_time(times):
    with pytest.raises(ValueError, match="two frames"):
        observables.motor_rate(times, np.zeros((len(times), 1)))


# Winding
# ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("handedness", [-1, 1])
def test_winding_number_counts_the_turns_of_a_double_helix(handedness):
    """Two opposite strands of radius 0.05 and pitch 1 over 20 turns; the open ends take away a little."""
    a, _ = helix(2001, radius=0.05, pitch=1.0, h=20 * np.hypot(np.pi * 0.1, 1.0) / 2000, handedness=handedness)
    b = a * [-1.0, -1.0, 1.0]
    assert observables.turns_about_axis(a, [0, 0, 0], [0, 0, 2]) == pytest.approx(20 * handedness)
    assert observables.winding_number(a[::5], b[::5]) == pytest.approx(20 * handedness, abs=0.2)
    assert observables.winding_number(b[::5], a[::5]) == pytest.approx(observables.winding_number(a[::5], b[::5]))


def test_winding_number_of_linked_rings_is_whole_and_jumps_at_a_crossing():
    angle = np.linspace(0.0, 2 * np.pi, 41)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    across = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], axis=-1)
    numbers = [observables.winding_number(ring, across + np.array([x, 0.0, 0.0])) for x in (0.5, 1.9, 2.1)]
    np.testing.assert_allclose(np.abs(numbers), [1.0, 1.0, 0.0], atol=1e-12)


def test_turns_about_an_axis_somewhere_in_space():
    turn = rotation([1, -2, 0.5], 0.8)
    points, _ = helix(31)
    turns = observables.turns_about_axis(points @ turn.T + np.array([7, 8, 9]), [7, 8, 9], turn @ [0, 0, 1])
    assert turns == pytest.approx(-30 * 0.2 / np.hypot(2 * np.pi * 0.22, 2.14))
