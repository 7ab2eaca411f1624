"""The contact law of an implicit step against dense matrices in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.contact import contact_list
from warpflag_kernels.fluid import body
from warpflag_kernels.implicit import contact_solve

from tests.bench import FLOW_TOLERANCE, TOLERANCE, close, displacements, flat, spins
from tests.contacts import (
    CELLS,
    SIGMA,
    Listed,
    controlled,
    dense_jacobian,
    dense_solution,
    find,
    listed,
    listed_contacts,
    steric_force,
    touching,
)
from tests.plans import as_on_gpu

# Loads and what they cause.


@pytest.mark.parametrize("name", ["bundle", "no body contact"])
def test_forces_at_contacts_act_on_both_sides_and_on_the_body(name, device, precision):
    b = touching(CELLS[name], precision, device, seed=0)
    find(b)
    assert any(other < 0 for _, other in listed_contacts(b)) == (name == "bundle")
    on_nodes: list[np.ndarray] = []
    jacobian = dense_jacobian(b, on_nodes)
    magnitude, s = np.random.default_rng(1).uniform(0, 5, jacobian.shape[1]), b.stepper
    before = np.random.default_rng(2).uniform(-1, 1, (b.count, 3))
    l = Listed(b, jacobian, jacobian, jacobian, jacobian)
    l.set("force", magnitude)
    b.data.force.assign(before)
    contact_list.act(b.model, b.state, s.contacts, s.law.force)
    added = b.data.force.numpy() - before
    assert close(added, np.tensordot(magnitude, on_nodes, 1), precision)
    # With nothing else acting, the body feels what B says, and all of it adds up to nothing.
    b.data.force.assign(added)
    b.data.joint_before.zero_()
    b.model.data.motor.torque.zero_()
    body.body_motion(b.model, b.state)
    force, torque = (
        a.numpy().astype(np.float64).sum(axis=0) for a in (b.data.flagellum_force, b.data.flagellum_torque)
    )
    assert close(np.concatenate([force, torque]), (jacobian @ magnitude)[:6], precision)
    free, x = np.setdiff1d(np.arange(b.count), b.first), b.data.pose.position.numpy()
    scale = np.abs(added).sum()
    assert np.abs(force + added[free].sum(axis=0)).max() < TOLERANCE[precision] * scale
    assert np.abs(torque + np.cross(x[free], added[free]).sum(axis=0)).max() < TOLERANCE[precision] * scale


NO_STERIC = {"no steric": {"steric.enabled": False}}  # the body alone, beside flagella that pass through each other


@pytest.mark.parametrize("name", [*CELLS, *NO_STERIC])
def test_products_are_those_of_dense_matrices(name, device, precision):
    """W lambda and Y lambda. With every gap open and -lambda acting, the first evaluation applies W to lambda."""
    check_answers(listed(touching({**CELLS, **NO_STERIC}[name], precision, device, seed=0)), precision)


def test_products_where_contacts_are_few(device, precision):
    """Nodes that only the segment after them loads, and nodes without any load."""
    b = touching({"body.contact": False}, precision, device, seed=0, separation=0.061)
    l = listed(b)
    loaded = {e for pair in listed_contacts(b) for e in pair}
    free = np.setdiff1d(np.arange(b.count), b.first)
    assert any(e not in loaded and e + 1 in loaded for e in free)
    check_answers(l, precision)


def check_answers(l: Listed, precision: str) -> None:
    for seed in range(2):
        load, start = np.random.default_rng(seed).uniform(0, 5, l.jacobian.shape[1]), l.push(2e-3)
        given = l.own("gap")
        l.set("force", -load)
        l.set("solved_gap", 1.0)
        x = l.solve(start, coarse=1e30)
        assert close(l.own("change"), l.compliance @ load, precision, 1.0, FLOW_TOLERANCE)
        caused = l.columns @ load
        for part in (slice(0, 6), displacements(l.bench), spins(l.bench)):
            assert (
                close((x - flat(start))[part], caused[part], precision, 2.0, FLOW_TOLERANCE) or not caused[part].any()
            )
        assert np.abs(l.own("free_gap") - given - l.jacobian.T @ flat(start)).max() < 1e-7
    assert l.bench.stepper.law.products.numpy()[0] == 2


# The law.


def obeyed(l: Listed, start: Any, acting: np.ndarray, given: np.ndarray, x: np.ndarray, precision: str) -> np.ndarray:
    """Checks a solution against the law and the dense matrices; returns the forces."""
    gaps, force = l.own("solved_gap"), l.own("force")
    assert not l.failed()
    assert np.abs(l.own("gap") - gaps).max() < 1.1 * l.tolerance  # the gaps that the increment leads to
    assert close(force, steric_force(gaps, l.strength), precision)
    caused = l.columns @ (force - acting)
    # What the kernel calls solved, and what its round-off adds.
    allowed = 1.1 * l.tolerance + FLOW_TOLERANCE[precision] * np.abs(l.compliance @ (force - acting)).max()
    free = given + l.jacobian.T @ flat(start)
    assert np.abs(gaps - free - l.compliance @ (force - acting)).max() < allowed
    assert close(x, flat(start) + caused, precision, 3.0, FLOW_TOLERANCE)  # of forces that nearly cancel
    # To the tolerance the solution is the only one.
    exact = dense_solution(free, l.compliance, acting, l.strength)
    assert np.abs(gaps - exact).max() < 5 * allowed
    return force


@pytest.mark.parametrize("name", list(CELLS))
def test_gaps_obey_the_law_at_the_end_of_the_step(name, device, precision):
    """At loads of several pN, where contacts are stiffer than what they rest on: W is not symmetric, and a solution
    must not take it to be."""
    l = listed(touching(CELLS[name], precision, device, seed=0))
    if name == "strong":  # the pose would mean hundreds of pN
        l.set("gap", np.linspace(1.05, 1.15, l.jacobian.shape[1]) * SIGMA)
        l.warm_start()
    acting, given, start = l.own("force"), l.own("gap"), l.push(2e-3)
    # Forces that act from the start are those at the gaps found; what overlaps deeply counts for less.
    assert close(acting, steric_force(np.maximum(given, contact_solve.DEEPEST * SIGMA), l.strength), precision)
    force = obeyed(l, start, acting, given, l.solve(start), precision)
    assert (force > 0).sum() > 3 and force.max() > 2.0
    assert np.abs(force - acting).max() > 0.1 * force.max()
    # Solved again from there, with nothing added, it stays; the gaps are now those with the forces that act.
    again = l.solve(l.bench.increment(), anew=False)
    assert np.abs(again).max() == 0.0 and np.array_equal(l.own("force"), force)


BAD_STARTS = {
    "deep overlap": (0.5 * SIGMA, 0.0),
    "deeper than the axes": (0.0, 0.0),
    "all open, then closed": (1.25 * SIGMA, 0.02),
    "all closed, then open": (0.8 * SIGMA, -0.02),
}


# Cell, step and start: longest step of the stepper; many contacts; a hundred times as strong.
FAR = [("all", 3e-5, start) for start in BAD_STARTS] + [("bundle", 1e-5, start) for start in BAD_STARTS]
FAR += [("strong", 1e-5, start) for start in list(BAD_STARTS)[1:]]


@pytest.mark.parametrize("name, step, start", FAR)
def test_newton_converges_from_far_away(name, step, start, device, precision):
    gap, way = BAD_STARTS[start]
    # Under hundreds of pN the round-off of a gap in float32 is about the usual tolerance: one may or may not get there.
    reachable = 4.0 if name == "strong" and precision == "float32" else 1.0
    l = listed(touching(CELLS[name], precision, device, seed=0), step, reachable * controlled(step))
    l.set("gap", gap)
    l.warm_start()
    acting, given, push = l.own("force"), l.own("gap"), l.push(way)
    obeyed(l, push, acting, given, l.solve(push), precision)


def test_what_stays_open_costs_nothing_and_changes_nothing(device, precision):
    l = listed(touching({}, precision, device, seed=0))
    l.set("gap", 1.2 * SIGMA)
    l.warm_start()
    start = l.push(-2e-3)
    assert np.array_equal(l.solve(start), flat(start))
    assert np.abs(l.own("force")).max() == 0.0 and l.own("gap").min() > 1.2 * SIGMA
    assert l.bench.stepper.law.products.numpy()[0] == 0 and not l.failed()


@pytest.mark.parametrize("name", ["a gap", "a free increment", "the tolerance"])
def test_what_cannot_be_solved_is_reported(name, device, precision):
    l = listed(touching({}, precision, device, seed=0))
    start = l.push(2e-3)
    if name == "a gap":
        gaps = l.own("gap")
        gaps[-1] = np.nan
        l.set("gap", gaps)
    elif name == "a free increment":
        start.body.assign(np.full((1, 6), np.nan))
    else:
        l.bench.stepper.law.gap_tolerance.fill_(-1.0)
    l.solve(start)
    assert l.failed()
    assert l.bench.stepper.law.products.numpy()[0] <= 1 + contact_solve.CONTACT_ITERATIONS


@pytest.mark.parametrize("name", ["all", "three", "bundle", "anchored", "no body contact"])
def test_what_one_solution_tells_serves_the_next(name, device, precision):
    """Pressed further together, contacts are solved again: to the same law, with fewer products than from nothing."""
    solved, products = [], []
    for anew in (True, False):
        l = listed(touching(CELLS[name], precision, device, seed=0), tolerance=1e-4 * SIGMA)
        l.solve(l.push(2e-3))
        acting, given, start = l.own("force"), l.own("gap"), l.push(1e-3)
        before = l.bench.stepper.law.products.numpy()[0]
        x = l.solve(start, anew=anew)
        obeyed(l, start, acting, given, x, precision)
        solved.append(l.own("solved_gap"))
        products.append(l.bench.stepper.law.products.numpy()[0] - before)
    assert 0 < products[1] < products[0]
    assert np.abs(solved[0] - solved[1]).max() < 20 * l.tolerance


@pytest.mark.parametrize("name", ["three", "bundle"])
def test_threads_of_a_block_solve_the_same_law(name, monkeypatch, device, precision):
    """As on a GPU: eight threads share every loop and wait for each other, here as fibers of a CPU."""
    if device != "cpu":
        pytest.skip("a GPU does it anyway")
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    l = listed(touching(CELLS[name], precision, device, seed=0, planned=as_on_gpu))
    acting, given, start = l.own("force"), l.own("gap"), l.push(2e-3)
    force = obeyed(l, start, acting, given, l.solve(start), precision)
    assert (force > 0).sum() > 3
