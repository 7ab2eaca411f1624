"""A whole cell by one thread, as a CPU takes it: the same as element by element and stage by stage."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.rod import comoving_chart, reconstruction
from warpflag_kernels.stepping.right_hand_side import launch_right_hand_side, stages

from tests.helpers import cell, shaken, touching_cell
from tests.plans import by_elements
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene

POSE = ("position", "tangent", "director", "length", "body_position", "body_orientation", "body_axis")
FOUND = (
    "joint_before", "joint_after", "joint_spin_before", "joint_spin_after", "steric_first", "steric_second",
    "body_contact", "force", "spin_torque", "velocity", "flagellum_force", "flagellum_torque", "body_velocity",
    "body_spin",
)  # fmt: skip
RATES = ("rate", "body_rate")
TERMS = {
    "everything": {},
    "no contact between flagella": {"steric.enabled": False},
    "no contact with the body": {"body.contact": False},
    "no bearing torque": {"motor.bearing_torque": False},
    "flow between flagella": {"hydrodynamics.mode": "between"},
    "flow within flagella": {"hydrodynamics.mode": "within", "steric.enabled": False},
    "bare": {"hydrodynamics.mode": "none", "steric.enabled": False, "body.contact": False},
}


def batch(values: dict[str, Any], precision: str, device: str) -> Simulation:
    """Cells of two, three and two flagella of unequal lengths, two of them in contact, evaluated once."""
    unequal = {"flagellum.1.length": 1.2, "flagellum.1.segments": 5}
    scenes: list[Scene] = [
        touching_cell({**unequal, **values}, precision),
        cell({"flagella.count": 3, "flagella.segment_length": 0.1, **values}, precision),
        touching_cell({"flagella.length": 0.4, **values}, precision, separation=0.03),
    ]
    starts = [shaken(scene, seed, node=0.002) for seed, scene in enumerate(scenes)]
    sim = Simulation(scenes, device=device, starts=starts)
    if not sim.system.model.plan.by_cells:
        pytest.skip("a thread takes a whole cell on a CPU alone")
    sim.evaluate()
    return sim


def written(owner: Any, names: tuple[str, ...], launch: Callable[[], None]) -> dict[str, np.ndarray]:
    """What a launch writes into cleared arrays."""
    arrays = {name: getattr(owner, name) for name in names if getattr(owner, name) is not None}
    for array in arrays.values():
        array.zero_()
    launch()
    return {name: array.numpy().astype(np.float64) for name, array in arrays.items()}


def check(sim: Simulation, at_once: dict[str, np.ndarray], apart: dict[str, np.ndarray], first: bool) -> None:
    """The same to round-off of the type; the first cell is written if it takes part."""
    model = sim.system.model
    flagella = model.data.first_flagellum.numpy()[1]
    counts = {model.cell_count: 1, model.flagellum_count: flagella}
    counts[model.element_count] = model.data.first_node.numpy()[flagella]
    for name, found in at_once.items():
        scale = np.abs(apart[name]).max()
        assert scale > 0, name
        assert np.abs(found - apart[name]).max() < 20 * float(np.finfo(model.precision.name).eps) * scale, name
        assert found[: counts[len(found)]].any() == first, name


@pytest.mark.parametrize("active", [[1, 1, 1], [0, 1, 1]], ids=["all cells", "one idle"])
@pytest.mark.parametrize("terms", TERMS)
def test_a_right_hand_side_at_once_is_its_stages(terms, active, precision, device):
    sim = batch(TERMS[terms], precision, device)
    model, state = sim.system.model, sim.system.state
    state.data.active.assign(active)

    def by_stages() -> None:
        for _name, launch in stages(model):
            launch(model, state)

    found = []
    for launch in (lambda: launch_right_hand_side(model, state), by_stages):
        if model.switches.steric:
            state.neighbours.position.fill_(1e30)  # lists are to be made anew
        found.append(written(state.data, FOUND, launch))
    check(sim, *found, first=bool(active[0]))


@pytest.mark.parametrize("active", [[1, 1, 1], [0, 1, 1]], ids=["all cells", "one idle"])
def test_reconstruction_and_rates_at_once_are_those_of_every_element(active, precision, device):
    sim = batch({}, precision, device)
    model, state, c = sim.system.model, sim.system.state, sim.system.chart
    state.data.active.assign(active)
    random = np.random.default_rng(3)
    c.increment.assign(random.uniform(-0.05, 0.05, (model.element_count, 4)))
    c.body_increment.assign(random.uniform(-0.5, 0.5, (model.cell_count, 6)))
    c.flagellum_spin.assign(random.uniform(-1e3, 1e3, (model.flagellum_count, 3)))
    c.elapsed.fill_(1e-3)
    finely = dataclasses.replace(model, plan=by_elements(model.plan))
    steps = ((state.data.pose, POSE, reconstruction.reconstruct), (c, RATES, comoving_chart.increment_rates))
    for owner, names, function in steps:
        at_once, apart = (written(owner, names, functools.partial(function, cut, state, c)) for cut in (model, finely))
        check(sim, at_once, apart, first=bool(active[0]))


def test_the_strict_build_keeps_to_the_stages(device):
    assert not Simulation(cell(), device=device, strict=True).system.model.plan.by_cells
    assert Simulation(cell(), device=device).system.model.plan.by_cells == wp.get_device(device).is_cpu
