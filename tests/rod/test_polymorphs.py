"""Polymorphs: thresholds in a filament wound up uniformly, fronts under reversed motors, stopped runs, and off."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import attachment, cell, ground_state_frames, placed, rotation, unit
from tests.runs import executed
from warpflag.model import switching
from warpflag.observables import power_balance
from warpflag.record import Record
from warpflag.record.recorder import Recorder
from warpflag.run.simulation import NumericalError, Simulation
from warpflag.scene import Scene, SceneError, load, with_values

A = 3.5
NORMAL, SEMICOILED = np.array([0.0, 1.3, -2.1]), np.array([0.0, 2.84, 2.29])
FORMS = {
    "polymorphs.enabled": True,
    "polymorphs.ramp": 1e-4,
    "flagella.count": 1,
    "body.contact": False,
    "numerics.on_accuracy": "warn",
}
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
    return sim.system.state.optional.forms.form.numpy()[1:-1]


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


COLLINEAR = {"flagella.intrinsic_curvature": (0.0, 0.5, -2.1), "polymorphs.semicoiled": (0.0, 0.5, 2.29)}


def test_a_front_stops_where_the_moment_has_fallen_to_the_threshold_if_the_forms_are_nearly_collinear(device):
    """The moment falls as T (1 - x/L): 68, 80 and 88 % change, if the axes of the helices meet at 26 degrees."""
    for torque in (1.26, 2.0, 3.4):
        found = grown(-torque, device, 2e-2, **COLLINEAR, **{"hydrodynamics.mode": "consistent"})
        assert abs(found.mean() - (1.0 - 0.4 / torque)) < 0.05
        assert np.abs(np.diff(found)).sum() == 1


def test_a_scene_that_starts_from_a_record_has_the_forms_of_its_frame(tmp_path, device):
    scene = cell({**HELD, "motor.torque": -3.4, "duration": 4e-3, "frames": 2})
    Simulation(scene, device=device, reporters=[Recorder(tmp_path / "run.h5")]).run()
    with Record(tmp_path / "run.h5") as record:
        kept = record.frame(-1).forms[1:-1]
    assert 0.2 < kept.mean() < 0.9
    sim = Simulation(with_values(scene, {"start.record": str(tmp_path / "run.h5")}), device=device)
    np.testing.assert_array_equal(forms(sim), kept)
    sim.advance(1e-4)
    assert abs(forms(sim).sum() - kept.sum()) <= 2  # the front is where it was


REAL_HOOK = {"hook.stiffness": 0.65, "hydrodynamics.mode": "consistent", "polymorphs.ramp": None}


@pytest.mark.parametrize("torque, expected", [(1.05, 0.0), (1.26, 0.72), (3.4, 0.90)])
def test_a_front_of_semicoiled_form_runs_as_far_as_the_moment_allows(torque, expected, device):
    """1 - 0.35/T of the filament, nothing below the threshold of nucleation, on a hook as soft as a real one."""
    found = grown(-torque, device, 6e-2, **REAL_HOOK)
    assert abs(found.mean() - expected) < 0.05
    assert np.abs(np.diff(found)).sum() == (expected > 0.0)


def test_a_fast_front_stops_after_one_turn_of_the_new_form_where_the_filament_has_a_kink(device):
    """Whatever the length: after 1.72 um, from where on the outer part stands across the axis; to 0.5 um."""
    for length in (6.0, 10.0):
        found = grown(-1.26, device, 3e-2, **{**REAL_HOOK, "polymorphs.front_speed": 1e3, "flagella.length": length})
        assert abs(0.2 * found.sum() - 2 * np.pi / np.linalg.norm(SEMICOILED)) < 0.5


def test_a_free_cell_changes_the_form_of_its_filament_and_back(device):
    """The shipped reversal, at the stall torque of a motor."""
    sim = Simulation(load(Path(__file__).parents[2] / "examples" / "reversal.toml"), device=device)
    sim.advance(0.06)
    assert abs(forms(sim).mean() - 0.72) < 0.05
    sim.advance(0.1)
    assert forms(sim).sum() == 0


def test_a_filament_in_the_target_form_goes_back_above_the_other_threshold(device):
    """Hotani's 0.4, on a universal joint, the axis of the form along that of the motor at the start."""
    h = 0.2
    shares = []
    for torque in (0.38, 0.46):
        free = {"flagella.on_axis": False, "hook.stiffness": 0.0, "hydrodynamics.mode": "consistent"}
        scene = cell({**HELD, **free, "motor.torque": torque, "flagella.segment_length": h})
        frames = ground_state_frames(scene.resolved_flagella()[0].segment_count, h, SEMICOILED)
        axis = unit(SEMICOILED)  # in the axes of the first segment, nearly
        frames = rotation(math.acos(axis[2]) * unit(np.cross(axis, [0.0, 0.0, 1.0]))) @ frames
        anchor = attachment(scene, scene.resolved_flagella()[0])[0]
        start = placed(scene, [anchor + h * np.cumsum(frames[:, :, 2], axis=0)], [frames[:, :, 0]])
        sim = Simulation(scene, device=device, starts=start)
        sim.system.state.optional.forms.form.fill_(1)
        sim.system.state.optional.forms.before.fill_(1)
        sim.advance(1e-2)
        shares.append(forms(sim).mean())
    assert shares[0] == 1.0
    assert shares[1] < 0.3  # the threshold is 0.4, at the root


def test_the_power_balance_of_every_step_holds_on_ramps(device, monkeypatch):
    scene = cell({**HELD, "motor.torque": -1.26, "hydrodynamics.mode": "consistent", "polymorphs.ramp": 2e-4})
    sim = Simulation(scene, device=device)
    sim.advance(1e-2)
    assert int(sim.stepper.balance.refused.numpy()[0]) == 0
    monkeypatch.setattr("warpflag_kernels.stepping.balance.ramps", lambda model: False)
    with pytest.raises(NumericalError, match="power balance"):
        Simulation(scene, device=device).advance(1e-2)


def test_motor_and_ramps_put_in_what_is_dissipated_and_stored(device):
    """Integrals over 0.4 ms with several joints on their ramps agree to 1e-3."""
    values = {"motor.torque": -3.4, "flagella.length": 3.0, "numerics.time_step": 5e-7, "polymorphs.ramp": 2e-4}
    sim = Simulation(cell({**HELD, **values, "flagella.twist_rigidity": 2.5}), device=device)
    sim.advance(2e-4)
    times, stored, motor, ramps, dissipated = [], [], [], [], []
    for i in range(81):
        time = 2e-4 + i * 5e-6
        sim.advance(time)
        found = power_balance(sim.evaluate())
        times.append(time)
        stored.append(sim.cells().elastic_energy.sum())
        motor.append(found.motor)
        ramps.append(found.supplied["polymorphs"])
        dissipated.append(found.dissipated)
    put_in, by_ramps, lost = (np.trapezoid(x, times) for x in (motor, ramps, dissipated))
    assert abs(by_ramps) > 1.0
    assert put_in + by_ramps - lost == pytest.approx(stored[-1] - stored[0], abs=1e-3 * lost)


def test_joints_go_on_to_the_second_form_from_the_root(device):
    values = {"motor.torque": -3.4, "flagella.length": 3.0}
    second = {"polymorphs.second": "curly_1", "polymorphs.second_rate": 1e3}
    scene = cell({**HELD, **values, **second})
    (begin, end), *_ = switching.second_intervals(scene, 0)
    assert 0.0 < begin < end
    sim = Simulation(scene, device=device)
    sim.advance(0.9 * begin)
    assert forms(sim).max() == 1
    sim.advance(begin + 3e-3)
    found = forms(sim)
    assert found[0] == 2 and (np.diff(found) <= 0).all()
    assert (found == 2).sum() > 3
    # No further joint goes on once its interval is over, though the motor still winds up.
    ended = Simulation(scene, device=device)
    second = ended.system.model.optional.polymorphs.second
    intervals = np.zeros_like(second.numpy())
    intervals[0] = begin, begin + 5e-4
    second.assign(intervals)
    ended.advance(begin + 6e-4)
    last = forms(ended).copy()
    assert 0 < (last == 2).sum() < (found == 2).sum()
    ended.advance(begin + 2e-3)
    np.testing.assert_array_equal(forms(ended) == 2, last == 2)
    other = Simulation(cell({**HELD, **values}), device=device)
    other.advance(begin + 3e-3)
    assert forms(other).max() == 1


def test_the_second_form_comes_at_its_rate_while_a_motor_winds_up():
    values = {"polymorphs.second": "curly_1", "polymorphs.second_rate": 2.0, "motor.switching": "schedule"}
    values |= {"motor.switch_times": (1.0, 3.0, 4.0), "polymorphs.enabled": True, "duration": 10.0}
    begun = []
    for seed in range(400):
        found = switching.second_intervals(cell({**values, "motor.seed": seed}), 0)
        assert found == switching.second_intervals(cell({**values, "motor.seed": seed}), 0)
        assert all((1.0 < a < b == 3.0) or (a > 4.0 and b == np.inf) for a, b in found)
        begun += [a - 4.0 for a, b in found if b == np.inf]
    assert len(begun) == 400
    assert np.mean(begun) == pytest.approx(0.5, abs=4 * 0.5 / 20)


def test_the_second_form_goes_by_the_sense_of_a_prescribed_rate():
    """The torque of a motor that turns at a given rate says nothing of its sense."""
    values = {"polymorphs.second": "curly_1", "polymorphs.second_rate": 1e3, "motor.law": "rate", "motor.torque": 3.4}
    forward, reverse = (
        switching.second_intervals(cell({**FORMS, **values, "motor.rate": rate}), 0) for rate in (50.0, -50.0)
    )
    assert forward == () and len(reverse) == 1


@pytest.mark.parametrize("strain", [(0.0, 0.0, 0.0), (0.0, 1.3, 0.0)])
def test_filaments_without_a_hand_have_no_polymorphs(strain):
    """Straight ones, or flat ones: no sense of a motor is against a handedness of theirs, and none ever flipped."""
    with pytest.raises(SceneError, match=r"polymorphs.enabled .* no handedness.*flagella.intrinsic_curvature"):
        cell({**FORMS, "flagella.intrinsic_curvature": strain})
    cell({**FORMS, "flagella.intrinsic_curvature": (0.0, 0.0, 1e-3)})


def test_radius_and_pitch_give_curvature_and_torsion():
    radius, pitch = 1.3 / (1.3**2 + 2.1**2), -2.1 * 2 * np.pi / (1.3**2 + 2.1**2)
    scene = cell({"flagella.helix_radius": radius, "flagella.helix_pitch": pitch})
    assert scene.flagella.ground_strain == pytest.approx((0.0, 1.3, -2.1))
    for values in ({"flagella.helix_radius": 0.2}, {"flagella.helix_pitch": -2.0}):
        with pytest.raises(ValueError, match="needs flagella"):
            cell(values)
    with pytest.raises(ValueError, match="intrinsic_curvature"):
        cell({"flagella.helix_radius": 0.2, "flagella.helix_pitch": -2.0, "flagella.intrinsic_curvature": (0, 1, 1)})


def test_the_mirrored_cell_changes_alike(device):
    mirrored = {"flagella.intrinsic_curvature": (0.0, 1.3, 2.1)}
    found = [grown(-3.4, device, 2e-3), grown(3.4, device, 2e-3, **mirrored)]
    assert found[0].sum() > 3
    assert np.abs(found[0].astype(int) - found[1]).sum() <= 1


def test_forms_of_the_mirrored_filament_are_mirror_images(device, precision):
    """Curvature across and twist change their signs, of the ground state and of both other forms."""
    values = {**HELD, "polymorphs.semicoiled": (0.4, 2.84, 2.29), "polymorphs.second": "curly_1"}
    strains = []
    for own in ((0.3, 1.3, -2.1), (-0.3, 1.3, 2.1)):
        sim = Simulation(cell({**values, "flagella.intrinsic_curvature": own}, precision), device=device)
        strains.append(sim.system.model.optional.polymorphs.rest_strain.numpy()[3:-3].reshape(-1, 3, 3))
    np.testing.assert_allclose(strains[0] * [-1.0, 1.0, -1.0], strains[1], rtol=1e-6)
    assert np.abs(strains[0][0, 0] - strains[0][0, 1]).min() > 0.01
    h = sim.scenes[0].resolved_flagella()[0].segment_length
    np.testing.assert_allclose(
        strains[0][:, 1], np.tile(h * np.array([0.4, 2.84, 2.29]), (len(strains[0]), 1)), rtol=1e-6
    )


def test_a_stopped_run_goes_on_with_the_same_bits(device):
    second = {"polymorphs.second": "coiled", "polymorphs.second_rate": 1e5}
    scene = cell({**HELD, "motor.torque": -3.4, "flagella.length": 3.0, **second})
    whole, first, second = (Simulation(scene, device=device, strict=True) for _ in range(3))
    for time in (5e-4, 1e-3):
        whole.advance(time)
    first.advance(5e-4)
    assert set(forms(first)) == {0, 1, 2}
    second.restore(first.checkpoint())
    second.advance(1e-3)
    assert np.array_equal(second.state.positions, whole.state.positions)
    assert np.array_equal(forms(second), forms(whole))


def test_frames_and_record_hold_the_forms_and_the_share_in_the_target_form(device, tmp_path):
    scene = cell({**HELD, "motor.torque": -3.4, "flagella.length": 3.0, "duration": 1e-3, "frames": 4})
    frames = list(Simulation(scene, device=device).frames(1e-3))
    shares = np.array([frame.observables["target_form_share"] for frame in frames])[:, 0]
    assert shares[0] == 0.0 and shares[-1] > 0.1
    assert (np.diff(shares) >= 0).all()
    forms_of = np.array([frame.forms for frame in frames])
    assert np.allclose(forms_of.sum(axis=1) / 14, shares)
    assert set(np.diff(forms_of[-1, 1:].astype(int))) <= {0, -1}  # a front from the root
    with Record(executed(scene, tmp_path / "run")) as record:
        assert np.array_equal(record.forms[:], forms_of)
        assert np.array_equal(record.frame(-1).forms, forms_of[-1])
    with Record(executed(with_values(scene, {"polymorphs.enabled": False}), tmp_path / "plain")) as record:
        assert record.forms is None and record.frame(0).forms is None


def test_off_there_is_none_of_it(device):
    scene: Scene = with_values(cell({}), {})
    sim = Simulation(scene, device=device)
    assert not sim.system.model.timed
    for array in (sim.system.state.data.forms, sim.system.model.data.polymorphs):
        assert array is None or array.size == 0
    assert "polymorphs" not in [term.name for term in sim.system.model.terms]


@pytest.mark.parametrize("key", ["polymorphs.ramp", "polymorphs.target"])
def test_what_makes_no_polymorphs_is_refused(key):
    with pytest.raises(ValueError, match=key):
        cell({"polymorphs.enabled": True, key: 0})


@pytest.mark.parametrize(
    "key, value, limit", [("propagation_back", 0.5, "0.5, above that of polymorphs.propagation, 0.4"),
                          ("nucleation_back", -1.2, "1.2, above that of polymorphs.nucleation, 1.1")]
)  # fmt: skip
def test_thresholds_between_which_a_joint_would_go_to_and_fro_are_refused(key, value, limit):
    with pytest.raises(SceneError, match=f"polymorphs.{key} = .* moment of {limit}"):
        with_values(Scene(name="a"), {"polymorphs.enabled": True, f"polymorphs.{key}": value})
    with_values(Scene(name="a"), {f"polymorphs.{key}": value})  # says nothing where it is off
