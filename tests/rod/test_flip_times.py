"""When joints flip: as the moments and ramps say, whatever the steps and the stepper."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import cell
from tests.rod.test_polymorphs import HELD, REAL_HOOK, forms
from warpflag.run.simulation import Simulation

ACCURACIES = {"float64": 1e-4, "float32": 1e-3}
"""Of the finest run: float32 resolves no finer one [um per ms]."""
STEPPERS = {"float64": ("implicit", "rkc"), "float32": ("implicit",)}
"""Fewer in float32: what looks at joints is one for both."""
TIME_TOLERANCE = 3e-7
"""To which flips agree [s]; ramps take 1e-4 or more."""


def flipped(sim: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Joints that have flipped, and when they did last [s]."""
    changed = sim.system.state.optional.forms.changed.numpy()
    joints = np.flatnonzero(changed >= 0.0)
    return joints, changed[joints]


@pytest.mark.parametrize("speed", [200.0, 400.0, 1000.0])
def test_a_front_travels_at_the_speed_of_the_scene_whatever_the_segment_length(speed, device):
    """Beyond the end in which joints flip by themselves one joint after the other flips, a ramp apart."""
    for stepper, h in (("implicit", 0.2), ("implicit", 0.1), ("rkc", 0.2)):
        values = {**HELD, **REAL_HOOK, "polymorphs.front_speed": speed, "flagella.segment_length": h}
        sim = Simulation(cell({**values, "motor.torque": -3.4, "numerics.stepper": stepper}), device=device)
        sim.advance(1.6 / speed)
        joints, times = flipped(sim)
        beyond = joints > 0.6 / h + 1
        assert beyond.sum() >= 0.7 / h
        np.testing.assert_allclose(np.diff(times[beyond]), h / speed, rtol=1e-9)


@pytest.mark.parametrize("values", [{"polymorphs.ramp": 2e-4, "flagella.segment_length": 0.1, "flagella.length": 3.0},
                                    {"polymorphs.front_speed": 2e3}])  # fmt: skip
def test_joints_flip_at_times_that_neither_accuracy_nor_stepper_changes(values, precision, device):
    """Under a torque that comes at once the moment passes the joints near the root within 0.3 us of one another.

    In the second scene, of a front ten times as fast as real ones, three joints flip to and fro, one of them back at
    the end of its ramp, just before the moment for that has gone. Looking at the ends of steps alone, or letting a
    joint wait for a neighbour that it does not follow, sets other joints going: poses differ by hundreds to thousands
    of times the accuracy.
    """
    found = {}
    for stepper in STEPPERS[precision]:
        for accuracy in (5e-3, ACCURACIES[precision]):
            own = {**HELD, **REAL_HOOK, **values, "motor.torque": -3.4, "numerics.accuracy": accuracy}
            sim = Simulation(cell({**own, "numerics.stepper": stepper}, precision), device=device)
            sim.advance(2e-3)
            found[stepper, accuracy] = *flipped(sim), forms(sim), sim.state.positions
    joints, times, last, positions = found["implicit", ACCURACIES[precision]]
    for (_, accuracy), other in found.items():
        np.testing.assert_array_equal(other[0], joints)
        np.testing.assert_array_equal(other[2], last)
        np.testing.assert_allclose(other[1], times, rtol=0.0, atol=TIME_TOLERANCE)
        assert np.linalg.norm(other[3] - positions, axis=1).max() < accuracy * 2.0


SHORT = {
    "flagella.count": 1, "flagella.length": 1.4778, "flagella.segment_length": 0.1, "flagella.opening_angle": 119.0,
    "flagella.anchor_offset": 0.257, "flagella.intrinsic_curvature": (0.0, 1.292, 2.379),
    "flagella.nodes_on_helix": True, "motor.torque": 3.07, "motor.axis_angle": 76.2, "hook.stiffness": 6.64,
    "hook.stiffening_torque": 0.118, "polymorphs.enabled": True, "polymorphs.target": "semicoiled",
    "polymorphs.second": "coiled", "polymorphs.second_rate": 1941.29, "polymorphs.front_speed": 262.7,
    "polymorphs.nucleation": 0.8038, "fluid.viscosity": 0.021, "hydrodynamics.mode": "none", "body.length": 1.675,
    "body.width": 0.552, "steric.enabled": False, "numerics.stepper": "implicit",
}  # fmt: skip
"""A short filament, all of it near an end, in which joints flip by themselves and beside others, and go on."""


def test_a_joint_flips_by_itself_once_no_neighbour_leads_it(precision, device):
    """From the time on at which that one flips, within a step; a step later, another joint stayed in its form."""
    found = []
    for accuracy in (5e-3, 3e-4):
        sim = Simulation(cell({**SHORT, "numerics.accuracy": accuracy}, precision), device=device)
        sim.advance(2.3e-3)
        found.append((*flipped(sim), forms(sim), sim.state.positions))
    (joints, times, last, positions), (own_joints, own_times, own_last, own_positions) = found
    np.testing.assert_array_equal(joints, own_joints)
    np.testing.assert_array_equal(last, own_last)
    np.testing.assert_allclose(times, own_times, rtol=0.0, atol=5e-6)  # steps of 3e-5 s
    assert np.linalg.norm(positions - own_positions, axis=1).max() < 5e-3


def test_ramps_that_end_within_the_step_that_they_begin_in_keep_the_power_balance(device):
    values = {**HELD, **REAL_HOOK, "motor.torque": -1.26, "polymorphs.front_speed": 1e4, "body.anchored": False}
    sim = Simulation(cell(values), device=device)
    sim.advance(1e-3)
    assert forms(sim).sum() >= 3
    assert int(sim.stepper.balance.refused.numpy()[0]) == 0
