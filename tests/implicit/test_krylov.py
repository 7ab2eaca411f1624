"""Stiff cells: the Krylov solution against dense matrices, and runs against the explicit stepper."""

from __future__ import annotations

import numpy as np
import pytest
from warpflag_kernels.implicit import krylov, stability

from tests.bench import bench, close, dense_solver, displacements, spins
from tests.bench import flat as flattened
from warpflag.run.simulation import Simulation
from warpflag.scene import paper_scene, with_values

# Of a solution, relative to its largest value: what six products leave, and round-off.
TOLERANCE = {"float64": 2e-3, "float32": 1e-2}
STEP, GAIN, WEIGHT = 1e-5, 2 / 3, 1.3
STIFF = {"flagella.bending_rigidity": 35.0, "flagella.twist_rigidity": 35.0, "flagella.stretching_stiffness": 1e4}


HOOK = {"hook.length": 0.055, "hook.stiffness": 2.0}
FLOW = {"hydrodynamics.body_flow": True, "hydrodynamics.body_beads": 30}


@pytest.mark.parametrize(
    "values", [{}, {"body.anchored": True}, {"flagella.count": 1}, {"flagella.count": 3}, {**HOOK, **FLOW}]
)
def test_the_solution_is_that_with_the_full_mobility(values, device, precision):
    """From P b, and only in cells that are strongly coupled."""
    scene = {**STIFF, "steric.enabled": False, "body.contact": False, **values}
    exact, b = (bench(scene, p, device, node=1e-4, spin=0.01) for p in ("float64", precision))
    exact.factorise(STEP, WEIGHT * GAIN)
    band = b.factorise(STEP, WEIGHT * GAIN)
    random, fixed = np.random.default_rng(7), (6 + 4 * b.first[:, None] + np.arange(3)).ravel()
    velocities = random.uniform(-1, 1, 6 + 4 * b.count)
    velocities[fixed] = 0.0
    if values.get("body.anchored"):
        velocities[:6] = 0.0
    system = np.eye(6 + 4 * b.count) / STEP + GAIN * exact.mobility() @ exact.hessian()
    solution = np.linalg.solve(system, velocities)
    begun = dense_solver(exact, STEP, WEIGHT * GAIN) @ velocities
    s, space = b.stepper, krylov.allocate(b.model)
    s.law.gain.fill_(GAIN)
    for strong in (0, 1):
        s.stability.strong.fill_(strong)
        x = b.increment(begun[:6], begun[6:].reshape(-1, 4))
        krylov.solve(b.model, b.state, s.stiffness, band, s.law.gain, s.stability, space, b.increment(), x)
        assert b.data.active.numpy().all() and s.stability.any_strong.numpy()[0] == strong
        for part in (displacements(b), spins(b)):
            expected = solution if strong else begun
            assert close(flattened(x)[part], expected[part], precision, tolerance=TOLERANCE)
            assert np.abs(begun[part] - solution[part]).max() > 0.01 * np.abs(solution[part]).max()


STIFFER = {name: 1000 * value for name, value in STIFF.items()}
HELD = {"flagella.count": 1, "flagella.length": 2.0, "flagella.segment_length": 0.1, "body.anchored": True}
HELD |= {"hydrodynamics.mode": "consistent", "motor.torque": 1.0}
FAMILY = {
    "held": (HELD, 100.0),
    "held, all": ({**HELD, "hydrodynamics.mode": "all"}, 100.0),
    "free": ({}, 100.0),
    "free, stiffer": ({}, 1e4),
    "stretch alone": ({"flagella.stretching_stiffness": 1e7}, 1.0),
    "three": ({"flagella.count": 3, "flagella.opening_angle": 90.0}, 100.0),
    "hook and body flow": ({**HOOK, **FLOW}, 100.0),
}


@pytest.mark.parametrize("name", FAMILY)
def test_stiff_cells_keep_their_accuracy_in_long_steps(name, device):
    """A = C = 3.5 f with K in proportion, from 0.1 ms on: as the explicit stepper finds, at the accuracy asked for."""
    values, factor = FAMILY[name]
    stiff = {"flagella.bending_rigidity": 3.5 * factor, "flagella.twist_rigidity": 3.5 * factor}
    stiff["flagella.stretching_stiffness"] = min(1e7, 1e3 * factor)
    scene, duration, accuracy = with_values(paper_scene(name="stiff"), {**stiff, **values}), 2e-4, 5e-3
    ends = []
    for stepper, asked in (("rkc", 2e-4), ("implicit", accuracy)):
        sim = Simulation(with_values(scene, {"numerics.stepper": stepper, "numerics.accuracy": asked}), device=device)
        sim.advance(duration)
        ends.append(sim.state)
    error = np.linalg.norm(ends[0].positions - ends[1].positions, axis=1).max()
    assert error < 2 * accuracy * duration * 1e3
    assert ends[1].elastic_energy.sum() == pytest.approx(ends[0].elastic_energy.sum(), rel=0.05)
    assert ends[1].step < 250


def test_the_stiffest_cells_with_flow_round_the_body_keep_their_accuracy(device):
    """f = 1e4, against a run of a thirtieth of the accuracy: the Krylov space is larger there."""
    stiff = {"flagella.bending_rigidity": 3.5e4, "flagella.twist_rigidity": 3.5e4, "flagella.stretching_stiffness": 1e7}
    around = {"hydrodynamics.mode": "consistent", "hydrodynamics.body_flow": True, "flagella.length": 7.0}
    scene, duration, accuracy = with_values(paper_scene(name="stiff"), {**stiff, **around}), 2e-4, 5e-3
    ends = []
    for asked in (accuracy / 30, accuracy):
        sim = Simulation(with_values(scene, {"numerics.accuracy": asked}), device=device)
        sim.advance(duration)
        ends.append(sim.state.positions)
    assert np.linalg.norm(ends[0] - ends[1], axis=1).max() < 2 * accuracy * (duration / 1e-3) ** 0.5


def test_a_flexible_cell_needs_no_krylov_space(device):
    sim = Simulation(paper_scene(name="flexible"), device=device)
    sim.advance(1e-4)
    assert 0.5 < sim.stepper.stability.kappa.numpy()[0] < stability.LARGE_KAPPA
    assert not sim.stepper.stability.strong.numpy().any()


def test_a_stiff_cell_goes_on_with_the_same_bits(device):
    stiff, _ = FAMILY["held"]
    scene = with_values(paper_scene(name="stiff"), {**stiff, **STIFF})
    whole, parts = (Simulation(scene, device=device, strict=True) for _ in range(2))
    whole.advance(5e-5)
    kept = whole.checkpoint()
    assert whole.stepper.stability.strong.numpy()[0] == 1
    whole.advance(1e-4)
    parts.restore(kept)
    parts.advance(1e-4)
    assert np.array_equal(whole.state.positions, parts.state.positions)


def test_cells_of_a_batch_decide_each_for_itself(device):
    scenes = [with_values(paper_scene(name="cell"), values) for values in ({}, STIFFER)]
    batch = Simulation(scenes, device=device, strict=True)
    batch.advance(1e-4)
    assert batch.stepper.stability.strong.numpy().tolist() == [0, 1]
    for c, scene in enumerate(scenes):
        single = Simulation(scene, device=device, strict=True)
        single.advance(1e-4)
        assert np.array_equal(single.state.positions, batch.cell_state(c).positions), c
