"""The implicit stepper as a whole: order, the same solution as RKC, every kind of scene, and the power balance.

RKC shares nothing with it but the forces. Two windows of the zipping cell: "free" begins 20 us after the motors start,
"contact" at 5.5 ms with some ten closed contacts.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest
from warpflag_kernels.stepping.health import Fault

from tests.helpers import as_start, attachment, cell, free_nodes, placed, touching_cell, unit
from tests.oracles import energy
from warpflag.model.geometry import InitialState
from warpflag.run.simulation import CellState, NumericalError, Simulation
from warpflag.scene import FlagellumOverride, Scene, paper_scene, with_values

# Node error over the accuracy's share of the time; in both precisions.
SHARE = 5.0

ACCURACY = 1e-3
STATE = [field.name for field in dataclasses.fields(CellState)]


def test_a_step_collocates_on_the_parabola_that_the_step_before_begins(device):
    """Its value at the collocation point, over that at the end, of what is zero at begin and end of the step before."""
    sim = Simulation(cell(implicit()), device=device, capture=False)
    found, launch = [], sim.stepper.launch_pass

    def watched() -> None:
        launch()
        data = sim.stepper.data
        found.append([values.numpy()[0] for values in (data.ratio, data.theta, data.rho)])

    sim.stepper.launch_pass = watched
    sim.advance(2e-5)
    ratio, theta, rho = np.array(found).T
    assert len(rho) > 5 and (theta < 1.0).sum() > 5 and np.ptp(ratio) > 0.1
    np.testing.assert_allclose(rho, theta * (1.0 + theta * ratio) / (1.0 + ratio), rtol=1e-12)


def rkc(step: float) -> dict[str, Any]:
    return {"numerics.stepper": "rkc", "numerics.time_step": step}


def implicit(step: float | None = None, accuracy: float = ACCURACY) -> dict[str, Any]:
    numerics = {"numerics.accuracy": accuracy} if step is None else {"numerics.time_step": step}
    return {"numerics.stepper": "implicit", **numerics}


def zipping(values: dict[str, Any]) -> Scene:
    phases = (FlagellumOverride(phase=180.0), FlagellumOverride(phase=280.0))
    return with_values(paper_scene(name="zipping", flagellum=phases), values)


def advanced(scene: Scene, start: InitialState | None, duration: float, device: str) -> Simulation:
    sim = Simulation(scene, device=device, starts=start)
    sim.advance(duration)
    return sim


def reached(sim: Simulation) -> InitialState:
    """The state reached, as a start at time zero."""
    return dataclasses.replace(as_start(sim.scenes[0], sim.cell_state()), time=0.0)


def distance(a: Simulation, b: Simulation) -> float:
    """Largest displacement of a node [um]."""
    x, y = a.cell_state().positions, b.cell_state().positions
    return float(np.linalg.norm(x - y, axis=1).max())


WINDOWS = {"free": 4e-4, "contact": 2e-4}  # lengths [s]


@cache
def window(name: str, device: str) -> InitialState:
    if name == "free":
        return reached(advanced(zipping(rkc(2e-7)), None, 20e-6, device))
    return reached(advanced(zipping(implicit()), None, 5.5e-3, device))


@cache
def exact(name: str, device: str) -> Simulation:
    return advanced(zipping(rkc(1e-6)), window(name, device), WINDOWS[name], device)


def errors(name: str, settings: list[dict[str, Any]], device: str) -> np.ndarray:
    runs = (advanced(zipping(s), window(name, device), WINDOWS[name], device) for s in settings)
    return np.array([distance(run, exact(name, device)) for run in runs])


@pytest.mark.parametrize("name", list(WINDOWS))
def test_second_order_and_the_same_solution_as_rkc(name, device):
    steps = [2.5e-6, 5e-6, 1e-5, 2e-5]
    found = errors(name, [implicit(step) for step in [1e-6, *steps]], device)
    assert found[0] < 5e-5
    slope = np.polyfit(np.log(steps), np.log(found[1:]), 1)[0]
    # A contact that closes or opens inside a step is a kink in time, which costs a part of the order.
    assert (1.8 if name == "free" else 1.6) < slope < 2.2, found
    assert (exact(name, device).cell_state().steric_force > 1.0) == (name == "contact")


@pytest.mark.parametrize("name", list(WINDOWS))
def test_rkc_is_of_second_order_there_too(name, device):
    steps = [5e-6, 1e-5, 2e-5]
    found = errors(name, [rkc(step) for step in steps], device)
    slope = np.polyfit(np.log(steps), np.log(found), 1)[0]
    assert (1.8 if name == "free" else 1.6) < slope < 2.4, found


# Every kind of scene, and values far from the usual.

SCENES = {
    "usual": (touching_cell, {}),
    "one": (cell, {"flagella.count": 1, "flagella.length": 4.0}),
    "three": (cell, {"flagella.count": 3, "flagella.length": 4.0}),
    "unequal": (touching_cell, {"flagellum.1.length": 2.4, "flagellum.1.segments": 10}),
    "anchored": (touching_cell, {"body.anchored": True}),
    "no axial rotation": (touching_cell, {"body.axial_rotation": False}),
    "no translation": (touching_cell, {"body.translation": False}),
    "no bearing torque": (touching_cell, {"motor.bearing_torque": False}),
    "no pairs": (touching_cell, {"hydrodynamics.mode": "none"}),
    "pairs within": (touching_cell, {"hydrodynamics.mode": "within"}),
    "no steric": (touching_cell, {"steric.enabled": False}),
    "no body contact": (touching_cell, {"body.contact": False}),
    "h 0.1": (touching_cell, {"flagella.segment_length": 0.1, "motor.torque": 2.0}),
    "h 0.05": (cell, {"flagella.segment_length": 0.05, "flagella.length": 1.2, "motor.torque": 1.0}),
    "h 0.4": (touching_cell, {"flagella.segment_length": 0.4}),
    "K x10": (touching_cell, {"flagella.stretching_stiffness": 1e4}),
    "K x100": (touching_cell, {"flagella.stretching_stiffness": 1e5}),
    "F_0 x100": (touching_cell, {"steric.strength": 80.0}),
    "eta x10": (touching_cell, {"fluid.viscosity": 1e-2}),
    "eta /10": (cell, {"fluid.viscosity": 1e-4, "flagella.length": 6.0}),
    "T x3": (cell, {"motor.torque": 10.2, "flagella.length": 6.0}),
}


@cache
def under_way(name: str, device: str) -> InitialState:
    """Some time after the motors have started; what came before is not compared."""
    make, values = SCENES[name]
    return reached(advanced(make({**values, **implicit()}), None, 4e-5, device))


@pytest.mark.parametrize("name", list(SCENES))
def test_every_scene_follows_rkc(name, device, precision):
    make, values = SCENES[name]
    start, duration = under_way(name, device), 1e-4
    sim = advanced(make({**values, **implicit()}, precision), start, duration, device)
    oracle = advanced(make({**values, **rkc(1e-6)}), start, duration, device)
    assert distance(oracle, Simulation(oracle.scenes[0], device=device, starts=start)) > 0.1  # far from where it began
    assert distance(sim, oracle) < SHARE * ACCURACY * duration * 1e3


def hairpin(scene: Scene) -> InitialState:
    """A flagellum that runs straight off the body, turns round within six joints, and comes back beside itself."""
    anchor, m = attachment(scene, scene.resolved_flagella()[0])
    side = unit(np.cross(m, [0.3, 0.5, 0.1]))
    angle = np.radians(np.interp(np.arange(10), [2, 8], [0.0, 180.0]))[:, None]
    return placed(scene, [anchor + np.cumsum(0.2 * (np.cos(angle) * m + np.sin(angle) * side), axis=0)])


def test_a_hairpin_unfolds_as_it_does_with_rkc(device, precision):
    values = {"flagella.count": 1, "body.contact": False}
    start = hairpin(cell(values))
    sim, oracle = (
        advanced(cell({**values, **stepper}, p), start, 2e-5, device)
        for stepper, p in ((implicit(), precision), (rkc(1e-8), "float64"))
    )
    moved = distance(oracle, Simulation(oracle.scenes[0], device=device, starts=start))
    assert moved > 0.1
    assert distance(sim, oracle) < 0.01 * moved


def test_a_torque_beyond_what_the_joints_hold_stops_with_a_reason(device, precision):
    with pytest.raises(NumericalError) as caught:
        advanced(cell({"motor.torque": 34.0, "flagella.length": 6.0, **implicit()}, precision), None, 1e-4, device)
    assert caught.value.kind == Fault.TWIST
    assert caught.value.time < 1e-6


# The same numbers.


def same(a: CellState, b: CellState) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in STATE)


def test_captured_and_eager_contacts_agree_to_the_last_bit(device, precision):
    scene = touching_cell(implicit(accuracy=5e-3), precision)
    runs = [Simulation(scene, device=device, capture=capture) for capture in (True, False)]
    for sim in runs:
        sim.advance(5e-6)
    assert same(*(sim.cell_state() for sim in runs))
    assert runs[0].stepper.memory()["rejected"][0] == runs[1].stepper.memory()["rejected"][0]


def test_cells_with_their_own_contacts_equal_their_single_runs(device, precision):
    common = implicit(accuracy=5e-3)
    scenes = [touching_cell(common, precision), cell(common, precision)]
    scenes += [touching_cell({"flagellum.1.length": 1.2, **common}, precision, separation=0.039)]
    batch = Simulation(scenes, device=device)
    batch.advance(1e-5)
    for c, scene in enumerate(scenes):
        assert same(batch.cell_state(c), advanced(scene, None, 1e-5, device).cell_state()), c
    assert batch.cell_state(0).steric_force > 0.1


def test_a_run_in_contact_restored_goes_on_to_the_same_bits(device, precision):
    scene = touching_cell(implicit(accuracy=5e-3), precision)
    whole, resumed = (Simulation(scene, device=device) for _ in range(2))
    whole.advance(1e-5)
    resumed.restore(whole.checkpoint())
    for sim in (whole, resumed):
        sim.advance(3e-5)
    assert same(whole.cell_state(), resumed.cell_state())
    assert whole.cell_state().steric_force > 0.1


# Work and energy.


def imbalance(numerics: dict[str, Any], frames: int, device: str) -> tuple[float, float]:
    """Motor work - dissipation - change of energy, and that change, over the motor work in 0.4 ms of contact.

    Motor work: T times the turn of the motors. Dissipation: forces on velocities, by Simpson's rule over the frames.
    """
    scene, duration = zipping(numerics), 4e-4
    sim = Simulation(scene, device=device, starts=window("contact", device))
    nodes, torque = free_nodes(scene), np.array([spec.torque for spec in scene.resolved_flagella()])
    powers, energies = [], []
    for k in range(frames + 1):
        sim.advance(duration * k / frames)
        e = sim.evaluate()
        power = (e.forces[nodes] * e.velocities[nodes]).sum() + e.torques @ e.spins
        powers.append(power + e.body_force @ e.body_velocity + e.body_torque @ e.body_spin)
        if k in (0, frames):
            energies.append(energy(scene, as_start(scene, sim.cell_state())))
    weights = np.ones(frames + 1)
    weights[1:-1:2], weights[2:-1:2] = 4.0, 2.0
    dissipation = duration / frames / 3 * weights @ powers
    work, stored = torque @ sim.cell_state().motor_angle, energies[1] - energies[0]
    return float((work - dissipation - stored) / work), float(stored / work)


def test_motor_work_is_dissipation_and_change_of_energy(device):
    left, stored = imbalance(implicit(), 100, device)
    assert abs(left) < 1e-3 < 0.1 * abs(stored)


def test_the_power_balance_is_of_second_order(device):
    coarse, fine = (abs(imbalance(implicit(step), round(2e-4 / step), device)[0]) for step in (1e-5, 5e-6))
    assert coarse < 1e-2 and fine < coarse / 3
