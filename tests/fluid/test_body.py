"""The cell body: the spheroid's mobility, what the flagella hand to it, and the switches that hold it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.helpers import attachment, cell, evaluated, matrix, quaternion, shaken, tangents, touching_cell
from warpflag.model.geometry import InitialState, initial_state
from warpflag.run.simulation import CellState, Simulation
from warpflag.scene.resistance import SpheroidMobility, spheroid_mobility

# Of the largest value of its kind.
TOLERANCE = {"float64": 1e-12, "float32": 1e-5}

ETA = 1e-3


def ellipsoid_drags(length: float, width: float, viscosity: float) -> tuple[float, float, float, float]:
    """Drag along and across, about and across the axis, from Oberbeck's and Jeffery's integrals over confocal shells.

    With D = sqrt((a^2 + x)(b^2 + x)^2), chi = int dx/D, alpha_i = int dx/((a_i^2 + x) D) over x > 0: force
    16 pi eta/(chi + alpha_i a_i^2), torque 16 pi eta (a_j^2 + a_k^2)/(3 (alpha_j a_j^2 + alpha_k a_k^2)).
    """
    a2, b2 = (length / 2) ** 2, (width / 2) ** 2
    # x = b^2 tan^2 makes the integrands smooth on a finite interval: Gauss-Legendre is then exact to round-off.
    node, weight = np.polynomial.legendre.leggauss(120)
    angle = (node + 1) * math.pi / 4
    x = b2 * np.tan(angle) ** 2
    weight = weight * math.pi / 4 * 2 * b2 * np.tan(angle) / np.cos(angle) ** 2
    shell = weight / (np.sqrt(a2 + x) * (b2 + x))
    chi, alpha, beta = shell.sum(), (shell / (a2 + x)).sum(), (shell / (b2 + x)).sum()
    scale = 16 * math.pi * viscosity
    return (
        scale / (chi + alpha * a2),
        scale / (chi + beta * b2),
        scale * 2 * b2 / (6 * beta * b2),
        scale * (a2 + b2) / (3 * (alpha * a2 + beta * b2)),
    )


def drags(mobility: SpheroidMobility) -> np.ndarray:
    return 1 / np.array([mobility.along, mobility.across, mobility.spin, mobility.tumble])


@pytest.mark.parametrize("width", [0.1, 0.8, 2.0, 2.4998, 2.49995, 2.5])
def test_spheroid_drag_is_the_ellipsoid_integrals(width):
    """Slender to spherical, and on both sides of the change to the series near the sphere."""
    found = drags(spheroid_mobility(2.5, width, ETA))
    assert found == pytest.approx(ellipsoid_drags(2.5, width, ETA), rel=1e-8)


def test_spheroid_drag_of_the_paper_s_body():
    found = drags(spheroid_mobility(2.5, 0.8, ETA))
    assert found == pytest.approx([0.010775, 0.013343, 3.737e-3, 1.2373e-2], rel=2e-4)


def test_sphere_has_stokes_drag():
    found = drags(spheroid_mobility(0.8, 0.8, ETA))
    translation, turning = 6 * math.pi * ETA * 0.4, 8 * math.pi * ETA * 0.4**3
    assert found == pytest.approx([translation, translation, turning, turning], rel=1e-12)


def close(found, expected, precision: str, scale: float | None = None) -> bool:
    largest = np.abs(expected).max() if scale is None else scale
    return bool(np.abs(np.asarray(found) - expected).max() < TOLERANCE[precision] * largest)


def test_body_moves_by_its_mobility(precision, device):
    scene = touching_cell({}, precision)
    start = shaken(scene, seed=12, node=0.002)
    found = evaluated(scene, start, device)
    axis = matrix(start.body_orientation)[:, 2]
    parallel = np.outer(axis, axis)
    along, across, spin, tumble = ellipsoid_drags(2.5, 0.8, ETA)
    force = (along * parallel + across * (np.eye(3) - parallel)) @ found.body_velocity
    torque = (spin * parallel + tumble * (np.eye(3) - parallel)) @ found.body_spin
    assert close(force, found.body_force, precision, 10 * np.abs(found.body_force).max())
    assert close(torque, found.body_torque, precision, 10 * np.abs(found.body_torque).max())


def test_switches_hold_the_body(precision, device):
    """Each takes away the motion it names and leaves forces and the other motions alone."""

    def motion(values: dict) -> tuple[np.ndarray, np.ndarray]:
        scene = touching_cell(values, precision)
        found = evaluated(scene, shaken(scene, seed=13, node=0.002), device)
        return found.body_velocity, found.body_spin

    scene = touching_cell()
    axis = matrix(shaken(scene, seed=13, node=0.002).body_orientation)[:, 2]
    velocity, spin = motion({})
    assert np.abs(velocity).min() > 1 and abs(spin @ axis) > 1

    held_velocity, held_spin = motion({"body.translation": False})
    assert np.all(held_velocity == 0) and np.all(held_spin == spin)
    held_velocity, held_spin = motion({"body.axial_rotation": False})
    assert np.all(held_velocity == velocity)
    assert close(held_spin, spin - (spin @ axis) * axis, precision, np.abs(spin).max())
    held_velocity, held_spin = motion({"body.anchored": True})
    assert np.all(held_velocity == 0) and np.all(held_spin == 0)


def test_a_held_body_stays(device):
    """In a run: an anchored body keeps its pose to the last bit, the others keep what the switch names."""

    def after_run(values: dict) -> CellState:
        sim = Simulation(cell({"numerics.time_step": 2e-6, **values}), device=device)
        sim.advance(2e-5)
        return sim.cell_state()

    free = after_run({})
    assert np.abs(free.body_position).max() > 1e-4 and abs(free.body_angle) > 1e-4
    state = after_run({"body.translation": False})
    assert np.all(state.body_position == 0.0)
    assert state.body_angle == pytest.approx(free.body_angle, rel=0.2)
    state = after_run({"body.axial_rotation": False})
    assert abs(state.body_angle) < 1e-3 * abs(free.body_angle)  # of second order in the tilt that goes on
    assert state.body_position == pytest.approx(free.body_position, rel=0.2, abs=1e-4)
    state = after_run({"body.anchored": True})
    assert np.all(state.body_position == 0.0) and state.body_angle == 0.0
    assert np.all(state.body_orientation == [0.0, 0.0, 0.0, 1.0])
    assert np.abs(state.motor_angle).min() > 1e-3


def test_motor_torque_reacts_on_the_body(precision, device):
    """In the ground state nothing but the motors acts: +T_m on each tripod, -T_m m on the body."""
    scene = cell({"flagellum.0.torque": 2.0, "flagellum.1.torque": -0.7}, precision)
    start = initial_state(scene)
    found = evaluated(scene, start, device)
    specs = scene.resolved_flagella()
    axes = np.array([attachment(scene, spec)[1] for spec in specs])
    count = specs[0].segment_count + 1
    torques = np.zeros(2 * count)
    torques[[0, count]] = 2.0, -0.7
    # Round-off of the elastic terms is that of C/h and K.
    assert close(found.torques, torques, precision, 100.0)
    assert close(found.body_torque, -(2.0 * axes[0] - 0.7 * axes[1]), precision, 1000.0)
    assert close(found.body_force, np.zeros(3), precision, 1000.0)


def twisted_hook(scene, twist: float) -> InitialState:
    """The ground state with the tripod of flagellum 0 turned by minus the twist, on a turned body."""
    start = initial_state(scene)
    m = tangents(scene, start)[0][0]
    e1 = start.directors[0][0]
    start.directors[0][0] = e1 * math.cos(twist) - np.cross(m, e1) * math.sin(twist)
    turn = quaternion([0.3, -0.5, 0.2])
    q = matrix(turn)
    return InitialState(
        tuple(x @ q.T for x in start.positions), tuple(x @ q.T for x in start.directors), np.zeros(3), turn
    )


def test_bearing_torque_of_the_hook(precision, device):
    """The bent joint carries M (m + t)/(1 + m.t): M along m, which the motor answers, and M tan(beta/2) across it.

    The latter acts on the body, unless the scene asks for the paper's form, which drops it.
    """
    moment = 3 * 3.5 / 0.2 * 0.05  # 3C/h times the twist
    scene = cell({"flagellum.0.torque": moment}, precision)
    start = twisted_hook(scene, 0.05)
    m, t = tangents(scene, start)[0][:2]
    beta = math.acos(m @ t)
    assert beta > 0.2
    # On the filament -M (m + t)/(1 + m.t); on the body its opposite less the share M m, which turns the tripod.
    bearing = moment * ((m + t) / (1 + m @ t) - m)
    assert np.linalg.norm(bearing) == pytest.approx(moment * math.tan(beta / 2)) and abs(bearing @ m) < 1e-12
    full = evaluated(scene, start, device)
    without = evaluated(cell({"flagellum.0.torque": moment, "motor.bearing_torque": False}, precision), start, device)
    assert close(full.body_torque - without.body_torque, bearing, precision, 1000.0)
    # Without it the forces at the anchors and the motors are all there is.
    x, axes = start.positions, [t[0] for t in tangents(scene, start)]
    count = len(x[0])
    arms = np.cross(x[0][0], without.forces[0]) + np.cross(x[1][0], without.forces[count])
    assert close(without.body_torque, arms - moment * axes[0] - 3.4 * axes[1], precision, 1000.0)
    assert np.all(full.forces == without.forces)
