"""Contacts of a thermal step: their closest points where the step leads, as a linear step from the start sees them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from warpflag_kernels.base import clock
from warpflag_kernels.contact import contact_list, search
from warpflag_kernels.implicit import delassus, quasi_newton
from warpflag_kernels.rod import chain_chart
from warpflag_kernels.stepping import health
from warpflag_kernels.thermal import additive_chart, closing

from tests.helpers import anchors, shaken, touching_cell
from tests.oracles import segment_distances
from warpflag.model.start import starting_state
from warpflag.run.faults import NumericalError
from warpflag.run.simulation import Simulation
from warpflag.scene import with_values

TOLERANCE = {"float64": 1e-12, "float32": 1e-6}  # of a gap [um]


def test_gaps_where_a_step_leads_are_those_of_the_linear_step_from_the_start(precision, device):
    warm = {"numerics.stepper": "implicit", "fluid.temperature": 300.0, "flagella.length": 1.0}
    scene = touching_cell(warm, precision)
    sim = Simulation(scene, device=device, starts=shaken(scene, 2, node=1e-3))
    s, random = sim.system, np.random.default_rng(3)
    model, state, pose = s.model, s.state, s.state.data.pose
    contacts = contact_list.allocate(model, True)
    law = delassus.allocate(model, contacts)
    quasi_newton.allocate(model, contacts, law)
    x = chain_chart.allocate(model)
    nodes = 3e-3 * random.standard_normal((model.element_count, 4))
    nodes[anchors(scene), :3] = 0.0
    x.node.assign(nodes)  # the body rests
    sim.evaluate()
    state.data.active.fill_(1)
    search.find(model, state, pose, contacts)
    law.force.fill_(1.0)
    start = pose.position.numpy().copy()
    closing.renew(model, state, s.chart, x, additive_chart.allocate(model), contacts, law)
    np.testing.assert_array_equal(pose.position.numpy(), start)
    count = int(contacts.count.numpy()[0])
    assert (law.force.numpy()[:count] == 0.0).all()

    additive_chart.retract(model, state, s.chart, x, additive_chart.allocate(model))
    end, axis = pose.position.numpy().astype(np.float64), pose.body_axis.numpy()[0].astype(np.float64)
    names = ("segment", "other", "at", "at_other", "normal", "gap")
    listed = (getattr(contacts, name).numpy()[:count] for name in names)
    kinds, changes = set(), []
    for e, j, at, at_other, normal, gap in zip(*listed, strict=True):
        moved = at * nodes[e, :3] + (1 - at) * nodes[e - 1, :3]
        if j >= 0:
            moved = moved - at_other * nodes[j, :3] - (1 - at_other) * nodes[j - 1, :3]
            p, q = end[[e - 1]], end[[j - 1]]
            there = segment_distances(p, end[[e]] - p, q, end[[j]] - q)[0, 0]
        else:
            half = (scene.body.length - scene.body.width) / 2
            off = end[e] - np.clip(end[e] @ axis, -half, half) * axis
            there = np.linalg.norm(off) - scene.body.width / 2
        kinds.add(j >= 0)
        changes.append(normal @ moved)
        assert abs(gap + changes[-1] - there) < TOLERANCE[precision]
    assert kinds == {True, False} and np.max(np.abs(changes)) > 1e-3


@pytest.mark.parametrize(
    ("gap", "strength", "steps", "stops"),
    [(0.74, 0.8, 1, True), (0.5, 0.8, 1, True), (0.76, 0.8, 1, False), (0.74, 0.4, 1, False), (0.74, 0.8, 0, False)],
)
def test_a_contact_closer_than_noise_can_press_it_stops_the_cell(gap, strength, steps, stops, precision, device):
    """0.74 sigma is 40 kT of the paper's contact, 20 of half its strength; a start may have any.

    Of the second cell: the first is twice as warm, which is not asked.
    """
    warm = {"numerics.stepper": "implicit", "fluid.temperature": 300.0, "flagella.length": 1.0}
    scene = touching_cell({**warm, "steric.strength": strength}, precision)
    sim = Simulation([with_values(scene, {"fluid.temperature": 600.0}), scene], device=device)
    model, state, control = sim.system.model, sim.system.state, sim.system.control
    contacts = contact_list.allocate(model, True)
    sim.evaluate()
    state.data.active.fill_(1)
    search.find(model, state, state.data.pose, contacts)
    last = int(contacts.first.numpy()[1] + contacts.count.numpy()[1]) - 1
    gaps = contacts.gap.numpy()
    gaps[: last + 1] = 0.05
    gaps[last] = gap * 0.04
    contacts.gap.assign(gaps)
    control.steps.fill_(steps)
    closing.check_gaps(model, state, contacts, sim.stepper.noise, control)
    sound, fault = control.fault.numpy().tolist()
    assert sound == clock.NO_FAULT and (fault != clock.NO_FAULT) == stops
    if stops:
        assert health.decode(fault) == (health.Fault.PRESSED, int(contacts.segment.numpy()[last]))


def test_a_step_looks_at_the_gaps_that_the_last_one_left(device):
    """Two filaments, the second one's last node 0.02 um from the first's."""
    scene = touching_cell({"numerics.stepper": "implicit", "fluid.temperature": 300.0, "flagella.length": 1.0})
    rest = starting_state(scene)
    first, second = (x.copy() for x in rest.positions)
    apart = second[1:] - first[1:]
    nearer = np.linspace(0.0, 1 - 0.02 / 0.042, len(apart) + 1)[1:, None]  # the last one all the way
    second[1:] -= nearer * apart
    start = dataclasses.replace(rest, positions=(first, second))
    sim = Simulation(scene, device=device, starts=start)
    sim.prepare()
    sim.system.control.steps.fill_(1)
    with pytest.raises(NumericalError, match="a step has missed it") as error:
        sim.advance(1e-6)
    assert error.value.kind == health.Fault.PRESSED and sim.steps.tolist() == [1]
