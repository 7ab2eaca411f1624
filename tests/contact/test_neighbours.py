"""Lists of near segments: complete while they hold, built anew when they must be, and the same forces to the bit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.contact import neighbours, pair_forces, search

from tests.helpers import cell, touching_cell, unit
from tests.oracles import CUTOFF, segment_distances
from warpflag.run.simulation import Simulation

SIGMA = 0.04
# Distances are known to this much [um].
TOLERANCE = {"float64": 1e-12, "float32": 1e-5}
HALF = 0.5 * neighbours.SKIN


class Cells:
    """A batch: fine and coarse meshes, unequal lengths, three flagella, and two far from each other."""

    def __init__(self, precision: str, device: str) -> None:
        unequal = {"flagellum.1.length": 1.2, "flagellum.1.segments": 5}
        three = {"flagella.count": 3, "flagellum.2.azimuth": 30.0, "flagella.segment_length": 0.1}
        scenes = [
            touching_cell({"flagella.segment_length": 0.05, "flagella.length": 1.0}, precision, separation=0.13),
            touching_cell(unequal, precision, separation=0.13),
            touching_cell({"flagella.segment_length": 0.7, "flagella.length": 2.8}, precision, separation=0.13),
            touching_cell({**three, "flagella.length": 1.0}, precision, separation=0.13),
            cell({}, precision),
        ]
        self.sim = Simulation(scenes, device=device)
        self.sim.evaluate()
        self.model, self.state = self.sim.system.model, self.sim.system.state
        self.data, self.near = self.state.data, self.state.neighbours
        self.data.active.fill_(1)
        m = self.model.data
        self.flagellum, self.cell = m.flagellum_of.numpy(), m.cell_of.numpy()
        self.first_node, self.first_flagellum = m.first_node.numpy(), m.first_flagellum.numpy()
        self.segments = np.setdiff1d(np.arange(self.model.element_count), self.first_node)
        self.start = self.data.pose.position.numpy().astype(np.float64)

    def place(self, x: np.ndarray) -> None:
        lengths = np.linalg.norm(np.diff(x, axis=0, prepend=0.0), axis=1)
        lengths[self.first_node[:-1]] = 1.0
        self.data.pose.position.assign(x)
        self.data.pose.length.assign(lengths)

    def built_at(self) -> np.ndarray:
        """Positions of the nodes when the lists were built."""
        return self.near.position.numpy().copy()

    def forces(self) -> np.ndarray:
        """Contact forces on both nodes of every segment and the sum of their magnitudes, from fresh lists or old."""
        magnitude = wp.zeros(self.model.element_count, dtype=self.model.precision.real, device=self.model.device)
        pair_forces.segment_contact(self.model, self.state)
        pair_forces.steric_magnitudes(self.model, self.state, magnitude)
        return np.hstack([self.data.steric_first.numpy(), self.data.steric_second.numpy(), magnitude.numpy()[:, None]])

    def forces_without_lists(self) -> np.ndarray:
        """The same with every segment tested against all others, as where a list has no room."""
        count = self.near.count.numpy().copy()
        self.near.count.fill_(-1)
        found = self.forces()
        assert (self.near.count.numpy() == -1).all()  # not built anew meanwhile
        self.near.count.assign(count)
        return found

    def lists(self) -> list[list[int]]:
        count, segment = self.near.count.numpy(), self.near.segment.numpy().reshape(-1, neighbours.SLOTS)
        return [segment[e, : count[e]].tolist() for e in range(len(count))]

    def expected_neighbours(self, x: np.ndarray) -> list[set[int]]:
        """Segments of other flagella of the cell that contact or its search can ask for, by segment."""
        found: list[set[int]] = [set() for _ in x]
        for c in range(self.model.cell_count):
            own = self.segments[self.cell[self.segments] == c]
            p, d = x[own - 1], x[own] - x[own - 1]
            near = segment_distances(p, d, p, d) < (CUTOFF + search.MARGIN) * SIGMA
            near &= self.flagellum[own][:, None] != self.flagellum[own]
            for i, j in np.argwhere(near):
                found[own[i]].add(int(own[j]))
        return found

    def drift(self, distance: float) -> np.ndarray:
        """Flagella of a cell moved toward each other, each by this way [um]."""
        way = np.zeros_like(self.start)
        for c in range(self.model.cell_count):
            k = self.first_flagellum[c]
            for other in range(k + 1, self.first_flagellum[c + 1]):
                a, b = self.first_node[k], self.first_node[other]
                way[b : self.first_node[other + 1]] = distance * unit(self.start[a + 1] - self.start[b + 1])
            way[self.first_node[k] : self.first_node[k + 1]] = -way[self.first_node[k + 1]]
        return way


def jitter(random: np.random.Generator, count: int, largest: float) -> np.ndarray:
    return largest * random.uniform(0, 1, (count, 1)) * unit(random.standard_normal((count, 3)))


def test_whatever_can_be_near_is_listed_until_a_node_has_moved_by_half_the_skin(device, precision):
    b = Cells(precision, device)
    b.forces()
    lists, built = b.lists(), b.built_at()
    for e, listed in enumerate(lists):
        assert listed == sorted(set(listed))
        assert all(b.cell[j] == b.cell[e] and b.flagellum[j] != b.flagellum[e] for j in listed)
        assert not set(listed) & set(b.first_node) and (listed == [] or e in b.segments)
    # Shorter than the flagella are, or a list would be of no use; nothing near where flagella part.
    longest = [max(len(lists[e]) for e in b.segments[b.cell[b.segments] == c]) for c in range(5)]
    assert 0 < longest[1] < 10 and 0 < longest[0] < 20
    random, new = np.random.default_rng(1), 0
    at_first = b.expected_neighbours(b.start)
    for distance in (0.25 * HALF, 0.5 * HALF, 0.95 * HALF):
        for _ in range(4):
            x = b.start + b.drift(distance) + jitter(random, len(b.start), 0.99 * HALF - distance)
            b.place(x)
            with_lists = b.forces()
            assert np.array_equal(with_lists, b.forces_without_lists())
            assert b.lists() == lists and np.array_equal(b.built_at(), built)
            for e, near in enumerate(b.expected_neighbours(x)):
                assert near <= set(lists[e])
                new += len(near - at_first[e])
    assert new > 50
    assert [np.abs(with_lists[b.cell == c]).max() > 0.0 for c in range(4)] == [True] * 4


def test_forces_of_a_random_walk_are_those_without_lists(device, precision):
    b = Cells(precision, device)
    random, x, builds, acting = np.random.default_rng(2), b.start.copy(), np.zeros(5, dtype=int), 0
    before = b.built_at()
    # Together, apart and together again, by steps up to and beyond what the lists hold for.
    for step in range(30):
        x = b.start + np.sin(0.4 * step) ** 2 * b.drift(0.05) + jitter(random, len(x), 0.5 * HALF * (1 + step % 3))
        b.place(x)
        with_lists = b.forces()
        assert np.array_equal(with_lists, b.forces_without_lists()), step
        now = b.built_at()
        for c in range(5):
            own = b.cell == c
            far = np.linalg.norm(x[own] - before[own], axis=1).max()
            fresh = np.array_equal(now[own], b.data.pose.position.numpy()[own])
            assert fresh if far > HALF + TOLERANCE[precision] else (now[own] == before[own]).all()
            builds[c] += fresh
        before = now
        acting += (with_lists[:, -1] > 0).sum()
    assert acting > 100 and (builds > 3).all() and (builds < 30).any()


@pytest.mark.parametrize("share, stale", [(0.99, 0), (1.01, 1)])
def test_only_the_cell_in_which_a_node_has_moved_too_far_is_listed_anew(share, stale, device, precision):
    b = Cells(precision, device)
    b.forces()
    lists, x = b.lists(), b.start.copy()
    for e in (b.first_node[3], b.first_node[3] + 5):  # an anchor counts as well
        x = b.start.copy()
        x[e] += share * HALF * np.array([0.0, 0.6, -0.8])
        b.place(x)
        neighbours.refresh(b.model, b.state)
        assert list(b.near.stale.numpy()) == [0, stale, 0, 0, 0]
        fresh = (b.built_at() == b.data.pose.position.numpy()).all(axis=1)
        assert fresh[e] == bool(stale)
        b.place(b.start)
        b.forces()
    assert b.lists() == lists


@pytest.mark.parametrize("broken", ["a node", "an end", "all"])
def test_lists_made_of_what_is_not_a_number_do_not_last(broken, device, precision):
    """A stage that blew up is taken back, and so are its lists: though all else has hardly moved since."""
    b = Cells(precision, device)
    near = b.start + b.drift(0.05)
    b.place(near)
    expected = b.forces()
    nodes = {"a node": [3, 30], "an end": [b.first_node[2] - 1, b.first_node[4] - 1], "all": slice(None)}[broken]
    b.place(near + 1.02 * HALF * np.array([0.0, 0.0, 1.0]))
    b.forces()
    blown = near.copy()
    blown[nodes] = np.nan
    b.place(blown)
    b.forces()
    b.place(near)
    assert np.array_equal(b.forces(), expected)
    assert np.array_equal(b.forces_without_lists(), expected)
    assert np.abs(expected[3]).max() > 0.0 or np.abs(expected[30]).max() > 0.0


def test_a_crowd_too_large_for_a_list_is_tested_in_full(device, precision):
    """Eight fine filaments side by side: more near segments than a list holds, though not at their ends."""
    values: dict[str, Any] = {"flagella.count": 8, "flagella.segment_length": 0.025, "flagella.length": 1.5}
    values |= {f"flagellum.{k}.azimuth": 5.0 * k for k in range(8)}
    values |= {"flagella.opening_angle": 0.0, "flagellum.7.azimuth": 80.0}
    sim = Simulation(cell(values, precision), device=device)
    sim.evaluate()
    state, near = sim.system.state, sim.system.state.neighbours
    count = near.count.numpy()
    assert (count < 0).sum() > 20 and (count > 0).sum() > 20
    found = state.data.steric_first.numpy().copy(), state.data.steric_second.numpy().copy()
    near.count.fill_(-1)
    sim.evaluate()
    assert (near.count.numpy() == -1).all()
    assert np.array_equal(found[0], state.data.steric_first.numpy())
    assert np.array_equal(found[1], state.data.steric_second.numpy())
    assert np.abs(found[0]).max() > 0.1
