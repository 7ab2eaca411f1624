"""Runs and tumbles of constructed paths whose pieces are known."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import rotation
from warpflag.observables.behaviour import exponential_mean, runs_and_tumbles

STEP = 0.002  # s between frames
EDGE = 0.015  # s: to which edges of pieces are found, three tenths of the averaging time
ANGLE = 2.0  # deg


def path(pieces, *, coil=0.0, coil_rate=30.0, step=STEP):
    """Times and positions of a cell that does one piece after another: (duration [s], speed [um/s], turn [deg]).

    A piece turns evenly about an axis across the direction that it begins with. The coil is that of a wobbling body.
    """
    positions, direction, other, point = (
        [np.zeros(3)],
        np.array([0.6, 0.0, 0.8]),
        np.array([0.0, 1.0, 0.0]),
        np.zeros(3),
    )
    for duration, speed, turn in pieces:
        count = round(duration / step)
        small = rotation(np.radians(turn) / count * other)
        for _ in range(count):
            direction = small @ direction
            point = point + speed * step * direction
            positions.append(point)
        if turn:  # out of the plane next time
            other = rotation(0.7 * direction) @ other
    times = step * np.arange(len(positions))
    phase = 2 * np.pi * coil_rate * times
    across = np.stack([np.cos(phase), np.sin(phase), 0 * phase], axis=1)
    return times, np.array(positions) + coil * across


PIECES = [
    (0.8, 25.0, 0),
    (0.2, 0.0, 68),
    (1.0, 22.0, 0),
    (0.12, 0.0, 120),
    (0.5, 28.0, 0),
    (0.3, 0.0, 30),
    (0.6, 25.0, 0),
]
BOUNDS = np.cumsum([0.0, *(piece[0] for piece in PIECES)])


@pytest.mark.parametrize("coil", [0.0, 0.15])
def test_a_cell_that_stops_to_tumble(coil):
    found = runs_and_tumbles(*path(PIECES, coil=coil))
    np.testing.assert_allclose(found.runs, BOUNDS.reshape(-1, 2)[:4], atol=EDGE)
    np.testing.assert_allclose(found.tumbles, BOUNDS[1:-1].reshape(-1, 2), atol=EDGE)
    np.testing.assert_allclose(np.degrees(found.tumble_angles), [68, 120, 30], atol=ANGLE)
    np.testing.assert_allclose(found.tumble_durations, [0.2, 0.12, 0.3], atol=2 * EDGE)
    np.testing.assert_allclose(found.run_durations, [1.0, 0.5], atol=2 * EDGE)  # the first and the last are cut off
    np.testing.assert_allclose(found.run_speeds, [25, 22, 28, 25], rtol=0.04)
    assert found.run_speed == pytest.approx((25 * 1.4 + 22 + 14) / 2.9, rel=0.03)
    assert found.tumbling_fraction == pytest.approx(0.62 / BOUNDS[-1], abs=0.01)
    expected = (found.times > 0.81) & (found.times < 0.99)
    assert found.tumbling[expected].all() and not found.tumbling[found.times < 0.79].any()


def test_stops_with_short_runs_between_are_one_tumble():
    """Each too short for a tumble of its own; one alone is part of a run."""
    stop, go = (0.014, 0.0, 0), (0.03, 20.0, 0)
    pieces = [(0.5, 20.0, 0), stop, go, stop, go, stop, (0.5, 20.0, 0), stop, (0.5, 20.0, 0)]
    found = runs_and_tumbles(*path(pieces, step=2e-4), smoothing=1e-3)
    np.testing.assert_allclose(found.tumbles, [[0.5, 0.5 + 3 * 0.014 + 2 * 0.03]], atol=1e-3)
    assert len(found.runs) == 2 and found.runs[-1, 1] == found.times[-1]


def test_a_cell_that_turns_without_slowing_down():
    """A turn of 90 degrees in 0.1 s, 16 rad/s; one of 90 degrees in 1 s, 1.6 rad/s, is part of a run."""
    found = runs_and_tumbles(*path([(0.5, 20.0, 0), (0.1, 20.0, 90), (0.5, 20.0, 0), (1.0, 20.0, 90), (0.5, 20.0, 0)]))
    assert len(found.tumbles) == 1 and len(found.runs) == 2
    np.testing.assert_allclose(found.tumbles[0], [0.5, 0.6], atol=0.03)
    np.testing.assert_allclose(np.degrees(found.tumble_angles), 90, atol=6)


def test_the_direction_of_a_run_is_not_that_of_its_bend():
    """Averaged, the path bends half a window before a corner; a tumble that is found shorter has the corner's angle."""
    corner = path([(0.6, 20.0, 0), (0.004, 20.0, 160), (0.6, 20.0, 0)])
    found = runs_and_tumbles(*corner, turning=50.0, slow=0.0, reach=0.02)
    assert len(found.tumbles) == 1 and np.diff(found.tumbles[0]) < 0.03
    assert np.degrees(found.tumble_angles[0]) == pytest.approx(160, abs=0.1)


def test_a_reversal_is_a_tumble_of_half_a_turn():
    times, forth = path([(0.6, 20.0, 0)])
    back = forth[::-1][1:]
    found = runs_and_tumbles(np.append(times, times[-1] + times[1:]), np.vstack([forth, back]))
    assert len(found.tumbles) == 1 and np.degrees(found.tumble_angles[0]) == pytest.approx(180, abs=1)
    np.testing.assert_allclose(found.tumbles[0].mean(), 0.6, atol=EDGE)


def test_what_is_too_short_is_no_piece_of_its_own():
    pieces = [(0.6, 25.0, 0), (0.15, 0.0, 40), (0.03, 25.0, 0), (0.15, 0.0, 40), (0.6, 25.0, 0)]
    found = runs_and_tumbles(*path(pieces))
    np.testing.assert_allclose(found.tumbles, [[0.6, 0.93]], atol=EDGE)
    apart = runs_and_tumbles(*path(pieces), smoothing=0.01, shortest_run=0.0)
    assert len(apart.tumbles) == 2
    brief = [(0.6, 25.0, 0), (0.04, 0.0, 0), (0.6, 25.0, 0)]
    assert len(runs_and_tumbles(*path(brief), smoothing=0.01).tumbles) == 1
    assert len(runs_and_tumbles(*path(brief), smoothing=0.01, shortest_tumble=0.06).tumbles) == 0


def test_a_short_piece_that_an_end_of_the_path_cuts_off_stays():
    """It may be longer than it looks, at either end."""
    cut_off = path([(0.03, 25.0, 0), (0.15, 0.0, 40), (0.6, 25.0, 0), (0.15, 0.0, 40), (0.03, 25.0, 0)])
    found = runs_and_tumbles(*cut_off, smoothing=0.01)
    np.testing.assert_allclose(found.runs, [[0.0, 0.03], [0.18, 0.78], [0.93, 0.96]], atol=EDGE)
    np.testing.assert_allclose(found.tumbles, [[0.03, 0.18], [0.78, 0.93]], atol=EDGE)


def test_a_cell_that_only_runs_and_one_that_only_tumbles():
    found = runs_and_tumbles(*path([(1.0, 25.0, 0)]))
    assert (len(found.runs), len(found.tumbles), found.tumbling_fraction) == (1, 0, 0.0)
    assert found.run_speed == pytest.approx(25.0) and len(found.run_durations) == 0
    found = runs_and_tumbles(*path([(1.0, 25.0, 3000)]))
    assert (len(found.runs), found.tumbling_fraction) == (0, 1.0)
    assert np.isnan(found.run_speed) and np.isnan(found.tumble_angles).all()


def test_the_path_may_lie_and_be_sampled_anyhow():
    times, positions = path(PIECES)
    found = runs_and_tumbles(times, positions)
    turn = rotation([0.3, -1.0, 0.5])
    moved = runs_and_tumbles(times + 5.0, positions @ turn.T + [100.0, -50.0, 30.0])
    np.testing.assert_allclose(moved.tumbles - 5.0, found.tumbles, atol=1.01 * STEP)  # a frame may lie on an edge
    np.testing.assert_allclose(moved.tumble_angles, found.tumble_angles, atol=1e-3)
    kept = np.sort(np.random.default_rng(1).choice(len(times), len(times) // 2, replace=False))
    uneven = runs_and_tumbles(times[kept], positions[kept])
    np.testing.assert_allclose(uneven.tumbles, found.tumbles, atol=EDGE)


def test_a_path_shorter_than_three_averages_is_refused():
    with pytest.raises(ValueError, match=r"path of 100 ms is too short for runs and tumbles: .* the smoothing, 50 ms"):
        runs_and_tumbles(*path([(0.1, 25.0, 0)]))


def test_mean_of_durations_of_which_some_are_cut_off():
    """Runs of 1.3 s in windows of 2 s: the estimate is right within its error, the mean of the whole ones is not."""
    random, deviations, naive = np.random.default_rng(5), [], []
    for _ in range(300):
        seen, ended = [], []
        for _ in range(20):
            ends = np.cumsum(random.exponential(1.3, 40))
            bounds = [0.0, *ends[ends < 2.0], 2.0]
            seen += [*np.diff(bounds)]
            ended += [*[True] * (len(bounds) - 2), False]
            naive += [*np.diff(bounds)[1:-1]]
        mean, error = exponential_mean(seen, ended)
        deviations.append((1.3 - mean) / error)
    assert abs(np.mean(deviations)) < 0.3  # a third of an error at most: 1/mean is unbiased, mean not quite
    assert np.std(deviations) == pytest.approx(1.0, abs=0.15)
    assert np.mean(naive) < 0.8
    assert np.isnan(exponential_mean([2.0], [False])).all()


def test_which_runs_and_tumbles_of_a_path_end():
    found = runs_and_tumbles(*path(PIECES[:4]))
    assert found.run_ended.tolist() == [True, True] and found.tumble_ended.tolist() == [True, False]
    mean, error = found.run_length
    assert mean == pytest.approx(0.9, abs=EDGE) and error == pytest.approx(mean / np.sqrt(2))


def test_the_speed_in_runs_is_the_mean_over_their_time():
    found = runs_and_tumbles(*path([(1.6, 15.0, 0), (0.2, 0.0, 60), (0.4, 25.0, 0)]))
    assert found.run_speed == pytest.approx((1.6 * 15 + 0.4 * 25) / 2.0, rel=0.03)
