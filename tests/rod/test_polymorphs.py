"""Polymorphs: thresholds in a filament wound up uniformly, fronts under reversed motors, stopped runs, and off."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import attachment, cell, ground_state_frames, placed
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, with_values

A = 3.5
NORMAL, SEMICOILED = np.array([0.0, 1.3, -2.1]), np.array([0.0, 2.84, 2.29])
FORMS = {"polymorphs.enabled": True, "polymorphs.ramp": 1e-4, "flagella.count": 1, "body.contact": False}
HELD = {
    **FORMS,
    "body.anchored": True,
    "flagella.opening_angle": 0.0,
    "motor.axis_angle": 0.0,
    "hook.stiffness": 40.0,
    "flagella.on_axis": True,
    "flagella.length": 6.0,
    "numerics.stepper": "implicit",
}


def forms(sim: Simulation) -> np.ndarray:
    """Of the joints between segments."""
    return sim.system.state.data.forms.form.numpy()[1:-1]


def flipped(moment: float, device: str, precision: str = "float64", values: dict | None = None) -> np.ndarray:
    """Joints that flip in the first step of a helix of form 0 that is wound up against its handedness all along."""
    h = 0.1
    scene = cell({**FORMS, "flagella.segment_length": h, "numerics.time_step": 1e-9, **(values or {})}, precision)
    strain = NORMAL * (1.0 - moment / A / np.linalg.norm(NORMAL))
    frames = ground_state_frames(scene.resolved_flagella()[0].segment_count, h, strain)
    anchor = attachment(scene, scene.resolved_flagella()[0])[0]
    start = placed(scene, [anchor + h * np.cumsum(frames[:, :, 2], axis=0)], [frames[:, :, 0]])
    sim = Simulation(scene, device=device, starts=start)
    sim.advance(1e-9)
    return forms(sim)


def test_a_filament_wound_up_uniformly_flips_at_the_thresholds_and_at_its_ends_alone(precision, device):
    """Its moment is A times the strain taken off along the ground state; near its ends joints nucleate above 1.1."""
    found = flipped(1.12, device, precision)
    assert found[:6].sum() >= 4 and found[-6:].sum() >= 4
    assert found[8:-8].sum() == 0
    assert flipped(1.08, device, precision).sum() == 0
    assert flipped(-1.5, device, precision).sum() == 0


def grown(torque: float, device: str, time: float, **values: object) -> np.ndarray:
    scene = cell({**HELD, "motor.torque": torque, **values})
    sim = Simulation(scene, device=device)
    sim.advance(time)
    return forms(sim)


def test_reversed_motors_change_the_filament_from_the_root_above_the_threshold(device):
    """A front runs from the root under 3.4 pN um, over most of the filament; nothing happens below 1.1, or forward."""
    early, late = (grown(-3.4, device, time) for time in (2e-3, 2e-2))
    assert 0.2 < early.mean() < 0.6
    assert early[0] == 1 and np.abs(np.diff(early)).sum() == 1
    assert late.mean() > 0.6 and late[0] == 1
    assert grown(-1.0, device, 5e-3).sum() == 0
    assert grown(3.4, device, 5e-3).sum() == 0


def test_the_mirrored_cell_changes_alike(device):
    mirrored = {"flagella.intrinsic_curvature": (0.0, 1.3, 2.1)}
    found = [grown(-3.4, device, 2e-3), grown(3.4, device, 2e-3, **mirrored)]
    assert found[0].sum() > 3
    assert np.abs(found[0].astype(int) - found[1]).sum() <= 1


def test_both_steppers_see_the_ramps_alike(device):
    ends = []
    for stepper, step in (("implicit", 1e-6), ("rkc", 1e-6)):
        scene = cell({**HELD, "motor.torque": -3.4, "numerics.stepper": stepper, "numerics.time_step": step})
        sim = Simulation(scene, device=device)
        sim.advance(1.3e-4)
        assert forms(sim).sum() >= 3
        ends.append((sim.state.positions, forms(sim)))
    assert np.array_equal(ends[0][1], ends[1][1])
    moved = np.abs(ends[0][0] - Simulation(scene, device=device).state.positions).max()
    assert np.abs(ends[0][0] - ends[1][0]).max() < 0.03 * moved  # joints flip at ends of steps


def test_a_stopped_run_goes_on_with_the_same_bits(device):
    scene = cell({**HELD, "motor.torque": -3.4, "flagella.length": 3.0})
    whole, first, second = (Simulation(scene, device=device, strict=True) for _ in range(3))
    for time in (5e-4, 1e-3):
        whole.advance(time)
    first.advance(5e-4)
    assert 0 < forms(first).sum() < len(forms(first))
    second.restore(first.checkpoint())
    second.advance(1e-3)
    assert np.array_equal(second.state.positions, whole.state.positions)
    assert np.array_equal(forms(second), forms(whole))


def test_frames_hold_the_share_in_the_target_form(device):
    scene = cell({**HELD, "motor.torque": -3.4, "flagella.length": 3.0, "duration": 1e-3, "frames": 4})
    frames = list(Simulation(scene, device=device).frames(1e-3))
    shares = np.array([frame.observables["target_form_share"] for frame in frames])[:, 0]
    assert shares[0] == 0.0 and shares[-1] > 0.1
    assert (np.diff(shares) >= 0).all()


def test_off_there_is_none_of_it(device):
    scene: Scene = with_values(cell({}), {})
    sim = Simulation(scene, device=device)
    assert not sim.system.model.timed
    for array in (sim.system.state.data.forms.form, sim.system.model.data.polymorphs.rest_strain):
        assert array is None or array.size == 0
    assert "polymorphs" not in [term.name for term in sim.system.model.terms]


@pytest.mark.parametrize("key", ["polymorphs.ramp", "polymorphs.target"])
def test_what_makes_no_polymorphs_is_refused(key):
    with pytest.raises(ValueError, match=key):
        cell({"polymorphs.enabled": True, key: 0})
