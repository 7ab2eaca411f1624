"""The whole swimmer in contact: no net force, no net torque, and every bit of motor work accounted for."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.helpers import anchors, as_start, displaced, free_nodes, matrix, tangents, touching_cell
from tests.oracles import (
    CUTOFF,
    contact_distances,
    dense_mobility,
    drag_coefficients,
    energy,
    expected_pair_radius,
    slope,
    whole_mobility,
)
from warpflag.model.geometry import InitialState
from warpflag.model.shell import body_shell
from warpflag.run.simulation import Evaluation, Simulation
from warpflag.scene import Scene, with_values
from warpflag.scene.resistance import spheroid_mobility

# Net force and torque of the sum of magnitudes; power of the dissipation.
BALANCE = {"float64": 1e-13, "float32": 1e-6}
POWER = {"float64": 1e-7, "float32": 1e-4}

UNEQUAL = {
    "flagella.count": 3,
    "flagellum.2.azimuth": 90.0,
    "flagellum.1.torque": 4.5,
    "flagellum.1.length": 1.2,
    "flagellum.1.segments": 6,
}


HOOK = {"hook.length": 0.055, "hook.stiffness": 2.0, "hook.stiffening_torque": 3.0}
FLOW = {"hydrodynamics.body_flow": True, "hydrodynamics.body_beads": 30}
CASES = {"two": {}, "unequal": UNEQUAL, "hook": HOOK, "hook and body flow": {**HOOK, **FLOW}}


@cache
def state_in_contact(precision: str, device: str, case: str) -> tuple[Scene, InitialState, Evaluation]:
    """Side by side, turned by their motors for 10 us: twisted, bent, and pressed together."""
    scene = touching_cell({"numerics.time_step": 1e-6, "motor.torque": 5.0, **CASES[case]}, precision)
    sim = Simulation(scene, device=device)
    sim.advance(1e-5)
    start = as_start(scene, sim.cell_state())
    pressed = contact_distances(start) < CUTOFF * 0.04
    assert pressed.sum() >= 3
    return scene, start, sim.evaluate()


def arms(start: InitialState) -> np.ndarray:
    return np.concatenate(start.positions) - start.body_position


@pytest.mark.parametrize("case", CASES)
def test_swimmer_is_free_of_net_force_and_torque(case, precision, device):
    scene, start, found = state_in_contact(precision, device, case)
    nodes, t = free_nodes(scene), np.concatenate(tangents(scene, start))
    forces = np.vstack([found.forces[nodes], found.body_force])
    torques = np.vstack([
        np.cross(arms(start)[nodes], found.forces[nodes]),
        found.torques[:, None] * t,
        found.body_torque,
    ])  # fmt: skip
    for vectors in (forces, torques):
        assert np.abs(vectors.sum(axis=0)).max() < BALANCE[precision] * np.linalg.norm(vectors, axis=1).sum()


def test_paper_s_form_is_not_torque_free(device):
    """What dropping the bearing torque costs: the same sum, far from zero."""
    scene, start, _ = state_in_contact("float64", device, "two")
    found = Simulation(with_values(scene, {"motor.bearing_torque": False}), device=device, starts=start).evaluate()
    nodes, t = free_nodes(scene), np.concatenate(tangents(scene, start))
    net = np.cross(arms(start)[nodes], found.forces[nodes]).sum(axis=0) + found.torques @ t + found.body_torque
    assert np.linalg.norm(net) > 0.1


def imbalance(scene: Scene, start: InitialState, found: Evaluation) -> float:
    """(Motor power - dissipation - dE/dt) over the dissipation, from the velocities alone.

    dE/dt: central difference of the elastic and steric energy along the velocity. Dissipation: v.M^-1.v with a dense
    mobility, that of the body and nodes together with flow round it. Motor power: T_m on each tripod's spin, -T_m m on
    the body's.
    """
    nodes, first = free_nodes(scene), anchors(scene)
    v, h = found.velocities[nodes].ravel(), np.array([spec.segment_length for spec in scene.resolved_flagella()])
    counts = [len(x) for x in start.positions]
    spin_drag = drag_coefficients(scene)[2] * np.repeat(h, counts)
    dissipation = spin_drag @ found.spins**2
    if scene.hydrodynamics.body_flow:
        shell = body_shell(scene.body.length, scene.body.width, scene.hydrodynamics.body_beads)
        motions = np.concatenate([found.body_velocity, found.body_spin, v])
        dissipation += motions @ np.linalg.solve(whole_mobility(scene, start, shell.points, shell.radius), motions)
    else:
        dissipation += v @ np.linalg.solve(dense_mobility(scene, start, expected_pair_radius(scene)), v)
        along, across, spin, tumble = body_drags(scene)
        axis = matrix(start.body_orientation)[:, 2]
        for motion, parallel, other in ((found.body_velocity, along, across), (found.body_spin, spin, tumble)):
            dissipation += other * motion @ motion + (parallel - other) * (motion @ axis) ** 2

    motor = np.array([spec.torque for spec in scene.resolved_flagella()])
    m = np.array([t[0] for t in tangents(scene, start)])
    power = motor @ (found.spins[first] - m @ found.body_spin)

    def at(time: float) -> float:
        motion = (found.velocities, found.spins, found.body_velocity, found.body_spin)
        return energy(scene, displaced(scene, start, *(time * rate for rate in motion)))

    # Largest displacement along the difference: 1e-5 um or rad.
    step = 1e-5 / max(np.abs(found.velocities).max(), np.abs(found.spins).max())
    return float((power - dissipation - slope(at, step)) / dissipation)


def body_drags(scene: Scene) -> tuple[float, float, float, float]:
    m = spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity)
    return 1 / m.along, 1 / m.across, 1 / m.spin, 1 / m.tumble


@pytest.mark.parametrize("case", CASES)
def test_motor_power_is_dissipation_and_stored_energy(case, precision, device):
    scene, start, found = state_in_contact(precision, device, case)
    assert abs(imbalance(scene, start, found)) < POWER[precision]


@pytest.mark.parametrize("part", ["velocities", "spins", "body_velocity", "body_spin"])
def test_power_balance_notices_a_wrong_velocity(part, device):
    """A part in a hundred of any share of the motion breaks the balance."""
    scene, start, found = state_in_contact("float64", device, "two")
    wrong = replace(found, **{part: 1.01 * getattr(found, part)})
    assert abs(imbalance(scene, start, wrong)) > 10 * POWER["float64"]


def test_power_balance_notices_a_wrong_mobility(device):
    """The velocities of the pair radius as printed do not balance with the dense matrix of the default one."""
    scene, start, _ = state_in_contact("float64", device, "two")
    printed = with_values(scene, {"hydrodynamics.mode": "as_printed"})
    found = Simulation(printed, device=device, starts=start).evaluate()
    assert abs(imbalance(scene, start, found)) > 1e-4
    assert abs(imbalance(printed, start, found)) < POWER["float64"]


def test_a_step_moves_the_cell_by_its_velocities(precision, device):
    """One step of explicit Euler: nodes and body by their velocities, frames by the minimal rotation and their spin."""
    scene, start, _ = state_in_contact(precision, device, "two")
    step = 1e-9
    scene = with_values(scene, {"numerics.stepper": "euler", "numerics.time_step": step})
    sim = Simulation(scene, device=device, starts=start)
    found = sim.evaluate()
    sim.advance(start.time + step)
    state = as_start(scene, sim.cell_state())
    motion = (found.velocities, found.spins, found.body_velocity, found.body_spin)
    expected = displaced(scene, start, *(step * rate for rate in motion))
    # Of second order in the step, against movements of 1e-5 um and 1e-3 rad.
    allowed = {"float64": 1e-9, "float32": 2e-6}[precision]
    assert sim.cell_state().step == 1
    for name in ("positions", "directors"):
        difference = np.concatenate(getattr(state, name)) - np.concatenate(getattr(expected, name))
        assert np.abs(difference).max() < allowed, name
    assert state.body_position == pytest.approx(expected.body_position, abs=1e-3 * step)
    assert state.body_orientation == pytest.approx(expected.body_orientation, abs=1e-3 * step)
