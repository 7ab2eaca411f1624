"""The search for contacts of an implicit step: which it lists, and how they follow to another pose."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.contact import search
from warpflag_kernels.implicit import contact_solve
from warpflag_kernels.rod import chain_chart

from tests.bench import Bench, close, flat
from tests.contacts import (
    BUNDLE,
    CELLS,
    CROWD,
    REACH,
    SIGMA,
    Listed,
    find,
    listed,
    listed_contacts,
    steric_force,
    touching,
)
from tests.helpers import cell, touching_cell
from tests.oracles import CUTOFF, body_gaps, segment_distances
from tests.plans import by_elements
from warpflag.run.simulation import Simulation

# The list.


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


PLANNED = pytest.mark.parametrize("planned", [lambda own: own, by_elements], ids=["own", "elements"])


@PLANNED
@pytest.mark.parametrize("values, asked", [({}, 0.0), (CROWD, 0.0), ({}, 2.1 * SIGMA)], ids=["two", "three", "farther"])
def test_search_finds_every_contact_and_nothing_else(values, asked, planned, device, precision):
    """Up to the least reach, or to what the step asks for."""
    total, reach = 0, max(REACH, asked)
    for seed in range(4):
        b = touching(values, precision, device, seed, planned=planned)
        b.stepper.contacts.reach.fill_(asked)
        find(b)
        found, exact = listed_contacts(b), expected_contacts(b, reach + 1e-6)
        assert found.keys() <= exact.keys()
        assert all(gap > reach - 1e-6 for pair, gap in exact.items() if pair not in found)
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


def test_contacts_are_searched_for_farther_where_a_step_may_err_by_more(device, precision):
    """The cutoff and three times what the step may err, tau (dt/ms)^(1/2), and no more than sigma beyond the cutoff."""
    for accuracy, beyond in ((5e-3, 3 * 5e-3 * 0.2**0.5), (0.5, SIGMA)):
        sim = Simulation(
            touching_cell({"numerics.stepper": "implicit", "numerics.accuracy": accuracy}, precision), device=device
        )
        sim.stepper.steps.wanted_step.fill_(2e-4)
        sim.system.control.longest_step.fill_(2e-4)
        sim.system.control.target.fill_(1.0)
        sim.system.state.data.active.fill_(1)
        sim.stepper.launch_pass()
        assert sim.stepper.contacts.reach.numpy()[0] == pytest.approx(CUTOFF * SIGMA + beyond, rel=1e-6)


def chain_of(head: int, following: np.ndarray) -> list[int]:
    found = []
    while head >= 0:
        found.append(head)
        head = following[head]
        assert len(found) <= len(following)
    return found


@PLANNED
def test_chains_hold_every_contact_once_on_either_side(planned, device, precision):
    b = touching(BUNDLE, precision, device, seed=0, planned=planned)
    for _ in range(2):  # the second search meets the chains of the first
        find(b)
    c, contact_count = b.stepper.contacts, len(listed_contacts(b))
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


@PLANNED
def test_a_contact_list_that_overflows_is_noticed(planned, device, precision):
    b = touching({}, precision, device, planned=planned)
    find(b)
    count = len(listed_contacts(b))
    b.stepper.contacts.first.assign([0, count - 1])
    find(b)
    assert b.stepper.contacts.overflow.numpy()[0] == 1
    assert b.stepper.contacts.count.numpy()[0] < count


# Where the contacts are.


def pose_gaps(l: Listed) -> np.ndarray:
    """Gaps of the listed contacts in the stepper's pose."""
    b, pose = l.bench, l.bench.data.pose
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


def test_the_room_for_contacts_is_that_of_a_hexagonal_bundle(device):
    """A node lies against six filaments at most, three segments of each, listed once, and against the body: ten."""

    def room(values):
        sim = Simulation(cell({"numerics.stepper": "implicit", **values}), device=device)
        return int(sim.stepper.contacts.first.numpy()[-1]) / int(sim.first_node[-1])

    crowd = {"body.length": 20.0, "body.width": 10.0, "flagella.anchor_offset": 0.0}
    assert room({}) == 4
    assert [room({**crowd, "flagella.count": n}) for n in (4, 7, 12)] == [6, 10, 10]
    assert room({"flagella.count": 1, "steric.self_contact": True}) == 10  # a coil is a bundle of itself


@pytest.mark.parametrize("name", ["all", "bundle", "anchored", "no body contact"])
def test_forces_begin_with_the_gaps_that_are_predicted(name, device, precision):
    """Those of the pose and, to first order, of the share of the way that is still to come."""
    l = listed(touching(CELLS[name], precision, device, seed=0, separation=0.055))
    b, s, way, share = l.bench, l.bench.stepper, l.push(2e-3), 0.4
    given = l.own("gap")
    assert np.abs(given - pose_gaps(l)).max() < 1e-6
    shares = wp.full(1, share, dtype=wp.float64, device=device)
    contact_solve.warm_start(b.model, b.state, shares, way, s.contacts, s.law)
    predicted = given + share * l.jacobian.T @ flat(way)
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
    chain_chart.retract(b.model, b.state, b.data.pose, s.data.one, way, b.data.pose)
    search.renew(b.model, b.state, b.data.pose, s.contacts)
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
