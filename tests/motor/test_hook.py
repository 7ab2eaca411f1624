"""The hook: its forces are the gradient of its energy, its stiffness in the matrix, every stepper, and where it stands.

Net force, torque and power with a hook: `tests.stepping.test_balance`.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from warpflag_kernels.implicit import linearised

from tests.bench import Bench
from tests.helpers import (
    anchors,
    as_start,
    attachment,
    cell,
    displaced,
    evaluated,
    free_nodes,
    matrix,
    shaken,
    tangents,
)
from tests.oracles import body_gaps, elastic_energies, energy_gradient, hook_bending
from warpflag.model.geometry import InitialState, initial_state
from warpflag.run.simulation import Simulation
from warpflag.scene import SceneError, with_values

# Of the largest force, torque or second derivative of its kind.
TOLERANCE = {"float64": 1e-7, "float32": 2e-3}
HOOK = {"hook.length": 0.055, "hook.stiffness": 0.65}
SCENES = {
    "hook": HOOK,
    "stiffening": {**HOOK, "hook.stiffening_torque": 0.5, "flagellum.1.torque": -1.7},
    "on a cap, sharply bent": {**HOOK, "flagellum.0.anchor_offset": 1.1, "flagellum.1.motor_axis_angle": 170.0},
}


@pytest.mark.parametrize("values", SCENES.values(), ids=SCENES)
def test_forces_and_torques_are_the_energy_gradient(values, precision, device):
    scene = cell(values, precision)
    start = shaken(scene, seed=1)
    bending = sum(
        hook_bending(scene, spec, t, e1)
        for spec, t, e1 in zip(scene.resolved_flagella(), tangents(scene, start), start.directors, strict=True)
    )
    assert bending > 0.01
    expected = energy_gradient(scene, start, lambda *at: elastic_energies(*at).sum())
    sim = Simulation(scene, device=device, starts=start)
    found = sim.evaluate()
    motor = np.array([spec.torque for spec in scene.resolved_flagella()])
    torques = found.torques.copy()
    torques[anchors(scene)] -= motor
    reaction = motor @ np.array([t[0] for t in tangents(scene, start)])
    for value, exact, scale in (
        (found.forces[free_nodes(scene)], expected.forces[free_nodes(scene)], np.abs(expected.forces).max()),
        (torques, expected.torques, np.abs(expected.torques).max()),
        (found.body_force, expected.body_force, np.abs(found.forces).max()),
        (found.body_torque + reaction, expected.body_torque, np.abs(found.forces).max()),
        (sim.cell_state().elastic_energy, elastic_energies(scene, start), elastic_energies(scene, start).sum()),
    ):
        assert np.abs(value - exact).max() < TOLERANCE[precision] * scale


def hook_part(values, precision, device):
    """A bench, and a function: x . H x of the hooks alone, for an increment (body, nodes)."""
    benches = []
    for stiffness in (0.65, 0.0):
        scene = cell({"flagella.length": 1.0, "hook.length": 0.055, **values, "hook.stiffness": stiffness}, precision)
        b = Bench(scene, initial_state(scene), device)
        linearised.set_stiffness(b.model, b.state, b.stepper.stiffness)
        benches.append(b)

    def square(body, nodes):
        total = 0.0
        for sign, b in zip((1, -1), benches, strict=True):
            on_body, forces, torques = b.force_change(body, nodes)
            forces[b.first] = 0.0
            total -= sign * (on_body @ body + np.sum(forces * nodes[:, :3]) + torques @ nodes[:, 3])
        return total

    return benches[0], square


def increments(b, count=5):
    random = np.random.default_rng(3)
    for _ in range(count):
        nodes = np.zeros((b.count, 4))
        rows = np.concatenate([b.first, b.first + 1])
        nodes[rows] = random.uniform(-1, 1, (len(rows), 4)) * [0.1, 0.1, 0.1, 1.0]
        nodes[b.first, :3] = 0.0
        yield random.uniform(-1, 1, 6) * [0.1, 0.1, 0.1, 1.0, 1.0, 1.0], nodes


def test_stiffness_in_the_matrix_is_the_second_derivative_of_the_energy(precision, device):
    """With the helix axis on the motor axis, where the energy is zero, exactly that."""
    values = {"motor.axis_angle": 45.0, "steric.enabled": False, "body.contact": False}
    b, square = hook_part(values, precision, device)

    def energy(start):
        return sum(
            hook_bending(b.scene, spec, t, e1)
            for spec, t, e1 in zip(b.scene.resolved_flagella(), tangents(b.scene, start), start.directors, strict=True)
        )

    start, step = initial_state(b.scene), 2e-4
    assert energy(start) < 1e-12
    for body, nodes in increments(b):
        moved = [displaced(b.scene, start, s * nodes[:, :3], s * nodes[:, 3], s * body[:3], s * body[3:])
                 for s in (step, -step)]  # fmt: skip
        exact = sum(map(energy, moved)) / step**2
        assert abs(square(body, nodes) - exact) < {"float64": 1e-5, "float32": 1e-2}[precision] * exact


@pytest.mark.parametrize("angle", [0.0, 80.0, 110.0, 170.0])
def test_stiffness_in_the_matrix_is_never_negative(angle, device):
    b, square = hook_part(
        {"flagella.opening_angle": 0.0, "motor.axis_angle": angle, "body.contact": False}, "float64", device
    )
    found = [square(*x) for x in increments(b)]
    assert min(found) > 0.01


@pytest.mark.parametrize("stiffness", [0.65, 50.0])
def test_steppers_agree_and_steps_are_of_second_order(stiffness, device):
    """Over 100 us, from 100 us after the motors start; the stiff hook relaxes within nanoseconds."""
    values = {"hook.length": 0.055, "hook.stiffness": stiffness, "flagella.length": 1.0, "body.contact": False}
    scene = cell({**values, "motor.torque": 1.0, "flagella.segment_length": 0.25, "steric.enabled": False})

    def end(start: InitialState | None, stepper: str, step: float) -> InitialState:
        own = with_values(scene, {"numerics.stepper": stepper, "numerics.time_step": step})
        sim = Simulation(own, device=device, starts=start)
        sim.advance(1e-4)
        return dataclasses.replace(as_start(scene, sim.cell_state()), time=0.0)

    def apart(a: InitialState, b: InitialState) -> float:
        return float(np.abs(np.concatenate(a.positions) - np.concatenate(b.positions)).max())

    start = end(None, "rkc", 2e-7)
    exact = end(start, "rkc", 1e-7)
    found = [apart(end(start, "implicit", step), exact) for step in (4e-6, 2e-6, 1e-6)]
    assert found[2] < 1e-3 * apart(start, exact)
    slope = np.polyfit(np.log([4.0, 2.0, 1.0]), np.log(found), 1)[0]
    assert 1.8 < slope < 2.2, found


def test_r_0_stands_at_the_end_of_the_hook_and_turns_with_the_body(precision, device):
    scene = cell({"hook.length": 0.3, "flagellum.0.anchor_offset": -1.2, "flagellum.0.motor_axis_angle": 130.0})
    scene = with_values(scene, {"numerics.precision": precision, "numerics.stepper": "implicit"})
    sim = Simulation(scene, device=device)
    sim.advance(2e-4)
    found = evaluated(scene, initial_state(scene), device)
    start = as_start(scene, sim.cell_state())
    assert np.abs(sim.cell_state().body_orientation[:3]).max() > 1e-3
    turn = matrix(start.body_orientation)
    for spec, nodes, first in zip(scene.resolved_flagella(), start.positions, found.first, strict=True):
        anchor, m = attachment(scene, spec)
        assert nodes[0] == pytest.approx(start.body_position + turn @ anchor, abs=1e-6)
        on_surface = (nodes[0] - 0.3 * turn @ m)[None]
        assert body_gaps(scene, start, on_surface) == pytest.approx([0.0], abs=1e-6)
        assert found.tangents[first] == pytest.approx(m, abs=1e-6)


@pytest.mark.parametrize("h", [0.4, 0.2, 0.05])
@pytest.mark.parametrize("on_axis", [False, True])
def test_at_rest_the_hook_is_straight_where_helix_and_motor_axis_agree(on_axis, h, device):
    values = {**HOOK, "motor.axis_angle": 30.0, "flagella.opening_angle": 60.0, "flagella.on_axis": on_axis}
    scene = cell({**values, "flagella.segment_length": h, "flagella.length": 4.0})
    sim = Simulation(scene, device=device)
    sim.evaluate()
    assert sim.cell_state().elastic_energy.sum() < 1e-24


@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_a_hook_stiffens_by_the_torque_of_the_law_and_a_stopped_run_goes_on_with_the_same_bits(stepper, device):
    law = {"motor.law": "torque_speed", "motor.torque": 1.26, "motor.knee": 50.0, "motor.no_load": 200.0}
    scene = cell({**HOOK, **law, "hook.stiffening_torque": 0.5, "numerics.stepper": stepper})
    whole, first, second = (Simulation(scene, device=device, strict=True) for _ in range(3))
    for time in (1e-3, 1.2e-3):
        whole.advance(time)
    torques = whole.system.state.optional.motor.on_hook.numpy()
    assert np.abs(torques - whole.evaluate().motor_torques).max() < 0.02 < 0.3 < np.abs(torques - 1.26).max()
    first.advance(1e-3)
    second.restore(first.checkpoint())
    second.advance(1.2e-3)
    assert np.array_equal(second.state.positions, whole.state.positions)


def test_a_member_of_a_batch_has_the_hook_and_the_motors_of_its_own_scene(device):
    law = {"motor.law": "torque_speed", "numerics.stepper": "implicit", **HOOK}
    first = {"motor.torque": 1.26, "motor.knee": 50.0, "motor.no_load": 200.0, "hook.stiffening_torque": 0.5}
    other = {"motor.torque": 1.0, "motor.knee": 20.0, "motor.no_load": 90.0, "hook.stiffening_torque": 0.1}
    scenes = [cell({**law, **first}), cell({**law, **other, "hook.stiffness": 0.4, "hook.length": 0.08})]
    batch = Simulation(scenes, device=device, strict=True)
    batch.advance(1e-4)
    for c, scene in enumerate(scenes):
        alone = Simulation(scene, device=device, strict=True)
        alone.advance(1e-4)
        assert np.array_equal(batch.cell_state(c).positions, alone.state.positions)


def test_nonsense_is_refused_by_name():
    for values, key in (
        ({"hook.stiffness": 1.0, "motor.bearing_torque": False}, "hook.stiffness"),
        ({"hook.stiffening_torque": 1.0}, "hook.stiffening_torque"),
        ({"hook.length": -0.1}, "hook.length"),
    ):
        with pytest.raises(SceneError, match=key):
            cell(values)


def test_without_stiffness_nothing_is_allocated_and_the_terms_are_those_of_before(device):
    bare = Simulation(cell({"hook.length": 0.055}), device=device).system.model
    assert bare.data.hook is None and "hook" not in [term.name for term in bare.terms]
    assert "hook" in [term.name for term in Simulation(cell(HOOK), device=device).system.model.terms]
    constant = Simulation(cell({**HOOK, "hook.stiffening_torque": 0.5}), device=device)
    assert constant.system.state.data.motor is None
