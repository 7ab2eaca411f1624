"""The measured stability of a step's iterations, against the eigenvalues of dense matrices."""

from __future__ import annotations

import numpy as np
import pytest
from warpflag_kernels.implicit import stability
from warpflag_kernels.rod import chain_chart, kept_increment

from tests.bench import Bench, bench, dense_solver, flat
from tests.helpers import cell, moved_rigidly, rotation, shaken, touching_cell
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, with_values

# Of kappa, relative.
TOLERANCE = {"float64": 1e-3, "float32": 5e-3}
STEP, GAIN, WEIGHT = 1e-5, 0.6, 1.5  # s, g, over-implicitness
FREE = {"steric.enabled": False, "body.contact": False, "flagella.length": 1.0, "flagella.count": 3}
LONG = {"steric.enabled": False, "body.contact": False, "flagella.length": 6.0}  # two flexible flagella
SOFT = {"flagella.bending_rigidity": 0.01, "flagella.twist_rigidity": 0.01, "flagella.stretching_stiffness": 1e2}
BESIDE = {**FREE, "flagellum.2.azimuth": 353.0}


def crowd(name: str, precision: str, device: str) -> Bench:
    """Three flagella, far from each other or side by side."""
    if name == "apart":
        return bench({**FREE, "flagellum.1.length": 0.8}, precision, device)
    scene = touching_cell({**BESIDE, "body.anchored": name == "anchored"}, precision, 0.055)
    return Bench(scene, shaken(scene, 1, node=1e-3, spin=0.05), device)


def looked(b: Bench, times: int) -> tuple[float, float]:
    """kappa and the over-implicitness chosen, after so many looks at one state."""
    s = b.stepper
    b.factorise(STEP, WEIGHT * GAIN)
    s.law.gain.fill_(GAIN)
    for _ in range(times):
        s.data.over_implicit.fill_(WEIGHT)
        s.stability.measured.fill_(1)
        s.stability.active.fill_(1)
        stability.measure(
            b.model, b.state, s.stiffness, s.band, s.law.gain, b.increment(), s.stability, s.data.over_implicit,
            b.sim.system.control.longest_step,
        )  # fmt: skip
    return float(s.stability.kappa.numpy()[0]), float(s.data.over_implicit.numpy()[0])


@pytest.mark.parametrize("name", ["apart", "side by side", "anchored"])
def test_kappa_is_the_largest_eigenvalue_with_the_full_mobility(name, device, precision):
    exact, b = (crowd(name, p, device) for p in ("float64", precision))
    exact.factorise(STEP, WEIGHT * GAIN)
    full = np.eye(6 + 4 * b.count) / STEP + GAIN * exact.mobility() @ exact.hessian()
    eigenvalues = np.abs(np.linalg.eigvals(WEIGHT * dense_solver(exact, STEP, WEIGHT * GAIN) @ full))
    found, chosen = looked(b, 400)
    assert found == pytest.approx(eigenvalues.max(), rel=TOLERANCE[precision])
    assert chosen == pytest.approx(1.3)  # rods this short are stiff: the Krylov space is for them


def test_over_implicitness_of_flexible_crowds_follows_kappa(device, precision):
    """Above the limit kappa/2 by a fifth, never falling by more than 1.5 % at once; for two flagella the least."""
    scene = touching_cell({**BESIDE, **SOFT, "hydrodynamics.mode": "all"}, precision, 0.055)
    b = Bench(scene, shaken(scene, 1, node=1e-3, spin=0.05), device)
    found, chosen = looked(b, 100)
    assert chosen == pytest.approx(max(0.6 * found, 0.985 * WEIGHT, 1.3), rel=1e-6) and chosen > found / 2
    taut = Bench(with_values(scene, {"flagella.stretching_stiffness": 1e3}), shaken(scene, 1, node=1e-3), device)
    assert looked(taut, 1)[1] == pytest.approx(1.3)  # their stiff modes are for the Krylov space
    two = bench({**FREE, **SOFT, "flagella.count": 2}, precision, device)
    assert looked(two, 20)[1] == pytest.approx(1.3)


def test_who_is_measured_and_when(device, precision):
    """At its start, after a rejected step, and every few steps: a crowd or a stiff cell more often than another."""
    first, long, short = stability.FIRST_MEASUREMENTS, stability.LONG_INTERVAL, stability.INTERVAL
    late, begun = 100 * long, stability.FIRST_OF_FLEXIBLE
    assert long % short == 0 == begun % short and begun < first < late
    taut, rods = {**LONG, "flagella.stretching_stiffness": 1e4}, {**LONG, "flagella.bending_rigidity": 35.0}
    three = {**LONG, "flagella.count": 3}
    cases = ((three, 1.0, True), (taut, 1.0, True), (rods, 1.0, True), (LONG, 10.0, True), (LONG, 1.0, False))
    for values, kappa, often in cases:
        b = bench(values, precision, device)
        s = b.stepper
        s.stability.kappa.fill_(kappa)
        for steps, accepted, expected in (
            (first - 1, 1, often), (begun, 1, True), (late + begun, 1, True), (late + 1, 1, False),
            (late + 1, 0, True), (late + begun + short, 1, often),
        ):  # fmt: skip
            s.data.evaluations.fill_(steps)
            s.data.accepted.fill_(accepted)
            longest = b.sim.system.control.longest_step
            stability.schedule(b.model, b.state, s.data.evaluations, s.data.accepted, longest, s.stability)
            assert bool(s.stability.measured.numpy()[0]) == expected, (values, steps)
    assert bench({"hydrodynamics.mode": "none"}, precision, device).stepper.stability is None


def rayleigh(probe: np.ndarray, hessian: np.ndarray, mobility: np.ndarray, local: np.ndarray) -> float:
    """In the inner product with H, with the mobility and with the local one."""
    forces = -hessian @ probe
    stored = probe @ hessian @ probe / STEP
    return WEIGHT * (stored + GAIN * forces @ mobility @ forces) / (stored + WEIGHT * GAIN * forces @ local @ forces)


def test_the_quotient_has_the_body_moved_by_all_flagella(device, precision):
    """A small body, and a probe in which it moves alone: its part is large, and flagella pull it together."""
    values = {**LONG, "body.length": 0.5, "body.width": 0.4, "flagella.anchor_offset": 0.0}
    exact, b = (bench(values, p, device) for p in ("float64", precision))
    exact.factorise(STEP, WEIGHT * GAIN)
    hessian, mobility, local = exact.hessian(), exact.mobility(), exact.mobility("none")
    own = b.stepper.stability
    own.probe.node.zero_()
    own.probe.body.assign(np.array([[1.0, -0.7, 0.4, 0.5, 0.9, -0.6]]))
    probe = flat(own.probe)
    quotient = rayleigh(probe, hessian, mobility, local)
    kept_increment.keep(b.model, b.data.active, b.data.pose, own.probe)
    still = local.copy()
    still[:6] = 0.0
    assert abs(rayleigh(probe, hessian, mobility, still) / quotient - 1) > 0.02
    assert looked(b, 1)[0] == pytest.approx(quotient, rel=TOLERANCE[precision])


def test_two_flexible_flagella_are_measured_from_below(device, precision):
    """By the Rayleigh quotient of the probe, whatever its direction; it rises to the largest eigenvalue."""
    exact, b = (bench(LONG, p, device) for p in ("float64", precision))
    exact.factorise(STEP, WEIGHT * GAIN)
    hessian, mobility, local = exact.hessian(), exact.mobility(), exact.mobility("none")
    full = np.eye(6 + 4 * b.count) / STEP + GAIN * mobility @ hessian
    largest = np.linalg.eigvals(WEIGHT * dense_solver(exact, STEP, WEIGHT * GAIN) @ full).real.max()
    start = bench(LONG, precision, device)
    kept_increment.bring_back(start.model, start.data.active, start.data.pose, start.stepper.stability.probe)
    first, _ = looked(b, 1)
    quotient = rayleigh(flat(start.stepper.stability.probe), hessian, mobility, local)
    assert first == pytest.approx(quotient, rel=TOLERANCE[precision]) and first < 0.9 * largest
    assert not b.stepper.stability.strong.numpy().any()
    last, chosen = looked(b, 400)
    assert last == pytest.approx(largest, rel=0.015)  # H has a small antisymmetric part
    assert chosen == pytest.approx(max(0.6 * last, 0.985 * WEIGHT), rel=1e-6)


def largest_root(r: float, share: float, theta: float = 0.8) -> float:
    """Of a stiff mode in equal steps, of which two iterations leave r of what is not known when they begin.

    q_n+1 = q_n + d_n - (1 - r)/rho (q_n + theta d_n) + r share (d_n - d_n-1), d_n = q_n - q_n-1.
    """
    rho = theta * (1 - (1 - theta) / 2)
    pull, known = (1 - r) / rho, r * share
    return float(np.abs(np.roots([1.0, pull * (1 + theta) - 2 - known, 1 - pull * theta + 2 * known, -known])).max())


def test_a_step_begins_with_no_more_than_keeps_slow_modes_damped(device, precision):
    """Neighbours that move against each other have 0.56 of the local mobility at least."""
    sim = Simulation(cell({"numerics.stepper": "implicit"}, precision), device=device, capture=False)
    sim.advance(2e-5)
    data, begun = sim.stepper.data, {}
    sim.system.control.target.fill_(1e-3)
    for w in (1.0, 1.3, 1.6, 2.1, 3.0, 5.0):
        sim.system.state.data.active.fill_(1)
        data.over_implicit.fill_(w)
        data.share.fill_(1.0)
        sim.stepper.launch_pass()
        begun[w] = float(data.begun.numpy()[0])
        assert float(data.awaited.numpy()[0]) + begun[w] == pytest.approx(1.0)  # gaps are predicted with the rest
        assert largest_root((1 - 0.56 / w) ** 2, begun[w]) < 0.905, w
    assert begun[1.0] == begun[1.3] == 1.0
    data.share.fill_(0.5)
    sim.system.state.data.active.fill_(1)
    data.over_implicit.fill_(2.6)
    sim.stepper.launch_pass()
    assert float(data.begun.numpy()[0]) == pytest.approx(0.5 / 4)
    assert largest_root(0.42, 1.0) > 0.95  # as in the table of docs/numerics.md


def test_kappa_is_measured_while_a_flagellum_turns(device):
    """Not half of what it is at rest; and steps are stable, so that its energy is steady on a fine mesh, too."""
    values = {"flagella.count": 1, "flagella.segment_length": 0.05, "flagella.length": 6.0, "body.anchored": True}
    values |= {"flagella.opening_angle": 0.0, "flagella.on_axis": True, "flagella.anchor_offset": 1.2}
    sim = Simulation(
        with_values(Scene(name="a"), {**values, "motor.axis_angle": 0.0, "motor.torque": 1.0}), device=device
    )
    measured, energies = [], []
    for i in range(20):
        sim.advance(0.02 + i * 5e-4)
        measured.append(float(sim.stepper.stability.kappa.numpy()[0]))
        energies.append(sim.state.elastic_energy.sum())
    system, s, response = sim.system, sim.stepper, chain_chart.allocate(sim.system.model)
    for _ in range(60):
        s.stability.measured.fill_(1)
        s.stability.active.fill_(1)
        stability.measure(
            system.model, system.state, s.stiffness, s.band, s.law.gain, response, s.stability, s.data.over_implicit,
            system.control.longest_step,
        )  # fmt: skip
    at_rest = float(s.stability.kappa.numpy()[0])
    assert 0.75 * at_rest < max(measured) < 1.1 * at_rest and at_rest > 2.2
    assert np.std(energies) < 5e-3 * np.mean(energies)  # 3e-2 where kappa is missed


def test_an_increment_that_is_kept_turns_with_the_cell(device, precision):
    """Kept and brought back it is the same; of another pose, turned as a whole, the same turned."""
    b = bench({**LONG, "flagella.length": 2.0}, precision, device)
    rng = np.random.default_rng(3)
    nodes = rng.standard_normal((b.count, 4))
    nodes[b.first, :3] = 0.0
    x = b.increment(rng.standard_normal((1, 6)), nodes)
    before = flat(x)
    kept_increment.keep(b.model, b.data.active, b.data.pose, x)
    kept = flat(x)
    assert np.abs(kept - before).max() > 0.1
    kept_increment.bring_back(b.model, b.data.active, b.data.pose, x)
    tolerance = {"float64": 1e-12, "float32": 1e-5}[precision]
    np.testing.assert_allclose(flat(x), before, atol=tolerance)
    turn = np.array([0.7, -1.1, 0.4])
    turned = Bench(b.scene, moved_rigidly(b.start, turn, np.array([3.0, 1.0, -2.0])), device)
    y = turned.increment(kept[:6], kept[6:].reshape(-1, 4))
    kept_increment.bring_back(turned.model, turned.data.active, turned.data.pose, y)
    r = rotation(turn)
    expected = before[6:].reshape(-1, 4).copy()
    expected[:, :3] = expected[:, :3] @ r.T
    body = np.concatenate([r @ before[:3], r @ before[3:6]])
    np.testing.assert_allclose(flat(y), np.concatenate([body, expected.ravel()]), atol=10 * tolerance)
