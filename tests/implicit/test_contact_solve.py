"""Contacts of an implicit step and the law they obey, against dense matrices in NumPy.

B: unit forces at the contacts on (body, nodes); M: the mobility; P: the factorised system. Y = P g M B is what a load
adds to the increment, W = B^T Y what it adds to the gaps. Layout as in `tests.bench`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.base.types import DeviceModel
from warpflag_kernels.contact import contact_list, search
from warpflag_kernels.fluid import body
from warpflag_kernels.implicit import collocation, contact_solve, frozen_flow
from warpflag_kernels.rod import chain_chart
from warpflag_kernels.stepping import step_control

from tests.bench import FLOW_TOLERANCE, TOLERANCE, Bench, close, dense_solver, displacements, flat, spins
from tests.helpers import shaken, touching_cell
from tests.oracles import CUTOFF, body_gaps, segment_distances
from warpflag.stepping.stepper import DEFAULT_ACCURACY

SIGMA = 0.04
REACH = (CUTOFF + search.MARGIN) * SIGMA
STEP, GAIN = 1e-5, 2 / 3  # s, and g of BDF2 at a constant step
FINE = contact_solve.FINEST * SIGMA


def controlled(step: float) -> float:
    """Tolerance of a gap in a step at the usual accuracy [um]."""
    return collocation.GAP_SHARE * DEFAULT_ACCURACY * 1e3 * float(np.sqrt(step * step_control.SPAN))


CROWD = {"flagella.count": 3, "flagellum.2.azimuth": 357.0, "flagellum.1.length": 1.2, "flagella.opening_angle": 90.0}
BUNDLE = {"flagella.count": 3, "flagellum.2.azimuth": 353.0}  # all along, and with the body
CELLS = {"all": {}, "none": {"hydrodynamics.mode": "none"}, "within": {"hydrodynamics.mode": "within"}}
CELLS |= {
    "between": {"hydrodynamics.mode": "between"},
    "three": CROWD,
    "bundle": BUNDLE,
    "anchored": {"body.anchored": True},
}
CELLS |= {"no body contact": {"body.contact": False}, "strong": {"steric.strength": 80.0}}


def touching(values: dict[str, Any], precision: str, device: str, seed: int = 1, separation: float = 0.042) -> Bench:
    scene = touching_cell({"flagella.length": 1.0, **values}, precision, separation)
    return Bench(scene, shaken(scene, seed, node=2e-3, spin=0.05), device)


def find(b: Bench) -> None:
    search.find(b.model, b.state, b.stepper._now, b.stepper._contacts)


# The list.


def listed_contacts(b: Bench) -> dict[tuple[int, int], dict[str, Any]]:
    """What the search found, by (segment, other segment or -1 for the body)."""
    c, count = b.stepper._contacts, b.stepper._contacts.count.numpy()[0]
    assert c.overflow.numpy()[0] == 0
    names = ("segment", "other", "at", "at_other", "normal", "gap", "anchored")
    columns = {name: getattr(c, name).numpy()[:count] for name in names}
    found = {}
    for i in range(count):
        row = {name: column[i] for name, column in columns.items()}
        found[int(row["segment"]), int(row["other"])] = row
    assert len(found) == count  # none twice
    return found


def expected_contacts(b: Bench, reach: float) -> dict[tuple[int, int], float]:
    """Every pair of segments of different flagella, and of a node and the body, nearer than `reach`: its gap."""
    near, ends = {}, np.append(b.first, b.count)
    for k, x in enumerate(b.start.positions):
        for j, y in list(enumerate(b.start.positions))[k + 1 :]:
            distances = segment_distances(x[:-1], np.diff(x, axis=0), y[:-1], np.diff(y, axis=0))
            for e, o in np.argwhere(distances < reach):
                near[int(ends[k] + 1 + e), int(ends[j] + 1 + o)] = distances[e, o]
        for e, gap in enumerate(body_gaps(b.scene, b.start, x[1:]), start=1):
            if gap < reach:
                near[int(ends[k] + e), -1] = gap
    return near


@pytest.mark.parametrize("values", [{}, CROWD], ids=["two", "three"])
def test_search_finds_every_contact_and_nothing_else(values, device, precision):
    total = 0
    for seed in range(4):
        b = touching(values, precision, device, seed)
        find(b)
        found, exact = listed_contacts(b), expected_contacts(b, REACH + 1e-6)
        assert found.keys() <= exact.keys()
        assert all(gap > REACH - 1e-6 for pair, gap in exact.items() if pair not in found)
        x = b.data.pose.position.numpy().astype(np.float64)
        for (e, other), row in found.items():
            assert abs(row["gap"] - exact[e, other]) < 1e-6
            if other >= 0:
                here = x[e - 1] + row["at"] * (x[e] - x[e - 1])
                there = x[other - 1] + row["at_other"] * (x[other] - x[other - 1])
                assert np.abs(here - there - row["gap"] * row["normal"]).max() < 1e-6
                assert row["anchored"] == 1 * (e - 1 in b.first) + 2 * (other - 1 in b.first)
            else:
                # Straight off the surface: along the normal the gap grows as fast as the node moves.
                away = b.start.body_position + x[e] + np.array([[0.0], [0.01]]) * row["normal"]
                assert np.diff(body_gaps(b.scene, b.start, away))[0] == pytest.approx(0.01, abs=1e-6)
        total += len(found)
    assert total > 40


def chain_of(head: int, following: np.ndarray) -> list[int]:
    found = []
    while head >= 0:
        found.append(head)
        head = following[head]
        assert len(found) <= len(following)
    return found


def test_chains_hold_every_contact_once_on_either_side(device, precision):
    b = touching(BUNDLE, precision, device, seed=0)
    for _ in range(2):  # the second search meets the chains of the first
        find(b)
    c, contact_count = b.stepper._contacts, len(listed_contacts(b))
    names = ("segment", "other", "start", "stop", "head", "next", "body_head")
    segment, other, start, stop, head, following, body_head = (getattr(c, name).numpy() for name in names)
    own = [list(range(start[e], stop[e])) for e in range(b.count)]
    assert [i for contacts_of in own for i in contacts_of] == list(range(contact_count))  # in the order of the segments
    assert all((segment[own[e]] == e).all() for e in range(b.count))
    every = np.arange(contact_count)
    for e in range(b.count):
        assert chain_of(head[e], following) == list(every[other[:contact_count] == e])
    flagellum = np.searchsorted(b.first, segment[:contact_count], side="right") - 1
    for k in range(len(b.first)):
        assert chain_of(body_head[k], following) == list(every[(other[:contact_count] < 0) & (flagellum == k)])
    assert (other[:contact_count] < 0).sum() > 1 and (other[:contact_count] >= 0).sum() > 5


def test_a_contact_list_that_overflows_is_noticed(device, precision):
    b = touching({}, precision, device)
    find(b)
    count = len(listed_contacts(b))
    b.stepper._contacts.first.assign([0, count - 1])
    find(b)
    assert b.stepper._contacts.overflow.numpy()[0] == 1
    assert b.stepper._contacts.count.numpy()[0] < count


# Dense matrices.


def dense_levers(b: Bench, contact_forces: list[np.ndarray] | None = None) -> np.ndarray:
    """B: unit contact forces on (body, nodes), shape [6 + 4 count, contacts].

    contact_forces: takes those on the nodes, those of r_0 included, shape [count, 3] each.
    """
    columns = []
    arms = np.concatenate(b.start.positions) - b.start.body_position
    for (e, other), row in listed_contacts(b).items():
        forces = np.zeros((b.count, 3))
        n = row["normal"].astype(np.float64)
        on_body = np.zeros(6)
        if other < 0:
            forces[e] = n
            on_body = -np.concatenate([n, np.cross(arms[e], n)])
        else:
            for sign, second, at in ((1, e, row["at"]), (-1, other, row["at_other"])):
                forces[second] += sign * at * n
                forces[second - 1] += sign * (1 - at) * n
        if contact_forces is not None:
            contact_forces.append(forces.copy())
        on_anchor = forces[b.first]
        on_body += np.concatenate([on_anchor, np.cross(arms[b.first], on_anchor)], axis=1).sum(axis=0)
        forces[b.first] = 0.0
        columns.append(np.concatenate([on_body, np.hstack([forces, np.zeros((b.count, 1))]).ravel()]))
    return np.stack(columns, axis=1)


def steric_force(gap: np.ndarray, strength: float) -> np.ndarray:
    """F_0 [2 (sigma/r)^13 - (sigma/r)^7] below the cutoff, along its tangent below 0.7 sigma [pN]."""
    x = np.asarray(gap, dtype=np.float64) / SIGMA
    y = 1 / np.clip(x, 0.7, CUTOFF)
    slope = 26 * 0.7**-14 - 7 * 0.7**-8
    return np.where(x < CUTOFF, strength * (2 * y**13 - y**7 + slope * np.maximum(0.7 - x, 0.0)), 0.0)


def stiffness(gap: np.ndarray, strength: float) -> np.ndarray:
    """-dF/dgap [pN/um]."""
    x = np.asarray(gap, dtype=np.float64) / SIGMA
    y = 1 / np.clip(x, 0.7, CUTOFF)
    return np.where(x < CUTOFF, strength / SIGMA * (26 * y**14 - 7 * y**8), 0.0)


def dense_solution(free: np.ndarray, compliance: np.ndarray, acting: np.ndarray, strength: float) -> np.ndarray:
    """Gaps that obey gap = free + W (F(gap) - acting): Newton's method, shortened until the residual falls."""

    def residual(gap: np.ndarray) -> np.ndarray:
        return gap - free - compliance @ (steric_force(gap, strength) - acting)

    gap = np.full_like(free, SIGMA)
    for _ in range(200):
        r = residual(gap)
        if np.abs(r).max() < 1e-13:
            return gap
        change = -np.linalg.solve(np.eye(len(r)) + compliance * stiffness(gap, strength), r)
        share = 1.0
        while np.linalg.norm(residual(gap + share * change)) > np.linalg.norm(r) and share > 1e-9:
            share /= 2
        gap = gap + share * change
    raise AssertionError("the oracle has no solution")


@dataclass
class Listed:
    """A bench whose contacts are listed and its system factorised, with dense B, P, Y and W."""

    bench: Bench
    levers: np.ndarray
    solver: np.ndarray
    columns: np.ndarray
    compliance: np.ndarray
    tolerance: float = FINE

    @property
    def strength(self) -> float:
        return self.bench.scene.steric.strength

    def own(self, name: str) -> np.ndarray:
        """Of the contacts: their gaps, or what the law holds."""
        arrays = self.bench.stepper._contacts if name == "gap" else self.bench.stepper._law
        return getattr(arrays, name).numpy()[: self.levers.shape[1]].astype(np.float64)

    def set(self, name: str, values: Any) -> None:
        array = getattr(self.bench.stepper._contacts if name == "gap" else self.bench.stepper._law, name)
        whole = array.numpy()
        whole[: self.levers.shape[1]] = values
        array.assign(whole)

    def press(self) -> None:
        s = self.bench.stepper
        contact_solve.press(self.bench.model, self.bench.state, s.data.one, self.bench.increment(), s._contacts, s._law)

    def solve(self, start: Any, coarse: float = 1.0, anew: bool = True) -> np.ndarray:
        """The increment with the answer of the contacts."""
        b, s, out = self.bench, self.bench.stepper, self.bench.increment()
        contact_solve.solve(b.model, b.state, s._contacts, s._band, s._flow, start, s._law, out, coarse, anew)
        return flat(out)

    def failed(self) -> bool:
        return bool(self.bench.stepper._law.failed.numpy()[0])

    def push(self, way: float) -> Any:
        """An increment that moves all that is near toward each other, by about `way` [um]."""
        return self.bench.increment(0.0, -way * self.levers.sum(axis=1)[6:].reshape(-1, 4))


def listed(b: Bench, step: float = STEP, tolerance: float = FINE) -> Listed:
    s, band = b.stepper, b.factorise(step, 1.3 * GAIN)
    s._law.gain.fill_(GAIN)
    s._law.tolerance.fill_(tolerance)
    s._law.failed.zero_()
    find(b)
    contact_solve.press(b.model, b.state, s.data.one, b.increment(), s._contacts, s._law)
    levers, solver = dense_levers(b), dense_solver(b, step, 1.3 * GAIN)
    if b.model.switches.pairs != "none":
        frozen_flow.build(b.model, b.state, s._flow, s._contacts)
    assert band.singular.numpy()[0] == 0
    columns = solver @ (GAIN * b.mobility() @ levers)
    return Listed(b, levers, solver, columns, levers.T @ columns, tolerance)


# Loads and what they cause.


@pytest.mark.parametrize("name", ["bundle", "no body contact"])
def test_forces_at_contacts_act_on_both_sides_and_on_the_body(name, device, precision):
    b = touching(CELLS[name], precision, device, seed=0)
    find(b)
    assert any(other < 0 for _, other in listed_contacts(b)) == (name == "bundle")
    on_nodes: list[np.ndarray] = []
    levers = dense_levers(b, on_nodes)
    magnitude, s = np.random.default_rng(1).uniform(0, 5, levers.shape[1]), b.stepper
    before = np.random.default_rng(2).uniform(-1, 1, (b.count, 3))
    l = Listed(b, levers, levers, levers, levers)
    l.set("force", magnitude)
    b.data.force.assign(before)
    contact_list.act(b.model, b.state, s._contacts, s._law.force)
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
    assert close(np.concatenate([force, torque]), (levers @ magnitude)[:6], precision)
    free, x = np.setdiff1d(np.arange(b.count), b.first), b.data.pose.position.numpy()
    scale = np.abs(added).sum()
    assert np.abs(force + added[free].sum(axis=0)).max() < TOLERANCE[precision] * scale
    assert np.abs(torque + np.cross(x[free], added[free]).sum(axis=0)).max() < TOLERANCE[precision] * scale


NO_STERIC = {"no steric": {"steric.enabled": False}}  # the body alone, beside flagella that pass through each other


@pytest.mark.parametrize("name", [*CELLS, *NO_STERIC])
def test_a_load_is_answered_as_by_dense_matrices(name, device, precision):
    """W lambda and Y lambda. With every gap open and -lambda acting, the first evaluation applies W to lambda."""
    check_answers(listed(touching({**CELLS, **NO_STERIC}[name], precision, device, seed=0)), precision)


def test_a_load_is_answered_where_contacts_are_few(device, precision):
    """Nodes that only the segment after them loads, and nodes without any load."""
    b = touching({"body.contact": False}, precision, device, seed=0, separation=0.061)
    l = listed(b)
    loaded = {e for pair in listed_contacts(b) for e in pair}
    free = np.setdiff1d(np.arange(b.count), b.first)
    assert any(e not in loaded and e + 1 in loaded for e in free)
    check_answers(l, precision)


def check_answers(l: Listed, precision: str) -> None:
    for seed in range(2):
        load, start = np.random.default_rng(seed).uniform(0, 5, l.levers.shape[1]), l.push(2e-3)
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
        assert np.abs(l.own("free_gap") - given - l.levers.T @ flat(start)).max() < 1e-7
    assert l.bench.stepper._law.products.numpy()[0] == 2


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
    free = given + l.levers.T @ flat(start)
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
        l.set("gap", np.linspace(1.05, 1.15, l.levers.shape[1]) * SIGMA)
        l.press()
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
    l.press()
    acting, given, push = l.own("force"), l.own("gap"), l.push(way)
    obeyed(l, push, acting, given, l.solve(push), precision)


def test_what_stays_open_costs_nothing_and_changes_nothing(device, precision):
    l = listed(touching({}, precision, device, seed=0))
    l.set("gap", 1.2 * SIGMA)
    l.press()
    start = l.push(-2e-3)
    assert np.array_equal(l.solve(start), flat(start))
    assert np.abs(l.own("force")).max() == 0.0 and l.own("gap").min() > 1.2 * SIGMA
    assert l.bench.stepper._law.products.numpy()[0] == 0 and not l.failed()


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
        l.bench.stepper._law.tolerance.fill_(-1.0)
    l.solve(start)
    assert l.failed()
    assert l.bench.stepper._law.products.numpy()[0] <= 1 + contact_solve.ITERATIONS


@pytest.mark.parametrize("name", ["all", "three", "bundle", "anchored", "no body contact"])
def test_what_one_solution_tells_serves_the_next(name, device, precision):
    """Pressed on, contacts are solved again: to the same law, with fewer products than by who knows nothing."""
    solved, products = [], []
    for anew in (True, False):
        l = listed(touching(CELLS[name], precision, device, seed=0), tolerance=1e-4 * SIGMA)
        l.solve(l.push(2e-3))
        acting, given, start = l.own("force"), l.own("gap"), l.push(1e-3)
        before = l.bench.stepper._law.products.numpy()[0]
        x = l.solve(start, anew=anew)
        obeyed(l, start, acting, given, x, precision)
        solved.append(l.own("solved_gap"))
        products.append(l.bench.stepper._law.products.numpy()[0] - before)
    assert 0 < products[1] < products[0]
    assert np.abs(solved[0] - solved[1]).max() < 20 * l.tolerance


@pytest.mark.parametrize("name", ["three", "bundle"])
def test_lanes_of_a_block_solve_the_same_law(name, monkeypatch, device, precision):
    """As on a GPU: eight threads share every loop and wait for each other, here as fibers of a CPU."""
    if device != "cpu":
        pytest.skip("a GPU does it anyway")
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    monkeypatch.setattr(DeviceModel, "one_thread_per_cell", False)
    monkeypatch.setattr(contact_solve, "_lanes", lambda _model: 8)
    l = listed(touching(CELLS[name], precision, device, seed=0))
    law, b = l.bench.stepper._law, l.bench
    law.on_first, law.on_second = wp.zeros_like(b.data.force), wp.zeros_like(b.data.force)
    acting, given, start = l.own("force"), l.own("gap"), l.push(2e-3)
    force = obeyed(l, start, acting, given, l.solve(start), precision)
    assert (force > 0).sum() > 3


# Where the contacts are.


def pose_gaps(l: Listed) -> np.ndarray:
    """Gaps of the listed contacts in the stepper's pose."""
    b, pose = l.bench, l.bench.stepper._now
    y, axis = (a.numpy().astype(np.float64) for a in (pose.position, pose.body_axis))
    half, gaps = (b.scene.body.length - b.scene.body.width) / 2, []
    for e, other in listed_contacts(b):
        if other < 0:
            away = y[e] - np.clip(y[e] @ axis[0], -half, half) * axis[0]
            gaps.append(np.linalg.norm(away) - b.scene.body.width / 2)
        else:
            p, q = y[[e - 1]], y[[other - 1]]
            gaps.append(segment_distances(p, y[[e]] - p, q, y[[other]] - q)[0, 0])
    return np.array(gaps)


@pytest.mark.parametrize("name", ["all", "bundle", "anchored", "no body contact"])
def test_forces_begin_with_the_gaps_that_are_predicted(name, device, precision):
    """Those of the pose and, to first order, of the share of the way that is still to come."""
    l = listed(touching(CELLS[name], precision, device, seed=0, separation=0.055))
    b, s, way, share = l.bench, l.bench.stepper, l.push(2e-3), 0.4
    given = l.own("gap")
    assert np.abs(given - pose_gaps(l)).max() < 1e-6
    shares = wp.full(1, share, dtype=wp.float64, device=device)
    contact_solve.press(b.model, b.state, shares, way, s._contacts, s._law)
    predicted = given + share * l.levers.T @ flat(way)
    assert np.abs(predicted - given).max() > 0.01 * SIGMA
    assert np.abs(l.own("solved_gap") - predicted).max() < 1e-6 and np.array_equal(l.own("gap"), given)
    deepest = contact_solve.DEEPEST * SIGMA
    assert close(l.own("force"), steric_force(np.maximum(l.own("solved_gap"), deepest), l.strength), precision)


@pytest.mark.parametrize("name", ["all", "bundle", "anchored", "no body contact"])
def test_contacts_follow_to_another_pose(name, device, precision):
    """Renewed, they are what a search in that pose finds of them."""
    l = listed(touching(CELLS[name], precision, device, seed=0, separation=0.055))
    b, s, way = l.bench, l.bench.stepper, l.push(4e-3)
    before = listed_contacts(b)
    chain_chart.retract(b.model, b.state, s._now, s.data.one, way, s._now)
    search.renew(b.model, b.state, s._now, s._contacts)
    renewed = listed_contacts(b)
    assert renewed.keys() == before.keys()
    assert np.abs(l.own("gap") - pose_gaps(l)).max() < 1e-6
    assert max(abs(renewed[pair]["gap"] - before[pair]["gap"]) for pair in before) > 0.02 * SIGMA
    find(b)
    found = listed_contacts(b)
    both = renewed.keys() & found.keys()
    assert len(both) > 3
    for pair in both:
        for part in ("at", "at_other", "normal", "gap", "anchored"):
            assert np.abs(renewed[pair][part] - found[pair][part]).max() < {"float64": 1e-9, "float32": 1e-3}[precision]
