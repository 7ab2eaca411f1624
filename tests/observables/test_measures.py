"""Shape, contact and power of constructed cells, and the measures on a record."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from tests.helpers import as_start, displaced, evaluated, rotation, touching_cell
from tests.oracles import energy, slope
from tests.shapes import Zipping, bent_helix, helix, joined, line
from warpflag import observables
from warpflag.model.geometry import initial_state
from warpflag.observables import recorded
from warpflag.record import Record
from warpflag.record.recorder import Recorder
from warpflag.run.simulation import Simulation
from warpflag.scene import paper_scene, with_values

TURN = rotation([0.4, -1.0, 0.3])


def arrays(start):
    return np.concatenate(start.positions), np.concatenate(start.directors)


# Shape


def test_strain_of_the_ground_state_is_the_intrinsic_one():
    scene = paper_scene(name="rest")
    start = initial_state(scene)
    for nodes, directors in zip(start.positions, start.directors, strict=True):
        omega = observables.strain(observables.segment_tangents(nodes), directors[1:], 0.2)
        np.testing.assert_allclose(omega, np.tile([0.0, 1.3, -2.1], (29, 1)), atol=1e-12)


def test_strain_of_a_ring_is_its_curvature_and_of_a_spun_line_its_twist():
    angle = 2 * np.pi * np.arange(201) / 200
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1) * 0.5
    across = np.tile([0.0, 0.0, 1.0], (200, 1))
    omega = observables.strain(observables.segment_tangents(ring), across, np.pi / 200)
    np.testing.assert_allclose(np.linalg.norm(omega[:, :2], axis=1), 2.0, rtol=1e-3)
    np.testing.assert_allclose(omega[:, 2], 0.0, atol=1e-9)

    spin = 0.3 * np.arange(20)
    directors = np.stack([np.cos(spin), np.sin(spin), 0 * spin], axis=-1)
    omega = observables.strain(np.tile([0.0, 0.0, 1.0], (20, 1)), directors, 0.2)
    np.testing.assert_allclose(omega, np.tile([0.0, 0.0, 1.5], (19, 1)), atol=1e-12)


def test_elastic_energy_by_term():
    """At rest none; stretched by 1 % K L/2 1e-4; the hook twisted by 0.2 rad 3 C/(2 h) 0.04; spun joint by joint."""
    scene = paper_scene(name="rest")
    positions, directors = arrays(initial_state(scene))
    axes, first_node = observables.motor_axes(scene), np.array([0, 31, 62])

    def energies(scene, positions, directors):
        return observables.elastic_energy(scene, positions, directors, axes, first_node)

    np.testing.assert_allclose(energies(scene, positions, directors), 0.0, atol=1e-9)
    stretched = np.concatenate([nodes[0] + 1.01 * (nodes - nodes[0]) for nodes in np.split(positions, 2)])
    np.testing.assert_allclose(energies(scene, stretched, directors), [0, 0, 2 * 1000 * 6 / 2 * 1e-4], atol=1e-9)

    twisted = directors.copy()
    twisted[0] = rotation(0.2 * axes[0]) @ directors[0]
    np.testing.assert_allclose(energies(scene, positions, twisted), [0, 3 * 3.5 / 0.4 * 0.04, 0], atol=1e-9)

    bare = with_values(scene, {"flagella.count": 1, "flagella.intrinsic_curvature": (0.0, 0.0, 0.0)})
    angle = 0.2 * np.arange(31) / 2.0
    ring = 2.0 * np.stack([np.sin(angle), 0 * angle, 1 - np.cos(angle)], axis=-1)
    e1 = np.tile([0.0, 1.0, 0.0], (31, 1))
    axis = observables.segment_tangents(ring)[:1]
    found = observables.elastic_energy(bare, ring, e1, axis, first_node[:2])
    np.testing.assert_allclose(found[:2], [3.5 / 2 * 0.2 * 29 / 2.0**2, 0.0], rtol=2e-3, atol=1e-12)


def test_a_hook_stiffens_alike_under_both_senses_of_the_torque():
    """By 1 + |T_m|/T_s: bent, it stores 1.75 times as much at 1.5 pN um and T_s = 2 pN um as without stiffening."""
    scene = with_values(paper_scene(name="hook"), {"hook.stiffness": 0.65, "motor.axis_angle": 55.0})
    positions, directors = arrays(initial_state(scene))
    axes, first_node = observables.motor_axes(scene), np.array([0, 31, 62])
    stored = [
        observables.elastic_energy(with_values(scene, values), positions, directors, axes, first_node)[0]
        for values in ({}, *({"hook.stiffening_torque": 2.0, "motor.torque": t} for t in (1.5, -1.5)))
    ]
    assert stored[0] > 1e-3
    np.testing.assert_allclose(stored, stored[0] * np.array([1.0, 1.75, 1.75]), rtol=1e-9)


def test_force_density_is_over_the_mean_length_of_the_flagella(tmp_path):
    densities = []
    for k, values in enumerate(({}, {"flagellum.0.length": 4.0, "flagellum.1.length": 5.0})):
        (tmp_path / f"{k}").mkdir()
        made = Zipping(tmp_path / f"{k}", values={"steric.diameter": 0.4, **values})
        with Record(made.directory) as record:
            densities.append(recorded.steric_force_densities(record)[-1])
    assert 4.5 * densities[1] == pytest.approx(6.0 * densities[0], rel=1e-12) and densities[0] > 0.0


@pytest.mark.parametrize("handedness", [-1, 1])
def test_axis_and_pitch_of_a_helix_anywhere(handedness):
    nodes, _ = helix(31, pitch=2.0, handedness=handedness)
    moved = nodes @ TURN.T + [5.0, -3.0, 2.0]
    axis = observables.helix_axis(observables.segment_tangents(moved))
    np.testing.assert_allclose(axis, TURN @ [0.0, 0.0, 1.0], atol=1e-9)
    assert observables.helix_pitch(moved) == pytest.approx(2.0 * handedness)


def test_wave_runs_from_the_motor_for_a_left_handed_helix_that_turns_positive():
    """The crest of the turning helix is seen to move."""
    before, _ = helix(2001, h=0.002)
    after, _ = helix(2001, h=0.002, phase=2 * np.pi * 0.05)
    crests = [nodes[np.argmax(nodes[400:1400, 0]) + 400, 2] for nodes in (before, after)]
    moved = crests[1] - crests[0]
    assert moved == pytest.approx(0.05 * 2.14, abs=4e-3)
    assert observables.phase_velocity(observables.helix_pitch(before), 0.05) == pytest.approx(moved, abs=4e-3)


def test_helix_rate_of_turning_precessing_and_swimming_helices():
    """Two helices that turn at 700 and -400 Hz about axes that themselves turn about another one at 20 Hz."""
    times = 5e-5 * np.arange(81)
    frames = []
    for t in times:
        precessed = rotation([0.0, 2 * np.pi * 20 * t, 0.0]) @ TURN
        pair = [helix(31, phase=2 * np.pi * rate * t)[0] @ precessed.T + 100.0 * t for rate in (700.0, -400.0)]
        frames.append(np.concatenate(pair))
    # Turning about the axis comes on top of the precession's share along it.
    share = 20.0 * (TURN @ [0.0, 0.0, 1.0])[1]
    rates = observables.helix_rate(times, np.array(frames), np.array([0, 31, 62]))
    np.testing.assert_allclose(rates, [700.0 + share, -400.0 + share], rtol=2e-3)


def test_helix_rate_is_exact_of_an_axis_that_sweeps_fast():
    """20 degrees a frame in a plane, which is the minimal rotation of the axis, and 40 about itself."""
    frames = []
    for k in range(12):
        swept = rotation([0.0, np.radians(20.0 * k), 0.0])
        frames.append(helix(31, phase=np.radians(40.0 * k))[0] @ swept.T)
    rates = observables.helix_rate(1e-3 * np.arange(12), np.array(frames), np.array([0, 31]))
    np.testing.assert_allclose(rates, 40.0 / 360.0 / 1e-3, rtol=1e-6)


@pytest.mark.parametrize(("bend", "tolerance"), [(20.0, 1e-3), (5.0, 3e-3), (3.0, 1e-2)])
def test_helix_rate_of_a_bent_helix_is_that_about_its_bent_axis(bend, tolerance):
    """One rotation fitted to all tangents, whose axes fan out over 100 degrees at a bend of 3 um, would be 38 % low."""
    times = 2e-4 * np.arange(101)
    bounds = np.array([0, 31, 70])
    frames = []
    for t in times:
        pair = [bent_helix(31, bend=bend, phase=2 * np.pi * 110.0 * t), bent_helix(39, bend=bend, phase=-500.0 * t)]
        frames.append(np.concatenate(pair) @ TURN.T + 50.0 * t)
    rates = observables.helix_rate(times, np.array(frames), bounds)
    np.testing.assert_allclose(rates, [110.0, -500.0 / (2 * np.pi)], rtol=tolerance)


def test_helix_rate_of_less_than_a_turn_and_of_a_line():
    times = 1e-4 * np.arange(21)
    short = np.array([helix(8, phase=2 * np.pi * 300.0 * t)[0] for t in times])
    np.testing.assert_allclose(observables.helix_rate(times, short, np.array([0, 8])), 300.0, rtol=1e-6)
    straight = np.array([line(11) for _ in times])
    np.testing.assert_allclose(observables.helix_rate(times, straight, np.array([0, 11])), 0.0, atol=1e-9)


def test_motor_axes_and_lab_rate():
    scene = with_values(
        paper_scene(name="m"), {"motor.axis_angle": 30.0, "flagellum.1.azimuth": 90.0, "flagellum.0.tilt": 5.0}
    )
    axes = observables.motor_axes(scene)
    half, tall = 0.5, math.sqrt(3) / 2
    np.testing.assert_allclose(axes, [[half, 0, tall], [0, half, tall]], atol=1e-12)
    times = np.linspace(0.0, 1e-2, 50)
    angle = 2 * np.pi * -50.0 * times
    orientations = np.stack([0 * angle, 0 * angle, np.sin(angle / 2), np.cos(angle / 2)], axis=-1)
    rates = observables.lab_motor_rate(times, 2 * np.pi * np.outer(times, [300.0, 200.0]), orientations, axes)
    np.testing.assert_allclose(rates, [300.0 - 50.0 * tall, 200.0 - 50.0 * tall])


def test_body_power_is_that_of_its_drag_along_and_across():
    """Swimming at 45 degrees to its axis while it tumbles: along 0.010775, across 0.013343, tumble 1.2373e-2."""
    scene, times = paper_scene(name="b"), np.linspace(0.0, 1e-4, 11)
    angle = 100.0 * times  # rad, about x: the axis turns by 0.01 in all
    orientations = np.stack([np.sin(angle / 2), 0 * angle, 0 * angle, np.cos(angle / 2)], axis=-1)
    path = np.outer(times, [200.0, 0.0, 200.0])
    expected = 200.0**2 * (0.010775 + 0.013343) + 100.0**2 * 1.2373e-2
    assert observables.body_power(times, path, orientations, scene) == pytest.approx(expected, rel=1e-3)


def test_thrust_on_a_sphere_is_stokes_drag():
    sphere = with_values(paper_scene(name="s"), {"body.length": 2.0, "body.width": 2.0, "flagella.anchor_offset": 0.0})
    assert observables.thrust(25.0, sphere) == pytest.approx(6 * math.pi * 1e-3 * 1.0 * 25.0)


# Contact

LAW = {"strength": 0.8, "diameter": 0.04, "length": 6.0}


def force_at(distance):
    return 0.8 * (2 * (0.04 / distance) ** 13 - (0.04 / distance) ** 7)


def test_steric_force_law():
    found = observables.steric_force(np.array([0.04, 0.038, 0.0449, 0.02]), 0.8, 0.04)
    np.testing.assert_allclose(found, [0.8, force_at(0.038), 0.0, 155.4 + 7.424e4 * 0.008], rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize(("angle", "s", "t"), [(0.5, 0.3, 0.6), (3e-5, 0.3, 0.6), (3e-6, 0.5, 0.8)])
def test_closest_points_of_nearly_parallel_segments(angle, s, t):
    """Segments 0.04 apart whose common normal is at s = 0.3, t = 0.6; below 1e-5 rad they count as parallel."""
    along, across = np.array([0.0, 0.0, 0.2]), 0.2 * np.array([math.sin(angle), 0.0, math.cos(angle)])
    found = observables.closest_parameters(-0.3 * along, along, np.array([0.0, 0.04, 0.0]) - 0.6 * across, across)
    np.testing.assert_allclose(found, [s, t], atol=1e-5)


@pytest.mark.parametrize(("where", "count"), [("between nodes", 1), ("at a node", 2), ("at two nodes", 4)])
def test_crossed_lines_by_every_rule(where, count):
    """A contact at a vertex counts twice, where two vertices meet four times; one at mid-segment once."""
    first, second = line(11), line(11)
    second = second[:, [2, 1, 0]] - [1.0, 0.038, -1.0]  # along x, crossing at z = 1
    if where == "between nodes":
        first += [0.1, 0.0, 0.1]
    elif where == "at a node":
        first += [0.1, 0.0, 0.0]
    shape = joined(first, second)
    expected = count * force_at(0.038) / 6.0
    for rule in ("pairs", "nodes", "net"):
        assert observables.steric_force_density(*shape, **LAW, rule=rule) == pytest.approx(expected), rule


def test_opposite_contacts_cancel_in_the_net_rule_only():
    """A line between two limbs of a hairpin that press on it from both sides, at mid-segment."""
    first = line(4, h=0.2)
    hairpin = np.array([[0.1, 0.039, 0.31], [-0.1, 0.039, 0.31], [-0.1, -0.039, 0.31], [0.1, -0.039, 0.31]])
    shape = joined(first, hairpin)
    values = {rule: observables.steric_force_density(*shape, **LAW, rule=rule) for rule in ("pairs", "nodes", "net")}
    one = force_at(0.039) / 6.0
    assert values["pairs"] == pytest.approx(2 * one)
    assert values["net"] == pytest.approx(0.0, abs=1e-12)
    # The forces on the line cancel node by node; those on the hairpin do not.
    assert values["nodes"] == pytest.approx(one)


def test_forces_on_the_nodes_of_both_flagella_are_those_of_levers():
    """A single segment, pressed from above at a quarter and from below at three quarters by the middles of two others.

    Its nodes feel 3/4 - 1/4 of a force each, to either side; those of the others half a force.
    """
    far = np.array([[0.25, -2, 0.038], [0.25, 2, 0.038], [0.75, 2, -0.038], [0.75, -2, -0.038]])
    for shape in (joined(far, line(2, h=1.0)[:, [2, 1, 0]]), joined(line(2, h=1.0)[:, [2, 1, 0]], far)):
        nodes = observables.steric_force_density(*shape, **LAW, rule="nodes")
        assert nodes == pytest.approx((4 * 0.5 + 2 * 0.5) / 2 * force_at(0.038) / 6.0)


@pytest.mark.parametrize(("rule", "share"), [("pairs", 2.0), ("nodes", 2 / 3), ("net", 2 / 3)])
def test_a_line_between_two_is_pressed_by_none(rule, share):
    """Three lines in a row, crossing pairs only at the middle ones: forces on the middle line cancel."""
    apart, along = np.array([0.0, 0.038, 0.0]), line(2, h=2.0) - [0.0, 0.0, 1.0]
    across = along[:, [2, 1, 0]]
    shape = joined(across - apart, along, across + apart)
    found = observables.steric_force_density(*shape, **LAW, rule=rule)
    assert found == pytest.approx(share * force_at(0.038) / 6.0)


def test_neighbours_of_a_flagellum_with_long_segments_do_not_touch():
    """Segments longer than 3 sigma: the next one shares a node and counts for nothing, the one after it does."""
    straight = line(6, h=0.2)
    alone = (straight, np.array([0, 6]))
    assert observables.steric_force_density(*alone, **LAW, self_contact=True) == 0.0
    hairpin = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.2], [0.0, 0.038, 0.2], [0.0, 0.038, 0.0]])
    found = observables.steric_force_density(hairpin, np.array([0, 4]), **LAW, self_contact=True)
    assert found == pytest.approx(force_at(0.038) / 6.0)


def test_apart_there_is_no_force():
    shape = joined(line(11), line(11, x=0.045))
    assert observables.steric_force_density(*shape, **LAW) == 0.0


# Power


def test_power_balance_is_motor_work_dissipation_and_stored_energy():
    """In contact, turned by the motors for 10 us: what is left of their work is the growth of the energy."""
    scene = touching_cell({"numerics.time_step": 1e-6, "motor.torque": 5.0})
    simulation = Simulation(scene, device="cpu")
    simulation.advance(1e-5)
    start = as_start(scene, simulation.cell_state())
    found = evaluated(scene, start, "cpu")
    balance = observables.power_balance(found)
    turned = start.body_orientation
    matrix = rotation(2 * math.acos(min(turned[3], 1.0)) * turned[:3] / max(np.linalg.norm(turned[:3]), 1e-300))
    axes = observables.motor_axes(scene) @ matrix.T
    assert balance.supplied == {"motor": pytest.approx(5.0 * (found.spins[[0, 11]] - axes @ found.body_spin).sum())}
    assert min(balance.motor, balance.translation, balance.spin, balance.body) > 0.0

    def at(time):
        motion = (found.velocities, found.spins, found.body_velocity, found.body_spin)
        return energy(scene, displaced(scene, start, *(time * rate for rate in motion)))

    step = 1e-5 / max(np.abs(found.velocities).max(), np.abs(found.spins).max())
    assert balance.stored == pytest.approx(slope(at, step), rel=1e-5, abs=1e-6 * balance.motor)


# Records


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return Zipping(tmp_path_factory.mktemp("zipping"))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short run of two flagella in contact, in its record."""
    path = tmp_path_factory.mktemp("run") / "run.h5"
    scene = touching_cell({"duration": 4e-5, "frames": 8, "numerics.time_step": 1e-6})
    simulation = Simulation(scene, device="cpu", reporters=[Recorder(path)])
    simulation.run()
    return scene, path, simulation.state


def test_measures_on_a_record_are_those_that_the_run_recorded(run):
    _, path, last = run
    with Record(path) as record:
        kept = record.observables
        np.testing.assert_array_equal(recorded.bundle_lengths(record), kept["bundle_length"])
        np.testing.assert_allclose(recorded.steric_force_densities(record), kept["steric_force_density"], rtol=1e-9)
        energies = recorded.elastic_energies(record)
        np.testing.assert_allclose(energies.sum(axis=1), kept["elastic_energy"], rtol=1e-9, atol=1e-20)
        np.testing.assert_allclose(energies[-1], last.elastic_energy, rtol=1e-9)
        theta = recorded.phase_profile(record)
        np.testing.assert_allclose(theta.mean(axis=1), kept["phase_difference"], rtol=1e-9)
        assert theta.shape == (9, 10)
        assert recorded.strains(record, 1).shape == (9, 9, 3)
        np.testing.assert_allclose(recorded.strains(record, 1)[0], np.tile([0, 1.3, -2.1], (9, 1)), atol=1e-9)
    assert kept["steric_force_density"].max() > 0.0


def test_forces_are_nil_where_the_scene_has_none(run, tmp_path):
    scene, _, _ = run
    bare = with_values(scene, {"steric.enabled": False})
    Simulation(bare, device="cpu", reporters=[Recorder(tmp_path / "run.h5")]).run(1e-5)
    with Record(tmp_path) as record:
        assert (recorded.steric_force_densities(record) == 0.0).all()


def test_swimming_of_a_made_up_cell(made):
    with Record(made.directory) as record:
        found = recorded.swimming(record, 2e-3, 5e-3)
        zipped = recorded.swimming(record, 7.1e-3)
        third = recorded.swimming(record)
    assert (found.start, found.stop) == pytest.approx((2e-3, 5e-3))
    assert (third.start, third.stop) == pytest.approx((2 / 3 * 8e-3, 8e-3), abs=5e-5)
    assert found.body_speed == pytest.approx(made.body_speed)
    assert found.net_speed == pytest.approx(made.body_speed)
    assert found.body_rate == pytest.approx(made.body_rate)
    np.testing.assert_allclose(found.motor_rate, made.motor_rate)
    along_m = made.body_rate * math.cos(math.radians(55))
    np.testing.assert_allclose(found.motor_rate_lab, made.motor_rate + along_m)
    np.testing.assert_allclose(zipped.helix_rate, made.helix_rate)
    assert zipped.pitch == pytest.approx(made.pitch)
    assert zipped.phase_velocity == pytest.approx(-made.pitch * made.helix_rate)
    assert found.thrust == pytest.approx(0.010775 * made.body_speed, rel=1e-3)
    assert found.motor_power == pytest.approx(2 * 3.4 * 2 * math.pi * made.motor_rate)
    assert found.stored_power == pytest.approx(50.0)
    drag = 0.010775 * made.body_speed**2 + 3.737e-3 * (2 * math.pi * made.body_rate) ** 2
    assert found.body_power == pytest.approx(drag, rel=1e-3)
    with Record(made.directory) as record, pytest.raises(ValueError, match="two frames"):
        recorded.swimming(record, 2e-3, 2e-3)


def test_motors_whose_torque_falls_work_by_the_mean_of_each_interval():
    """Torque 4 - 2 s, rate 1 + s in the share s of 1 ms: a line and an angle that is a parabola, at uneven frames."""
    share = np.array([0.0, 0.1, 0.4, 0.5, 1.0])
    torque, angle = 4.0 - 2.0 * share, 6.0 * (share + share**2 / 2)
    record = SimpleNamespace(
        times=1e-3 * share,
        observables={"motor_torque": np.stack([torque, 0 * torque], axis=1)},
        motor_angle=np.stack([angle, angle], axis=1),
    )
    found = recorded.motor_torques(record, paper_scene("any"), slice(1, 4))
    np.testing.assert_allclose(found[:, 0], [3.5, 3.1])
    assert (found[:, 1] == 0.0).all() and found.shape == (2, 2)
    whole = recorded.motor_torques(record, paper_scene("any"), slice(0, 5))
    work = float((whole * np.diff(record.motor_angle, axis=0)).sum())
    exact = 6.0 * (4.0 + 1.0 - 2.0 / 3.0)  # the integral of (4 - 2 s) 6 (1 + s)
    assert work == pytest.approx(exact, rel=0.01)
