"""Motors that reverse: tables of their drives, known before a run, and runs that go on with the same bits."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import cell
from warpflag.model.switching import corners, switch_times
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, with_values

MARKOV = {"motor.switching": "markov", "motor.to_reverse": 2.0, "motor.to_forward": 5.0, "motor.switch_ramp": 1e-3}


def drive(scene: Scene, motor: int, times: np.ndarray) -> np.ndarray:
    return np.interp(times, *corners(scene, motor))


def test_a_schedule_reverses_at_its_times_along_ramps():
    values = {"motor.switching": "schedule", "motor.switch_times": (0.1, 0.2), "motor.switch_ramp": 0.02}
    scene = cell({**values, "flagellum.1.switch_times": (0.15, 0.16, 0.3)})
    times = np.array([0.0, 0.1, 0.105, 0.11, 0.12, 0.15, 0.2, 0.21, 0.22, 9.0])
    np.testing.assert_allclose(drive(scene, 0, times), [1, 1, 0.5, 0, -1, -1, -1, 0, 1, 1], atol=1e-12)
    # Turned back halfway: at 0.16 its drive is 0, and 0.01 later it is forward again.
    times = np.array([0.15, 0.155, 0.16, 0.165, 0.17, 0.3, 0.31, 0.32])
    np.testing.assert_allclose(drive(scene, 1, times), [1, 0.5, 0, 0.5, 1, 1, 0, -1], atol=1e-12)


@pytest.mark.parametrize("coupling", [0.0, 0.6, 1.0])
def test_markov_switching_has_its_rates_whatever_the_coupling(coupling):
    """Mean sojourns of 1/rate forward and in reverse, over some thousand of each; and how often two motors agree."""
    scene = cell({**MARKOV, "duration": 10.0, "motor.coupling": coupling})
    forward, reverse, together, total = [], [], 0.0, 0.0
    for seed in range(200):
        own = with_values(scene, {"motor.seed": seed})
        grid = np.arange(0.0, 10.0, 0.01)
        states = []
        for motor in (0, 1):
            times = np.array(switch_times(own, motor))
            sojourns = np.diff(times[times < 20.0])
            reverse += list(sojourns[::2])
            forward += list(sojourns[1::2])
            states.append(np.searchsorted(times, grid) % 2)
        both = np.mean(states[0] & states[1])
        together, total = together + both, total + np.mean(states)
    assert np.mean(reverse) == pytest.approx(1 / 5.0, rel=0.05)
    assert np.mean(forward) == pytest.approx(1 / 2.0, rel=0.05)
    bias = total / 200
    assert bias == pytest.approx(2 / 7, rel=0.05)
    if coupling == 0.0:
        assert together / 200 == pytest.approx(bias**2, rel=0.1)
    elif coupling == 1.0:
        assert together / 200 == pytest.approx(bias, rel=1e-9)
    else:
        assert bias**2 * 1.3 < together / 200 < bias


@pytest.mark.parametrize("coupling", [0.0, 1.0])
def test_both_directions_have_clocks_of_their_own(coupling):
    """Also at equal rates, at which ticks of a clock for both would undo each other."""
    values = {"motor.to_reverse": 50.0, "motor.to_forward": 50.0, "motor.coupling": coupling, "duration": 10.0}
    times = [0.0, *switch_times(cell({**MARKOV, **values}), 1)]
    for begin in (0, 1):
        assert np.diff(times)[begin::2].mean() == pytest.approx(1 / 50.0, rel=0.15)


def test_a_motor_switches_the_same_in_any_cell_and_to_any_end():
    """Of seed and number of the motor alone: neither the duration nor the other motors change its times."""
    scene = cell({**MARKOV, "duration": 2.0})
    longer = with_values(scene, {"duration": 4.0, "flagella.count": 3})
    for motor in (0, 1):
        times = switch_times(scene, motor)
        assert len(times) > 2
        assert switch_times(longer, motor)[: len(times)] == times
    assert switch_times(scene, 0) != switch_times(scene, 1)
    assert switch_times(scene, 0) != switch_times(with_values(scene, {"motor.seed": 1}), 0)
    # Two values for good, on every machine.
    assert switch_times(scene, 0)[:2] == pytest.approx(FIRST_SWITCHES, rel=1e-12)


FIRST_SWITCHES = (0.10263120207685084, 0.14882109132808025)

LAWS = {
    "constant": {"motor.torque": 0.4},
    "torque_speed": {"motor.torque": 1.26, "motor.law": "torque_speed", "motor.coupling": 0.5},
}


@pytest.mark.parametrize("law", list(LAWS))
@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_a_stopped_run_goes_on_with_the_same_bits_and_alone_as_in_a_batch(stepper, law, device):
    values = {**MARKOV, **LAWS[law], "motor.to_reverse": 3e3, "motor.to_forward": 3e3, "motor.switch_ramp": 1e-4}
    scene = cell({**values, "numerics.stepper": stepper, "flagella.length": 1.0, "duration": 1e-3})
    other = with_values(scene, {"motor.seed": 5})
    assert any(1e-4 < t < 1e-3 for t in switch_times(scene, 0))
    whole = Simulation([other, scene], device=device, strict=True)
    whole.advance(6e-4)
    first = Simulation(scene, device=device, strict=True)
    first.advance(3e-4)
    second = Simulation(scene, device=device, strict=True)
    second.restore(first.checkpoint())
    second.evaluate()
    second.advance(6e-4)
    straight = Simulation(scene, device=device, strict=True)
    straight.advance(3e-4)
    straight.advance(6e-4)
    assert np.array_equal(second.state.positions, straight.state.positions)
    assert np.array_equal(second.state.motor_angle, straight.state.motor_angle)
    direct = Simulation(scene, device=device, strict=True)
    direct.advance(6e-4)
    assert np.array_equal(whole.cell_state(1).positions, direct.state.positions)
    assert not np.array_equal(whole.cell_state(0).positions, whole.cell_state(1).positions)


def test_steps_of_rkc_end_at_the_corners_of_every_drive(device):
    """Fixed steps of 1 us at most, in stretches of 3.5, 1.2 and 5.3 us; and of both motors in 2.5 us more."""
    values = {"motor.switching": "schedule", "motor.switch_times": (3.5e-6,), "motor.switch_ramp": 1.2e-6}
    values |= {"numerics.stepper": "rkc", "numerics.time_step": 1e-6, "flagella.length": 1.0}
    values |= {"motor.law": "torque_speed", "motor.torque": 1.0}
    steps = []
    for more in ({}, {"flagellum.1.switch_times": (7.2e-6,)}):
        sim = Simulation(cell({**values, **more}), device=device)
        sim.advance(1e-5)
        steps.append(int(sim.steps[0]))
    assert steps == [4 + 2 + 6, 4 + 2 + 3 + 2 + 2]  # the second turns from 7.2 to 8.4 us


def test_frames_hold_torque_and_drive(device):
    scene = cell(
        {
            "motor.switching": "schedule",
            "motor.switch_times": (2e-5,),
            "motor.switch_ramp": 4e-5,
            "flagellum.1.switch_times": (),
            "flagellum.0.torque": 0.5,
            "motor.reverse_torque": 0.2,
            "duration": 1e-4,
            "frames": 10,
            "flagella.length": 1.0,
        }
    )
    frames = list(Simulation(scene, device=device).frames(1e-4))
    found = np.array([frame.observables["motor_drive"] for frame in frames])
    np.testing.assert_allclose(found[:, 0], [1, 1, 1, 0.5, 0, -0.5, -1, -1, -1, -1, -1], atol=1e-9)
    np.testing.assert_array_equal(found[:, 1], 1.0)
    torques = np.array([frame.observables["motor_torque"] for frame in frames])
    # That of the step into which a frame falls: late by a part of a step, here while the drive changes within 40 us.
    expected = np.where(found[:, 0] > 0, 0.5, 0.2) * found[:, 0]
    np.testing.assert_allclose(torques[:, 0], expected, atol=0.01)
    np.testing.assert_allclose(torques[[0, 1, 7, 8, 9, 10], 0], expected[[0, 1, 7, 8, 9, 10]], atol=1e-9)
    np.testing.assert_allclose(torques[:, 1], 3.4, rtol=1e-9)
