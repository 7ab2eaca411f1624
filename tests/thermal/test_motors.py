"""Motors that follow a law, in thermal noise: equilibrium with a rate that is held, rates on a curve, switching."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.helpers import cell
from tests.thermal.test_equilibrium import ERRORS, PASSIVE, ensemble, mean_energies
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, SceneError, with_values

WARM = {**PASSIVE, "hydrodynamics.mode": "all", "numerics.time_step": 1e-5}


def turned(sim: Simulation) -> np.ndarray:
    """Angles that motors have turned against their bodies [rad], shape [cells, flagella]."""
    return sim.cells().motor_angle.reshape(len(sim.scenes), -1).copy()


def test_motors_that_stand_still_leave_equilibrium_alone(device):
    """A prescribed rate of zero takes the noise off the tripods and none off anything else."""
    values = {"numerics.time_step": 1e-5, "hydrodynamics.mode": "all", "motor.law": "rate", "motor.rate": 0.0}
    sim, scene = ensemble(values, "float64", 64, device)
    mean, error = mean_energies(sim, scene, 2e-4, 2e-5, 30)
    assert np.all(error < 0.03)
    assert np.all(abs(mean - 1) < ERRORS * error)
    assert abs(turned(sim)).max() < 1e-9  # also when restoring lengths turns the body


def test_a_curve_sees_the_rate_averaged_over_its_time(precision, device):
    """tau dA/dt = Omega - A, implicitly: steps as long as tau count one half, those before them a quarter."""
    law = {**WARM, "motor.law": "torque_speed", "motor.torque": 1.26, "motor.averaging_time": 1e-5}
    sim = Simulation(cell(law, precision), device=device)
    angles, expected = [np.zeros(2)], np.zeros(2)
    for i in range(3):
        sim.advance(1e-5 * (i + 1))
        angles.append(turned(sim)[0])
        expected = 0.5 * (angles[-1] - angles[-2]) / 1e-5 + 0.5 * expected
        found = sim.checkpoint()["stepper.average_rate"]
        np.testing.assert_allclose(found, expected, rtol=1e-2)  # the axis moves within a step, 0.1 % here
    assert sim.steps[0] == 3


def test_members_average_over_their_own_times(device):
    law = {**WARM, "motor.law": "torque_speed", "motor.torque": 1.26, "motor.knee": 0.0, "motor.no_load": 1500.0}
    scenes = [cell({**law, "motor.averaging_time": time}) for time in (1e-3, 2e-5)]
    batch, *alone = (Simulation(own, device=device) for own in (scenes, *scenes))
    for sim in (batch, *alone):
        sim.advance(1e-4)
    found = [sim.system.state.optional.motor.torque.numpy() for sim in (batch, *alone)]
    assert np.array_equal(found[0], np.concatenate(found[1:])) and not np.array_equal(found[1], found[2])


def test_a_prescribed_rate_is_kept(precision, device):
    sim = Simulation(cell({**WARM, "motor.law": "rate", "motor.rate": 200.0}, precision), device=device)
    sim.advance(1e-3)
    assert abs(turned(sim) / (2 * np.pi * 200.0 * 1e-3) - 1).max() < (1e-9 if precision == "float64" else 1e-4)


def test_rates_on_a_curve_are_those_without_noise(device):
    """A straight curve, so that what noise does to the averaged rate averages out."""
    values = {**WARM, "motor.law": "torque_speed", "motor.torque": 1.26, "motor.knee": 0.0, "motor.no_load": 1500.0}
    warm, start, end, count = cell({**values, "motor.averaging_time": 5e-4}), 2e-3, 5e-3, 24
    cold = with_values(warm, {"fluid.temperature": 0.0, "numerics.time_step": None})
    rates, torques = [], []
    for scenes in ([with_values(warm, {"fluid.seed": i}) for i in range(count)], [cold]):
        sim = Simulation(scenes, device=device)
        sim.advance(start)
        before, looks = turned(sim), []
        for i in range(6):
            sim.advance(start + (i + 1) / 6 * (end - start))
            looks.append(sim.system.state.optional.motor.torque.numpy().reshape(len(scenes), -1).mean(axis=1))
        rates.append(((turned(sim) - before) / (end - start)).mean(axis=1) / (2 * np.pi))
        torques.append(np.mean(looks, axis=0))
    error = rates[0].std(ddof=1) / count**0.5
    assert error < 8.0
    assert abs(rates[0].mean() - rates[1].mean()) < ERRORS * error + 0.01 * rates[1].mean()  # a step of 1e-5 errs, too
    error = torques[0].std(ddof=1) / count**0.5
    assert 1e-3 < error < 4e-3  # the curve is followed
    assert abs(torques[0].mean() - torques[1].mean()) < ERRORS * error + 0.01


def test_motors_reverse_on_schedule(device):
    values = {"motor.switching": "schedule", "motor.switch_times": (1e-3,), "motor.switch_ramp": 1e-4}
    sim = Simulation(cell({**WARM, **values, "motor.torque": 1.0}), device=device)
    angles = [np.zeros((1, 2))]
    for i in range(4):
        sim.advance(5e-4 * (i + 1))
        angles.append(turned(sim))
    changes = np.diff(angles, axis=0)
    assert np.all(changes[1] > 0.5) and np.all(changes[3] < -0.5)


def test_goes_on_with_the_same_bits(device):
    """After a checkpoint, which has the torques and the averaged rates."""
    scene: Scene = cell({**WARM, "motor.law": "torque_speed", "motor.torque": 1.26, "flagellum.0.law": "rate"})
    whole = Simulation(scene, device=device, strict=True)
    whole.advance(2e-4)
    kept = whole.checkpoint()
    whole.advance(4e-4)
    resumed = Simulation(scene, device=device, strict=True)
    resumed.restore(kept)
    resumed.advance(4e-4)
    assert np.array_equal(resumed.state.positions, whole.state.positions)


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ({"motor.law": "torque_speed", "numerics.stepper": "euler", "numerics.time_step": 1e-9}, "numerics.stepper"),
        ({"motor.switching": "markov", "numerics.stepper": "euler", "numerics.time_step": 1e-9}, "numerics.stepper"),
        ({"motor.switching": "markov", "numerics.stepper": "rkc", "numerics.time_step": 1e-9}, "numerics.stepper"),
        ({"polymorphs.enabled": True}, "polymorphs.enabled"),
    ],
)
def test_what_noise_does_not_go_with_is_refused(values: dict[str, Any], key: str):
    with pytest.raises(SceneError) as error:
        cell({**WARM, **values})
    assert error.value.key == key
