"""A filament without a body: r_0 is a free end. Against dense mobilities of all its nodes, rigid and flexible."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from tests.helpers import as_start, cell, displaced, unit
from tests.oracles import drag_coefficients, elastic_energies, expected_pair_radius, rotne_prager, slope
from tests.plans import as_on_gpu, by_elements, plan
from warpflag.model.geometry import InitialState, initial_state
from warpflag.observables import power_balance
from warpflag.record.reporters import start_reporter
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, SceneError, with_values

# Of the largest velocity or torque.
TOLERANCE = {"float64": 1e-10, "float32": 1e-3}
POWER = {"float64": 1e-7, "float32": 2e-2}
FREE = {"body.enabled": False, "flagella.count": 1, "flagella.length": 2.0}
STRAIGHT = {"flagella.intrinsic_curvature": (0.0, 0.0, 0.0)}
PULL = (0.3, -0.2, 0.5)


def free(values: dict | None = None, precision: str = "float64") -> Scene:
    return cell({**FREE, **(values or {})}, precision)


def dense(scene: Scene, x: np.ndarray) -> np.ndarray:
    """Mobility of all nodes, both ends with half a segment, shape [3 count, 3 count]."""
    (spec,) = scene.resolved_flagella()
    count, (along, across, _) = len(x), drag_coefficients(scene)
    mobility = rotne_prager(x, expected_pair_radius(scene), scene.fluid.viscosity)
    if scene.hydrodynamics.mode == "none":
        mobility[:] = 0.0
    t = unit(np.diff(x, axis=0))
    t = np.vstack([t[0], unit(t[:-1] + t[1:]), t[-1]])
    for i in range(count):
        length = spec.segment_length * (0.5 if i in (0, count - 1) else 1.0)
        outer = np.outer(t[i], t[i])
        mobility[i, :, i, :] = (outer / along + (np.eye(3) - outer) / across) / length
    return mobility.reshape(3 * count, 3 * count)


def bent(scene: Scene) -> InitialState:
    random, start = np.random.default_rng(2), initial_state(scene)
    count = len(start.positions[0])
    return displaced(scene, start, 2e-3 * random.uniform(-1, 1, (count, 3)), 0.1 * random.uniform(-1, 1, count))


@pytest.mark.parametrize("mode", ["none", "all"])
@pytest.mark.parametrize("planned", [lambda own: own, by_elements, as_on_gpu], ids=["own", "elements", "gpu"])
def test_every_node_moves_by_its_drag_and_the_flow_of_all_others(mode, planned, precision, device, monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)  # fibers for the threads of a block
    scene = free({"hydrodynamics.mode": mode, "external.force_per_length": PULL}, precision)
    start = bent(scene)
    found = Simulation(scene, starts=start, plan=planned(plan(scene, device))).evaluate()
    forces = found.forces.copy()
    assert found.body_force == pytest.approx(forces[0], rel=1e-5)
    expected = (dense(scene, start.positions[0]) @ forces.ravel()).reshape(-1, 3)
    assert np.abs(found.velocities - expected).max() < TOLERANCE[precision] * np.abs(expected).max()
    assert found.body_velocity == pytest.approx(found.velocities[0], rel=1e-5)
    assert np.abs(found.body_spin).max() == 0.0
    net = forces.sum(axis=0) - 2.0 * np.array(PULL)
    assert np.abs(net).max() < 10 * TOLERANCE[precision] * np.abs(forces).max()


def test_power_of_the_pull_is_dissipation_and_stored_energy(precision, device):
    scene = free({"external.force_per_length": PULL}, precision)
    start = bent(scene)
    found = Simulation(scene, device=device, starts=start).evaluate()
    balance = power_balance(found)
    assert set(balance.supplied) == {"external"} and balance.motor == 0.0

    def at(time: float) -> float:
        motion = (found.velocities, found.spins, found.body_velocity, found.body_spin)
        moved = displaced(scene, start, *(time * rate for rate in motion))
        return float(elastic_energies(scene, moved)[:3].sum() - hook_twist(scene, moved))

    step = 1e-5 / max(np.abs(found.velocities).max(), np.abs(found.spins).max())
    assert abs(balance.stored - slope(at, step)) < POWER[precision] * balance.dissipated


def test_its_record_has_a_sphere_as_thick_as_the_filament_in_place_of_the_body():
    told: dict[str, float] = {}
    reporter = SimpleNamespace(start=lambda *_, **sizes: told.update(sizes))
    start_reporter(reporter, free({"flagella.filament_radius": 0.015}), np.array([0, 11]))
    assert (told["filament_radius"], told["body_length"], told["body_width"]) == (0.015, 0.03, 0.03)


def hook_twist(scene: Scene, start: InitialState) -> float:
    """What the oracle of a cell counts for the hook, which a free filament has not."""
    none = with_values(scene, {"flagella.hook_twist_factor": 1e-3})
    full = elastic_energies(with_values(scene, {"flagella.hook_twist_factor": 1.0 + 1e-3}), start)[1]
    one = full - elastic_energies(none, start)[1]
    return scene.flagella.hook_twist_factor * float(one)


def rigid_velocity(scene: Scene, x: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Of r_0, were the nodes one rigid body pulled by `force` per length."""
    (spec,) = scene.resolved_flagella()
    weights = np.full(len(x), spec.segment_length)
    weights[[0, -1]] /= 2
    motions = np.zeros((3 * len(x), 6))
    for i, arm in enumerate(x - x[0]):
        motions[3 * i : 3 * i + 3, :3] = np.eye(3)
        motions[3 * i : 3 * i + 3, 3:] = [[0, arm[2], -arm[1]], [-arm[2], 0, arm[0]], [arm[1], -arm[0], 0]]
    friction = motions.T @ np.linalg.solve(dense(scene, x), motions)
    return np.linalg.lstsq(friction, motions.T @ np.outer(weights, force).ravel(), rcond=1e-9)[0][:3]


@pytest.mark.parametrize("stepper", ["rkc", "implicit"])
@pytest.mark.parametrize("shape", ["rod along", "rod across", "ring"])
def test_a_stiff_rod_and_a_ring_sediment_as_rigid_bodies_do(shape, stepper, precision, device):
    """The discrete sum's own rigid-body mobility; a rod falls along itself about 1.5 times as fast as across."""
    curvature = (0.0, 2 * math.tan(math.pi / 10) / 0.2, 0.0) if shape == "ring" else (0.0, 0.0, 0.0)
    stiff = {
        "flagella.bending_rigidity": 350.0,
        "flagella.twist_rigidity": 350.0,
        "flagella.intrinsic_curvature": curvature,
    }
    pull = {"rod along": (0.0, 0.0, 1.0), "rod across": (0.0, 1.0, 0.0), "ring": (0.0, 1.0, 0.0)}[shape]
    scene = free({**stiff, "flagella.opening_angle": 0.0, "numerics.stepper": stepper}, precision)
    scene = with_values(scene, {"external.force_per_length": pull, "flagella.length": 1.8 if shape == "ring" else 2.0})
    sim = Simulation(scene, device=device)
    sim.advance(2e-5)
    before = sim.state
    sim.advance(1e-4)
    state = sim.state
    start = as_start(scene, state)
    expected = rigid_velocity(scene, start.positions[0], np.array(pull))
    velocity = (state.positions[0] - before.positions[0]) / 8e-5
    assert velocity == pytest.approx(expected, abs=2e-2 * np.linalg.norm(expected))
    assert state.body_position == pytest.approx(state.positions[0], abs=1e-6)


def test_steppers_agree_on_a_flexible_filament_that_tumbles_past_its_tripod(device):
    """Released from a bent shape: implicit steps converge to what RKC finds, at any angle to the motor axis."""
    scene = free({"external.force_per_length": (5.0, 0.0, -40.0), "flagella.opening_angle": 120.0})

    def end(stepper: str, step: float) -> np.ndarray:
        sim = Simulation(with_values(scene, {"numerics.stepper": stepper, "numerics.time_step": step}), device=device)
        sim.advance(2e-4)
        return sim.state.positions

    exact = end("rkc", 5e-7)
    errors = [np.abs(end("implicit", step) - exact).max() for step in (8e-6, 4e-6, 2e-6)]
    moved = np.abs(exact - initial_state(scene).positions[0]).max()
    assert errors[2] < 1e-3 * moved
    assert errors[0] > 3 * errors[1] > 9 * errors[2]


def test_without_a_body_there_is_neither_motor_nor_hook_nor_contact(device):
    sim = Simulation(free({"hook.stiffness": 1.0, "external.force_per_length": PULL}), device=device)
    assert [term.name for term in sim.system.model.terms] == ["elastic", "external", "free end"]
    assert "free end" not in [term.name for term in Simulation(cell(), device=device).system.model.terms]
    for values, key in (
        ({"flagella.count": 2}, "flagella.count"),
        ({"external.body_force": (0, 0, 1.0)}, "body_force"),
    ):
        with pytest.raises(SceneError, match=key):
            free(values)
