"""Straight swimming with one polar flagellum on a hook, beside the linear stability of the same nodes as a rigid body.

The oracle, `examples/hydrodynamics/tools/joint.py`, knows dense mobilities and the moment of the joint; it shares no
code with the kernels that a run goes through. `examples/hydrodynamics/tables.py` has the longer form.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from warpflag.scene import with_values

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "hydrodynamics" / "tools"))
import joint  # type: ignore[import-not-found]

TORQUE = 0.38
TWO_TURNS = 0.0175  # s, of the motor
# Of growth rates, over the free joint's, and of thresholds; and of the speed. Measured: 2e-2, 2e-2 and 5e-3.
TOLERANCE = {"float64": (0.1, 0.01), "float32": (0.1, 0.01)}


@pytest.mark.parametrize(
    "body_flow, number", [(True, "float64"), (False, "float64"), (False, "float32")], ids=["flow", "", "float32"]
)
def test_growth_and_threshold_are_those_of_rigid_bodies(body_flow, number, device):
    """About 25/s and 0.50 T with flow round the body, 21/s and 0.44 T without."""
    shares = np.array([1e-3, 0.35, 0.65])
    scenes = [joint.polar_cell(TORQUE, share * TORQUE, body_flow) for share in shares]
    exact = np.array([joint.stability(scene).growth for scene in scenes])
    assert exact[0] == pytest.approx(25.0 if body_flow else 20.5, rel=0.03)
    scenes = [with_values(scene, {"numerics.precision": number}) for scene in scenes]
    found = joint.growth_rates(scenes, TWO_TURNS, device)
    assert found == pytest.approx(exact, abs=TOLERANCE[number][0] * exact[0])
    threshold, expected = (float(np.interp(0.0, -growth[1:], shares[1:])) for growth in (found, exact))
    assert threshold == pytest.approx(expected, rel=TOLERANCE[number][0])
    assert (0.48 if body_flow else 0.43) < threshold < (0.53 if body_flow else 0.48)


@pytest.mark.parametrize("body_flow", [True, False], ids=["flow", ""])
def test_a_joint_without_stiffness_grows_as_fast(body_flow, device):
    scene = joint.polar_cell(TORQUE, 0.0, body_flow)
    found = joint.growth_rates([scene], TWO_TURNS, device)
    assert found == pytest.approx(joint.stability(scene).growth, rel=TOLERANCE["float64"][0])


@pytest.mark.parametrize("body_flow", [True, False], ids=["flow", ""])
def test_with_a_very_stiff_hook_a_cell_swims_as_a_rigid_one(body_flow, device):
    scene = joint.polar_cell(TORQUE, 100.0, body_flow)
    expected = joint.rigid_speed(scene)
    assert joint.speed_of_run(scene, expected[1], device) == pytest.approx(expected, rel=TOLERANCE["float64"][1])
