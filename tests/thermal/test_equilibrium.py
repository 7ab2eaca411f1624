"""Cells at a temperature: energies of joints, no drift of a passive helix, resumed runs. Seeds are fixed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.helpers import cell, shaken, touching_cell
from warpflag.run.faults import NumericalError
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, SceneError, with_values

KT = 1.380649e-5 * 300.0
PASSIVE = {
    "fluid.temperature": 300.0,
    "motor.torque": 0.0,
    "numerics.stepper": "implicit",
    "body.contact": False,
    "steric.enabled": False,
    "flagella.length": 1.2,
    "duration": 1.0,
}
# Mean energy of a joint or segment over kT: bend, twist, stretch (quadrature of the joint's own integral).
JOINT = np.array([0.99977, 0.50006, 0.50002])
HOOK = np.array([0.0, 0.5, 0.0])
ERRORS = 4  # standard errors that a mean may be off


def ensemble(values: dict[str, Any], precision: str, count: int, device: str) -> tuple[Simulation, Scene]:
    scene = cell({**PASSIVE, **values}, precision)
    return Simulation([with_values(scene, {"fluid.seed": i}) for i in range(count)], device=device), scene


def expected_energy(scene: Scene) -> np.ndarray:
    """Mean bending, twist and stretching energy of a cell over kT."""
    segments = np.array([spec.segment_count for spec in scene.resolved_flagella()])
    bend = np.zeros(3)
    if scene.hook.stiffness:  # 2 k u with u = tan^2(beta/2), on the sphere: weight 1/(1 + u)^2
        u = np.linspace(0.0, 40 * KT / scene.hook.stiffness, 100_000)
        weight = np.exp(-2 * scene.hook.stiffness * u / KT) / (1 + u) ** 2
        bend[0] = np.sum(weight * 2 * scene.hook.stiffness * u) / np.sum(weight) / KT
    hook = HOOK if scene.body.enabled else np.zeros(3)
    return sum(JOINT * [n - 1, n - 1, n] + hook + bend for n in segments)


def mean_energies(sim: Simulation, scene: Scene, start: float, interval: float, frames: int) -> Any:
    """Mean bending, twist and stretching energy over what is expected, and its standard error over the cells."""
    sim.advance(start)
    found = []
    for i in range(frames):
        sim.advance(start + (i + 1) * interval)
        found.append(sim.cells().elastic_energy / KT)
    means = np.mean(found, axis=0) / expected_energy(scene)
    return means.mean(axis=0), means.std(axis=0, ddof=1) / len(means) ** 0.5


@pytest.mark.parametrize(
    ("step", "count", "mode", "hook"), [(1e-6, 2, "all", 0), (1e-5, 2, "all", 0), (1e-5, 1, "consistent", 4.0)]
)
def test_energies_are_those_of_boltzmann(step, count, mode, hook, precision, device):
    values = {"numerics.time_step": step, "flagella.count": count, "hydrodynamics.mode": mode, "hook.stiffness": hook}
    if hook:  # its modes take 0.4 ms: the start has it unbent
        values |= {"flagella.opening_angle": 110.0, "flagella.on_axis": True}
    sim, scene = ensemble(values, precision, 64, device)
    mean, error = mean_energies(sim, scene, 8e-4 if hook else max(20 * step, 1e-4), 2 * step, 40)
    assert np.all(error < 0.03)
    assert np.all(abs(mean - 1) < ERRORS * error)


def test_with_flow_round_the_body(precision, device):
    values = {"numerics.time_step": 1e-5, "hydrodynamics.mode": "consistent", "hydrodynamics.body_flow": True}
    sim, scene = ensemble({**values, "hydrodynamics.body_beads": 30}, precision, 64, device)
    mean, error = mean_energies(sim, scene, 2e-4, 2e-5, 30)
    assert np.all(error < 0.03)
    assert np.all(abs(mean - 1) < ERRORS * error)


@pytest.mark.parametrize("mode", ["none", "all"])
def test_a_free_filament_has_them_too(mode, precision, device):
    values = {"numerics.time_step": 1e-5, "flagella.count": 1, "hydrodynamics.mode": mode, "body.enabled": False}
    sim, scene = ensemble(values, precision, 64, device)
    mean, error = mean_energies(sim, scene, 2e-4, 2e-5, 30)
    assert np.all(error < 0.03)
    assert np.all(abs(mean - 1) < ERRORS * error)


@pytest.mark.parametrize("stepper", ["rkc", "euler"])
def test_explicit_steps_agree(stepper, device):
    """Two segments in their short steps, which are 5 % too warm or 1 % too cold at most."""
    values = {"numerics.stepper": stepper, "flagella.length": 0.4, "flagella.count": 1, "hydrodynamics.mode": "none"}
    sim, scene = ensemble(values, "float64", 24, device)
    mean, error = mean_energies(sim, scene, 1e-6, 5e-7, 5)
    assert np.all(error < 0.15)
    assert np.all(abs(mean - 1) < ERRORS * error)


def test_a_passive_helix_does_not_swim(device):
    """Along its own axis; increments chained as rotations make it swim at 30 um/s toward its root here."""
    sim, scene = ensemble({"flagella.count": 1, "numerics.time_step": 1e-5}, "float64", 96, device)
    nodes, start, step, frames = scene.resolved_flagella()[0].segment_count + 1, 2e-4, 1e-5, 150

    def look() -> tuple[np.ndarray, np.ndarray]:
        x = sim.cells().positions.reshape(96, nodes, 3)
        axis = x[:, -1] - x[:, 1]
        return x[:, 1:].mean(axis=1), axis / np.linalg.norm(axis, axis=1, keepdims=True)

    sim.advance(start)
    way, (middle, axis) = np.zeros(96), look()
    for i in range(frames):
        sim.advance(start + (i + 1) * step)
        middle_before, axis_before = middle, axis
        middle, axis = look()
        way += np.sum((middle - middle_before) * (axis + axis_before) / 2, axis=1)
    speed = way / (frames * step)
    error = speed.std(ddof=1) / 96**0.5
    assert error < 4.0
    assert abs(speed.mean()) < ERRORS * error


@pytest.mark.parametrize("stepper", ["implicit", "rkc", "euler"])
def test_goes_on_with_the_same_bits(stepper, precision, device):
    """After a checkpoint, in a batch of another size, without captured passes; another seed gives another run."""
    step = 2e-6 if stepper == "implicit" else 4e-9
    warm = {"fluid.temperature": 300.0, "fluid.seed": 5, "numerics.stepper": stepper, "numerics.time_step": step}
    warm |= {"hydrodynamics.body_flow": stepper == "implicit", "hydrodynamics.body_beads": 30}
    scene = touching_cell({"flagella.length": 1.2, **warm}, precision)
    whole = Simulation(scene, device=device, strict=True)
    whole.advance(20 * step)
    kept = whole.checkpoint()
    whole.advance(40 * step)
    resumed = Simulation(scene, device=device, strict=True)
    resumed.restore(kept)
    resumed.advance(40 * step)
    other = with_values(scene, {"fluid.seed": 6})
    batch = Simulation([other, scene], device=device, strict=True, capture=False)
    batch.advance(20 * step)
    batch.advance(40 * step)
    for found in (resumed.state, batch.cell_state(1)):
        assert np.array_equal(found.positions, whole.state.positions)
        assert np.array_equal(found.directors, whole.state.directors)
    assert not np.array_equal(batch.cell_state(0).positions, whole.state.positions)


@pytest.mark.parametrize("stepper", ["implicit", "rkc", "euler"])
def test_frames_are_ends_of_steps(stepper, device):
    """Each at its time, and the last one is the state; steps are cut so that they end there."""
    values = {"numerics.stepper": stepper, "numerics.time_step": 1e-9, "duration": 5.5e-9, "frames": 2}
    sim = Simulation(cell({**PASSIVE, **values}), device=device)
    frames = list(sim.frames(5.5e-9))
    assert [frame.step for frame in frames] == [0, 3, 6]
    assert np.allclose(frames[-1].positions, sim.state.positions, rtol=0, atol=1e-12)
    assert not np.allclose(frames[-1].positions, frames[1].positions, rtol=0, atol=1e-12)


def test_no_step_is_rejected(device):
    """Every cell takes the same steps whatever its noise, cut only where a time is asked for; a step that is not sound
    stops its cell. So there is no step whose noise would have to be divided."""
    values = {**PASSIVE, "flagella.length": 0.6, "hydrodynamics.mode": "all", "numerics.time_step": 1e-5}
    scenes = [cell({**values, "fluid.seed": i, "fluid.temperature": 300.0 * 1.5**i}) for i in range(5)]
    wild = cell({**values, "motor.torque": 100.0})
    sim = Simulation([*scenes, wild], device=device)
    with pytest.raises(NumericalError, match="stopped at 0 ms"):
        sim.advance(1.05e-4)
    sim.exclude(5)
    assert sim.steps.tolist() == [11] * 5 + [0]
    assert np.all(sim.times[:5] == 1.05e-4) and sim.times[5] == 0.0


def test_steppers_take_the_same_noise(device):
    """In short steps the implicit and the explicit step agree: the random elastic force vanishes with the step."""
    warm = {"fluid.temperature": 300.0, "numerics.time_step": 1e-12, "hydrodynamics.mode": "all", "motor.torque": 3.4}
    ends = []
    for stepper in ("implicit", "euler", "rkc"):
        sim = Simulation(cell({**warm, "numerics.stepper": stepper}), device=device)
        start = sim.state.positions
        sim.advance(1e-10)
        ends.append(sim.state.positions - start)
    assert abs(ends[0] - ends[1]).max() < 0.05 * abs(ends[0]).max()
    assert abs(ends[2] - ends[1]).max() < 0.05 * abs(ends[1]).max()


def test_explicit_steps_are_shares_of_the_longest_sound_step(device):
    """With noise a twentieth of it, and 0.11 of it where two stages leave less of an error; implicit ones are 1 us."""
    cold = cell({"numerics.stepper": "euler"})
    (longest,) = Simulation(cold, device=device).system.control.longest_step.numpy()
    for stepper, expected in (("euler", 0.05 * longest), ("rkc", 0.11 * longest), ("implicit", 1e-6)):
        warm = with_values(cold, {"numerics.stepper": stepper, "fluid.temperature": 300.0})
        for given in (None, 2e-7):
            sim = Simulation(with_values(warm, {"numerics.time_step": given}), device=device)
            assert sim.system.control.longest_step.numpy() == pytest.approx(expected if given is None else given)


def test_two_stages_are_of_second_order(device):
    """Of a disturbed cell, at a temperature that moves nothing; Euler's error is some thirty times as large."""
    cold = {"fluid.temperature": 1e-12, "hydrodynamics.mode": "all", "motor.torque": 3.4, "flagella.length": 0.6}
    scene, until = cell({**PASSIVE, **cold, "numerics.stepper": "rkc"}), 8e-9
    start, ends = shaken(scene, 3, node=1e-3, spin=0.02), {}
    for stepper, step in (("rkc", 1e-9), ("rkc", 5e-10), ("rkc", 3.125e-11), ("euler", 5e-10)):
        values = {"numerics.stepper": stepper, "numerics.time_step": step}
        sim = Simulation(with_values(scene, values), device=device, starts=start)
        sim.advance(until)
        ends[stepper, step] = sim.state.positions
    found = [abs(ends[key] - ends["rkc", 3.125e-11]).max() for key in list(ends) if key != ("rkc", 3.125e-11)]
    assert 3.5 < found[0] / found[1] < 5.0
    assert found[2] > 10 * found[1]


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ({"hydrodynamics.mode": "as_printed"}, "hydrodynamics.mode"),
        ({"hydrodynamics.mode": "between"}, "hydrodynamics.mode"),
        ({"numerics.accuracy": 1e-3}, "numerics.accuracy"),
        ({"motor.bearing_torque": False}, "motor.bearing_torque"),
        ({"fluid.temperature": 0.0, "fluid.noise_tolerance": 1e-3}, "fluid.noise_tolerance"),
        ({"fluid.temperature": -1.0}, "fluid.temperature"),
    ],
)
def test_what_noise_does_not_go_with_is_refused(values, key):
    with pytest.raises(SceneError) as error:
        cell({**PASSIVE, **values})
    assert error.value.key == key


def test_a_pair_radius_without_a_root_is_refused(device):
    with pytest.raises(SceneError, match="indefinite"):
        Simulation(cell({**PASSIVE, "hydrodynamics.pair_radius": 0.02}), device=device)
    with pytest.raises(SceneError, match="same terms"):
        Simulation([cell(PASSIVE), cell({**PASSIVE, "fluid.temperature": 0.0})], device=device)
