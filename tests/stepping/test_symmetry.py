"""Nothing in the model knows where the cell is, how it is turned, or left from right."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers import cell, evaluated, matrix, moved_rigidly, rotation, shaken, touching_cell
from tests.oracles import CUTOFF, contact_distances
from warpflag.model.geometry import InitialState
from warpflag.run.simulation import CellState, Simulation
from warpflag.scene import Scene, with_values

# Forces and velocities of the largest of their kind; places after a run in um, where round-off of every stage adds up.
TOLERANCE = {"float64": 1e-9, "float32": 2e-3}
PLACES = {"float64": 1e-9, "float32": 5e-5}

TURN, FAR = np.array([0.7, -1.1, 0.4]), np.array([1000.0, -600.0, 300.0])  # rad; um, some millimetre
MIRROR = np.diag([1.0, -1.0, 1.0])


FLOW = {"hydrodynamics.mode": "consistent", "hydrodynamics.body_flow": True}


def cell_in_contact(precision: str, more: dict[str, object] | None = None) -> tuple[Scene, InitialState]:
    # Explicit Euler has no stage count that could differ between the two runs; float32 would lose its tiny steps.
    stepper = {"float64": ("euler", 4e-9), "float32": ("rkc", 2e-7)}[precision]
    values = {
        "numerics.stepper": stepper[0],
        "numerics.time_step": stepper[1],
        # Out of phase: the closest points of segments that are all but parallel hang on their last digits.
        "flagellum.0.phase": 180.0,
        "flagellum.1.phase": 176.5,
        **(more or {}),
    }
    scene = touching_cell(values, precision, separation=0.06)
    start = shaken(scene, seed=14, node=0.002, spin=0.05)
    assert (contact_distances(start) < CUTOFF * 0.04).sum() > 10
    return scene, start


def run(scene: Scene, start: InitialState, device: str) -> CellState:
    sim = Simulation(scene, device=device, starts=start)
    sim.advance(4e-6)
    return sim.cell_state()


def close(found: np.ndarray, expected: np.ndarray, precision: str) -> bool:
    return bool(np.abs(found - expected).max() < TOLERANCE[precision] * np.abs(expected).max())


def mirrored(start: InitialState) -> InitialState:
    """Seen in the plane y = 0: vectors, e1 among them, by their mirror image, axes of rotation by its opposite."""
    x, y, z, w = start.body_orientation
    return InitialState(
        tuple(r @ MIRROR for r in start.positions),
        tuple(e1 @ MIRROR for e1 in start.directors),
        MIRROR @ start.body_position,
        np.array([-x, y, -z, w]),
        start.time,
    )


def mirrored_scene(scene: Scene) -> Scene:
    """Right-handed filaments and reversed motors, anchors on the other side."""
    bend_1, bend_2, twist = scene.flagella.intrinsic_curvature
    values = {f"flagellum.{k}.azimuth": -spec.azimuth for k, spec in enumerate(scene.resolved_flagella())}
    values |= {"flagella.intrinsic_curvature": (-bend_1, bend_2, -twist), "motor.torque": -scene.motor.torque}
    return with_values(scene, values)


def test_forces_and_velocities_turn_with_the_cell(precision, device):
    scene, start = cell_in_contact(precision)
    here, there = (evaluated(scene, s, device) for s in (start, moved_rigidly(start, TURN, FAR)))
    q = rotation(TURN)
    for name in ("forces", "velocities", "body_force", "body_torque", "body_velocity", "body_spin"):
        assert close(getattr(there, name), getattr(here, name) @ q.T, precision), name
    for name in ("torques", "spins"):
        assert close(getattr(there, name), getattr(here, name), precision), name


@pytest.mark.parametrize("more", [{}, FLOW])
def test_forces_and_velocities_are_mirrored(more, precision, device):
    """With flow round the body, too, whose beads have no hand."""
    scene, start = cell_in_contact(precision, more)
    right = evaluated(scene, start, device)
    left = evaluated(mirrored_scene(scene), mirrored(start), device)
    for name in ("forces", "velocities", "body_force", "body_velocity"):
        assert close(getattr(left, name), getattr(right, name) @ MIRROR, precision), name
    for name in ("body_torque", "body_spin"):  # axial vectors
        assert close(getattr(left, name), -getattr(right, name) @ MIRROR, precision), name
    for name in ("torques", "spins"):
        assert close(getattr(left, name), -getattr(right, name), precision), name


def test_run_turned_and_far_away(precision, device):
    """A millimetre from the origin, in float32 too: places are kept relative to the body."""
    scene, start = cell_in_contact(precision)
    here, there = (run(scene, s, device) for s in (start, moved_rigidly(start, TURN, FAR)))
    assert np.abs(here.positions - np.concatenate(start.positions)).max() > 0.01
    assert here.motor_angle.min() > 1.0
    q = rotation(TURN)
    for found, expected in (
        (there.positions, here.positions @ q.T + FAR),
        (there.directors, here.directors @ q.T),
        (there.motor_angle, here.motor_angle),
        (there.body_angle, here.body_angle),
        (there.body_position, q @ here.body_position + FAR),
        (matrix(there.body_orientation), q @ matrix(here.body_orientation)),
    ):
        assert np.abs(found - expected).max() < PLACES[precision]


def test_estimates_of_steps_do_not_know_how_the_cell_is_turned(precision, device):
    scene = cell({"numerics.stepper": "rkc", "numerics.time_step": 2e-6}, precision)
    start = shaken(scene, seed=5, node=0.002, spin=0.05)
    estimates = []
    for x in (start, moved_rigidly(start, np.array([0.5 * np.pi, 0.0, 0.0]), np.zeros(3))):  # y to z
        sim = Simulation(scene, device=device, starts=x)
        sim.advance(1e-5)
        estimates.append(np.array(sim.stepper.steps.achieved.total.numpy()[0]))
    assert close(*estimates, precision=precision) and estimates[0] > 0.0


@pytest.mark.parametrize("more", [{}, FLOW])
def test_mirrored_run(more, precision, device):
    scene, start = cell_in_contact(precision, more)
    left = run(scene, start, device)
    right = run(mirrored_scene(scene), mirrored(start), device)
    x, y, z, w = left.body_orientation
    for found, expected in (
        (right.positions, left.positions @ MIRROR),
        (right.directors, left.directors @ MIRROR),
        (right.motor_angle, -left.motor_angle),
        (right.body_angle, -left.body_angle),
        (right.body_orientation, np.array([-x, y, -z, w])),
    ):
        assert np.abs(found - expected).max() < PLACES[precision]
    assert left.motor_angle.min() > 1.0


def test_a_mirrored_bundle_takes_the_same_implicit_steps(precision, device):
    """Their over-implicitness follows a probe that begins at random: it has the filament's hand."""
    values = {"flagella.count": 8, "flagella.length": 3.0, "flagella.opening_angle": 0.0, "motor.axis_angle": 0.0}
    values |= {"flagella.anchor_offset": 1.2, "flagella.on_axis": True, "hydrodynamics.mode": "consistent"}
    scene = cell({**values, "numerics.stepper": "implicit", "numerics.time_step": 1e-5}, precision)
    start = shaken(scene, seed=3, node=2e-4, spin=5e-3)
    ends = []
    for s, x in ((scene, start), (mirrored_scene(scene), mirrored(start))):
        sim = Simulation(s, device=device, starts=x)
        sim.stepper.data.over_implicit.fill_(1.3)  # it falls slowly from its start value, whatever is measured
        sim.advance(5e-4)
        ends.append((sim.cell_state().positions, sim.stepper.data.over_implicit.numpy()[0]))
    (left, weight), (right, other) = ends
    assert weight > 1.8 and abs(weight - other) < TOLERANCE[precision] * weight
    assert np.abs(right - left @ MIRROR).max() < PLACES[precision]
