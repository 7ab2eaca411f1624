"""Step control: the accuracy asked for is the accuracy reached, at switch-on, in contact and after jumps; what can't be
stepped ends with a reason.

Windows and their starts are those of `tests.implicit.test_implicit`. Both steppers that estimate an error obey the same
control.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from warpflag_kernels.stepping.health import Fault

from tests.helpers import cell, touching_cell, unit
from tests.implicit.test_implicit import advanced, distance, implicit, reached, window, zipping
from warpflag.run.simulation import NumericalError, Simulation
from warpflag.scene import with_values

# Node error over `numerics.accuracy` per simulated ms, at most and at least; both precisions.
SHARE, WASTE = 2.0, 0.03

DURATION = 1e-3


@cache
def exact(name: str, device: str) -> Simulation:
    return advanced(zipping(implicit(1e-6)), window(name, device), DURATION, device)


def controlled(stepper: str, accuracy: float, precision: str = "float64") -> dict[str, object]:
    return {"numerics.stepper": stepper, "numerics.accuracy": accuracy, "numerics.precision": precision}


def counts(sim: Simulation) -> tuple[int, int, int]:
    """Steps taken, steps rejected, right-hand sides."""
    memory = sim.stepper.memory()
    return int(sim.steps[0]), int(memory["rejected"][0]), int(memory["evaluations"][0])


@pytest.mark.parametrize("name", ["free", "contact"])
@pytest.mark.parametrize("accuracy", [2e-2, 5e-3, 1e-3])
@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_the_accuracy_asked_for_is_reached(stepper, accuracy, name, device, precision):
    sim = advanced(zipping(controlled(stepper, accuracy, precision)), window(name, device), DURATION, device)
    share = distance(sim, exact(name, device)) / accuracy
    assert WASTE < share < SHARE, (share, counts(sim))


@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_steps_are_small_at_switch_on_and_grow(stepper, device, precision):
    sim = Simulation(zipping(controlled(stepper, 5e-3, precision)), device=device)
    steps = []
    for until in (1e-7, 1e-6, 1e-5, 1e-4, 6e-4):
        before, time = sim.steps[0], sim.times[0]
        sim.advance(until)
        steps.append((until - time) / (sim.steps[0] - before))  # their mean
    assert steps[0] < 5e-8 and steps[-1] > 5e-6
    assert (np.diff(steps[:4]) > 0).all(), steps  # then they are what the accuracy asks for


@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_switch_on_itself_is_accurate(stepper, device, precision):
    """The first 20 us, in which the twist runs down the filaments, against steps of a nanosecond and less."""
    oracle = advanced(zipping(implicit(1e-9)), None, 1e-6, device)
    oracle = advanced(zipping(implicit(1e-8)), reached(oracle), 1.9e-5, device)
    sim = advanced(zipping(controlled(stepper, 5e-3, precision)), None, 2e-5, device)
    assert distance(sim, oracle) < SHARE * 5e-3 * 2e-2


def test_every_attempt_is_a_step_or_a_rejected_one(device, precision):
    sim = advanced(touching_cell(implicit(accuracy=5e-3), precision), None, 2e-6, device)
    before = counts(sim)[1]
    sim.stepper.steps.wanted_step.fill_(1e-5)  # far too long, so soon
    sim.advance(3e-5)
    taken, rejected, evaluations = counts(sim)
    assert rejected > before
    assert evaluations == taken + rejected


def test_a_rejected_step_leaves_no_trace(device):
    """Steps that fail one after another leave the cell where it was."""
    sim = advanced(zipping(implicit(5e-6)), window("contact", device), 2e-5, device)
    first, before, rejected = sim.stepper.contacts.first, sim.cell_state(), counts(sim)[1]
    memory = sim.checkpoint()
    first.assign(np.array([0, 1]))  # no room for the contacts: nothing can be solved
    with pytest.raises(NumericalError) as caught:
        sim.advance(2.5e-5)
    after, left = sim.cell_state(), sim.checkpoint()
    assert caught.value.kind == Fault.CROWDED and counts(sim)[1] > rejected
    for name in ("time", "step", "positions", "directors", "motor_angle", "body_position", "body_orientation"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name
    changed = {name for name, values in memory.items() if not np.array_equal(values, left[name])}
    measured = {f"stepper.{name}" for name in ("kappa", "strong", "probe_node", "probe_body", "over_implicit")}
    assert changed <= {"stepper.wanted_step", "stepper.rejected", "stepper.evaluations"} | measured


def test_after_a_jump_of_the_torque_a_restart_begins_small_and_follows(device):
    scene = zipping(implicit(accuracy=5e-3))
    sim = advanced(scene, window("free", device), 1e-4, device)
    usual = sim.system.control.step.numpy()[0]
    start, torque = reached(sim), sim.system.model.data.motor.torque
    torque.assign(2.0 * torque.numpy())
    sim.stepper.restart()
    steps, time = sim.steps[0], sim.times[0]
    sim.advance(time + 1e-7)
    assert 1e-7 / (sim.steps[0] - steps) < 0.01 * usual
    sim.advance(time + 1e-4)
    doubled = with_values(scene, {"motor.torque": 6.8, "numerics.accuracy": 2e-4})
    oracle = advanced(doubled, start, 1e-4, device)
    assert distance(sim, oracle) < SHARE * 5e-3 * 0.1


@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_a_jump_that_nobody_announces_is_noticed(stepper, device):
    """Without a restart: the estimate sees it and steps are rejected, though only a restart keeps the full accuracy."""
    scene = zipping(controlled(stepper, 5e-3))
    sim = advanced(scene, window("free", device), 1e-4, device)
    start, torque, rejected = reached(sim), sim.system.model.data.motor.torque, counts(sim)[1]
    torque.assign(3.0 * torque.numpy())
    sim.advance(1.5e-4)
    oracle = advanced(with_values(scene, {"motor.torque": 10.2, "numerics.accuracy": 2e-4}), start, 5e-5, device)
    assert counts(sim)[1] > rejected
    assert distance(sim, oracle) < 0.1 * distance(sim, advanced(scene, start, 5e-5, device))


def linking(sim: Simulation) -> float:
    """Gauss integral of the two flagella [turns]: jumps by one where they pass through each other, else drifts."""
    a, b = np.split(sim.cell_state().positions, 2)
    p, q, r, s = a[:-1, None], a[1:, None], b[None, :-1], b[None, 1:]
    # Each pair of segments sees a spherical quadrangle of each other (Klenin, Langowski, Biopolymers 54, 307 (2000)).
    sides = [unit(np.cross(x, y)) for x, y in ((r - p, s - p), (s - p, s - q), (s - q, r - q), (r - q, r - p))]
    angles = [np.arcsin(np.clip((sides[i - 1] * sides[i]).sum(axis=-1), -1, 1)) for i in range(4)]
    sign = np.sign((np.cross(s - r, q - p) * (r - p)).sum(axis=-1))
    return float((sum(angles) * sign).sum() / (4 * np.pi))


@pytest.mark.parametrize("step", [3e-5, 1e-4, 1e-3])
def test_no_contact_is_stepped_through_at_a_fixed_step_far_too_long(step, device):
    """The filaments stay on the sides where they are, or the run says why not; where they do not repel they cross."""
    right = linking(exact("contact", device))
    sim = Simulation(zipping(implicit(step)), device=device, starts=window("contact", device))
    try:
        sim.advance(DURATION)
    except NumericalError as error:
        assert error.kind in (Fault.CROSSING, Fault.STRAIN, Fault.UNSOLVED)
    else:
        assert abs(linking(sim) - right) < 0.1
    ghosts = advanced(zipping({**implicit(1e-5), "steric.enabled": False}), window("contact", device), DURATION, device)
    assert abs(linking(ghosts) - right) > 0.9


IMPOSSIBLE = {
    # Not positive definite where two filaments touch: repulsion pulls them together.
    "printed mobility": {"hydrodynamics.mode": "as_printed"},
    # Between flagella alone neither.
    "flows between alone": {"hydrodynamics.mode": "between"},
    "torque": {"motor.torque": 60.0},
}


@pytest.mark.parametrize("name", list(IMPOSSIBLE))
@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_an_impossible_scene_ends_soon_and_with_a_reason(stepper, name, device, precision):
    # Pressed together from the start: at a distance they may part by chance.
    scene = touching_cell({**IMPOSSIBLE[name], **controlled(stepper, 5e-3, precision)}, separation=0.036)
    sim = Simulation(scene, device=device)
    with pytest.raises(NumericalError):
        sim.advance(1e-3)
    assert counts(sim)[0] + counts(sim)[1] < 5000


def test_a_cell_whose_steps_cannot_be_solved_says_so_and_its_neighbours_go_on(device, precision):
    scenes = [make(implicit(accuracy=5e-3), precision) for make in (touching_cell, cell)]
    batch, alone = Simulation(scenes, device=device), Simulation(scenes[1], device=device)
    first = batch.stepper.contacts.first
    first.assign(first.numpy() + np.array([first.numpy()[1] - 1, 0, 0]))  # no room in the first cell
    with pytest.raises(NumericalError) as caught:
        batch.advance(2e-5)
    assert caught.value.cell == 0 and caught.value.kind == Fault.CROWDED
    assert batch.times[0] == 0.0
    alone.advance(2e-5)
    assert np.array_equal(batch.cell_state(1).positions, alone.cell_state().positions)


def test_ends_of_advances_do_not_wear_the_step_down(device):
    """Cut short to end on a time asked for, a step is as long again soon after."""
    scene = zipping(implicit(accuracy=5e-3))
    whole, parts = (Simulation(scene, device=device, starts=window("free", device)) for _ in range(2))
    whole.advance(5e-4)
    for until in np.arange(1, 6) * 1e-4 + 1e-7:
        parts.advance(until - 1e-7)
        parts.advance(until)
    assert parts.steps[0] < whole.steps[0] + 5 * 14
    assert distance(parts, whole) < SHARE * 5e-3 * 0.5


@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_steps_do_not_depend_on_the_order_of_unequal_flagella(stepper, device, precision):
    """Each is judged by the one that errs most, and where that is round-off by the one that has most of it."""
    values = {**controlled(stepper, 1e-3, precision), "numerics.on_accuracy": "warn"}
    values |= {"steric.enabled": False, "body.contact": False}
    found = []
    for first, second in ((3.0, 0.6), (0.6, 3.0)):
        lengths = {"flagellum.0.length": first, "flagellum.1.length": second}
        found.append(Simulation(cell({**values, **lengths}, precision), device=device))
        found[-1].advance(5e-5)
    assert found[0].steps[0] == pytest.approx(found[1].steps[0], rel=0.05)
