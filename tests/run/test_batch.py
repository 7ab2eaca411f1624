"""A batch: every member runs as it would alone, with its own clock, and falls alone."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
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
