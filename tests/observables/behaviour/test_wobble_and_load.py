"""Precession and nutation of constructed axes; load points of motors and torque-speed curves."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import rotation
from warpflag.observables.behaviour import load_points, operating_rate, torque_at, wobble

TIMES = 1e-3 * np.arange(501)
TURN = rotation([0.4, -1.0, 0.3])


def axes(angles, azimuths):
    made = [np.sin(angles) * np.cos(azimuths), np.sin(angles) * np.sin(azimuths), np.cos(angles)]
    return np.stack(made, axis=1) @ TURN.T


@pytest.mark.parametrize("rate", [12.0, -31.0])
def test_precession_and_nutation(rate):
    angles = 0.3 + 0.04 * np.cos(2 * np.pi * 57.0 * TIMES)
    found = wobble(TIMES, 3.0 * axes(angles, 2 * np.pi * rate * TIMES), 2.0 * TURN[:, 2])
    assert found.angle == pytest.approx(0.3, abs=1e-3)
    assert found.precession_rate == pytest.approx(rate, rel=1e-9)
    assert found.nutation == pytest.approx(0.04, rel=0.01)
    assert found.nutation_rate == pytest.approx(57.0, abs=0.1)


def test_nutation_is_the_amplitude_however_few_frames_there_are():
    angles = 0.3 + 0.04 * np.array([1.0, 0.0, -1.0, 0.0])  # a period of a cosine
    found = wobble(TIMES[:4], axes(angles, 50.0 * TIMES[:4]), TURN[:, 2])
    assert found.nutation == pytest.approx(0.04, rel=1e-9) and found.angle == pytest.approx(0.3, rel=1e-9)


def test_a_steady_cone_has_no_nutation_and_a_steady_axis_no_precession():
    found = wobble(TIMES, axes(0.2 + 0 * TIMES, 50.0 * TIMES), TURN[:, 2])
    assert found.nutation < 1e-9 and np.isnan(found.nutation_rate)
    still = wobble(TIMES, axes(0 * TIMES, 0 * TIMES), TURN[:, 2])
    assert still.angle < 1e-9 and np.isnan(still.precession_rate) and np.isnan(still.nutation_rate)


def test_a_direction_that_turns_counts_from_itself():
    """A direction that sweeps over a great circle, with the axis at 0.1 rad that turns about it at 20 Hz."""
    swept = [rotation([0.0, 2.0 * t, 0.0]) for t in TIMES]
    phase = 2 * np.pi * 20.0 * TIMES
    cone = np.stack([np.sin(0.1) * np.cos(phase), np.sin(0.1) * np.sin(phase), np.cos(0.1) + 0 * phase], axis=1)
    found = wobble(TIMES, [r @ v for r, v in zip(swept, cone, strict=True)], [r[:, 2] for r in swept])
    assert found.angle == pytest.approx(0.1)
    assert found.precession_rate == pytest.approx(20.0, rel=1e-6)
    assert found.nutation < 1e-9


def test_a_direction_that_sweeps_far_from_frame_to_frame():
    """20 degrees a frame, which is its minimal rotation, and the axis turns by 40 about it."""
    frames = np.arange(12)
    swept = [rotation([0.0, np.radians(20.0 * k), 0.0]) for k in frames]
    phase = np.radians(40.0 * frames)
    cone = np.stack([np.sin(0.3) * np.cos(phase), np.sin(0.3) * np.sin(phase), np.cos(0.3) + 0 * phase], axis=1)
    found = wobble(1e-3 * frames, [r @ v for r, v in zip(swept, cone, strict=True)], [r[:, 2] for r in swept])
    assert found.precession_rate == pytest.approx(40.0 / 360.0 / 1e-3, rel=1e-6)


def test_a_window_of_one_frame_is_refused():
    with pytest.raises(ValueError, match="two frames"):
        wobble([0.0], [[0, 0, 1]], [0, 0, 1])


def test_load_points_are_means_over_the_window():
    angles = 2 * np.pi * np.outer(TIMES, [100.0, -40.0])
    points = load_points(TIMES, angles, [0.8, -0.5])
    assert [(p.rate, p.torque) for p in points] == [
        (pytest.approx(100.0), pytest.approx(0.8)),
        (pytest.approx(-40.0), pytest.approx(-0.5)),
    ]
    assert points[0].drag == pytest.approx(0.8 / (2 * np.pi * 100)) and points[1].drag > 0
    uneven = np.array([0.0, 1.0, 4.0])
    found = load_points(uneven, np.zeros((3, 1)), [[1.0], [3.0]])[0]
    assert found.torque == pytest.approx(0.25 * 1.0 + 0.75 * 3.0) and np.isnan(found.drag)


def test_torque_speed_curve():
    rates = np.array([-50.0, 0.0, 175.0, 237.5, 300.0, 400.0])
    np.testing.assert_allclose(torque_at(rates, 1.26, 175.0, 300.0), [1.26, 1.26, 1.26, 0.63, 0.0, 0.0], atol=1e-12)


def test_a_load_works_where_it_meets_the_curve():
    drags = np.geomspace(1e-6, 1e-1, 60)  # from hardly any load to a stall
    rates = operating_rate(drags, 1.26, 175.0, 300.0)
    np.testing.assert_allclose(torque_at(rates, 1.26, 175.0, 300.0), 2 * np.pi * drags * rates, rtol=1e-9)
    assert rates[0] > 299 and rates[-1] < 3 and (np.diff(rates) < 0).all()
    assert operating_rate(0.0, 1.26, 175.0, 300.0) == pytest.approx(300.0)
    knee = 1.26 / (2 * np.pi * 175.0)
    assert operating_rate(knee, 1.26, 175.0, 300.0) == pytest.approx(175.0)
