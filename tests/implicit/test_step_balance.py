"""The power balance of every implicit step: its parts against known values, and that it sees an unstable stepper."""

from __future__ import annotations

import numpy as np
import pytest
from warpflag_kernels.implicit.stability import LEAST_OVER_IMPLICIT
from warpflag_kernels.stepping import balance
from warpflag_kernels.stepping.health import Fault

from tests.helpers import cell, free_nodes, touching_cell
from warpflag.run.simulation import NumericalError, Simulation
from warpflag.scene import paper_scene, with_values

# Of energy and work, relative: float32 has seven digits, and differences of positions of some um.
TOLERANCE = {"float64": 1e-9, "float32": 2e-3}


def sums(sim: Simulation, name: str) -> float:
    return float(getattr(sim.stepper.balance, name).numpy().sum())


def test_energy_and_work_of_a_step_are_those_of_the_cell(device, precision):
    """A body held fast, no contacts: the motor's work is torque times angle, as the chart counts it."""
    values = {"numerics.stepper": "implicit", "body.anchored": True, "body.contact": False, "steric.enabled": False}
    sim = Simulation(cell({**values, "flagellum.0.torque": 2.0, "flagellum.1.torque": -1.0}, precision), device=device)
    sim.advance(1e-4)
    for until in (1.01e-4, 1.05e-4):  # a step each
        before, steps = sim.cell_state(), sim.steps[0]
        sim.advance(until)
        after = sim.cell_state()
        if sim.steps[0] == steps + 1:
            turned = after.motor_angle - before.motor_angle
            assert sums(sim, "work") == pytest.approx(float(turned @ [2.0, -1.0]), rel=TOLERANCE[precision])
        energy = float(after.elastic_energy.sum())
        assert sums(sim, "energy") == pytest.approx(energy, rel=TOLERANCE[precision])
        assert sim.stepper.balance.stored.numpy()[0] == pytest.approx(energy, rel=TOLERANCE[precision])
    assert sums(sim, "refused") == 0


def test_the_power_of_a_pose_is_that_of_all_forces_on_all_velocities(device, precision):
    """A small body, which motors turn fast: its turning is a tenth of all."""
    small = {"body.length": 0.5, "body.width": 0.4, "flagella.anchor_offset": 0.0, "motor.bearing_torque": True}
    scene = cell({**small, "numerics.stepper": "implicit", "external.body_force": (1.0, 0.0, 2.0)}, precision)
    sim = Simulation(scene, device=device)
    sim.advance(2e-5)
    found, nodes = sim.evaluate(), free_nodes(scene)
    sim.system.state.data.active.fill_(1)
    balance.gather(sim.system.model, sim.system.state, sim.stepper.balance)
    turning = float(found.body_torque @ found.body_spin)
    power = float((found.forces[nodes] * found.velocities[nodes]).sum() + found.torques @ found.spins)
    power += float(found.body_force @ found.body_velocity) + turning
    assert sums(sim, "power") == pytest.approx(power, rel=TOLERANCE[precision]) and turning > 0.02 * power
    load = np.linalg.norm(found.forces[nodes], axis=1).sum()
    assert sums(sim, "load") == pytest.approx(load, rel=TOLERANCE[precision])


@pytest.mark.parametrize("values", [{}, {"motor.bearing_torque": True}, {"external.body_force": (0.0, 3.0, 1.0)}])
def test_what_is_put_in_is_dissipated_or_stored(values, device, precision):
    """In contact, the power of all velocities over a step is what its displacement leaves, to the error of the step."""
    scene = touching_cell({"numerics.stepper": "implicit", "numerics.time_step": 2e-6, **values}, precision)
    sim = Simulation(scene, device=device)
    sim.advance(2e-4)
    for until in (2.02e-4, 2.04e-4, 2.06e-4):
        stored, steps = sims_stored(sim), sim.steps[0]
        sim.advance(until)
        assert sim.steps[0] == steps + 1
        dissipated = sums(sim, "work") - (sums(sim, "energy") - stored)
        assert dissipated == pytest.approx(sums(sim, "power") * 2e-6, rel=0.2) and dissipated > 0


def sims_stored(sim: Simulation) -> float:
    return float(sim.stepper.balance.stored.numpy()[0])


STIFF = {
    "flagella.count": 1,
    "flagella.length": 3.0,
    "flagella.segment_length": 0.05,
    "flagella.bending_rigidity": 350.0,
    "flagella.twist_rigidity": 350.0,
    "flagella.stretching_stiffness": 1e5,
    "motor.torque": 1.0,
    "hydrodynamics.mode": "consistent",
    "body.anchored": True,
}


def sound_and_sick(values, device):
    """Two equal cells, the steps of the second with the least over-implicitness, whatever the filaments: unstable for
    stiff ones on a fine mesh."""
    pair = [Simulation(with_values(paper_scene(name="stiff"), values), device=device) for _ in range(2)]
    pair[1].stepper.stability = None
    pair[1].stepper.data.over_implicit.fill_(LEAST_OVER_IMPLICIT)
    return pair


def test_an_unstable_stepper_is_stopped_within_microseconds(device, precision):
    """Its energy would be a thousand times too large."""
    sound, sick = sound_and_sick(STIFF | {"numerics.precision": precision, "numerics.time_step": 1e-6}, device)
    sound.advance(2e-5)
    with pytest.raises(NumericalError) as caught:
        sick.advance(2e-5)
    assert caught.value.kind == Fault.BALANCE
    assert "flagella.bending_rigidity = 350, 100 times the default" in str(caught.value)


def test_an_unstable_stepper_under_control_stays_right(device, precision):
    """Error estimates and the balance shorten its steps until it is sound, at twenty times the cost.

    In float32 round-off of so stiff a filament keeps both at the shortest step, and both are right.
    """
    sound, sick = sound_and_sick(STIFF | {"numerics.precision": precision}, device)
    for sim in (sound, sick):
        sim.advance(1e-4)
    assert sums(sound, "refused") == 0
    assert sick.state.motor_angle == pytest.approx(sound.state.motor_angle, rel=0.02)
    if precision == "float64":
        assert sums(sick, "refused") > 20 and sick.steps[0] > 5 * sound.steps[0]


@pytest.mark.parametrize("missing", [-1e9, 10.0])
def test_a_step_without_energy_before_it_is_not_judged(missing, device):
    """A later one is, where energy comes from nowhere, and where more is gone than the fluid can take."""
    sim = Simulation(cell({"numerics.stepper": "implicit"}), device=device)
    sim.stepper.balance.stored.fill_(missing)
    sim.advance(2e-6)
    kept = sim.checkpoint()
    assert sums(sim, "refused") == 0
    sim.stepper.balance.stored.fill_(sims_stored(sim) + missing)
    with pytest.raises(NumericalError, match="power balance"):
        sim.advance(4e-6)
    assert np.isin(["stepper.balance_stored", "stepper.balance_known"], list(kept)).all()
