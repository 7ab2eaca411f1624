"""Forces from outside: what they act on, the work they do, under every stepper; and that absent they cost nothing."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import anchors, as_start, cell, displaced, evaluated, matrix, moved_rigidly, shaken, touching_cell
from tests.oracles import energy, slope
from tests.plans import by_elements, plan
from warpflag.model.geometry import initial_state
from warpflag.observables import power_balance
from warpflag.run.simulation import Simulation
from warpflag.scene import SceneError, with_values
from warpflag.scene.resistance import spheroid_mobility

# Relative to the largest value, or to the power supplied.
TOLERANCE = {"float64": 1e-12, "float32": 2e-4}
POWER = {"float64": 1e-6, "float32": 2e-2}
PER_LENGTH, ON_BODY = np.array([0.3, -0.2, 0.5]), np.array([-1.0, 0.4, 2.0])
VALUES = {"external.force_per_length": tuple(PER_LENGTH), "external.body_force": tuple(ON_BODY)}
UNEQUAL = {"flagella.count": 2, "flagellum.1.length": 1.2, "flagellum.1.segments": 5}


@pytest.mark.parametrize("finely", [False, True])
def test_nodes_carry_half_of_each_of_their_segments_and_the_body_the_rest(finely, precision, device):
    scene = cell({**UNEQUAL, "motor.torque": 1e-6, "steric.enabled": False}, precision)
    pulled, start = with_values(scene, VALUES), shaken(scene, seed=1, node=1e-3)
    planned = by_elements(plan(pulled, device)) if finely else None
    found = [
        Simulation(own, device=device, starts=start, plan=p).evaluate() for own, p in ((scene, None), (pulled, planned))
    ]
    share = []
    for spec in scene.resolved_flagella():
        weights = np.full(spec.segment_count + 1, spec.segment_length)
        weights[[0, -1]] /= 2
        share.append(weights)
    carried = np.concatenate(share)[:, None] * PER_LENGTH
    scale = np.abs(found[1].forces).max()
    assert np.abs(found[1].forces - found[0].forces - carried).max() < TOLERANCE[precision] * scale
    roots = anchors(scene)
    on_body = found[1].body_force - found[0].body_force
    assert np.abs(on_body - carried[roots].sum(axis=0) - ON_BODY).max() < TOLERANCE[precision] * scale
    arms = np.stack([x[0] for x in start.positions]) - start.body_position
    torque = np.cross(arms, carried[roots]).sum(axis=0)
    assert np.abs(found[1].body_torque - found[0].body_torque - torque).max() < TOLERANCE[precision] * scale


def test_the_total_is_force_times_length_and_the_force_on_the_body(precision, device):
    """Elastic and contact forces cancel in the sum over a whole cell; what is left is what is applied from outside."""
    scene = touching_cell({**VALUES, "flagellum.1.length": 1.0}, precision)
    start = shaken(scene, seed=3, node=2e-3, spin=0.01)
    found = evaluated(scene, start, device)
    free = np.setdiff1d(np.arange(len(found.forces)), found.first)
    lengths = sum(spec.length for spec in scene.resolved_flagella())
    total = found.forces[free].sum(axis=0) + found.body_force
    assert np.abs(total - lengths * PER_LENGTH - ON_BODY).max() < 50 * TOLERANCE[precision] * np.abs(found.forces).max()


@pytest.mark.parametrize("turned", [False, True])
def test_it_acts_in_lab_axes(turned, device):
    """Turned as a whole, the cell feels the force turned back, and nothing else changes."""
    turn, scene = np.array([0.4, -0.8, 0.3]) * turned, cell()
    rotation = matrix(moved_rigidly(initial_state(scene), turn, np.zeros(3)).body_orientation)
    start = shaken(scene, seed=4, node=1e-3, body=0.0)
    back = {"external.force_per_length": tuple(PER_LENGTH @ rotation), "external.body_force": tuple(ON_BODY @ rotation)}
    here = evaluated(with_values(scene, back), start, device)
    there = evaluated(with_values(scene, VALUES), moved_rigidly(start, turn, np.zeros(3)), device)
    assert np.abs(here.forces @ rotation.T - there.forces).max() < 1e-10 * np.abs(here.forces).max()
    assert np.abs(here.body_velocity @ rotation.T - there.body_velocity).max() < 1e-10 * np.abs(here.velocities).max()


def test_power_supplied_is_dissipation_and_stored_energy(precision, device):
    scene = touching_cell(VALUES, precision)
    start = shaken(scene, seed=5, node=1e-3, spin=0.01)
    found = evaluated(scene, start, device)
    balance = power_balance(found)
    assert set(balance.supplied) == {"motor", "external"} and abs(balance.supplied["external"]) > 1.0

    def at(time: float) -> float:
        motion = (found.velocities, found.spins, found.body_velocity, found.body_spin)
        return energy(scene, displaced(scene, start, *(time * rate for rate in motion)))

    step = 1e-5 / max(np.abs(found.velocities).max(), np.abs(found.spins).max())
    assert abs(balance.stored - slope(at, step)) < POWER[precision] * balance.dissipated


@pytest.mark.parametrize("stepper", ["euler", "rkc", "implicit"])
def test_a_body_at_rest_is_pulled_at_its_mobility(stepper, precision, device):
    """At first no flagellum resists; later the cell moves as far as its velocity says."""
    values = {"flagella.length": 1.0, "motor.torque": 1e-6, "external.body_force": (0.0, 0.0, 0.5)}
    scene = cell({**values, "numerics.stepper": stepper}, precision)
    sim = Simulation(scene, device=device)
    mobility = spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity).along
    assert sim.evaluate().body_velocity[2] == pytest.approx(
        0.5 * mobility, rel=1e-5 if precision == "float64" else 1e-2
    )
    duration, velocity, start = (2e-7 if stepper == "euler" else 2e-5), [], 0.0
    for k in range(21):
        sim.advance(duration * (1 + k / 20))
        velocity.append(sim.evaluate().body_velocity[2])
        start = start if k else sim.state.body_position[2]
    moved = sim.state.body_position[2] - start
    assert moved == pytest.approx(np.trapezoid(velocity, dx=duration / 20), rel=1e-2)
    assert 0.1 < velocity[-1] / (0.5 * mobility) < 1.0


def test_steppers_agree_and_their_work_balances(precision, device):
    """Pulled and swimming for 50 us, in contact: implicit and rkc lead to the same place, and the work of motors and of
    the pull is what was dissipated and stored."""
    pull = {"external.force_per_length": tuple(10 * PER_LENGTH), "external.body_force": tuple(10 * ON_BODY)}
    scene = touching_cell({**pull, "numerics.time_step": 5e-7}, precision)
    ends, begin, end, count = {}, 2e-5, 5e-5, 30
    for stepper in ("rkc", "implicit"):
        own = with_values(scene, {"numerics.stepper": stepper})
        sim, dissipated, supplied = Simulation(own, device=device), [], []
        for k in range(count + 1):
            sim.advance(begin + (end - begin) * k / count)
            balance = power_balance(sim.evaluate())
            dissipated.append(balance.dissipated)
            supplied.append(balance.supplied["external"])
            if k == 0:
                before, turned = energy(own, as_start(own, sim.cell_state())), sim.cell_state().motor_angle.sum()
        state, interval = sim.cell_state(), (end - begin) / count
        work = 3.4 * (state.motor_angle.sum() - turned) + np.trapezoid(supplied, dx=interval)
        left = work - np.trapezoid(dissipated, dx=interval) - energy(own, as_start(own, state)) + before
        assert abs(left) < (1e-2 if precision == "float64" else 5e-2) * work, stepper
        assert abs(np.trapezoid(supplied, dx=interval)) > 0.02 * work
        ends[stepper] = state.positions
    moved = np.abs(ends["rkc"] - np.concatenate(initial_state(scene).positions)).max()
    # Neither resolves the nanoseconds in which the motors start.
    assert np.abs(ends["rkc"] - ends["implicit"]).max() < (5e-3 if precision == "float64" else 2e-2) * moved


def test_without_it_nothing_is_allocated_and_the_kernels_are_those_of_before(device):
    bare = Simulation(cell(), device=device).system.model
    assert bare.data.external is None
    assert "external" not in [term.name for term in bare.terms]
    zero = cell({"external.force_per_length": (0.0, 0.0, 0.0)})
    assert Simulation(zero, device=device).system.model.switches == bare.switches
    assert "external" in [term.name for term in Simulation(cell(VALUES), device=device).system.model.terms]


def test_a_batch_may_differ_in_its_forces(device):
    scenes = [cell({"external.body_force": (0.0, 0.0, f)}) for f in (1.0, 3.0)]
    sim = Simulation(scenes, device=device)
    found = [
        sim.evaluate(c).body_force[2] - evaluated(cell(), initial_state(cell()), device).body_force[2] for c in (0, 1)
    ]
    assert found == pytest.approx([1.0, 3.0])


@pytest.mark.parametrize("key", ["external.force_per_length", "external.body_force"])
def test_nonsense_is_refused_by_name(key):
    for value in ((1.0, 2.0), (0.0, np.nan, 0.0), (0.0, 0.0, 1e9)):
        with pytest.raises(SceneError, match=key):
            with_values(cell(), {key: value})
