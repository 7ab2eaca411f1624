"""The switches of a scene: each takes out its own term and nothing else. In short runs and at single shapes."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.helpers import anchors, as_start, attachment, cell, evaluated, matrix, shaken, touching_cell
from tests.oracles import body_gaps
from warpflag.model.geometry import InitialState, initial_state
from warpflag.run.simulation import CellState, Simulation
from warpflag.scene import Scene, with_values

# Relative difference of two ways to the same number: float64, float32.
TOLERANCE = {"float64": 1e-9, "float32": 2e-3}


GENTLE = {"numerics.time_step": 2e-6}  # for starts that are not at rest


@pytest.fixture(params=["rkc", "implicit"])
def stepper(request: pytest.FixtureRequest) -> dict[str, str]:
    """The motions of the body also stand in the matrix of the implicit stepper."""
    return {"numerics.stepper": request.param}


def end_of_run(scene: Scene, device: str, start: InitialState | None = None, duration: float = 5e-5) -> CellState:
    sim = Simulation(scene, device=device, starts=start)
    sim.advance(duration)
    return sim.cell_state()


def close(a: np.ndarray, b: np.ndarray, precision: str) -> bool:
    return bool(np.abs(a - b).max() <= TOLERANCE[precision] * np.abs(b).max())


@pytest.mark.parametrize(
    ("mode", "own", "other"),
    [
        ("none", False, False),
        ("within", True, False),
        ("between", False, True),
        ("all", True, True),
        ("as_printed", True, True),
        ("consistent", True, True),
    ],
)
@pytest.mark.parametrize("flagellum", [0, 1])
def test_hydrodynamic_modes_couple_the_nodes_they_name(mode, own, other, flagellum, device, precision):
    """Stretching the last segment of one flagellum changes the forces on its last two nodes: who else feels it?"""
    scene = cell({"hydrodynamics.mode": mode, "flagella.segment_length": 0.1, "steric.enabled": False}, precision)
    start = initial_state(scene)
    nodes = [x.copy() for x in start.positions]
    nodes[flagellum][-1] += 0.02 * (nodes[flagellum][-1] - nodes[flagellum][-2])
    stretched = dataclasses.replace(start, positions=tuple(nodes))
    before, after = (evaluated(scene, shape, device).velocities for shape in (start, stretched))
    change = np.split(np.linalg.norm(after - before, axis=1), anchors(scene)[1:])
    assert change[flagellum][-1] > 1.0  # the end itself [um/s]
    # A mode that leaves a pair out does so to the last bit.
    expected = (own, change[flagellum][1:-4]), (other, change[1 - flagellum][1:])
    for coupled, changes in expected:
        assert (changes > 0).all() if coupled else (changes == 0).all()


def test_pair_radius_is_the_filaments_as_printed_and_larger_otherwise(device):
    radii = {}
    for mode in ("as_printed", "all"):
        sim = Simulation(cell({"hydrodynamics.mode": mode}), device=device)
        radii[mode] = sim.system.model.data.pairs.radius.numpy()[0]
    assert radii["as_printed"] == 0.010
    assert np.isclose(radii["all"], 2.8e-3 * 0.2 / (6 * np.pi * 1e-3), rtol=1e-12)
    given = Simulation(cell({"hydrodynamics.pair_radius": 0.05}), device=device)
    assert given.system.model.data.pairs.radius.numpy()[0] == 0.05


def test_steric_off_leaves_flagella_without_contact_forces(device, precision):
    on = touching_cell(precision=precision)
    off = with_values(on, {"steric.enabled": False})
    start = initial_state(on)
    with_contact, without = (evaluated(scene, start, device).forces for scene in (on, off))
    assert np.abs(with_contact - without).max() > 1.0  # pN
    # On opposite sides of the body there is nothing to switch off.
    on_far, off_far = cell(precision=precision), cell({"steric.enabled": False}, precision)
    apart, apart_without = (evaluated(scene, initial_state(on_far), device).forces for scene in (on_far, off_far))
    assert np.array_equal(apart, apart_without)
    ends = [end_of_run(scene, device) for scene in (on, off)]
    assert ends[0].steric_force > 1.0
    assert ends[1].steric_force == 0.0


def test_body_contact_pushes_nodes_out_and_can_be_switched_off(device, precision):
    on = cell({"steric.enabled": False}, precision)
    off = with_values(on, {"body.contact": False})
    start = initial_state(on)
    nodes = [x.copy() for x in start.positions]
    nodes[0][4] = [0.0, 0.405, 0.2]  # 5 nm from the surface
    start = dataclasses.replace(start, positions=tuple(nodes))
    push = evaluated(on, start, device).forces - evaluated(off, start, device).forces
    gaps = body_gaps(on, start, start.positions[0])
    assert np.isclose(gaps[4], 0.005)
    # Straight out at that node, by the linear law: 155.4 pN + 7.424e4 pN/um (0.028 um - gap).
    expected = np.array([0.0, 155.4 + 7.424e4 * (0.028 - 0.005), 0.0])
    assert np.abs(push[4] - expected).max() < 2e-3 * expected[1]
    untouched = np.concatenate([np.full(1, np.inf), *(body_gaps(on, start, x[1:]) for x in start.positions)])
    untouched = np.insert(untouched, len(nodes[0]), np.inf) > 0.045
    assert untouched.sum() > 15
    assert np.array_equal(push[untouched], np.zeros((untouched.sum(), 3)))


def test_body_without_translation_stays_and_turns(stepper, device, precision):
    free, held = (end_of_run(cell({"body.translation": on, **stepper}, precision), device) for on in (True, False))
    assert np.linalg.norm(free.body_position) > 1e-3
    assert np.array_equal(held.body_position, np.zeros(3))
    assert abs(held.body_angle) > 1e-2
    assert abs(held.body_orientation[3]) < 1 - 1e-6


def test_body_without_axial_rotation_tumbles_but_does_not_spin(stepper, device, precision):
    scene = cell({"body.axial_rotation": False, **GENTLE, **stepper}, precision)
    sim = Simulation(scene, device=device, starts=shaken(scene, seed=3, node=0.001))
    for step in range(1, 6):
        sim.advance(step * 1e-5)
        found = sim.evaluate()
        axis = matrix(sim.cell_state().body_orientation)[:, 2]
        assert abs(found.body_spin @ axis) < 1e-5 * np.linalg.norm(found.body_spin)
        assert np.linalg.norm(found.body_spin) > 1.0
    end = sim.cell_state()
    # About the axis of the moment: over a step the turns do not commute.
    assert abs(end.body_angle) < 1e-4 * abs(end_of_run(cell(precision=precision), device).body_angle)


def test_anchored_body_keeps_its_pose_to_the_last_bit_while_the_motors_turn(stepper, device, precision):
    scene = cell({"body.anchored": True, **GENTLE, **stepper}, precision)
    start = shaken(scene, seed=4, node=0.001)
    end = end_of_run(scene, device, start)
    assert np.array_equal(end.body_position, start.body_position)
    assert np.allclose(end.body_orientation, start.body_orientation, rtol=0, atol=1e-15)
    assert end.body_angle == 0.0
    assert (end.motor_angle > 0.1).all()
    roots = anchors(scene)
    begin = np.concatenate(start.positions)
    assert np.abs(end.positions[roots] - begin[roots]).max() < {"float64": 1e-14, "float32": 1e-6}[precision]


def test_bearing_torque_is_what_the_body_gets_across_the_motor_axis(device, precision):
    scene = cell({"flagella.count": 1, "body.contact": False, "motor.bearing_torque": False}, precision)
    sim = Simulation(scene, device=device)
    sim.advance(2e-5)
    state, paper = sim.cell_state(), sim.evaluate()
    (spec,) = scene.resolved_flagella()
    anchor, m = (matrix(state.body_orientation) @ v for v in attachment(scene, spec))
    # The paper's text: the force at the anchor, and -T_m m.
    expected = np.cross(anchor, paper.body_force) - spec.torque * m
    assert close(paper.body_torque, expected, precision)
    whole = evaluated(with_values(scene, {"motor.bearing_torque": True}), as_start(scene, state), device)
    bearing = whole.body_torque - paper.body_torque
    # A universal joint that transmits T_m passes on T_m tan(beta/2) across m, beta the angle of m to the filament.
    beta = np.arccos(m @ state.tangents[1])
    hook = np.linalg.norm(bearing)
    assert abs(bearing @ m) < 10 * TOLERANCE[precision] * hook
    assert np.isclose(hook, hook_moment(scene, state) * np.tan(beta / 2), rtol=TOLERANCE[precision])


def hook_moment(scene: Scene, state: CellState) -> float:
    """Moment of the hook joint [pN um]: (3C/h) times the angle from the carried director of the tripod to e1."""
    t, u = state.tangents[:2]
    a = state.directors[0] - (state.directors[0] @ u) / (1 + t @ u) * (t + u)
    twist = np.arctan2(np.cross(a, state.directors[1]) @ u, a @ state.directors[1])
    group = scene.flagella
    return abs(group.hook_twist_factor * group.twist_rigidity / 0.2 * twist)


def test_reversed_motors_on_mirrored_flagella_give_the_mirrored_run(stepper, device, precision):
    scene = cell({**GENTLE, **stepper}, precision)
    mirrored = with_values(scene, {"motor.torque": -3.4, "flagella.intrinsic_curvature": (0.0, 1.3, 2.1)})
    start, mirror = shaken(scene, seed=5, node=0.001, body=0.0), np.array([1.0, -1.0, 1.0])
    image = dataclasses.replace(
        start,
        positions=tuple(x * mirror for x in start.positions),
        directors=tuple(e * mirror for e in start.directors),
    )
    run, reflected = end_of_run(scene, device, start), end_of_run(mirrored, device, image)
    distance = {"float64": 1e-9, "float32": 1e-4}[precision]  # um
    assert np.abs(run.positions * mirror - reflected.positions).max() < distance
    assert np.abs(run.directors * mirror - reflected.directors).max() < 10 * distance
    assert np.abs(run.motor_angle + reflected.motor_angle).max() < 10 * distance
    assert (run.motor_angle > 0.1).all()


def test_each_flagellum_has_its_own_sense_of_rotation(stepper, device):
    end = end_of_run(cell({"flagellum.0.torque": 3.4, "flagellum.1.torque": -1.0, **stepper}), device)
    assert end.motor_angle[0] > 0.1 and end.motor_angle[1] < -0.1
