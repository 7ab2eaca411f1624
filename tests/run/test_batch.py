"""A batch: every member runs as it would alone, with its own clock, and falls alone."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.base.types import structs
from warpflag_kernels.stepping.health import Fault

from tests.helpers import cell, touching_cell
from warpflag.model.geometry import initial_state
from warpflag.run.simulation import CellState, NumericalError, Simulation
from warpflag.scene import Scene, SceneError, with_values

STATE = [field.name for field in dataclasses.fields(CellState)]


def members(precision: str, stepper: str = "rkc") -> list[Scene]:
    """Cells that share nothing but their terms: torques, lengths, phases, flagella, fluids, steps."""
    common = {"numerics.stepper": stepper}
    return [
        cell(common, precision),
        cell({"motor.torque": 1.0, "flagella.phase_difference": 0.4, **common}, precision),
        touching_cell({"flagella.length": 1.6, "numerics.time_step": 2e-6, **common}, precision),
        cell({"flagella.count": 3, "fluid.viscosity": 2e-3, "numerics.time_step": 4e-6, **common}, precision),
        cell(
            {"flagella.stretching_stiffness": 1e4, "flagellum.1.length": 1.0, "motor.torque": 0.1, **common}, precision
        ),
    ]


def equal(a: CellState, b: CellState) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in STATE)


@pytest.mark.parametrize("stepper", ["rkc", "implicit"])
def test_members_equal_their_single_runs_to_the_last_bit(stepper, device, precision):
    scenes = members(precision, stepper)
    batch = Simulation(scenes, device=device)
    for until in (2e-5, 3.5e-5):
        batch.advance(until)
    for c, scene in enumerate(scenes):
        alone = Simulation(scene, device=device)
        for until in (2e-5, 3.5e-5):
            alone.advance(until)
        assert equal(batch.cell_state(c), alone.cell_state()), c
    assert len(set(batch.steps)) > 1  # each took its own number of steps to the same time
    assert (batch.times == 3.5e-5).all()


def test_a_stiff_member_beside_a_soft_one_is_that_of_its_single_run(device, precision):
    """The full mobility is solved with in the first member alone."""
    rods = {"flagella.bending_rigidity": 350.0, "flagella.twist_rigidity": 350.0, "flagella.stretching_stiffness": 1e5}
    common = {"numerics.stepper": "implicit", "hydrodynamics.mode": "consistent"}
    scenes = [cell({**rods, **common}, precision), cell(common, precision)]
    batch, alone = Simulation(scenes, device=device), Simulation(scenes[0], device=device)
    for sim in (batch, alone):
        sim.advance(5e-5)
    assert batch.stepper.memory()["strong"].tolist() == [1, 0]
    assert equal(batch.cell_state(0), alone.cell_state())


@pytest.mark.parametrize("stepper", ["rkc", "implicit"])
def test_frames_of_a_member_are_those_of_its_single_run(stepper, device, precision):
    """Members that differ in length, in their frames' interval, and so in how many frames a look at them finds."""
    common = {"numerics.stepper": stepper, "duration": 4e-5}
    scenes = [
        touching_cell({"flagella.length": 1.6, "frames": 4, **common}, precision),
        touching_cell({"frames": 16, **common}, precision),
    ]
    batch = Simulation(scenes, device=device)
    found = {0: [], 1: []}
    for until in (1.9e-5, 4e-5):
        for frames in batch.cell_frames(until):
            for c, frame in frames.items():
                found[c].append(frame)
    for c, scene in enumerate(scenes):
        alone = Simulation(scene, device=device)
        expected = [frame for until in (1.9e-5, 4e-5) for frame in alone.frames(until)]
        assert len(expected) == len(found[c]) == scene.frames + 1
        for one, other in zip(found[c], expected, strict=True):
            assert (one.time, one.step) == (other.time, other.step)
            assert np.array_equal(one.positions, other.positions)
            assert one.observables.keys() == other.observables.keys()
            for name, value in one.observables.items():
                np.testing.assert_array_equal(value, other.observables[name], err_msg=name)
        force = alone.cell_state().steric_force
        assert force > 0.0 and expected[-1].observables["steric_force_density"] > 0.0


def test_members_do_not_feel_each_other(device):
    """Two cells in the same place: no contact, no flow between them."""
    scene = cell()
    batch = Simulation([scene, with_values(scene, {"motor.torque": -3.4}), scene], device=device)
    batch.advance(3e-5)
    assert equal(batch.cell_state(0), batch.cell_state(2))
    assert not np.array_equal(batch.cell_state(0).positions, batch.cell_state(1).positions)


@pytest.mark.parametrize("stepper", ["rkc", "euler"])
def test_a_member_that_violates_a_guard_falls_alone(stepper, device):
    short = {"numerics.stepper": stepper}
    weak, wild = cell(short), cell({"motor.torque": 60.0, **short})  # twists its joints beyond a quarter turn
    batch, alone = Simulation([weak, wild, weak], device=device), Simulation(weak, device=device)
    until = {"rkc": 2e-5, "euler": 4e-6}[stepper]
    alone.advance(until)
    with pytest.raises(NumericalError) as caught:
        batch.advance(until)
    assert caught.value.cell == 1
    assert caught.value.flagellum in (0, 1)
    assert caught.value.time == batch.times[1] < until
    assert batch.times[0] == batch.times[2] == until
    assert equal(batch.cell_state(0), alone.cell_state())
    # The others go on; the fallen one stays where it fell, and is not forgotten.
    fallen = batch.cell_state(1)
    alone.advance(2 * until)
    with pytest.raises(NumericalError) as again:
        batch.advance(2 * until)
    assert str(again.value) == str(caught.value)
    assert batch.times[2] == 2 * until
    assert equal(batch.cell_state(2), alone.cell_state())
    assert np.array_equal(batch.cell_state(1).positions, fallen.positions)


def test_a_bad_start_in_a_batch_names_its_own_flagellum(device):
    scenes = [cell({"flagella.count": 3}), cell()]
    starts = [initial_state(scene) for scene in scenes]
    nodes = [x.copy() for x in starts[1].positions]
    nodes[1][4:] += 0.3 * (nodes[1][4] - nodes[1][3])
    starts[1] = dataclasses.replace(starts[1], positions=tuple(nodes))
    batch = Simulation(scenes, device=device, starts=starts)
    with pytest.raises(NumericalError) as caught:
        batch.advance(1e-5)
    error = caught.value
    assert (error.kind, error.cell, error.flagellum, error.segment) == (Fault.STRAIN, 1, 1, 4)
    assert batch.times[0] == 1e-5


def test_a_batch_needs_the_same_terms_and_stepper(device):
    for other in ({"steric.enabled": False}, {"numerics.stepper": "euler"}, {"flagella.count": 1}):
        with pytest.raises(SceneError):
            Simulation([cell(), cell(other)], device=device)


@pytest.mark.parametrize("first", ["float64", "float32"])
def test_a_batch_has_one_precision(first):
    """The kernels of one would compute the other."""
    scenes = [cell({"numerics.precision": own}) for own in sorted(["float64", "float32"], reverse=first == "float64")]
    with pytest.raises(SceneError, match=r"numerics\.precision.*same in every scene"):
        Simulation(scenes, device="cpu")


def test_a_simulation_has_a_scene():
    with pytest.raises(ValueError, match="one scene at least"):
        Simulation([], device="cpu")


def test_cells_are_counted_from_the_end_too(device):
    batch = Simulation([cell(), cell({"flagella.count": 3})], device=device)
    for last, same in ((-1, 1), (-2, 0)):
        np.testing.assert_array_equal(batch.cell_state(last).positions, batch.cell_state(same).positions)
        forces = [batch.evaluate(own).forces for own in (last, same)]
        np.testing.assert_array_equal(*forces)
    for beyond in (2, -3):
        with pytest.raises(IndexError):
            batch.cell_state(beyond)
        with pytest.raises(IndexError):
            batch.evaluate(beyond)


FIRST = {
    **{"hook.length": 0.055, "hook.stiffness": 0.65, "hook.stiffening_torque": 0.5, "steric.strength": 0.8},
    **{"motor.law": "torque_speed", "motor.torque": 1.26, "motor.knee": 50.0, "motor.no_load": 200.0},
    **{"motor.reverse_torque": 1.0, "motor.reverse_knee": 40.0, "motor.switching": "schedule"},
    **{"motor.switch_times": (0.1, 0.2), "motor.switch_ramp": 1e-3, "motor.axis_angle": 50.0},
    **{"polymorphs.enabled": True, "polymorphs.nucleation": 1.1, "polymorphs.propagation": 0.6},
    **{"external.force_per_length": (0.0, 0.1, 0.0), "external.body_force": (0.2, 0.0, 0.0)},
    **{"hydrodynamics.mode": "consistent", "hydrodynamics.body_flow": False},
}
OTHER = {
    **{"hook.length": 0.1, "hook.stiffness": 0.4, "hook.stiffening_torque": 0.2, "steric.strength": 0.5},
    **{"motor.torque": 0.7, "motor.knee": 20.0, "motor.no_load": 90.0},
    **{"motor.reverse_torque": 0.3, "motor.reverse_knee": 10.0, "motor.rate": 30.0},
    **{"motor.switch_times": (0.3, 0.5, 0.7), "motor.switch_ramp": 3e-3, "motor.axis_angle": 30.0},
    **{"polymorphs.nucleation": 1.5, "polymorphs.propagation": 0.4, "polymorphs.front_speed": 40.0},
    **{"external.force_per_length": (0.3, 0.0, 0.1), "external.body_force": (0.0, 0.4, 0.1)},
    **{"fluid.viscosity": 2e-3, "body.length": 3.0, "body.width": 1.0, "flagella.filament_radius": 0.012},
    **{"flagella.bending_rigidity": 3.0, "flagella.twist_rigidity": 4.0, "flagella.stretching_stiffness": 2e3},
    **{"flagella.hook_twist_factor": 2.0, "flagella.intrinsic_curvature": (0.0, 1.0, -2.0)},
    **{"flagella.segment_length": 0.25},
}
NOISY = {"fluid.temperature": 298.0, "fluid.noise_tolerance": 0.1, "fluid.seed": 1, "numerics.time_step": 1e-6}
HOTTER = {"fluid.temperature": 310.0, "fluid.noise_tolerance": 0.05, "fluid.seed": 2, "numerics.time_step": 2e-6}


def numbers(part: Any, kind: Any, path: str = "") -> dict[str, np.ndarray]:
    """Arrays of numbers in a struct of the device, by name; those that only say where things lie are left out."""
    found = {}
    for name, var in kind.vars.items():
        value = getattr(part, name)
        if not isinstance(var.type, wp.array):
            found |= numbers(value, var.type, f"{path}{name}.")
        elif var.type.dtype is not wp.int32 and not hasattr(var.type.dtype, "vars") and value is not None:
            found[path + name] = value.numpy() if value.size else np.zeros(0)
    return {name: values for name, values in found.items() if len(values)}


def test_every_number_of_a_member_is_that_of_its_own_scene(device):
    """Two scenes that differ in every number: what the device has of the second in a batch, and alone."""
    scenes = [cell({**FIRST, "numerics.stepper": "implicit"}), cell({**FIRST, **OTHER, "numerics.stepper": "implicit"})]
    batch, alone = (Simulation(own, device=device).system.model for own in (scenes, scenes[1]))
    told, kind = [], structs(batch.precision).Model
    parts = [(batch.data, alone.data, kind)]
    parts += [
        (own, getattr(alone.optional, name), kind.vars[name].type.dtype) for name, own in vars(batch.optional).items()
    ]
    for both, one, own_kind in parts:
        single = numbers(one, own_kind)
        for name, values in numbers(both, own_kind).items():
            own = single[name]
            np.testing.assert_array_equal(values[-len(own) :], own, err_msg=name)
            assert not np.array_equal(values[: len(own)], own), f"{name} does not tell the scenes apart"
            told.append(name)
    assert len(told) > 25


def test_noise_of_a_member_is_that_of_its_own_scene(device):
    scenes = [
        cell({**values, "numerics.stepper": "implicit", "hydrodynamics.mode": "all"}) for values in (NOISY, HOTTER)
    ]
    sim = Simulation(scenes, device=device)
    energy, seed = sim.stepper.noise.energy.numpy(), sim.stepper.noise.seed.numpy()
    np.testing.assert_allclose(energy, 1.380649e-5 * np.array([298.0, 310.0]))
    assert seed.tolist() == [1, 2] and sim.stepper.lanczos.data.tolerance.numpy().tolist() == [0.1, 0.05]
    assert sim.system.control.longest_step.numpy().tolist() == [1e-6, 2e-6]
