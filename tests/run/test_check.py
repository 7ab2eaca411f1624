"""`warpflag check`: what a scene leaves out, how large that would be, and the time that it takes."""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.runs import small
from warpflag.run.check import report
from warpflag.run.check.left_out import EFFECTS, left_out
from warpflag.run.check.polymorphs import of_polymorphs
from warpflag.run.check.rigid import mesh_dependence, turning
from warpflag.run.check.time_needed import Needed
from warpflag.run.simulation import Simulation


def lines(**values):
    scene = small({key.replace("__", "."): value for key, value in values.items()})
    return left_out(scene, turning(scene))


def test_an_effect_that_the_scene_has_is_not_told():
    plain = lines()
    assert len(plain) == len(EFFECTS)
    for key, word in {"hook__stiffness": "hook stiffness", "hook__length": "hook length"}.items():
        assert any(line.startswith(word) for line in plain)
        assert not any(line.startswith(word) for line in lines(**{key: 0.05}))
    assert not any("lubrication" in line for line in lines(flagella__count=1))
    assert not any("hook length" in line for line in lines(body__contact=False))


def test_a_stiff_helix_turns_as_resistive_force_theory_says():
    """Local drag alone: closed forms for a helix of many segments, free to move along its axis."""
    scene = small({"flagella.length": 6.0, "flagella.segment_length": 0.05, "hydrodynamics.mode": "none"})
    found = turning(scene)
    o = np.array(scene.flagella.intrinsic_curvature)
    strain, (along, across, spin) = np.linalg.norm(o), (1.6e-3, 2.8e-3, 1.26e-6)
    radius, c = abs(o[1]) / strain**2, abs(o[2]) / strain
    s = math.sqrt(1 - c * c)
    turn = radius**2 * (along * s * s + across * c * c) + spin * c * c
    move, mixed = along * c * c + across * s * s, radius * s * c * (across - along)
    expected = scene.motor.torque / (6.0 * (turn - mixed**2 / move)) / (2 * math.pi)
    assert found.rate == pytest.approx(expected, rel=0.03)
    assert found.axial_length == pytest.approx(6.0 * c, rel=0.01) and found.radius == pytest.approx(radius, rel=0.01)


@pytest.mark.parametrize("mode, length, torque", [("all", 3.0, 2.0), ("none", 4.0, 1.0)])
def test_the_mesh_error_is_told_within_a_factor_of_two(mode, length, torque):
    """Beside the rate of a single flagellum on an anchored body, on both meshes."""
    rates = []
    values = {"flagella.length": length, "motor.torque": torque, "hydrodynamics.mode": mode, "flagella.count": 1}
    for h in (0.3, 0.15):
        scene = small({**values, "body.anchored": True, "body.contact": False, "flagella.segment_length": h})
        sim = Simulation(scene, device="cpu")
        sim.advance(1e-3)
        angle = sim.state.motor_angle[0]
        sim.advance(3e-3)
        rates.append(sim.state.motor_angle[0] - angle)
    told = mesh_dependence(small({**values, "flagella.segment_length": 0.3}), 0.5)
    assert told is not None and 0.5 < told / (rates[0] / rates[1] - 1) < 2.0


def test_the_time_is_a_range_of_its_parts():
    time = Needed(startup=1.0, compiling=0.0, sampled=0.5, rest=2.0, output=0.3, crowd=3.0)
    assert time.least < time.startup + time.stepping + time.output < time.most
    said = report(small(), "cpu")
    assert "# time " in said and "frames, record and movie" in said and "# What it leaves out" in said
    assert "Reynolds number" in said


@pytest.mark.parametrize(
    "values, word",
    [
        ({}, "against the handedness"),
        ({"motor.torque": -1.0}, "beyond 1 pN um, below polymorphs.nucleation 1.1"),
        ({"motor.torque": -1.2}, None),
        ({"motor.torque": 1.2, "flagella.intrinsic_curvature": (0.0, 1.3, 2.1)}, None),
        ({"motor.torque": 1.2, "motor.switching": "schedule"}, "against the handedness"),
        ({"motor.torque": 1.2, "motor.switching": "schedule", "motor.switch_times": (1e-3,)}, None),
        ({"motor.switching": "markov", "motor.reverse_torque": 0.9}, "beyond 0.9 pN um, below"),
        ({"motor.switching": "markov", "motor.torque": 1.3, "motor.law": "torque_speed"}, "1.3 only while they switch"),
        ({"motor.torque": -1.0, "polymorphs.nucleation": 0.9}, None),
        ({"motor.torque": -1.0, "polymorphs.enabled": False}, None),
        ({"motor.law": "rate"}, None),
    ],
)
def test_polymorphs_that_no_motor_can_reach_are_told(values, word):
    scene = small({"polymorphs.enabled": True, "flagella.length": 6.0, **values})
    found = of_polymorphs(scene, turning(scene))
    assert len(found) == (word is not None)
    assert all(word in line for line in found)


def test_the_torque_on_a_curve_is_where_it_meets_the_drag():
    """Steady in reverse on the straight line of its curve: told to within its printed digits."""
    values = {"motor.torque": 3.0, "motor.law": "torque_speed", "motor.switching": "markov", "flagella.length": 6.0}
    scene = small({"polymorphs.enabled": True, "polymorphs.nucleation": 2.9, **values})
    stiff = turning(scene)
    (line,) = of_polymorphs(scene, stiff)
    torque = float(line.split("about ")[1].split()[0])
    assert torque == pytest.approx(3.0 * (1 - torque / stiff.drag / 300.0), rel=0.05)
