"""Initial shapes: exact ground states, where they sit on the body, and the phase they start with."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import cell, helix_axis
from warpflag.model.clear_start import clear_start
from warpflag.model.geometry import ground_state, initial_state, phase_difference_at
from warpflag.model.start import starting_state
from warpflag.observables import phase_difference, turns_about_axis
from warpflag.run.simulation import Simulation
from warpflag.scene import Flagella, FlagellumOverride, Scene, SceneError, attachment, load, paper_scene, with_values
from warpflag.scene.smooth_helix import inscribed_strain

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.toml"))
NORMAL = (0.0, 1.3, -2.1)
STRAINS = [NORMAL, (0.0, 1.3, 2.1), (0.7, -1.1, 1.9), (2.0, 0.0, -0.3), (1.0, 1.0, 0.0), (0.0, 0.0, 2.0), (0.0,) * 3]


def opened(opening_angle: float = 90.0, **flagella) -> Scene:
    return paper_scene("test", flagella=Flagella(opening_angle=opening_angle, **flagella))


def tangents(nodes: np.ndarray) -> np.ndarray:
    edges = np.diff(nodes, axis=0)
    return edges / np.linalg.norm(edges, axis=1, keepdims=True)


def joint_strains(t: np.ndarray, e1: np.ndarray) -> np.ndarray:
    """(h Omega_1, h Omega_2, h Omega_3) of every joint, written down from the definitions."""
    strains = []
    for t_e, t_f, e1_e, e1_f in zip(t[:-1], t[1:], e1[:-1], e1[1:], strict=True):
        kb = 2 * np.cross(t_e, t_f) / (1 + t_e @ t_f)
        e2_e, e2_f = np.cross(t_e, e1_e), np.cross(t_f, e1_f)
        # Parallel transport of e1_e from t_e onto t_f: Rodrigues' formula with sin b = t_e x t_f.
        axis = np.cross(t_e, t_f)
        carried = e1_e * (t_e @ t_f) + np.cross(axis, e1_e) + axis * (axis @ e1_e) / (1 + t_e @ t_f)
        twist = math.atan2(np.cross(carried, e1_f) @ t_f, carried @ e1_f)
        strains.append([kb @ (e1_e + e1_f) / 2, kb @ (e2_e + e2_f) / 2, twist])
    return np.array(strains)


@pytest.mark.parametrize(
    ("segment_length", "radius", "pitch", "rise"),
    [(0.2, 0.2194, 2.1397, 0.16864), (0.1, 0.2147, 2.1573, None)],
)
def test_ground_state_has_the_known_sizes(segment_length, radius, pitch, rise):
    helix = ground_state(NORMAL, segment_length)
    assert helix.radius == pytest.approx(radius, abs=5e-5)
    assert helix.pitch == pytest.approx(pitch, abs=5e-5)
    if rise is not None:
        assert helix.rise == pytest.approx(rise, abs=5e-6)


@pytest.mark.parametrize("h", [0.05, 0.2, 0.4])
@pytest.mark.parametrize("strain", [NORMAL, (0.9, 1.3, -0.6), (0.0, 2.84, 2.29), (0.0, 1.5, 0.0)])
def test_nodes_lie_on_the_smooth_helix(strain, h):
    """Radius k/(k^2 + t^2) and pitch 2 pi t/(k^2 + t^2) at any segment length, and the bend's direction as given."""
    found = inscribed_strain(strain, h)
    helix = ground_state(found, h)
    bend, square = math.hypot(*strain[:2]), float(np.dot(strain, strain))
    assert helix.radius == pytest.approx(bend / square, rel=1e-9)
    assert helix.rise / helix.angle == pytest.approx(strain[2] / square, rel=1e-9, abs=1e-12)
    assert found[0] * strain[1] == pytest.approx(found[1] * strain[0], rel=1e-9)


def test_a_scene_with_its_nodes_on_the_helix_is_at_rest(device):
    values = {"flagella.nodes_on_helix": True, "flagella.helix_radius": 0.2, "flagella.helix_pitch": -2.2}
    scene = cell({**values, "hook.stiffness": 0.65, "motor.axis_angle": 45.0})
    sim = Simulation(scene, device=device)
    sim.evaluate()
    assert sim.state.elastic_energy.sum() < 1e-20
    axis, point = helix_axis(sim.state.positions[: scene.resolved_flagella()[0].segment_count + 1])
    away = sim.state.positions[1] - point
    assert np.linalg.norm(away - (away @ axis) * axis) == pytest.approx(0.2, rel=1e-9)


def test_segments_that_span_half_a_turn_are_refused():
    for form in ("target", "second"):
        forms = {"polymorphs.enabled": True, f"polymorphs.{form}": "curly_1"}
        with pytest.raises(SceneError, match=r"span half a turn.*polymorphs\.curly_1.*flagella\.nodes_on_helix"):
            cell(
                {
                    "flagella.nodes_on_helix": True,
                    "flagella.segment_length": 0.7,
                    "polymorphs.curly_1": (0, 3, 0),
                    **forms,
                }
            )
        with pytest.raises(SceneError, match=r"polymorphs\.curly_1 the frame turns by .* below pi"):
            cell({"flagella.segment_length": 0.5, "polymorphs.curly_1": (0, 1, 7), **forms})
    with pytest.raises(SceneError, match=r"span half a turn.*flagella\.nodes_on_helix"):
        cell(
            {"flagella.nodes_on_helix": True, "flagella.segment_length": 1.0, "flagella.intrinsic_curvature": (0, 3, 0)}
        )


@pytest.mark.parametrize("strain", [(0.0, 1.3, 0.0), (1.3, 0.0, -0.1)])
def test_a_flat_helix_does_not_grow_on_its_axis(strain):
    with pytest.raises(SceneError, match=r"flagella\.on_axis = true: needs a pitch of 0\.5 um or more"):
        cell({"flagella.on_axis": True, "flagella.intrinsic_curvature": strain})
    for fine in ((0.0, 0.0, 0.0), (0.0, 0.0, -2.1), (0.0, 1.3, -0.3)):
        cell({"flagella.on_axis": True, "flagella.intrinsic_curvature": fine})
    cell({"flagella.on_axis": False, "flagella.intrinsic_curvature": strain})


def test_ground_state_converges_to_the_continuum_helix_at_second_order():
    curvature, torsion = NORMAL[1], -NORMAL[2]
    squared = curvature**2 + torsion**2
    exact = np.array([curvature / squared, 2 * math.pi * torsion / squared])
    assert exact == pytest.approx([0.2131, 2.163], abs=5e-4)
    helices = [ground_state(NORMAL, h) for h in (0.2, 0.1, 0.05, 0.025)]
    errors = np.array([[helix.radius, helix.pitch] - exact for helix in helices])
    orders = np.log2(errors[:-1] / errors[1:])
    np.testing.assert_allclose(orders, 2.0, atol=0.06)
    np.testing.assert_allclose(orders[-1], 2.0, atol=0.004)


@pytest.mark.parametrize("strain", STRAINS)
@pytest.mark.parametrize("segment_length", [0.05, 0.2, 1.0])
def test_every_joint_has_exactly_the_intrinsic_strain(strain, segment_length):
    scene = opened(intrinsic_curvature=strain, segment_length=segment_length, length=6.0)
    state = initial_state(scene)
    for nodes, e1 in zip(state.positions, state.directors, strict=True):
        lengths = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
        np.testing.assert_allclose(lengths, segment_length, rtol=0, atol=1e-14)
        strains = joint_strains(tangents(nodes), e1[1:])
        # Tangents are differences of nodes up to 7 um from the origin: 8 eps / h.
        np.testing.assert_allclose(
            strains, segment_length * np.array([strain] * len(strains)), rtol=0, atol=max(1e-14, 2e-15 / segment_length)
        )


def test_joint_rotation_has_the_strain_to_rounding():
    for strain, h in itertools.product(STRAINS, (0.02, 0.2, 1.0)):
        joint = ground_state(strain, h).joint
        np.testing.assert_allclose(joint.T @ joint, np.eye(3), rtol=0, atol=1e-15)
        strains = joint_strains(np.array([[0.0, 0.0, 1.0], joint[:, 2]]), np.array([[1.0, 0.0, 0.0], joint[:, 0]]))
        np.testing.assert_allclose(strains[0], h * np.array(strain), rtol=0, atol=1e-15)


def test_a_twist_of_pi_per_joint_is_refused():
    with pytest.raises(ValueError, match="below pi"):
        ground_state((0.0, 1.0, math.pi), 1.0)


@pytest.mark.parametrize(("third", "sign"), [(-2.1, -1.0), (2.1, 1.0)])
def test_handedness(third, sign):
    scene = opened(intrinsic_curvature=(0.0, 1.3, third))
    axis = np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5)])
    nodes = initial_state(scene).positions[0]
    helix = ground_state((0.0, 1.3, third), 0.2)
    assert math.copysign(1.0, helix.angle) == sign
    centre = nodes[0] + helix.radius * np.array([math.sqrt(0.5), 0.0, -math.sqrt(0.5)])
    assert turns_about_axis(nodes, centre, axis) == pytest.approx(30 * helix.angle / (2 * math.pi), abs=1e-12)
    t = tangents(nodes)
    assert sign * np.cross(t[0], t[1]) @ t[2] > 0


@pytest.mark.parametrize("phase", [0.0, 37.0, 180.0, 290.0])
@pytest.mark.parametrize(("azimuth", "tilt"), [(0.0, 45.0), (180.0, 11.5), (72.0, 60.0), (0.0, 0.0), (45.0, 140.0)])
def test_helix_lies_about_the_axis_asked_for_at_the_phase_asked_for(azimuth, tilt, phase):
    own = FlagellumOverride(azimuth=azimuth, tilt=tilt, phase=phase, anchor_offset=-0.3)
    scene = paper_scene("test", flagella=Flagella(count=1), flagellum=(own,))
    nodes = initial_state(scene).positions[0]
    helix = ground_state(NORMAL, 0.2)
    normal = np.array([math.cos(math.radians(azimuth)), math.sin(math.radians(azimuth)), 0.0])
    axis = math.cos(math.radians(tilt)) * np.array([0, 0, 1.0]) + math.sin(math.radians(tilt)) * normal
    np.testing.assert_allclose(nodes[0], 0.4 * normal + [0, 0, -0.3], atol=1e-15)
    np.testing.assert_allclose(np.diff(nodes, axis=0) @ axis, helix.rise, rtol=0, atol=3e-15)
    x = np.array([1.0, 0.0, 0.0]) - axis[0] * axis
    x /= np.linalg.norm(x)
    outward = math.cos(math.radians(phase)) * x + math.sin(math.radians(phase)) * np.cross(axis, x)
    offsets = nodes - (nodes[0] - helix.radius * outward)
    across = offsets - np.outer(offsets @ axis, axis)
    np.testing.assert_allclose(np.linalg.norm(across, axis=1), helix.radius, rtol=0, atol=1e-14)


def test_phase_of_an_axis_along_x_is_the_limit_of_tilted_axes():
    nodes = [initial_state(opened(opening_angle)).positions for opening_angle in (180.0, 180.0 - 1e-6)]
    for exact, near in zip(*nodes, strict=True):
        np.testing.assert_allclose(exact, near, atol=1e-6)


def test_straight_rods_lie_along_their_axis_and_their_phase_turns_the_frame():
    def flagellum(phase):
        own = FlagellumOverride(tilt=30.0, phase=phase)
        scene = paper_scene("test", flagella=Flagella(count=1, intrinsic_curvature=(0, 0, 0)), flagellum=(own,))
        state = initial_state(scene)
        return state.positions[0], state.directors[0]

    nodes, e1 = flagellum(0.0)
    np.testing.assert_allclose(tangents(nodes), np.tile([0.5, 0.0, math.sqrt(0.75)], (30, 1)), atol=1e-14)
    turned_nodes, turned_e1 = flagellum(90.0)
    np.testing.assert_allclose(turned_nodes, nodes, atol=1e-15)
    np.testing.assert_allclose(turned_e1[1:], np.cross([0.5, 0.0, math.sqrt(0.75)], e1[1:]), atol=1e-15)


@pytest.mark.parametrize("path", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_examples_start_at_the_end_of_the_hook_and_clear_of_contact(path):
    """Where anchors leave less room, contact with the body may act, but not beyond the law's own range."""
    scene = load(path)
    little_room = scene.flagella.on_axis or path.stem in ("ecoli", "run_and_tumble")
    state = clear_start(scene, initial_state(scene))  # in body axes
    diameter = 4 * scene.flagella.filament_radius
    cutoff = 2 ** (1 / 6) * diameter
    half = (scene.body.length - scene.body.width) / 2
    fractions = np.linspace(0.0, 1.0, 25, endpoint=False)[None, :, None]
    curves = []
    for spec, nodes in zip(scene.resolved_flagella(), state.positions, strict=True):
        stub = nodes[0] - scene.hook.length * np.array(attachment.motor_axis(spec))
        middle = [0.0, 0.0, np.clip(stub[2], -half, half)]
        assert abs(np.linalg.norm(stub - middle) - scene.body.width / 2) < 1e-14
        axial = np.clip(nodes[:, 2], -half, half)
        gap = np.linalg.norm(nodes - axial[:, None] * [0, 0, 1], axis=1) - scene.body.width / 2
        if scene.body.contact:
            assert gap[1:].min() > (0.7 * diameter if little_room else 1.3 * cutoff)
        curves.append((nodes[:-1, None] * (1 - fractions) + nodes[1:, None] * fractions).reshape(-1, 3))
    boxes = [(curve.min(axis=0) - 4 * cutoff, curve.max(axis=0) + 4 * cutoff) for curve in curves]
    for i, j in itertools.combinations(range(len(curves)), 2):
        overlap = [np.maximum(boxes[i][0], boxes[j][0]), np.minimum(boxes[i][1], boxes[j][1])]
        a, b = (c[((c >= overlap[0]) & (c <= overlap[1])).all(axis=1)] for c in (curves[i], curves[j]))
        assert not len(a) or not len(b) or np.linalg.norm(a[:, None] - b[None], axis=-1).min() > 4 * cutoff


@pytest.mark.parametrize("path", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_tripod_stands_on_the_motor_axis_without_twist(path):
    scene = load(path)
    state = initial_state(scene)
    for spec, nodes, e1 in zip(scene.resolved_flagella(), state.positions, state.directors, strict=True):
        assert nodes.shape == e1.shape == (spec.segment_count + 1, 3)
        around, angle = math.radians(spec.azimuth), math.radians(spec.motor_axis_angle)
        normal = np.array([math.cos(around), math.sin(around), 0.0])
        motor_axis = math.cos(angle) * np.array([0, 0, 1.0]) + math.sin(angle) * normal
        assert abs(e1[0] @ motor_axis) < 1e-15
        np.testing.assert_allclose(np.linalg.norm(e1, axis=1), 1.0, rtol=0, atol=1e-14)  # of 30 rotations
        assert abs(joint_strains(np.array([motor_axis, tangents(nodes)[0]]), e1[:2])[0, 2]) < 1e-14
        np.testing.assert_allclose(np.vecdot(tangents(nodes), e1[1:]), 0.0, atol=1e-14)
    assert state.body_position.tolist() == [0, 0, 0] and state.body_orientation.tolist() == [0, 0, 0, 1]


@pytest.mark.parametrize(
    "values, words",
    [
        ({"motor.axis_angle": 180.0}, r"motor\.axis_angle = 180\.0: .* flagellum 0"),
        ({"flagellum.1.motor_axis_angle": 180.0}, r"flagellum\.1\.motor_axis_angle = 180\.0: .* flagellum 1"),
        ({"motor.axis_angle": 180.0, "flagellum.0.motor_axis_angle": 0.0}, r"^motor\.axis_angle = .* flagellum 1"),
    ],
)
def test_a_motor_axis_against_the_first_segment_is_refused(values, words):
    scene = with_values(opened(0.0, intrinsic_curvature=(0, 0, 0)), values)
    with pytest.raises(SceneError, match=words):
        initial_state(scene)


def test_mirrored_flagella_are_the_mirror_image():
    """Reflection in the x-z plane turns psi and the third strain round and keeps e1."""
    phases = {"flagellum.0.phase": 50.0, "flagellum.1.phase": 200.0}
    left = initial_state(with_values(opened(44.0), phases))
    mirrored_phases = {key: -phase for key, phase in phases.items()}
    right = initial_state(with_values(opened(44.0, intrinsic_curvature=(0.0, 1.3, 2.1)), mirrored_phases))
    for original, image in zip(left.positions + left.directors, right.positions + right.directors, strict=True):
        np.testing.assert_allclose(image, original * [1, -1, 1], atol=1e-14)


@pytest.mark.parametrize(
    ("opening_angle", "length", "shift", "theta"),
    [(23, 6, 150, 0.80), (44, 6, 120, 0.60), (90, 6, 130, 0.59), (23, 8, 150, 0.80), (90, 8, 130, 0.61)],
)
def test_known_shifts_give_the_known_phase_differences(opening_angle, length, shift, theta):
    scene = opened(opening_angle, length=length)
    assert round(phase_difference_at(scene, shift), 2) == theta


@pytest.mark.parametrize(("opening_angle", "lowest"), [(23, 0.04), (44, 0.09), (90, 0.20)])
def test_phase_difference_is_reached_or_refused(opening_angle, lowest):
    def measured(scene):
        state = initial_state(scene)
        first_node = np.cumsum([0] + [len(nodes) for nodes in state.positions])
        return phase_difference(np.vstack(state.positions), np.vstack(state.directors), first_node)

    for wanted in (lowest + 0.01, 0.3, 0.59, 0.8, 1.0 - 1e-9):
        scene = opened(opening_angle, phase_difference=wanted)
        assert measured(scene) == pytest.approx(wanted, abs=1e-10)
    # Without a wish both start at the same phase angle, where the least phase difference lies.
    assert measured(opened(opening_angle)) == pytest.approx(lowest, abs=6e-3)
    with pytest.raises(SceneError, match=r"flagella\.phase_difference = .*: these flagella reach") as caught:
        initial_state(opened(opening_angle, phase_difference=lowest - 0.01))
    reach = re.search(r"reach ([\d.]+) to ([\d.]+)", str(caught.value))
    assert reach and float(reach[1]) == pytest.approx(lowest, abs=6e-3) and float(reach[2]) > 0.999
    initial_state(opened(opening_angle, phase_difference=1.0))


def test_the_main_scene_starts_with_a_shift_of_130_degrees():
    scene = load(next(path for path in EXAMPLES if path.stem == "zipping"))
    state = initial_state(scene)
    shifted = initial_state(
        with_values(
            scene,
            {"flagella.phase_difference": None, "flagellum.0.phase": 180.0, "flagellum.1.phase": 310.0},
        )
    )
    for chosen, expected in zip(state.positions, shifted.positions, strict=True):
        np.testing.assert_allclose(chosen, expected, atol=1e-6)


@pytest.mark.parametrize("shift", [20.0, 97.0, 175.0])
def test_phase_difference_turns_flagella_of_odd_number_by_at_most_180_degrees(shift):
    def own(*phases):
        azimuths = (0.0, 180.0, 90.0, 270.0)
        return tuple(FlagellumOverride(azimuth=a, phase=p) for a, p in zip(azimuths, phases, strict=True))

    group = Flagella(count=4, opening_angle=44.0)
    wanted = phase_difference_at(paper_scene("test", flagella=group, flagellum=own(None, None, 20.0, None)), shift)
    wished = dataclasses.replace(group, phase_difference=wanted)
    chosen = initial_state(paper_scene("test", flagella=wished, flagellum=own(None, None, 20.0, None)))
    phases = (180.0, 180.0 + shift, 20.0, 180.0 + shift)
    expected = initial_state(paper_scene("test", flagella=group, flagellum=own(*phases)))
    for found, nodes in zip(chosen.positions, expected.positions, strict=True):
        np.testing.assert_allclose(found, nodes, atol=1e-9)


def test_flagella_of_unequal_length_can_be_shifted():
    own = (FlagellumOverride(), FlagellumOverride(length=4.0))
    scene = paper_scene("test", flagella=Flagella(opening_angle=23.0, phase_difference=0.7), flagellum=own)
    state = initial_state(scene)
    assert [len(nodes) for nodes in state.positions] == [31, 21]
    first_node = np.array([0, 31, 52])
    theta = phase_difference(np.vstack(state.positions), np.vstack(state.directors), first_node)
    assert theta == pytest.approx(0.7, abs=1e-10)


@pytest.mark.parametrize("h", [0.2, 0.05])
def test_on_its_axis_a_flagellum_starts_there_and_ends_as_the_helix(h):
    values = {
        "flagella.on_axis": True,
        "flagella.segment_length": h,
        "flagella.count": 1,
        "flagella.opening_angle": 50.0,
    }
    scene = with_values(opened(), values)
    nodes, e1 = initial_state(scene).positions[0], initial_state(scene).directors[0][1:]
    edges = np.diff(nodes, axis=0)
    assert np.linalg.norm(edges, axis=1) == pytest.approx(h, rel=1e-12)
    axis = np.array([math.sin(math.radians(25.0)), 0.0, math.cos(math.radians(25.0))])
    across = (nodes - nodes[0]) - np.outer((nodes - nodes[0]) @ axis, axis)
    distance = np.linalg.norm(across, axis=1)
    beyond = int(np.searchsorted((nodes - nodes[0]) @ axis, 0.5))
    assert distance[beyond:] == pytest.approx(ground_state(NORMAL, h).radius, rel=1e-9)
    assert (np.diff(distance[: beyond + 1]) > 0).all()
    # Beyond the taper the intrinsic strain is the helix's, and the shape has no energy anywhere.
    strains = joint_strains(tangents(nodes), e1)
    assert strains[beyond:] == pytest.approx(np.tile(h * np.array(NORMAL), (len(strains) - beyond, 1)), abs=1e-9)
    assert strains[:, 2] == pytest.approx(h * NORMAL[2], abs=1e-9)  # on the taper only the bends differ


@pytest.mark.parametrize("offset", [1.25, 1.1, -0.9])
def test_anchors_may_lie_on_the_caps(offset):
    scene = with_values(opened(), {"flagella.count": 1, "flagella.anchor_offset": offset})
    anchor = initial_state(scene).positions[0][0]
    centre = np.array([0.0, 0.0, math.copysign(0.85, offset)])
    assert anchor[2] == pytest.approx(offset)
    assert np.linalg.norm(anchor - centre) == pytest.approx(0.4)


def test_a_flagellum_along_x_has_the_phase_of_one_that_is_hardly_turned_from_there():
    along, beside = ({"flagella.opening_angle": angle, "flagella.anchor_offset": 0.1} for angle in (180.0, 179.9998))
    for phase in (0.0, 70.0, 180.0):
        own = {"flagellum.0.phase": phase, "flagellum.1.phase": phase}
        one, other = (initial_state(cell({**values, **own})) for values in (along, beside))
        for x, y in zip(one.positions, other.positions, strict=True):
            np.testing.assert_allclose(x, y, atol=1e-5)


@pytest.mark.parametrize("on_axis", [False, True])
def test_a_helix_that_a_run_could_not_begin_with_is_refused_with_the_reason(on_axis):
    """Joints twisted at rest by more than the guard of twists allows: no value of the motor would help."""
    values = {"flagella.helix_radius": 0.09, "flagella.helix_pitch": 1.1, "flagella.on_axis": on_axis}
    with pytest.raises(SceneError, match=r"flagella.segment_length = 0.4: makes segments .* take shorter ones"):
        starting_state(cell({**values, "flagella.length": 2.4, "flagella.segment_length": 0.4}))
    starting_state(cell({**values, "flagella.length": 2.4, "flagella.segment_length": 0.2}))
