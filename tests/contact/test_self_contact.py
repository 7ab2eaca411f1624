"""Contact of a flagellum with itself: the same law, between segments far enough apart along the contour."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from warpflag_kernels.stepping.health import Fault

from tests.bench import Bench
from tests.contacts import REACH, find, listed, listed_contacts
from tests.helpers import as_start, attachment, cell, evaluated, free_nodes, placed, unit
from tests.implicit.test_contact_solve import check_answers
from tests.oracles import CUTOFF, contact_distances, energy, energy_gradient, own_distances
from tests.plans import as_on_gpu, plan
from tests.stepping.test_health import COUNT, motions, sampled, seen
from warpflag import observables
from warpflag.model.geometry import InitialState
from warpflag.observables import contact, recorded
from warpflag.record import Record
from warpflag.record.recorder import Recorder
from warpflag.run.simulation import NumericalError, Simulation
from warpflag.scene import Scene, with_values
from warpflag.view.node_quantities import contact_load

# Of the largest force in the state; float32 knows a distance of 0.04 um some um from the body to 1e-5.
TOLERANCE = {"float64": 1e-7, "float32": 2e-3}
SIGMA = 0.04
RADIUS = 0.15  # of the coils below [um]: nine segments of 0.1 um a turn
SELF = {"steric.self_contact": True, "flagella.segment_length": 0.1, "flagella.length": 2.0, "body.contact": False}
# Flagella that want to be rings, turn upon turn.
RING = {**SELF, "flagella.count": 1, "flagella.intrinsic_curvature": (0.0, 1 / RADIUS, 0.0), "motor.torque": 0.0}
RING |= {"hydrodynamics.mode": "none", "body.anchored": True}


def coil(scene: Scene, pitch: float, seed: int | None = None) -> InitialState:
    """Every flagellum a coil of this pitch from its anchor on; a seed shakes it."""
    random = np.random.default_rng(seed)
    nodes, directors = [], []
    for spec in scene.resolved_flagella():
        anchor, _ = attachment(scene, spec)
        outward = unit(anchor * [1, 1, 0])
        along = np.cross([0.0, 0.0, 1.0], outward)
        turn = 2 * math.asin(spec.segment_length / (2 * np.hypot(RADIUS, pitch / (2 * math.pi))))  # of a segment
        angle = turn * np.arange(spec.segment_count + 1)
        circle = RADIUS * (np.outer(1 - np.cos(angle), outward) + np.outer(np.sin(angle), along))
        x = anchor + circle + np.outer(pitch * angle / (2 * math.pi), [0.0, 0.0, 1.0])
        if seed is not None:
            x[1:] += 0.002 * random.uniform(-1, 1, x[1:].shape)
        t = unit(np.diff(x, axis=0))
        nodes.append(x[1:])
        directors.append(unit(np.cross([0.0, 0.0, -1.0], t)))
    return placed(scene, nodes, directors)


def least(scene: Scene, start: InitialState) -> float:
    """The least distance of a flagellum from itself [um]."""
    return min(float(r.min()) for r in own_distances(scene, start))


def forces(scene: Scene, starts: Any, device: str, **choices: Any) -> tuple[np.ndarray, np.ndarray]:
    sim = Simulation(scene, device=device, starts=starts, **choices)
    sim.evaluate()
    state = sim.system.state.data
    return state.steric_first.numpy().astype(np.float64), state.steric_second.numpy().astype(np.float64)


@pytest.mark.parametrize("count", [1, 2])
def test_total_force_is_the_energy_gradient(count, precision, device):
    """Of coils whose turns touch all along; two of them touch each other, too."""
    beside = {"flagellum.1.azimuth": 20.0} if count == 2 else {}
    scene = cell({**SELF, "flagella.count": count, "flagella.length": 1.4, **beside}, precision)
    start = coil(scene, 0.95 * SIGMA, seed=1)
    assert sum((r < CUTOFF * SIGMA).sum() for r in own_distances(scene, start)) > 5 * count
    assert count == 1 or (contact_distances(start) < CUTOFF * SIGMA).any()
    expected = energy_gradient(scene, start, energy)
    found = evaluated(scene, start, device)
    nodes, largest = free_nodes(scene), np.abs(expected.forces).max()
    assert np.abs(found.forces[nodes] - expected.forces[nodes]).max() < TOLERANCE[precision] * largest
    assert np.abs(found.body_force - expected.body_force).max() < TOLERANCE[precision] * largest
    off = evaluated(with_values(scene, {"steric.self_contact": False}), start, device)
    assert np.abs(off.forces[nodes] - expected.forces[nodes]).max() > 1.0


def test_force_and_torque_are_conserved_however_it_is_executed(precision, device):
    scene = cell({**SELF, "flagella.count": 1}, precision)
    start = coil(scene, 0.9 * SIGMA, seed=2)
    first, second = forces(scene, start, device)
    x, epsilon = np.concatenate(start.positions), 100 * float(np.finfo(precision).eps)
    force, arm = np.vstack([first, second]), np.vstack([np.roll(x, 1, axis=0), x])
    assert np.abs(first).max() > 0.8
    assert np.abs(force.sum(axis=0)).max() < epsilon * np.abs(force).sum()
    torque = np.cross(arm, force)
    assert np.abs(torque.sum(axis=0)).max() < epsilon * np.abs(torque).sum()
    if device == "cpu":
        gathered = forces(scene, start, device, plan=as_on_gpu(plan(scene, device)))
        allowed = 10 * epsilon * np.abs(force).max()
        assert np.abs(np.array(gathered) - [first, second]).max() < allowed


def test_cells_of_a_batch_are_as_alone(precision, device):
    scene = cell({**SELF, "flagella.count": 1}, precision)
    starts = [coil(scene, pitch * SIGMA, seed=3) for pitch in (0.9, 1.0, 2.0)]
    together = forces([scene] * 3, starts, device)
    for c, start in enumerate(starts):
        own = slice(21 * c, 21 * (c + 1))
        for both, alone in zip(together, forces(scene, start, device), strict=True):
            assert np.array_equal(both[own], alone)
    assert [np.abs(together[0][21 * c : 21 * (c + 1)]).max() > 0 for c in range(3)] == [True, True, False]


@pytest.mark.parametrize("h", [0.03, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("curvature", [(0.0, 1.3, -2.1), (0.0, 0.0, 0.0)])
def test_a_helix_and_a_line_feel_nothing(h, curvature, precision, device):
    values = {"flagella.count": 1, "flagella.segment_length": h, "flagella.length": 4.0, "body.contact": False}
    scene = cell({**values, "steric.self_contact": True, "flagella.intrinsic_curvature": curvature}, precision)
    b = Bench(scene, None, device)
    assert not np.abs(b.data.steric_first.numpy()).any() and not np.abs(b.data.steric_second.numpy()).any()
    find(b)
    assert not listed_contacts(b)
    assert b.sim.cell_state().steric_force == 0.0


def test_neighbours_along_the_contour_do_not_touch_however_near(precision, device):
    """With h 0.05, 3 sigma are 2.4 segments: those two apart don't act, those three apart do."""
    values = {"flagella.count": 1, "flagella.length": 0.5, "flagella.segment_length": 0.05, "body.contact": False}
    scene = cell({**values, "steric.self_contact": True}, precision)
    ends = [[x, 0.0, 3.0] for x in range(2, 10)]
    for between, acting in (([], []), ([[0.01, 0.01, 3.0]], [2, 5])):
        nodes = [[-1.0, 0.0, 3.0], [0.0, 0.0, 3.0], *between, [0.02, 0.0, 3.0], [1.0, 0.0, 3.0], *ends][:10]
        first, second = forces(scene, placed(scene, [np.array(nodes)]), device)
        assert np.flatnonzero(np.abs(first + second).max(axis=1)).tolist() == acting


# Steps.


def test_search_finds_every_contact_and_nothing_else(device, precision):
    total = 0
    for seed in range(3):
        scene = cell({**SELF, "flagellum.1.azimuth": 30.0, "flagella.length": 1.6}, precision)
        b = Bench(scene, coil(scene, 1.1 * SIGMA, seed), device)
        find(b)
        exact, first = {}, 0
        for r, x in zip(own_distances(scene, b.start), b.start.positions, strict=True):
            exact |= {(first + i + 1, first + j + 1): r[i, j] for i, j in np.argwhere(r < REACH + 1e-6)}
            first += len(x)
        found = {
            pair: row for pair, row in listed_contacts(b).items() if (pair[0] < b.first[1]) == (pair[1] < b.first[1])
        }
        assert found.keys() <= exact.keys()
        assert all(gap > REACH - 1e-6 for pair, gap in exact.items() if pair not in found)
        for (e, other), row in found.items():
            assert row["gap"] == pytest.approx(exact[e, other], abs=1e-6)
            assert row["anchored"] == 1 * (e - 1 in b.first) + 2 * (other - 1 in b.first)
        total += len(found)
    assert total > 40


@pytest.mark.parametrize("mode", ["all", "none"])
def test_a_load_is_answered_as_by_dense_matrices(mode, device, precision):
    values = {**RING, "flagella.length": 1.4, "hydrodynamics.mode": mode, "body.anchored": False}
    b = Bench(cell(values, precision), coil(cell(values), 1.05 * SIGMA, seed=4), device)
    check_answers(listed(b, 1e-6), precision)


@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_a_coil_that_closes_upon_itself_stops_where_elastic_and_contact_forces_balance(stepper, device, precision):
    """Its turns would lie in one plane. The twist that opens them, pitch p, pulls with C p/(2 pi R^3)."""
    scene = with_values(cell(RING, precision), {"numerics.stepper": stepper, "numerics.accuracy": 1e-3})
    start = coil(scene, 0.1)
    sim = Simulation(scene, device=device, starts=start)
    sim.advance(2e-3)
    closed = as_start(scene, sim.cell_state())
    gap = least(scene, closed)
    assert 0.75 * SIGMA < gap < CUTOFF * SIGMA
    found, free = sim.evaluate(), free_nodes(scene)
    held = np.abs(sim.system.state.data.steric_second.numpy()).max()
    assert held > 0.1 and np.abs(found.forces[free]).max() < 0.05 * held
    if stepper == "implicit":
        through = Simulation(with_values(scene, {"steric.self_contact": False}), device=device, starts=start)
        through.advance(2e-3)
        assert least(scene, as_start(scene, through.cell_state())) < 0.3 * SIGMA


def test_the_steppers_agree(device):
    reached = []
    for stepper in ("implicit", "rkc"):
        scene = with_values(cell(RING), {"numerics.stepper": stepper, "numerics.accuracy": 1e-3})
        sim = Simulation(scene, device=device, starts=coil(scene, 0.1))
        sim.advance(5e-4)
        reached.append(sim.cell_state().positions)
    assert np.abs(reached[0] - reached[1]).max() < 2e-3


def test_passing_through_itself_is_an_error_only_where_it_repels(device, precision):
    """A coil that wants to be wound the other way round turns inside out."""
    other = {"flagella.intrinsic_curvature": (0.0, 6.0, 2.0), "steric.strength": 1e-6}
    scene = cell({**RING, **other, "numerics.stepper": "rkc", "numerics.time_step": 2e-6}, precision)
    sim = Simulation(scene, device=device, starts=coil(scene, 0.1))
    with pytest.raises(NumericalError) as caught:
        sim.advance(2e-3)
    assert caught.value.kind == Fault.CROSSING
    scene = with_values(scene, {"steric.self_contact": False})
    Simulation(scene, device=device, starts=coil(scene, 0.1)).advance(2e-3)


@pytest.mark.parametrize("looked_at", [None, 0.7])
def test_crossings_of_a_flagellum_with_itself_are_seen(looked_at, device, precision):
    """Two filaments of two segments that cross in dense samples, joined by way of far points to a single one."""
    scene = cell({"flagella.count": 1, "flagella.length": 1.4, "steric.self_contact": True}, precision)
    sim = Simulation([with_values(scene, {"numerics.stepper": "implicit"})] * COUNT, device=device)
    before, after = motions(0)
    crossed, _, _ = sampled(before, after)
    answer = seen(sim, joined(before), joined(after), looked_at)
    assert answer[crossed].all(), np.flatnonzero(crossed & ~answer)
    assert crossed.sum() > 50
    assert not seen(sim, joined(before), joined(before), looked_at).any()


def joined(pairs: np.ndarray) -> np.ndarray:
    """Two filaments as one flagellum, shape [COUNT, 1, 8, 3]."""
    far = np.tile([[50.0, 0.0, 0.0], [0.0, 50.0, 0.0]], (COUNT, 1, 1))
    return np.concatenate([pairs[:, 0], far, pairs[:, 1]], axis=1)[:, None]


def test_the_recorded_force_is_that_of_the_shape(tmp_path, device):
    """Contacts of a flagellum with itself count, where the scene has them."""
    scene = with_values(cell(RING), {"numerics.stepper": "implicit", "duration": 1e-4, "frames": 2})
    sim = Simulation(scene, device=device, starts=coil(scene, SIGMA), reporters=[Recorder(tmp_path / "run.h5")])
    sim.run(1e-4)
    with Record(tmp_path / "run.h5") as record:
        recorded_force = record.observables["steric_force_density"]
        assert recorded_force.min() > 0.1
        np.testing.assert_allclose(recorded.steric_force_densities(record), recorded_force, rtol=1e-6)
        shape = record.positions[0], record.first_node, scene.steric.strength, SIGMA, 2.0
        frames, spacing = record.positions[:], [contact.own_spacing(SIGMA, 0.1)]
    assert observables.steric_force_density(*shape) == 0.0
    load = contact_load(frames, shape[1], 0.8, SIGMA, np.array(spacing))
    np.testing.assert_allclose(load.sum(axis=1), 2 * 2.0 * recorded_force, rtol=1e-6)
    assert not contact_load(frames, shape[1], 0.8, SIGMA).any()


def test_density_leaves_out_segments_within_three_diameters_of_contour():
    """Along the sides of a square, sigma 1.2 of them, the fourth segment after one is the first that touches it."""
    nodes = 0.05 * np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0.6], [1, 0, 0.6]])

    def density(x: np.ndarray) -> float:
        return contact.steric_force_density(x, np.array([0, len(x)]), 0.8, 0.06, 1.0, self_contact=True)

    def load(x: np.ndarray) -> float:  # every contact counts on both sides
        spacing = np.array([contact.own_spacing(0.06, 0.05)])
        return float(contact_load(x[None], np.array([0, len(x)]), 0.8, 0.06, spacing).sum())

    assert density(nodes[:5]) == load(nodes[:5]) == 0.0
    force = float(contact.steric_force(0.03, 0.8, 0.06))
    assert density(nodes) == pytest.approx(force)
    assert load(nodes) == pytest.approx(2 * force)
