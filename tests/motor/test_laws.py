"""Motors on a torque-speed curve or at a prescribed rate: torques at one moment, in the steps of both steppers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from warpflag_kernels.implicit import motor_solve

from tests.bench import bench, dense_system, displacements, flat, spins
from tests.helpers import as_start, cell, matrix, shaken
from tests.plans import by_elements, plan
from tests.stepping.test_balance import imbalance
from warpflag.observables import power_balance
from warpflag.run.simulation import Evaluation, Simulation
from warpflag.scene import Scene, SceneError, with_values
from warpflag.scene.resistance import spheroid_mobility

# Relative to the largest value of its kind.
TOLERANCE = {"float64": 1e-9, "float32": 2e-3}
CURVE = {"motor.law": "torque_speed", "motor.torque": 1.26, "motor.knee": 100.0, "motor.no_load": 300.0}
# A small body, which the motors turn fast.
SMALL = {"body.length": 0.5, "body.width": 0.4, "flagella.anchor_offset": 0.0}
UNEQUAL = {
    **CURVE,
    "flagella.count": 3,
    "flagellum.0.law": "constant",
    "flagellum.0.torque": 0.8,
    "flagellum.1.knee": 20.0,
    "flagellum.2.law": "rate",
    "flagellum.2.rate": 90.0,
}


def rates(found: Evaluation) -> np.ndarray:
    """Of the motors relative to the body [Hz]."""
    return (found.spins[found.first] - found.tangents[found.first] @ found.body_spin) / (2 * np.pi)


def on_curve(torque: float, knee: float, end: float, rate: Any) -> Any:
    """The law in its own sense [pN um], rates in Hz."""
    return torque * np.clip((end - np.asarray(rate)) / (end - knee), 0.0, 1.0)


@pytest.mark.parametrize("finely", [False, True])
@pytest.mark.parametrize("turned", [0.0, -0.004, -0.02, -0.1, 0.02])
def test_torque_and_rate_lie_on_the_curve_and_turn_the_body(finely, turned, precision, device):
    """Hooks wound up by different angles put the motors on every piece of their curves."""
    scene = cell({**UNEQUAL, **SMALL, "steric.enabled": False, "body.contact": False}, precision)
    start = shaken(scene, seed=2, node=1e-4, spin=1e-3)
    for own in start.directors:  # tripods ahead of or behind their filaments
        t = np.cross(own[0], [0.3, 0.5, 0.8])
        own[0] += turned * t / np.linalg.norm(t)
        own[0] /= np.linalg.norm(own[0])
    planned = by_elements(plan(scene, device)) if finely else None
    found = Simulation(scene, device=device, starts=start, plan=planned).evaluate()
    # float32: a rate is the difference of two torques times a large mobility.
    digits = {"float64": 1e-7, "float32": 0.5}[precision]
    f, t = rates(found), found.motor_torques
    assert t[0] == pytest.approx(0.8, rel=1e-6)
    assert t[1] == pytest.approx(on_curve(1.26, 20.0, 300.0, f[1]), abs=1.26 / 280.0 * digits)
    assert f[2] == pytest.approx(90.0, abs=digits)
    # What turns the body is all of it: motors, forces at the anchors, bearings.
    body = spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity)
    axis = matrix(start.body_orientation)[:, 2]
    spin = body.tumble * found.body_torque + (body.spin - body.tumble) * (found.body_torque @ axis) * axis
    assert np.abs(found.body_spin - spin).max() < TOLERANCE[precision] * np.abs(spin).max()
    assert np.abs(found.tangents[found.first] @ found.body_spin).max() > 1.0


@pytest.mark.parametrize(("knee_back", "end"), [(0.0, None), (40.0, 150.0)])
def test_without_load_a_motor_runs_at_the_end_of_its_curve(knee_back, end, device):
    """The tripod's own drag is a two-thousandth of the slope; in reverse the other curve holds, mirrored."""
    reverse = {"motor.reverse_torque": 0.9, "motor.reverse_no_load": end, "motor.reverse_knee": knee_back}
    scene = cell({**CURVE, "motor.switching": "schedule", "motor.switch_times": (0.0,), **reverse})
    half = 0.25 * scene.motor.switch_ramp  # the drive is one half there, which makes the curve half as high
    for time, sign, stall, knee, last in (
        (0.0, 1.0, 1.26, 100.0, 300.0),
        (half, 1.0, 0.63, 100.0, 300.0),
        (1.0, -1.0, 0.9, knee_back, end or 300.0),
    ):
        start = shaken(scene, seed=1, node=0.0, spin=0.0)
        sim = Simulation(scene, device=device, starts=start)
        sim.system.control.time.fill_(time)
        found = sim.evaluate()
        assert rates(found) == pytest.approx(sign * last, rel=2e-3)
        assert found.motor_torques == pytest.approx(sign * on_curve(stall, knee, last, sign * rates(found)), abs=1e-9)


def test_reversed_motors_are_mirrored(device):
    scene = cell({**UNEQUAL, **SMALL})
    turned = {"motor.torque": -1.26, "flagellum.0.torque": -0.8, "flagellum.2.rate": -90.0}
    straight = {"flagella.intrinsic_curvature": (0.0, 0.0, 0.0)}
    found = [
        Simulation(with_values(scene, {**straight, **values}), device=device).evaluate() for values in ({}, turned)
    ]
    np.testing.assert_allclose(found[0].motor_torques, -found[1].motor_torques, rtol=1e-9)
    np.testing.assert_allclose(rates(found[0]), -rates(found[1]), rtol=1e-9)


def run(scene: Scene, device: str, time: float, start: Any = None) -> Simulation:
    sim = Simulation(scene, device=device, starts=start)
    sim.advance(time if start is None else start.time + time)
    return sim


def mean_rate(sim: Simulation) -> float:
    """Of the first motor over the next millisecond [Hz]. (At a constant torque the rate of one moment is the difference
    of two torques times a large mobility, and says little of a step's accuracy.)"""
    before, time = sim.state.motor_angle[0], sim.times[0]
    sim.advance(time + 1e-3)
    return (sim.state.motor_angle[0] - before) / (2 * np.pi * 1e-3)


ONE = {
    **CURVE,
    "flagella.count": 1,
    "flagella.opening_angle": 0.0,
    "motor.axis_angle": 0.0,
    "body.contact": False,
    "hydrodynamics.mode": "none",
}


@pytest.mark.parametrize("stall", [0.004, 1.26])
@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_stationary_point_is_the_intersection_of_curve_and_load(stepper, stall, device):
    """A straight rod on a held body spins against its own drag, gamma_R (L + h) with the tripod's. A torque taken
    from the rate of the last step would bear steps of 1e-9 s at 1.26 pN um. (rkc damps twist little in long steps.)"""
    values = {**ONE, "body.anchored": True, "numerics.stepper": stepper}
    values |= {"numerics.time_step": 4e-5 if stepper == "implicit" else 4e-6}
    values |= {"flagella.intrinsic_curvature": (0.0, 0.0, 0.0), "motor.torque": stall, "flagella.length": 1.0}
    sim = run(cell(values), device, 2e-3)
    found = sim.evaluate()
    slope, load = stall / (2 * np.pi * 200.0), 1.26e-6 * 1.2
    rate = 300.0 * slope / (slope + load)
    assert rate > 100.0
    assert rates(found)[0] == pytest.approx(rate, rel=1e-6)
    assert found.motor_torques[0] == pytest.approx(2 * np.pi * rate * load, rel=1e-6)
    assert mean_rate(sim) == pytest.approx(rate, rel=1e-6)


def test_steps_are_of_second_order_through_the_knee_and_the_steppers_agree(device):
    """The drive falls along a ramp and both motors pass their knees, at different times."""
    values = {
        **CURVE,
        **SMALL,
        "motor.torque": 0.3,
        "motor.knee": 250.0,
        "motor.switching": "schedule",
        "motor.switch_times": (0.2e-3,),
        "motor.switch_ramp": 2e-3,
        "flagellum.1.torque": 0.25,
        "flagellum.0.phase": 10.0,
        "flagellum.1.phase": 170.0,
        "hydrodynamics.mode": "none",
        "steric.enabled": False,
        "body.contact": False,
    }

    def end(stepper: str, step: float) -> np.ndarray:
        sim = run(cell({**values, "numerics.stepper": stepper, "numerics.time_step": step}), device, 1e-3)
        return np.concatenate([sim.state.positions.ravel(), sim.state.motor_angle])

    sim = run(cell({**values, "numerics.time_step": 2e-6}), device, 2e-4)
    slopes = [rates(sim.evaluate()) > 250.0]
    sim.advance(1e-3)
    assert slopes[0].all() and (rates(sim.evaluate()) < 100.0).all()
    reference = end("rkc", 5e-7)
    for stepper, steps in (("implicit", (4e-6, 1.6e-5)), ("rkc", (4e-6, 1.6e-5))):
        fine, coarse = (np.abs(end(stepper, step) - reference).max() for step in steps)
        assert fine < 5e-5
        assert coarse > 9 * fine  # second order: 16; first: 4


@pytest.mark.parametrize("hook", [{}, {"hook.length": 0.037, "hook.stiffness": 1.35, "motor.reverse_torque": 0.47}])
def test_rkc_keeps_its_accuracy_where_motors_turn_back_within_a_ramp(hook, precision, device):
    """They are let go and caught again: tripods spring back at hundreds of turns per second, which no node feels."""
    values = {
        **CURVE,
        **hook,
        "flagellum.0.length": 2.7,
        "flagellum.1.length": 3.0,
        "flagella.bending_rigidity": 16.0,
        "flagella.stretching_stiffness": 6000.0,
        "flagellum.0.torque": -0.8,
        "flagellum.1.torque": 0.8,
        "motor.knee": 30.0,
        "motor.no_load": 82.0,
        "motor.switching": "schedule",
        "motor.switch_times": (0.5e-4, 1.32e-4),
        "motor.switch_ramp": 1.8e-4,
        "hydrodynamics.mode": "none",
        "steric.enabled": False,
        "body.contact": False,
    }
    exact = run(cell({**values, "numerics.stepper": "implicit", "numerics.accuracy": 1e-4}), device, 4e-4).state
    found = run(cell({**values, "numerics.stepper": "rkc"}, precision), device, 4e-4).state
    away = np.linalg.norm(found.positions - exact.positions, axis=1).max()
    assert away < 5e-3 * 0.4**0.5  # what the default accuracy allows after 0.4 ms


def test_a_prescribed_rate_is_kept_and_its_torque_measured(precision, device):
    """Of a straight rod on a held body, which turns against its own drag."""
    values = {**ONE, "body.anchored": True, "flagella.length": 1.0, "motor.law": "rate", "motor.rate": 60.0}
    values |= {"flagella.intrinsic_curvature": (0.0, 0.0, 0.0)}
    for stepper in ("implicit", "rkc"):
        scene = cell({**values, "numerics.stepper": stepper, "numerics.time_step": 1e-5}, precision)
        sim = run(scene, device, 0.01)
        digits = {"float64": 1e-7, "float32": 1e-3}[precision]
        assert sim.state.motor_angle[0] == pytest.approx(2 * np.pi * 60.0 * 0.01, rel=digits)
        torque, digits = 2 * np.pi * 60.0 * 1.26e-6 * 1.2, {"float64": 1e-6, "float32": 0.1}[precision]
        assert sim.evaluate().motor_torques[0] == pytest.approx(torque, rel=digits)


@pytest.mark.parametrize("law", ["torque_speed", "rate"])
def test_power_of_the_motors_is_dissipated_or_stored(law, device):
    scene = cell({**CURVE, **SMALL, "motor.law": law, "flagellum.1.torque": 0.5, "numerics.time_step": 1e-6})
    start = as_start(scene, run(scene, device, 2e-5).state)
    found = Simulation(scene, device=device, starts=start).evaluate()
    acting = with_values(scene, {f"flagellum.{k}.torque": t for k, t in enumerate(found.motor_torques)})
    assert abs(imbalance(acting, start, found)) < 1e-7
    assert power_balance(found).motor == pytest.approx(2 * np.pi * rates(found) @ found.motor_torques)


def test_torques_of_a_step_are_those_of_the_dense_equations(precision, device):
    """Torques and what they do to an increment, against dense matrices: every motor on its curve at the step's rate."""
    values = {**UNEQUAL, **SMALL, "hydrodynamics.mode": "none", "steric.enabled": False, "body.contact": False}
    exact, b = (bench(values, p, device) for p in ("float64", precision))
    step, gain, weight = 1e-5, 0.7, 0.8
    exact.factorise(step, weight)
    band, s = b.factorise(step, weight), b.stepper
    s.law.gain.fill_(gain)
    s.data.ratio.fill_(0.6)
    held = np.array([0.8, 1.0, 0.2])
    b.state.optional.motor.within_step.assign(held)
    random, size = np.random.default_rng(3), 6 + 4 * b.count
    last, found, x = (2e-3 * random.uniform(-1, 1, size) for _ in range(3))
    last, found, given = (b.increment(y[:6], y[6:].reshape(-1, 4)) for y in (last, found, x))
    motor_solve.prepare(b.model, b.state, band, s.motors)
    motor_solve.solve(b.model, b.state, s.data, band, s.law.gain, s.motors, last, found, s.data.one, given)
    torques, solution = b.state.optional.motor.within_step.numpy().astype(float), flat(given)
    # What a torque T_k adds: P of the load on its tripod and on the body.
    system, mobility = dense_system(exact, step, weight), exact.mobility("none")
    turns = np.zeros((3, size))
    loads = np.zeros((size, 3))
    for k, first in enumerate(b.first):
        m = exact.data.pose.tangent.numpy()[first]
        turns[k, 9 + 4 * first], turns[k, 3:6] = 1.0, -m
        loads[9 + 4 * first, k] = 1.0
        loads[:6, k] = mobility[:6, 3:6] @ -m
    expected = x + np.linalg.solve(system, gain * loads @ (torques - held))
    tolerance = {"float64": 1e-9, "float32": 5e-4}[precision]
    for part in (slice(0, 6), displacements(b), spins(b)):
        assert np.abs(solution - expected)[part].max() < tolerance * np.abs(expected[part]).max()
    rate = turns @ (0.6 * flat(last) + (flat(found) + solution) / gain) / step / (2 * np.pi)
    digits = {"float64": 1e-6, "float32": 0.5}[precision]
    assert torques[0] == pytest.approx(0.8, rel=1e-6)
    assert torques[1] == pytest.approx(on_curve(1.26, 20.0, 300.0, rate[1]), abs=1.26 / 280.0 * digits)
    assert 0.0 < torques[1] < 1.26
    assert rate[2] == pytest.approx(90.0, abs=digits)


def test_constant_torque_has_none_of_it(device):
    sim = Simulation(cell({}), device=device)
    state = sim.system.state.data
    for array in (state.time, state.motor, sim.system.model.data.motor_law):
        assert array is None or array.size == 0
    assert not sim.system.model.timed
    assert next(term.name for term in sim.system.model.terms) == "motor"


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ({"motor.no_load": 100.0, "motor.knee": 100.0}, "motor.no_load"),
        ({"flagellum.1.no_load": 50.0, "flagellum.0.no_load": 300.0}, "flagellum.1.no_load"),
        ({"motor.reverse_knee": 400.0}, "motor.reverse_knee"),
        ({"motor.switch_times": (0.1,)}, "motor.switch_times"),
        ({"motor.switching": "schedule", "motor.switch_times": (0.2, 0.1)}, "motor.switch_times"),
        ({"motor.law": "stepper"}, "motor.law"),
        ({"motor.law": "rate", "fluid.temperature": 300.0, "numerics.stepper": "euler"}, "numerics.stepper"),
    ],
)
def test_what_makes_no_motor_is_refused(values, key):
    with pytest.raises(SceneError) as error:
        cell(values)
    assert key in str(error.value)
    assert "\n" not in str(error.value)
