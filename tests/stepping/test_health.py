"""Guards: each fires on what it is for, names the place, and stays silent where nothing is wrong.

Crossings are checked against dense sampling in time of constructed motions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from warpflag_kernels.base.clock import NO_FAULT
from warpflag_kernels.contact import neighbours, search
from warpflag_kernels.stepping import health
from warpflag_kernels.stepping.health import Fault

from tests.helpers import as_start, attachment, cell, placed, touching_cell, unit
from tests.oracles import contact_distances
from warpflag.model.geometry import InitialState, initial_state
from warpflag.run.simulation import NumericalError, Simulation
from warpflag.scene import Scene, with_values
from warpflag.stepping.rkc import euler_step

# Distance [um] beyond 5 % of a filament diameter at which no crossing may be seen: float64, float32.
CLEARANCE = {"float64": 2e-4, "float32": 3e-4}
TOUCH = 0.05 * 0.04  # um, of the default diameter


def found(sim: Simulation) -> tuple[Fault, int, int] | None:
    """What the guards say of a start: kind, flagellum, segment. No step is taken."""
    sim.system.state.data.active.fill_(1)
    sim.stepper.launch_pass()
    code = int(sim.system.control.fault.numpy()[0])
    if code == NO_FAULT:
        return None
    kind, element = health.decode(code)
    first = sim.system.model.data.first_node.numpy()
    flagellum = int(np.searchsorted(first, element, side="right")) - 1
    return kind, flagellum, element - int(first[flagellum])


def changed(scene: Scene, flagellum: int, change: Callable[[np.ndarray, np.ndarray], None]) -> InitialState:
    """The scene's start after a change of one flagellum's nodes and directors in place."""
    start = initial_state(scene)
    positions, directors = ([x.copy() for x in arrays] for arrays in (start.positions, start.directors))
    change(positions[flagellum], directors[flagellum])
    return dataclasses.replace(start, positions=tuple(positions), directors=tuple(directors))


def stretched(factor: float) -> Callable[[np.ndarray, np.ndarray], None]:
    def change(x: np.ndarray, _e1: np.ndarray) -> None:
        x[5:] += (factor - 1) * (x[5] - x[4])

    return change


def twisted(angle: float) -> Callable[[np.ndarray, np.ndarray], None]:
    """Joint 6, between segments 6 and 7, at this twist [rad]; the intrinsic one is -0.42."""

    def change(x: np.ndarray, e1: np.ndarray) -> None:
        t = unit(np.diff(x, axis=0))
        turn = angle + 0.2 * 2.1
        for segment in range(7, len(e1)):
            axis = t[segment - 1]
            e1[segment] = e1[segment] * np.cos(turn) + np.cross(axis, e1[segment]) * np.sin(turn)

    return change


def poisoned(what: str, value: float) -> Callable[[np.ndarray, np.ndarray], None]:
    def change(x: np.ndarray, e1: np.ndarray) -> None:
        (x if what == "node" else e1)[4, 1] = value

    return change


@pytest.mark.filterwarnings("ignore:invalid value")
@pytest.mark.parametrize("stepper", ["rkc", "implicit"])
@pytest.mark.parametrize(
    ("change", "kind", "segments"),
    [
        (stretched(1.06), Fault.STRAIN, {5}),
        (stretched(0.94), Fault.STRAIN, {5}),
        (stretched(50.0), Fault.STRAIN, {5}),
        (stretched(1e-4), Fault.STRAIN, {5}),
        (stretched(0.0), Fault.NOT_FINITE, {4, 5}),
        (twisted(1.6), Fault.TWIST, {6}),
        (twisted(-1.6), Fault.TWIST, {6}),
        # A value that is not finite spreads to the joints beside it.
        (poisoned("node", np.nan), Fault.NOT_FINITE, {3, 4}),
        (poisoned("node", np.inf), Fault.NOT_FINITE, {3, 4}),
        (poisoned("director", np.nan), Fault.NOT_FINITE, {3, 4}),
    ],
)
def test_a_bad_start_is_named_before_any_step(change, kind, segments, stepper, device, precision):
    scene = cell({"numerics.stepper": stepper}, precision)
    sim = Simulation(scene, device=device, starts=changed(scene, 1, change))
    with pytest.raises(NumericalError) as caught:
        sim.advance(1e-5)
    error = caught.value
    assert (error.kind, error.cell, error.flagellum, error.time) == (kind, 0, 1, 0.0)
    assert error.segment in segments
    line = str(error)
    assert "\n" not in line
    assert f"flagellum 1, segment {error.segment}" in line and "0 ms" in line and "; take a" in line
    assert sim.steps[0] == 0
    with pytest.raises(NumericalError):  # asked again, it does not pretend to have arrived
        sim.advance(1e-5)


@pytest.mark.parametrize("change", [stretched(1.049), stretched(0.951), twisted(1.55), twisted(-1.55)])
def test_guards_leave_the_permitted_alone(change, device, precision):
    scene = cell(precision=precision)
    assert found(Simulation(scene, device=device, starts=changed(scene, 1, change))) is None


@pytest.mark.parametrize(("degrees", "kind"), [(160, None), (168, Fault.FOLD), (179.9, Fault.FOLD)])
def test_a_joint_folded_back_is_seen(degrees, kind, device, precision):
    scene = cell({"steric.enabled": False, "body.contact": False}, precision)
    nodes = []
    for spec in scene.resolved_flagella():
        anchor, m = attachment(scene, spec)
        side = unit(np.cross(m, [0.3, 0.5, 0.1]))
        angle = np.radians(np.where(np.arange(spec.segment_count) < 5, 0.0, degrees))[:, None]
        steps = spec.segment_length * (np.cos(angle) * m + np.sin(angle) * side)
        nodes.append(anchor + np.cumsum(steps, axis=0))
    where = found(Simulation(scene, device=device, starts=placed(scene, nodes)))
    assert where == (None if kind is None else (kind, 0, 5))


@pytest.mark.parametrize("factor", [1.5, 1.65, 2.0, 3.0, 10.0, 50.0])
def test_euler_steps_too_long_end_in_an_error_or_in_right_numbers(factor, device):
    """Twice the stable step turns twist into finite garbage: no NaN ever shows it."""
    scene = with_values(cell(), {"numerics.stepper": "euler"})
    limit = euler_step(scene)

    def end(step: float) -> np.ndarray:
        sim = Simulation(with_values(scene, {"numerics.time_step": step}), device=device)
        sim.advance(2e-5)
        return sim.cell_state().positions

    try:
        reached = end(factor * limit)
    except NumericalError as error:
        assert factor > 1.6, error  # 2 over the spectral radius is 1.6 times the default step
    else:
        assert np.abs(reached - end(limit)).max() < 1e-4
        assert factor < 1.6


def test_where_an_advance_ends_is_looked_at_whatever_the_interval(device):
    scene = with_values(cell(), {"numerics.stepper": "euler"})
    step = 10 * euler_step(scene)
    sim = Simulation(with_values(scene, {"numerics.time_step": step}), device=device)
    assert sim.system.guard.interval.numpy()[0] > 15
    with pytest.raises(NumericalError):
        sim.advance(15 * step)


def test_between_the_ends_of_advances_every_so_many_th_step_is_looked_at(device):
    scene = with_values(cell(), {"numerics.stepper": "euler"})
    step = 10 * euler_step(scene)
    sim = Simulation(with_values(scene, {"numerics.time_step": step}), device=device)
    sim.system.guard.interval.fill_(12)
    with pytest.raises(NumericalError):
        sim.advance(15 * step)
    assert sim.steps.tolist() == [12]


def test_the_printed_mobility_bursts_at_contact_and_is_stopped(device):
    """Not positive definite at contact: no step is short enough."""
    for step in (1e-5, 1e-6):
        scene = touching_cell({"hydrodynamics.mode": "as_printed", "numerics.time_step": step})
        with pytest.raises(NumericalError) as caught:
            Simulation(scene, device=device).advance(2e-5)
        assert caught.value.kind in (Fault.CROSSING, Fault.STRAIN)


def test_filaments_that_pass_through_each_other_are_an_error_only_where_they_repel(device, precision):
    weak = touching_cell({"steric.strength": 1e-6}, precision)
    sim = Simulation(weak, device=device)
    sim.advance(3e-4)
    with pytest.raises(NumericalError) as caught:
        sim.advance(1.2e-3)
    assert caught.value.kind == Fault.CROSSING
    # Before the step that crossed they were near, and apart in the state before.
    assert contact_distances(as_start(weak, sim.cell_state())).min() < 0.03
    off = Simulation(touching_cell({"steric.enabled": False}, precision), device=device)
    off.advance(1.2e-3)  # they pass through each other, as the scene says
    assert off.system.guard.position is None


def test_no_false_alarm_in_contact(device, precision):
    scene = touching_cell(precision=precision)
    sim = Simulation(scene, device=device)
    for until in (2e-4, 4e-4, 6e-4, 8e-4, 1e-3):
        sim.advance(until)
        assert 0.028 < contact_distances(as_start(scene, sim.cell_state())).min() < 0.045


COUNT = 400


def motions(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Two filaments of two segments before and after: shape [COUNT, 2, 3, 3]. All angles, nearly parallel to across."""
    random = np.random.default_rng(seed)

    def spread(low: float, high: float) -> np.ndarray:
        return np.exp(random.uniform(np.log(low), np.log(high), (COUNT, 1)))

    along = unit(random.standard_normal((COUNT, 3)))
    gap = spread(0.003, 0.04) * unit(random.standard_normal((COUNT, 3)))
    bend = spread(0.003, 1.0)

    def filament(middle: np.ndarray) -> np.ndarray:
        back, ahead = (0.2 * unit(along + bend * random.standard_normal((COUNT, 3))) for _ in range(2))
        return np.stack([middle - back, middle, middle + ahead], axis=1)

    before = np.stack([filament(0 * gap), filament(gap + random.uniform(-0.1, 0.1, (COUNT, 1)) * along)], axis=1)
    after = before + spread(0.0003, 0.02)[:, None, None] * random.standard_normal(before.shape)
    after[:, 1] -= (random.uniform(0, 2.5, (COUNT, 1)) * gap)[:, None]
    return before, after


def closest(p: np.ndarray, d: np.ndarray, q: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances of segments p + s d and q + t e, and whether the lines' common perpendicular lies within both."""

    def dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.sum(a * b, axis=-1)

    def point(r: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.linalg.norm(r - a - np.clip(dot(r - a, b) / dot(b, b), 0, 1)[..., None] * b, axis=-1)

    normal = np.cross(d, e)
    square = dot(normal, normal)
    s, t = (dot(np.cross(q - p, v), normal) / square for v in (e, d))
    inside = (s > 0) & (s < 1) & (t > 0) & (t < 1)
    ends = np.minimum.reduce([point(p, q, e), point(p + d, q, e), point(q, p, d), point(q + e, p, d)])
    return np.where(inside, np.abs(dot(q - p, normal)) / np.sqrt(square), ends), inside


def sampled(before: np.ndarray, after: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Per motion: does any pair of segments pass through each other, how near do the filaments come [um], and does
    any pair change sides at all (turned past parallel, or passed by)?"""
    x = np.linspace(0.0, 1.0, 601)[:, None, None]
    crossed, turned, nearest = np.zeros(COUNT, bool), np.zeros(COUNT, bool), np.full(COUNT, np.inf)
    for i in range(2):
        for j in range(2):
            p, p_end, q, q_end = (
                before[:, k, n] + x * (after - before)[:, k, n] for k, n in ((0, i), (0, i + 1), (1, j), (1, j + 1))
            )
            d, e = p_end - p, q_end - q
            distance, inside = closest(p, d, q, e)
            side = np.sum(np.cross(d, e) * (q - p), axis=-1) > 0
            # The side changes between two samples in both of which the perpendicular lies within.
            crossed |= ((side[1:] != side[:-1]) & inside[1:] & inside[:-1]).any(axis=0)
            turned |= (side[1:] != side[:-1]).any(axis=0)
            nearest = np.minimum(nearest, distance.min(axis=0))
    return crossed, nearest, turned


def place(sim: Simulation, nodes: np.ndarray) -> None:
    data = sim.system.state.data
    lengths = np.ones(nodes.shape[:3])
    segments = np.diff(nodes, axis=2)
    lengths[:, :, 1:] = np.linalg.norm(segments, axis=-1)
    tangents = np.tile([0.0, 0.0, 1.0], (*nodes.shape[:3], 1))
    tangents[:, :, 1:] = segments / lengths[:, :, 1:, None]
    data.pose.position.assign(nodes.reshape(-1, 3))
    data.pose.length.assign(lengths.ravel())
    data.pose.tangent.assign(tangents.reshape(-1, 3))
    data.pose.director.assign(np.tile([1.0, 0.0, 0.0], (lengths.size, 1)))
    data.active.fill_(1)


def seen(sim: Simulation, before: np.ndarray, after: np.ndarray, looked_at: float | None) -> np.ndarray:
    """What the guard says of these motions, one per cell.

    looked_at: share of the way after which contacts have been looked for; None: they have not.
    """
    s, listed = sim.system, None
    if looked_at is not None:
        listed = sim.stepper.contacts
        place(sim, before + looked_at * (after - before))
        search.find(s.model, s.state, s.state.data.pose, listed)
    place(sim, after)
    s.guard.position.assign(before.reshape(-1, 3))
    for flags in (s.chart.commit, s.chart.at_start):
        flags.fill_(1)
    s.control.fault.fill_(NO_FAULT)
    health.check(s.model, s.state, s.chart, s.guard, s.control, listed)
    faults = s.control.fault.numpy()
    return np.array([code != NO_FAULT and health.decode(int(code))[0] == Fault.CROSSING for code in faults])


@pytest.mark.parametrize("looked_at", [None, 0.0, 0.7])
def test_crossings_are_those_of_dense_sampling(looked_at, device, precision):
    scene = cell({"flagella.length": 0.4, "numerics.stepper": "implicit"}, precision)
    sim = Simulation([scene] * COUNT, device=device)
    crossings = silent = 0
    for seed in range(3):
        before, after = motions(seed)
        crossed, nearest, turned = sampled(before, after)
        answer = seen(sim, before, after, looked_at)
        assert answer[crossed].all(), np.flatnonzero(crossed & ~answer)
        away = nearest > TOUCH + CLEARANCE[precision]
        assert not answer[away].any(), np.flatnonzero(away & answer)
        crossings, silent = crossings + crossed.sum(), silent + (away & turned).sum()
    assert crossings > 200 and silent > 200


@pytest.mark.parametrize("listed_at", [0.0, 0.5, 1.0])
@pytest.mark.parametrize(
    ("h", "count", "above", "below"),
    [(0.2, 2, 0.01, 0.01), (0.2, 2, 0.45, 0.45), (0.05, 2, 0.005, 0.195), (0.05, 16, 0.1, 0.6)],
)
def test_crossings_are_seen_wherever_the_lists_were_built(h, count, above, below, listed_at, device, precision):
    """Two filaments across each other, one of which moves through the other from beyond the reach of the lists, too,
    or on by many of its short segments; they meet in the middle of many, too."""
    lengths = {"flagella.length": count * h, "flagella.segment_length": h}
    for aside, expected in ((0.0, True), (0.6, False)):
        sim = Simulation(cell({**lengths, "numerics.stepper": "implicit"}, precision), device=device)
        along = h * (np.arange(count + 1.0) - count // 2 - (0.3 if count > 2 else -0.4))[:, None]
        still, moving = along * [1.0, 0.0, 0.0], along * [0.1, 1.0, 0.0] + [aside, 0.0, 0.0]
        before, after = (np.array([[still, np.add(moving, [0.0, 0.0, z])]]) for z in (above, -below))
        place(sim, before + listed_at * (after - before))
        neighbours.refresh(sim.system.model, sim.system.state)
        assert seen(sim, before, after, None)[0] == expected


@pytest.mark.parametrize(("turn", "expected"), [(2.1, True), (-2.1, True), (1.9, False), (-1.9, False)])
def test_a_motor_that_turns_too_far_in_a_step_is_named(turn, expected, device, precision):
    sim = Simulation(cell({}, precision), device=device)
    sim.evaluate()
    s, first = sim.system, int(sim.first_node[1])
    increments = np.zeros((s.model.element_count, 4))
    increments[first, 3] = turn
    s.chart.increment.assign(increments)
    for flags in (s.chart.commit, s.chart.at_start, s.state.data.active):
        flags.fill_(1)
    health.check(s.model, s.state, s.chart, s.guard, s.control)
    code = int(s.control.fault.numpy()[0])
    assert code == (health.encode(Fault.TURN) + first if expected else NO_FAULT)


@pytest.mark.parametrize(("apart", "kind"), [(0.0, Fault.CROSSING), (1e-3, Fault.CROSSING), (4e-3, None), (0.03, None)])
@pytest.mark.parametrize("stepper", ["rkc", "implicit"])
def test_a_start_whose_flagella_touch_is_refused(apart, kind, stepper, device, precision):
    """Two straight flagella that cross in the middle, so far apart [um]."""
    scene = cell({"numerics.stepper": stepper, "body.contact": False}, precision)
    anchors = np.array([attachment(scene, spec)[0] for spec in scene.resolved_flagella()])
    meeting = anchors.mean(axis=0) + np.array([0.0, 0.0, 1.5])
    across = unit(np.cross(anchors[1] - anchors[0], [0.0, 0.0, 1.0]))
    nodes = []
    for anchor, spec, shift in zip(anchors, scene.resolved_flagella(), (0.0, apart), strict=True):
        along = unit(meeting + shift * across - anchor)
        nodes.append(anchor + spec.segment_length * np.arange(1, spec.segment_count + 1)[:, None] * along)
    sim = Simulation(scene, device=device, starts=placed(scene, nodes))
    sim.prepare()
    assert [fault.kind for fault in sim.faults.values()] == ([] if kind is None else [kind])


@pytest.mark.parametrize("steps", [1, 5])
def test_a_fixed_step_beyond_its_stages_is_an_error(steps, device, precision):
    """As if the spectral radius had grown within the step, be it the first one."""
    sim = Simulation(cell({"numerics.time_step": 1e-6}, precision), device=device)
    sim.advance(1e-6 * steps)
    sim.stepper.data.stages.fill_(3)
    words = "beyond what its stages keep stable; take a shorter numerics.time_step"
    with pytest.raises(NumericalError, match=words) as caught:
        sim.advance(2e-5)
    assert caught.value.kind == Fault.UNSTABLE and sim.steps[0] == steps
    controlled = Simulation(cell({}, precision), device=device)
    controlled.advance(5e-6)
    controlled.stepper.data.stages.fill_(3)
    controlled.advance(6e-6)  # its estimates see an unstable step
