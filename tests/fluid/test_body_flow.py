"""Flow round the body: the shell of beads, the mobility with it, and what a run does with it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from tests.fluid.test_body import ellipsoid_drags
from tests.helpers import (
    anchors,
    as_start,
    attachment,
    cell,
    displaced,
    free_nodes,
    ground_state_frames,
    helix_axis,
    placed,
    shaken,
    tangents,
    touching_cell,
    unit,
)
from tests.oracles import (
    device_mobility,
    device_whole_mobility,
    drag_coefficients,
    energy,
    expected_pair_radius,
    slope,
    whole_mobility,
)
from tests.plans import as_on_gpu, by_elements, plan
from warpflag.model.shell import body_shell
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, SceneError, with_values

# Of the largest value of its kind.
TOLERANCE = {"float64": 1e-12, "float32": 2e-5}

ETA = 1e-3
ON = {"hydrodynamics.body_flow": True, "hydrodynamics.body_beads": 30}


@pytest.mark.parametrize("length, width, beads", [(2.5, 0.8, 30), (2.5, 0.8, 60), (2.5, 0.8, 120), (6.0, 0.8, 120)])
def test_the_shell_has_the_drags_of_the_spheroid(length, width, beads):
    """Within 0.5 %, and as little difference between the two directions across the axis; of a sphere, too."""
    shell = body_shell(length, width, beads)
    assert shell.points.shape == (beads, 3) and shell.error < 0.005
    drags = np.diagonal(shell.resistance) * 8 * math.pi * ETA
    along, across, spin, tumble = ellipsoid_drags(length, width, ETA)
    assert drags == pytest.approx([across, across, along, tumble, tumble, spin], rel=5e-3)
    ball = np.diagonal(body_shell(0.8, 0.8, 40).resistance)
    assert ball == pytest.approx([0.75 * 0.4] * 3 + [0.4**3] * 3, rel=5e-3)


@pytest.mark.parametrize("length, width, beads", [(2.5, 0.8, 60), (2.5, 0.8, 61), (0.8, 0.8, 20), (12.0, 0.8, 60)])
def test_the_shell_has_no_hand(length, width, beads):
    """Beads are their own mirror images in two planes, and a push along the axis turns nothing about it."""
    shell = body_shell(length, width, beads)
    for mirror in ((1.0, -1.0, 1.0), (1.0, 1.0, -1.0)):
        distances = np.linalg.norm(shell.points[:, None] * mirror - shell.points, axis=2)
        assert distances.min(axis=0).max() < 1e-12 and distances.min(axis=1).max() < 1e-12
    r = np.abs(shell.resistance)
    assert max(r[2, 5], r[0, 3], r[1, 4]) < 1e-12 * r[2, 2]
    separate = np.linalg.norm(shell.points[:, None] - shell.points, axis=2) + 9.0 * np.eye(beads)
    assert separate.min() > 0.6 * shell.radius


def beside(gap: float, azimuth: float, height: float, values: dict[str, Any], device: str) -> float:
    """Radial mobility of a node beside the body, not far from its equator, over that of its bead in free fluid."""
    scene = cell({"flagella.count": 1, "flagella.length": 0.4, "body.contact": False, **values})
    normal = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    place = (0.4 * math.sqrt(1 - (height / 1.25) ** 2) + gap) * normal + [0.0, 0.0, height]
    start = placed(scene, [np.array([place + 0.2 * normal, place])])
    found = [
        device_whole_mobility(
            Simulation(with_values(scene, {"hydrodynamics.body_flow": on}), device=device, starts=start)
        )
        for on in (False, True)
    ]
    change = normal @ (found[1] - found[0])[9:12, 9:12] @ normal
    return 1 + change * 6 * math.pi * ETA * expected_pair_radius(scene)


@pytest.mark.parametrize("beads, expected", [(60, (0.82, 0.85, 0.91, 0.98)), (120, (0.77, 0.81, 0.90, 0.98))])
def test_a_node_is_slow_toward_the_body(beads, expected, device):
    """At 0.06, 0.1, 0.2 and 0.5 um, the mean over places; a shell of 480 beads gives 0.65, 0.76, 0.90, 0.98."""
    values = {"hydrodynamics.body_beads": beads}
    places = [(k * math.pi * (3 - math.sqrt(5)), 0.05 * (k - 5.5)) for k in range(12)]
    for gap, value in zip((0.06, 0.1, 0.2, 0.5), expected, strict=True):
        around = np.mean([beside(gap, azimuth, height, values, device) for azimuth, height in places])
        assert around == pytest.approx(value, rel=0.03), gap


def constrained(whole: np.ndarray, held: list[int]) -> np.ndarray:
    """The mobility when some motions of the body are held: the forces that hold them are unknowns."""
    kept = np.linalg.solve(whole[np.ix_(held, held)], whole[held])
    found = whole - whole[:, held] @ kept
    found[held] = found[:, held] = 0.0
    return found


@pytest.mark.parametrize("switch", ["free", "translation", "anchored"])
def test_the_mobility_is_that_of_a_rigid_shell(switch, precision, device, monkeypatch):
    """Against a dense solution of the constraint, as on a CPU and as on a GPU; a held body obstructs the flow, too."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    values = {"translation": {"body.translation": False}, "anchored": {"body.anchored": True}}.get(switch, {})
    scene = touching_cell({**ON, "flagella.length": 1.0, "fluid.viscosity": 0.7e-3, **values}, precision)
    start = shaken(scene, seed=21, node=0.005)
    shell = body_shell(2.5, 0.8, 30)
    exact = whole_mobility(scene, start, shell.points, shell.radius)
    if switch != "free":
        exact = constrained(exact, [0, 1, 2] if switch == "translation" else list(range(6)))
    own = plan(scene, device)
    for form in (own, by_elements(own), as_on_gpu(own)):
        found = device_whole_mobility(Simulation(scene, plan=form, starts=start))
        for part in (slice(0, 3), slice(3, 6), slice(6, None)):
            expected = exact[part]
            assert np.abs(found[part] - expected).max() <= 10 * TOLERANCE[precision] * max(
                np.abs(exact[part]).max(), 1e-9
            )
    without = device_mobility(
        Simulation(with_values(scene, {"hydrodynamics.body_flow": False}), plan=None, device=device, starts=start)
    )
    assert np.abs(exact[6:, 6:] - without).max() > 0.01 * np.abs(without).max()


def hairpin(scene: Scene) -> Any:
    """Two flagella that go out, turn and come back beside themselves and each other, along the body."""
    nodes = []
    for k, spec in enumerate(scene.resolved_flagella()):
        anchor, h = attachment(scene, spec)[0], spec.segment_length
        out = spec.segment_count // 2
        steps = np.minimum(np.arange(1, spec.segment_count + 1), 2 * out - np.arange(1, spec.segment_count + 1) + 1)
        x = anchor + h * steps[:, None] * np.array([0.0, 0.0, 1.0])
        x[out:, 1] += 0.04
        x[:, 0] += 0.02 + 0.005 * k
        nodes.append(x)
    return placed(scene, nodes)


@pytest.mark.parametrize("mode", ["all", "consistent"])
@pytest.mark.parametrize("state", ["random", "in contact", "hairpin", "mixed mesh"])
def test_the_whole_mobility_is_symmetric_and_positive_definite(state, mode, device):
    """examples/hydrodynamics has the same for a thousand states."""
    values = {**ON, "hydrodynamics.mode": mode, "body.contact": False}
    if state == "mixed mesh":
        values |= {"flagellum.0.segments": 5, "flagellum.1.segments": 20, "flagella.length": 1.0}
    scene = touching_cell({"flagella.length": 1.4, **values}, separation=0.03)
    start = (
        hairpin(scene) if state == "hairpin" else shaken(scene, 5, node=0.5 if state == "random" else 0.01, spin=0.0)
    )
    found = device_whole_mobility(Simulation(scene, device=device, starts=start))
    # Spins of the body in um: of its size.
    assert np.abs(found - found.T).max() < 1e-11 * np.abs(found).max()
    assert np.linalg.eigvalsh((found + found.T) / 2).min() > 0.0


def test_swimmer_is_free_and_its_power_goes_into_the_fluid(precision, device):
    """Net force and torque vanish; motor power is v.M^-1.v with a dense mobility, and the stored energy."""
    scene = touching_cell({**ON, "flagella.length": 1.4, "motor.torque": 5.0, "numerics.time_step": 1e-6}, precision)
    sim = Simulation(scene, device=device, starts=shaken(scene, 6, node=5e-4, spin=0.02))
    start = shaken(scene, 6, node=5e-4, spin=0.02)
    found = sim.evaluate()
    nodes, first = free_nodes(scene), anchors(scene)
    arms, t = np.concatenate(start.positions) - start.body_position, np.concatenate(tangents(scene, start))
    torques = [np.cross(arms[nodes], found.forces[nodes]), found.torques[:, None] * t, found.body_torque]
    for vectors in (np.vstack([found.forces[nodes], found.body_force]), np.vstack(torques)):
        size = np.linalg.norm(vectors, axis=1).sum()
        assert np.abs(vectors.sum(axis=0)).max() < {"float64": 1e-12, "float32": 1e-6}[precision] * size
    shell = body_shell(2.5, 0.8, 30)
    moved = np.concatenate([found.body_velocity, found.body_spin, found.velocities[nodes].ravel()])
    dissipated = moved @ np.linalg.solve(whole_mobility(scene, start, shell.points, shell.radius), moved)
    h = np.repeat([spec.segment_length for spec in scene.resolved_flagella()], [len(x) for x in start.positions])
    dissipated += drag_coefficients(scene)[2] * h @ found.spins**2
    power = 5.0 * (found.spins[first] - t[first] @ found.body_spin).sum()
    step = 1e-5 / max(np.abs(found.velocities).max(), np.abs(found.spins).max())

    def at(time: float) -> float:
        motion = (found.velocities, found.spins, found.body_velocity, found.body_spin)
        return energy(scene, displaced(scene, start, *(time * rate for rate in motion)))

    assert abs(power - dissipated - slope(at, step)) < {"float64": 1e-7, "float32": 1e-4}[precision] * dissipated


def swimming(scene: Scene, device: str) -> tuple[float, float, float]:
    """Speed ahead [um/s], body and motor rate [Hz], this relative to the body, of a rigid flagellum in its ground state
    that turns about the body's axis; it begins at the pole, off the axis."""
    spec = scene.resolved_flagella()[0]
    h, count = spec.segment_length, spec.segment_count
    frames = ground_state_frames(count, h, scene.flagella.intrinsic_curvature)
    x = np.vstack([np.zeros(3), np.cumsum(h * frames[:, :, 2], axis=0)])
    axis, point = helix_axis(x)
    side = unit(np.cross(axis, np.eye(3)[0]))
    x = (x - point) @ np.stack([side, np.cross(axis, side), axis], axis=1)
    x[:, 2] += scene.body.length / 2 - x[0, 2]
    mobility = device_whole_mobility(Simulation(scene, device=device, starts=placed(scene, [x[1:]])))
    t, x = np.diff(x, axis=0) / h, x[1:]
    turn = [np.cross(e, x).ravel() for e in np.eye(3)]
    # Motions: velocity and spin of the body, and the motor's turn.
    motion = np.zeros((6 + x.size, 7))
    motion[:6, :6], motion[6:, :3] = np.eye(6), np.tile(np.eye(3), (count, 1))
    motion[6:, 3:6], motion[6:, 6] = np.stack(turn, axis=1), turn[2]
    spins = np.hstack([np.zeros((count, 3)), t, t[:, 2:]])
    resistance = motion.T @ np.linalg.solve(mobility, motion)
    resistance += drag_coefficients(scene)[2] * h * spins.T @ spins
    found = np.linalg.solve(resistance, np.append(np.zeros(6), spec.torque))
    return -found[2], found[5] / (2 * math.pi), found[6] / (2 * math.pi)


def test_a_coaxial_flagellum_swims_slower_in_the_wake_of_its_body(device):
    """A rigid helix of 6 um, 0.38 pN um: 18.1 um/s, -16.2 and 122 Hz without flow round the body; 16.0, -15.9 and 120
    with it."""
    values = {"flagella.count": 1, "flagella.length": 6.0, "motor.torque": 0.38, "flagella.anchor_offset": 1.25}
    expected = {False: (18.1, -16.2, 122.1), True: (16.0, -15.9, 119.9)}
    for on, (speed, body, motor) in expected.items():
        found = swimming(cell({**values, "hydrodynamics.body_flow": on}), device)
        assert found == (pytest.approx(speed, abs=0.2), pytest.approx(body, abs=0.1), pytest.approx(motor, abs=1.0))


@pytest.mark.parametrize("hook", [{}, {"hook.length": 0.055, "hook.stiffness": 0.65}], ids=["", "hook"])
def test_second_order_and_the_same_solution_as_the_explicit_stepper(hook, device):
    """In contact with the body and each other, 0.2 ms after the motors start."""
    scene = touching_cell({**ON, **hook, "numerics.stepper": "implicit", "motor.torque": 1.0})
    begun = Simulation(scene, device=device)
    begun.advance(2e-4)
    assert begun.state.steric_force > 0.1
    start = replace(as_start(scene, begun.state), time=0.0)

    def reached(values: dict[str, Any]) -> np.ndarray:
        sim = Simulation(with_values(scene, values), device=device, starts=start)
        sim.advance(2e-4)
        return sim.state.positions

    exact = reached({"numerics.stepper": "rkc", "numerics.time_step": 1e-6})
    steps = (5e-6, 1e-5, 2e-5)
    errors = [np.linalg.norm(reached({"numerics.time_step": step}) - exact, axis=1).max() for step in steps]
    assert errors[0] < 2e-4
    assert 1.6 < np.polyfit(np.log(steps), np.log(errors), 1)[0] < 2.4, errors


def test_cells_of_a_batch_have_each_its_own_body(device):
    """Bodies of two shapes and two numbers of beads, three cells: as alone, to the last bit."""
    common = {"flagella.length": 1.0, "hydrodynamics.body_flow": True, "numerics.stepper": "implicit"}
    own = (
        {"hydrodynamics.body_beads": 30},
        {"hydrodynamics.body_beads": 20, "body.length": 2.0},
        {"hydrodynamics.body_beads": 30},
    )
    scenes = [cell({**common, **values}) for values in own]
    batch = Simulation(scenes, device=device, strict=True)
    batch.advance(1e-5)
    for c in (1, 2):
        single = Simulation(scenes[c], device=device, strict=True)
        single.advance(1e-5)
        assert np.array_equal(single.state.positions, batch.cell_state(c).positions), c


@pytest.mark.parametrize("mode", ["none", "within", "between", "as_printed"])
def test_it_needs_a_mobility_that_is_positive_definite(mode):
    with pytest.raises(SceneError, match=r"hydrodynamics\.body_flow.*needs hydrodynamics\.mode all or consistent"):
        cell({"hydrodynamics.body_flow": True, "hydrodynamics.mode": mode})


def test_off_nothing_is_allocated(device):
    sim = Simulation(cell(), device=device)
    assert sim.system.state.shell.x is None and sim.system.model.data.body.shell_mobility is None
    assert sim.system.model.shells is None and sim.system.model.data.body.mobility_along is not None
    on = Simulation(cell(ON), device=device)
    assert on.system.state.shell.x is not None and on.system.model.data.body.mobility_along is None
