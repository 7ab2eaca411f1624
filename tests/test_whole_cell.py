"""The right-hand side of a whole cell by one thread, as a CPU takes it: the same as stage by stage."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.helpers import cell, shaken, touching_cell
from warpflag.scene import Scene
from warpflag.simulation import Simulation
from warpflag.stages import launch_right_hand_side, right_hand_side

FOUND = (
    "joint_before", "joint_after", "joint_spin_before", "joint_spin_after", "steric_first", "steric_second",
    "body_contact", "force", "spin_torque", "velocity", "flagellum_force", "flagellum_torque", "body_velocity",
    "body_spin",
)  # fmt: skip
TERMS = {
    "everything": {},
    "no contact between flagella": {"steric.enabled": False},
    "no contact with the body": {"body.contact": False},
    "no bearing torque": {"motor.bearing_torque": False},
    "flow between flagella": {"hydrodynamics.mode": "between"},
    "flow within flagella": {"hydrodynamics.mode": "within", "steric.enabled": False},
    "bare": {"hydrodynamics.mode": "none", "steric.enabled": False, "body.contact": False},
}


def batch(values: dict[str, Any], precision: str) -> list[Scene]:
    """Cells of two, three and two flagella of unequal lengths, two of them in contact."""
    unequal = {"flagellum.1.length": 1.2, "flagellum.1.segments": 5}
    return [
        touching_cell({**unequal, **values}, precision),
        cell({"flagella.count": 3, "flagella.segment_length": 0.1, **values}, precision),
        touching_cell({"flagella.length": 0.4, **values}, precision, separation=0.03),
    ]


def rebuilt(sim: Simulation, active: list[int], whole: bool) -> dict[str, np.ndarray]:
    """What a right-hand side writes into a cleared state, in one launch or stage by stage."""
    model, state = sim.system.model, sim.system.state
    for name in FOUND:
        if getattr(state.data, name) is not None:
            getattr(state.data, name).zero_()
    if model.switches.steric:
        state.neighbours.position.fill_(1e30)  # lists are to be made anew
    state.data.active.assign(active)
    if whole:
        launch_right_hand_side(model, state)
    else:
        for stage in right_hand_side(model.switches):
            stage.launch(model, state)
    arrays = {name: getattr(state.data, name) for name in FOUND}
    return {name: array.numpy().astype(np.float64) for name, array in arrays.items() if array is not None}


@pytest.mark.parametrize("terms", TERMS)
def test_a_whole_cell_at_once_is_its_stages(terms, precision, device):
    scenes = batch(TERMS[terms], precision)
    starts = [shaken(scene, seed, node=0.002) for seed, scene in enumerate(scenes)]
    sim = Simulation(scenes, device=device, starts=starts)
    model = sim.system.model
    if not model.one_thread_per_cell:
        pytest.skip("a thread takes a whole cell on a CPU alone")
    sim.evaluate()
    flagella = len(scenes[0].resolved_flagella())
    # Of the first cell, by the length of the array.
    counts = {model.cell_count: 1, model.flagellum_count: flagella}
    counts[model.element_count] = model.data.first_node.numpy()[flagella]
    for active in ([1, 1, 1], [0, 1, 1]):
        at_once, by_stages = (rebuilt(sim, active, whole) for whole in (True, False))
        for name, found in at_once.items():
            # To round-off of the type.
            scale = np.abs(by_stages[name]).max()
            assert scale > 0, name
            assert np.abs(found - by_stages[name]).max() < 20 * float(np.finfo(precision).eps) * scale, name
            assert found[: counts[len(found)]].any() == bool(active[0]), name


def test_the_strict_build_keeps_to_the_stages(device):
    assert not Simulation(cell(), device=device, strict=True).system.model.one_thread_per_cell
    assert Simulation(cell(), device=device).system.model.one_thread_per_cell == wp.get_device(device).is_cpu
