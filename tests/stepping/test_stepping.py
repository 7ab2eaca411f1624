"""Time stepping: RKC2 against Euler and against its own theory, clocks, restarts, captured against eager passes.

The oracle is explicit Euler, Richardson-extrapolated from two tiny steps, so it shares no coefficient with RKC.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from warpflag_kernels.rod import comoving_chart, reconstruction
from warpflag_kernels.stepping.right_hand_side import launch_right_hand_side

from tests.helpers import anchors, as_start, cell, displaced, free_nodes, shaken, touching_cell
from warpflag.model.geometry import InitialState
from warpflag.run.simulation import CellState, Simulation
from warpflag.scene import Scene, with_values

# Relative error of the spectral radius from finite differences: float64, float32.
RADIUS_TOLERANCE = {"float64": 0.03, "float32": 0.03}
COEFFICIENT_TOLERANCE = 1e-10
RATE_TOLERANCE = 1e-6
STATE = ("positions", "directors", "motor_angle", "body_position", "body_orientation")


def stepped(scene: Scene, stepper: str, step: float) -> Scene:
    return with_values(scene, {"numerics.stepper": stepper, "numerics.time_step": step})


def reached(scene: Scene, start: InitialState, duration: float, device: str) -> CellState:
    sim = Simulation(scene, device=device, starts=start)
    sim.advance(start.time + duration)
    return sim.cell_state()


def under_way(scene: Scene, device: str, time: float = 1e-4) -> InitialState:
    """The scene's state when the motors have wound up the filaments: before, no finite step resolves the twist."""
    sim = Simulation(stepped(scene, "rkc", 2e-6), device=device)
    sim.advance(time)
    return as_start(scene, sim.cell_state())


def same(a: CellState, b: CellState) -> bool:
    """Equal to the last bit."""
    return a.time == b.time and all(np.array_equal(getattr(a, name), getattr(b, name)) for name in STATE)


def largest_difference(a: CellState, b: CellState) -> float:
    return max(float(np.abs(getattr(a, name) - getattr(b, name)).max()) for name in STATE)


@pytest.mark.parametrize(("stepper", "step"), [("rkc", 1e-7), ("euler", 2e-9)])
def test_fixed_steps_are_equal(stepper, step, device, precision):
    """Two and a half of them are three that are shorter, to the last bit."""
    scene, until = cell({}, precision), 2.5 * step
    found = []
    for own in (step, until / 3):
        sim = Simulation(stepped(scene, stepper, own), device=device)
        sim.advance(until)
        assert sim.steps[0] == 3
        found.append(sim.cell_state())
    assert same(*found)


@pytest.mark.parametrize("make", [cell, touching_cell], ids=["free", "contact"])
def test_rkc_is_second_order_against_euler(make, device):
    scene, window = make(), 4e-5
    start = under_way(scene, device)
    coarse, fine = (reached(stepped(scene, "euler", step), start, window, device) for step in (4e-9, 2e-9))
    exact = {name: 2 * getattr(fine, name) - getattr(coarse, name) for name in STATE}
    errors = {name: [] for name in STATE}
    counts = (8, 16, 32, 64)
    for count in counts:
        state = reached(stepped(scene, "rkc", window / count), start, window, device)
        for name in STATE:
            errors[name].append(np.abs(getattr(state, name) - exact[name]).max())
    for name in ("positions", "directors", "body_orientation"):
        # One slope through all: single ones carry the error of the oracle and higher orders.
        slope = -np.polyfit(np.log(counts), np.log(errors[name]), 1)[0]
        assert 1.8 < slope < 2.2, (name, errors[name])
    assert errors["positions"][0] < 1e-3
    if make is touching_cell:
        assert min(state.steric_force for state in (coarse, fine)) > 0.1


def test_increment_rates_carry_the_state_exactly_as_it_moves(device):
    """Far from the start of a step, in a turning chart: the placed state moves with the velocities and spins."""
    scene = cell()
    sim = Simulation(scene, device=device, starts=shaken(scene, seed=2, node=1e-3))
    model, state, c = sim.system.model, sim.system.state, sim.system.chart
    random, first = np.random.default_rng(3), anchors(scene)
    nodes = random.uniform(-1, 1, (model.element_count, 4)) * [0.01, 0.01, 0.01, 0.3]
    nodes[first, :3] = 0.0
    body = random.uniform(-1, 1, (1, 6)) * [0.1, 0.1, 0.1, 0.5, 0.5, 0.5]
    c.flagellum_spin.assign(random.uniform(-1, 1, (2, 3)) * 5e4)

    def place(shift: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        c.increment.assign(nodes + shift * rates[0])
        c.body_increment.assign(body + shift * rates[1])
        c.elapsed.fill_(1e-5 + shift)
        state.data.active.fill_(1)
        reconstruction.reconstruct(model, state, c)
        pose = state.data.pose
        return tuple(a.numpy().copy() for a in (pose.position, pose.director, pose.body_position))

    rates = np.zeros_like(nodes), np.zeros_like(body)
    _, directors, _ = place(0.0)
    launch_right_hand_side(model, state)
    comoving_chart.increment_rates(model, state, c)
    rates = c.rate.numpy().copy(), c.body_rate.numpy().copy()
    s = state.data
    tangents, velocities, spin = s.pose.tangent.numpy().copy(), s.velocity.numpy().copy(), s.body_spin.numpy()[0].copy()
    spins = model.data.drag.spin_mobility.numpy()[0] * s.spin_torque.numpy()
    centre_velocity = s.body_velocity.numpy()[0].copy()
    along = np.diff(velocities, axis=0, prepend=0) / s.pose.length.numpy()[:, None]
    along[first] = np.cross(spin, tangents[first])  # the tripod's axis turns with the body
    turning = np.cross(tangents, along) + spins[:, None] * tangents
    step = 1e-12
    moved = [(b - a) / (2 * step) for a, b in zip(place(-step), place(step), strict=True)]
    expected = velocities - centre_velocity, np.cross(turning, directors), centre_velocity
    for found, exact in zip(moved, expected, strict=True):
        assert np.abs(found - exact).max() < RATE_TOLERANCE * np.abs(exact).max()


def coefficients(sim: Simulation, stages: int) -> tuple[np.ndarray, np.ndarray]:
    """What the device computes for every stage of a step of 1 s: mu, nu, m, g and the stage's time, in order."""
    from warpflag_kernels.stepping import rkc

    s, data = sim.system, sim.stepper.data
    s.control.time.zero_()
    s.control.target.fill_(1.0)
    s.control.longest_step.fill_(1.0)
    s.state.data.active.fill_(1)
    data.spectral_radius.fill_((stages - 1.5) * (stages - 0.5) / 1.54 / rkc.RADIUS_MARGIN)
    rows, times = [], []
    for j in range(1, stages + 1):
        data.stage.fill_(j)
        rkc.begin_pass(s.model, s.state, s.chart, s.control, sim.stepper.steps, data, euler=False)
        assert data.stages.numpy()[0] == stages
        assert s.chart.commit.numpy()[0] == (j == stages)
        rows.append(data.coefficients.numpy()[0].copy())
        times.append(s.chart.elapsed.numpy()[0])
    return np.array(rows), np.array(times)


def integrated(rows: np.ndarray, rate: Callable[[np.ndarray], np.ndarray], size: int) -> np.ndarray:
    """All stages of one step of y' = rate(y) from y = 0 with these coefficients, shape [stage_count, size]."""
    start = rate(np.zeros(size))
    stages = [np.zeros(size), rows[0, 2] * start]
    for mu, nu, m, g in rows[1:]:
        stages.append(mu * stages[-1] + nu * stages[-2] + m * rate(stages[-1]) + g * start)
    return np.array(stages[1:])


@pytest.mark.parametrize("stages", [2, 3, 10, 91, 300])
def test_coefficients_are_those_of_a_stable_second_order_method(stages, device):
    sim = Simulation(cell({"numerics.time_step": 1e-6}), device=device)
    sim.advance(1e-6)
    rows, times = coefficients(sim, stages)
    # y' = (1, y_0): each stage knows its time, and from the second on integrates t exactly.
    path = integrated(rows, lambda y: np.array([1.0, y[0]]), 2)
    assert abs(times[-1] - 1.0) < COEFFICIENT_TOLERANCE
    assert np.abs(path[:, 0] - times).max() < COEFFICIENT_TOLERANCE
    assert np.abs(path[1:, 1] - times[1:] ** 2 / 2).max() < COEFFICIENT_TOLERANCE
    # y' = z (1 + y): stable for every stiffness that gets this stage count, and damped away from 0.
    z = -np.linspace(1e-3, 1.0, 1000) * (stages**2 - 1) / 1.54
    growth = np.abs(1.0 + integrated(rows, lambda y: z * (1.0 + y), len(z))[-1])
    assert growth.max() < 1.0
    assert growth[z < -4.0].max(initial=0.0) < 0.98


NOISY = {"fluid.temperature": 300.0, "numerics.time_step": 2e-6}


@pytest.mark.parametrize(
    "values",
    [
        {"numerics.stepper": "rkc"},
        {"numerics.stepper": "implicit"},
        {"numerics.stepper": "implicit", **NOISY},
        {"numerics.stepper": "implicit", **NOISY, "hydrodynamics.body_flow": True},
        {"numerics.stepper": "euler", "fluid.temperature": 300.0, "numerics.time_step": 4e-9},
    ],
    ids=["rkc", "implicit", "noisy", "noisy flow", "noisy euler"],
)
def test_captured_and_eager_runs_agree_to_the_last_bit(values, device, precision):
    scene = touching_cell(values, precision)
    runs = []
    for capture in (True, False):
        sim = Simulation(scene, device=device, capture=capture)
        for part in (0.5, 1.0):
            sim.advance(part * 3e-5 if scene.numerics.stepper != "euler" else part * 4e-8)
        runs.append(sim.cell_state())
    assert same(*runs)
    assert runs[0].step >= 3 and runs[0].steric_force > 0.0


@pytest.mark.parametrize("stepper", ["rkc", "euler"])
def test_steps_divide_the_way_evenly_and_end_on_the_target(stepper, device):
    step = {"rkc": 1e-5, "euler": 4e-9}[stepper]
    sim = Simulation(stepped(cell(), stepper, step), device=device)
    taken = 0
    for until, count in ((2.5 * step, 3), (4.5 * step, 2), (4.5 * step, 0), (4.6 * step, 1), (7.6 * step, 3)):
        sim.advance(until)
        taken += count
        assert sim.times[0] == until
        assert sim.steps[0] == taken
        assert sim.cell_state().time == until


def test_a_run_in_parts_equals_the_run_in_one(device):
    scene = cell({"numerics.time_step": 1e-5})
    whole, parts = (Simulation(scene, device=device) for _ in range(2))
    whole.advance(8e-5)
    for until in (3e-5, 4e-5, 7e-5, 8e-5):
        parts.advance(until)
        parts.evaluate()  # looking must not disturb
        parts.cell_state()
    assert whole.steps[0] == parts.steps[0] == 8
    assert largest_difference(whole.cell_state(), parts.cell_state()) < 1e-9


# Solved with the full mobility.
STIFF = {"flagella.bending_rigidity": 350.0, "flagella.twist_rigidity": 350.0, "flagella.stretching_stiffness": 1e5}
STIFF |= {"hydrodynamics.mode": "consistent"}


@pytest.mark.parametrize(("stepper", "values"), [("rkc", {}), ("implicit", {}), ("implicit", STIFF)])
def test_a_restored_run_goes_on_to_the_same_bits(stepper, values, device, precision):
    scene = with_values(cell(precision=precision), {"numerics.stepper": stepper, **values})
    whole, resumed = (Simulation(scene, device=device) for _ in range(2))
    whole.advance(5e-5)
    assert not values or whole.stepper.memory()["strong"][0]
    checkpoint, memory = whole.checkpoint(), whole.stepper.memory()
    whole.advance(1e-4)  # what was remembered must not change with it
    assert all(np.array_equal(values, checkpoint[f"stepper.{name}"]) for name, values in memory.items())
    if values:
        resumed.stepper.stability.any_strong.zero_()  # as steps that needed no full solution leave it
    resumed.restore(checkpoint)
    assert resumed.times[0] == 5e-5
    resumed.advance(1e-4)
    assert same(whole.cell_state(), resumed.cell_state())
    ends = [sim.stepper.memory() for sim in (whole, resumed)]
    assert all(np.array_equal(values, ends[1][name]) for name, values in ends[0].items())


def dense_spectral_radius(scene: Scene, start: InitialState, device: str) -> float:
    """Largest |eigenvalue| of d(velocities, spins)/d(positions, spins) with the body held, by central differences."""
    exact = with_values(scene, {"numerics.precision": "float64"})
    nodes, count = free_nodes(scene), sum(len(x) for x in start.positions)
    moves = [(i, axis) for i in nodes for axis in range(3)] + [(i, None) for i in range(count)]
    step, shapes = 1e-6, []
    for i, axis in moves:
        for sign in (step, -step):
            shift, spin = np.zeros((count, 3)), np.zeros(count)
            if axis is None:
                spin[i] = sign
            else:
                shift[i, axis] = sign
            shapes.append(displaced(exact, start, nodes=shift, spins=spin))
    sim = Simulation([exact] * len(shapes), device=device, starts=shapes)
    found = [sim.evaluate(c) for c in range(len(shapes))]
    rates = np.array([np.concatenate([e.velocities[nodes].ravel(), e.spins]) for e in found])
    jacobian = (rates[0::2] - rates[1::2]).T / (2 * step)
    return float(np.abs(np.linalg.eigvals(jacobian)).max())


@pytest.mark.parametrize("stiffness", [1e3, 1e5])
def test_spectral_radius_is_that_of_the_dense_jacobian(stiffness, device, precision):
    scene = cell({"flagella.length": 1.0, "flagella.stretching_stiffness": stiffness}, precision)
    start = shaken(scene, seed=1, node=1e-4 if stiffness > 1e3 else 1e-3, spin=0.05)
    sim = Simulation(stepped(scene, "rkc", 1e-7), device=device, starts=start)
    sim.advance(1e-7)
    exact = dense_spectral_radius(scene, as_start(scene, sim.cell_state()), device)
    found = sim.stepper.memory()["spectral_radius"][0]
    assert abs(found / exact - 1) < RADIUS_TOLERANCE[precision]
    # The stage count follows: s stages reach 2/3 (s^2 - 1), and no more than needed with the margin.
    stages = sim.stepper.data.stages.numpy()[0]
    assert 0.653 * ((stages + 1) ** 2 - 1) >= exact * 1e-7
    assert 0.653 * ((stages - 2) ** 2 - 1) <= 1.3 * exact * 1e-7


def test_the_search_for_the_radius_begins_alike_in_every_cell_and_moves_no_anchor(device):
    scene = cell({"flagella.length": 1.0, "flagellum.1.segments": 4})
    for scenes in ([scene], [cell({"flagella.count": 3}), scene]):
        probe = Simulation(scenes, device=device).stepper.memory()["probe"][-11:].astype(np.float64)
        own = anchors(scene)
        assert not probe[own, :3].any() and probe[own, 3].all() and probe[free_nodes(scene)].all()
        if len(scenes) == 1:
            alone = probe
    np.testing.assert_array_equal(probe, alone)


def test_stage_count_follows_the_stiffness_during_a_run(device):
    scene = cell({"motor.torque": 1.0, "numerics.time_step": 1e-5})
    sim = Simulation(scene, device=device)
    sim.advance(2e-5)
    hook = sim.system.model.data.rod.hook_rigidity
    radius, stages = sim.stepper.memory()["spectral_radius"][0], sim.stepper.data.stages.numpy()[0]
    for step in range(24):  # the hook, whose twist is the fastest motion, ten times stiffer by 10 % a step
        hook.assign(hook.numpy() * 1.1)
        sim.stepper.data.stage.fill_(-1)  # its rates have changed: evaluate the state anew
        sim.advance(2e-5 + (step + 1) * 1e-5)
    stiffer = sim.stepper.memory()["spectral_radius"][0]
    assert 8.5 < stiffer / radius < 1.1**24
    assert abs(sim.stepper.data.stages.numpy()[0] / stages - np.sqrt(stiffer / radius)) < 0.05
