"""Elastic forces: the exact gradient of the discrete rod's energy, and its known answers."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.helpers import anchors, attachment, cell, evaluated, free_nodes, placed, rod, shaken, tangents, unit
from tests.oracles import elastic_energies, energy_gradient, steric_energy
from warpflag.model.geometry import initial_state
from warpflag.run.simulation import Simulation

# Of the largest force or torque of its kind. float32 loses digits where a length is compared with the rest length.
TOLERANCE = {"float64": 1e-7, "float32": 2e-3}

SCENES = {
    "paper": {},
    "unequal": {
        "flagella.count": 3,
        "flagella.bending_rigidity": 2.3,
        "flagella.twist_rigidity": 4.7,
        "flagella.stretching_stiffness": 640.0,
        "flagella.intrinsic_curvature": (0.4, 1.1, -1.7),
        "flagella.hook_twist_factor": 2.2,
        "flagellum.0.length": 1.1,
        "flagellum.0.segments": 4,
        "flagellum.1.length": 1.7,
        "flagellum.1.segments": 11,
        "flagellum.2.tilt": 80.0,
        "flagellum.2.motor_axis_angle": 10.0,
        "flagellum.2.anchor_offset": -0.3,
    },
}


def close(value, expected, precision: str, scale: float | None = None) -> bool:
    largest = np.abs(expected).max() if scale is None else scale
    return np.abs(np.asarray(value) - expected).max() < TOLERANCE[precision] * largest


@pytest.mark.parametrize("values", SCENES.values(), ids=SCENES)
def test_forces_and_torques_are_the_energy_gradient(values, precision, device):
    scene = cell(values, precision)
    start = shaken(scene, seed=1)
    assert abs(steric_energy(scene, start)) < 1e-15  # nothing but elasticity here, to round-off
    expected = energy_gradient(scene, start, lambda *at: elastic_energies(*at).sum())
    found = evaluated(scene, start, device)

    nodes, first = free_nodes(scene), anchors(scene)
    motor = np.array([spec.torque for spec in scene.resolved_flagella()])
    torques = found.torques.copy()
    torques[first] -= motor
    assert close(found.forces[nodes], expected.forces[nodes], precision)
    assert close(torques, expected.torques, precision)
    # The body carries r_0 and the motor axes: virtual work of its motion, with the nodes r_1..r_N held.
    reaction = motor @ np.array([t[0] for t in tangents(scene, start)])
    assert close(found.body_force, expected.body_force, precision)
    assert close(found.body_torque + reaction, expected.body_torque, precision, scale=np.abs(found.forces).max())


@pytest.mark.parametrize("values", SCENES.values(), ids=SCENES)
def test_energy(values, precision, device):
    scene = cell(values, precision)
    start = shaken(scene, seed=2)
    sim = Simulation(scene, device=device, starts=start)
    sim.evaluate()
    assert close(sim.cell_state().elastic_energy, elastic_energies(scene, start), precision)


def test_ground_state_is_free_of_force_and_energy(precision, device):
    scene = cell({"flagella.length": 6.0}, precision)
    start = initial_state(scene)
    sim = Simulation(scene, device=device, starts=start)
    found = sim.evaluate()
    # Compared with a strain of 1 %.
    scale = 0.01 * scene.flagella.stretching_stiffness
    assert close(found.forces, 0 * found.forces, precision, scale)
    torques = found.torques.copy()
    torques[anchors(scene)] -= scene.motor.torque
    assert close(torques, 0 * torques, precision, scene.flagella.twist_rigidity)
    assert sim.cell_state().elastic_energy.sum() < TOLERANCE[precision] * 1.0


def rod_along(scene, tangent, e1=None):
    """A rod with segments of rest length along given tangents, shape [N, 3]."""
    (spec,) = scene.resolved_flagella()
    anchor, _ = attachment(scene, spec)
    nodes = anchor + np.cumsum(spec.segment_length * tangent, axis=0)
    return placed(scene, [nodes], None if e1 is None else [e1])


def test_circular_arc_carries_bending_moment(precision, device):
    """Joints bent by beta: energy (A/2h)(2 tan(beta/2))^2 each; only the ends of the arc feel its moment."""
    scene = rod({"numerics.precision": precision})
    beta, h, rigidity = 0.2, 0.2, scene.flagella.bending_rigidity
    count = scene.resolved_flagella()[0].segment_count
    angle = beta * np.arange(count)
    start = rod_along(scene, np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1))
    sim = Simulation(scene, device=device, starts=start)
    found = sim.evaluate()
    bending = (count - 1) * rigidity / (2 * h) * (2 * math.tan(beta / 2)) ** 2
    assert close(sim.cell_state().elastic_energy, [bending, 0.0, 0.0], precision)
    # dE/d(beta) of a joint, a couple on the segment at the free end.
    moment = rigidity / h * 2 * math.tan(beta / 2) / math.cos(beta / 2) ** 2
    x = start.positions[0]
    outward = unit(np.cross([0.0, 1.0, 0.0], x[-1] - x[-2]))
    assert close(found.forces[-1], -moment / h * outward, precision)
    assert close(found.forces[3:-2], 0 * found.forces[3:-2], precision, moment / h)


def test_twisted_rod_carries_twisting_moment(precision, device):
    """Straight, every joint twisted by a: torque -C a/h on the last segment, +C a/h on the first, none between."""
    scene = rod({"numerics.precision": precision, "flagella.twist_rigidity": 5.0, "motor.torque": 0.0})
    a, h = 0.3, 0.2
    count = scene.resolved_flagella()[0].segment_count
    angle = a * np.arange(count)
    along = np.tile([0.0, 0.0, 1.0], (count, 1))
    start = rod_along(scene, along, np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))
    sim = Simulation(scene, device=device, starts=start)
    found = sim.evaluate()
    expected = np.zeros(count + 1)
    expected[1], expected[-1] = 5.0 * a / h, -5.0 * a / h
    assert close(found.torques, expected, precision)
    assert close(sim.cell_state().elastic_energy, [0.0, (count - 1) * 5.0 / (2 * h) * a**2, 0.0], precision)


def test_hook_is_three_times_stiffer_in_twist_and_bends_freely(precision, device):
    scene = rod({"numerics.precision": precision})
    (spec,) = scene.resolved_flagella()
    start = rod_along(scene, np.tile(unit(np.array([0.2, 0.5, 0.9])), (spec.segment_count, 1)))
    found = evaluated(scene, start, device)
    assert close(found.torques, np.r_[spec.torque, np.zeros(spec.segment_count)], precision)  # bent, no moment
    tripod, m = start.directors[0][:1], attachment(scene, spec)[1]
    start.directors[0][0] = tripod * math.cos(0.2) + np.cross(m, tripod) * math.sin(0.2)
    found = evaluated(scene, start, device)
    moment = 3 * 3.5 / 0.2 * 0.2  # 3C/h times the twist
    assert close(found.torques[:2], [spec.torque - moment, moment], precision)


def test_stretched_rod_pulls_with_its_stiffness(precision, device):
    """The whole rod 1 % longer: tension K/100 at both ends and none between."""
    scene = rod({"numerics.precision": precision})
    (spec,) = scene.resolved_flagella()
    start = rod_along(scene, np.tile([0.0, 0.0, 1.01], (spec.segment_count, 1)))
    found = evaluated(scene, start, device)
    expected = np.zeros_like(found.forces)
    expected[0, 2], expected[-1, 2] = 10.0, -10.0
    assert close(found.forces, expected, precision)
    assert close(found.body_force, [0.0, 0.0, 10.0], precision)
