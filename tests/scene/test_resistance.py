"""Drag of rigid helices: resistive-force theory, the pair sum that counts twice, and the mode that converges.

A rigid helix with force F and torque T along its axis, velocity U and angular velocity W: F = A U + B W,
T = B U + D W. The matrix comes from the mobility that the program's kernel applies, inverted here.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from tests.helpers import attachment, cell, ground_state_frames, helix_axis, placed
from tests.oracles import device_mobility
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, SceneError, paper_scene, with_values
from warpflag.scene.resistance import pace, pair_radii, pair_radius, spheroid_mobility

# Relative to resistive-force theory and to the numbers quoted below, which have three or four digits.
TOLERANCE = {"float64": 5e-3, "float32": 5e-3}

CURVATURE, TORSION = 1.3, 2.1  # of the paper's filament [1/um]
RADIUS = CURVATURE / (CURVATURE**2 + TORSION**2)
PITCH = 2 * math.pi * TORSION / (CURVATURE**2 + TORSION**2)


def helix_nodes(radius: float, pitch: float, length: float, count: int) -> np.ndarray:
    """Nodes at equal arc length along a left-handed helix about z, shape [count + 1, 3]."""
    arc = np.linspace(0, length, count + 1) / math.hypot(2 * math.pi * radius, pitch)
    turn = -2 * math.pi * arc
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), pitch * arc], axis=1)


def rigid_drag(mode: str, nodes, length, precision, device, axis=(0, 0, 1), point=(0, 0, 0), values=None) -> np.ndarray:
    """A [pN s/um], B [pN s], D [pN um s] about an axis through a point; both ends free."""
    # r_0 has no drag, it is the body's: another node ahead of the first, on the line of the first segment, is r_0.
    count = len(nodes)
    whole = length * count / (count - 1)
    scene = cell(
        {
            "flagella.count": 1,
            "flagella.length": whole,
            "flagella.segment_length": whole / count,
            "flagella.intrinsic_curvature": (0.0, 0.0, 0.0),
            "hydrodynamics.mode": mode,
            "body.contact": False,
            **(values or {}),
        },
        precision,
    )
    anchor, _ = attachment(scene, scene.resolved_flagella()[0])
    start = placed(scene, [anchor + nodes - (2 * nodes[0] - nodes[1])])
    mobility = device_mobility(Simulation(scene, device=device, starts=start))
    mobility[:3, :3] *= 2  # half a segment at this end too
    axis = np.asarray(axis, dtype=float)
    motions = np.stack([np.tile(axis, count), np.cross(axis, nodes - np.asarray(point)).ravel()], axis=1)
    drag = motions.T @ np.linalg.solve(mobility, motions)
    assert drag[0, 1] == pytest.approx(drag[1, 0], rel=1e-4)
    return np.array([drag[0, 0], drag[0, 1], drag[1, 1]])


def resistive_force_theory(length: float) -> np.ndarray:
    """A, B, D of the paper's helix under gamma_par and gamma_perp alone, in the continuum."""
    parallel, perpendicular = 1.6e-3, 2.8e-3
    along = TORSION / math.hypot(CURVATURE, TORSION)
    around = math.sqrt(1 - along**2)
    return length * np.array([
        parallel * along**2 + perpendicular * around**2,
        (perpendicular - parallel) * RADIUS * along * around,
        RADIUS**2 * (parallel * around**2 + perpendicular * along**2),
    ])  # fmt: skip


def perrin(a: float, b: float) -> list[float]:
    """Drag of a prolate spheroid along, across, about and across its axis in a fluid of viscosity 1, by quadrature.

    Semi-axes a, b, b; Perrin's integrals chi, alpha_i over s = b^2 (x/(1 - x))^2.
    """
    x, weights = np.polynomial.legendre.leggauss(400)
    x, weights = (x + 1) / 2, weights / 2
    s, ds = b**2 * (x / (1 - x)) ** 2, weights * 2 * b**2 * x / (1 - x) ** 3
    root = np.sqrt(a**2 + s) * (b**2 + s)
    chi, alpha, beta = np.sum(ds / root), np.sum(ds / (a**2 + s) / root), np.sum(ds / (b**2 + s) / root)
    rolling = 16 * math.pi / (3 * beta)
    tumbling = 16 * math.pi * (a**2 + b**2) / (3 * (a**2 * alpha + b**2 * beta))
    return [16 * math.pi / (chi + alpha * a**2), 16 * math.pi / (chi + beta * b**2), rolling, tumbling]


@pytest.mark.parametrize("aspect", [1.0, 1 + 1e-9, 1.00004, 1.00006, 1.02, 1.1, 1.5, 3.125, 20.0])
def test_mobility_of_the_body_is_perrins(aspect):
    found = spheroid_mobility(2.0 * aspect, 2.0, 0.01)
    expected = [1 / (0.01 * drag) for drag in perrin(aspect, 1.0)]
    assert [found.along, found.across, found.spin, found.tumble] == pytest.approx(expected, rel=1e-7)


def test_local_drag_is_resistive_force_theory(precision, device):
    """Within 0.5 % at h = 0.05 um, and second order in h."""
    expected = resistive_force_theory(10.0)
    assert expected == pytest.approx([0.01932, 1.145e-3, 1.121e-3], rel=1e-3)
    errors = []
    for count in (50, 100, 200):
        found = rigid_drag("none", helix_nodes(RADIUS, PITCH, 10.0, count), 10.0, precision, device)
        errors.append(np.abs(found / expected - 1))
    assert errors[-1].max() < TOLERANCE[precision]
    if precision == "float64":
        assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.3)
        assert np.log2(errors[1] / errors[2]) == pytest.approx(2.0, abs=0.3)


@pytest.mark.parametrize(
    "count, expected", [(200, (0.00833, 0.605e-3, 0.732e-3)), (100, (0.00897, 0.658e-3, 0.819e-3))]
)
def test_pair_sum_within_a_filament_counts_its_flow_twice(count, expected, device):
    """The paper's sum with a = 0.010 um: less than half the drag, and less with every refinement."""
    found = rigid_drag("as_printed", helix_nodes(RADIUS, PITCH, 10.0, count), 10.0, "float64", device)
    assert found == pytest.approx(expected, rel=TOLERANCE["float64"])


@pytest.mark.parametrize(
    "mode, expected", [("none", (0.01932, 1.177e-3, 1.188e-3)), ("all", (0.00974, 0.730e-3, 0.978e-3))]
)
def test_drag_of_the_discrete_ground_state(mode, expected, precision, device):
    """At h = 0.2 um, the default pair radius."""
    frames = ground_state_frames(50, 0.2, (0.0, CURVATURE, -TORSION))
    nodes = np.vstack([np.zeros(3), np.cumsum(0.2 * frames[:, :, 2], axis=0)])
    axis, point = helix_axis(nodes)
    found = rigid_drag(mode, nodes, 10.0, precision, device, axis, point)
    assert found == pytest.approx(expected, rel=TOLERANCE[precision])


def test_consistent_mode_converges_to_slender_body_theory(device):
    """Helix of radius 1, pitch 10.2, axial length 30.9, filament radius 0.04, eta = 1. Johnson's slender-body theory
    gives A, B, D = 41.58, 11.93, 87.77; chains of touching beads 41.2 to 42.3, 11.45 to 11.88, 85.0 to 88.7."""
    length = 30.9 / 10.2 * math.hypot(2 * math.pi, 10.2)
    values = {"fluid.viscosity": 1.0, "flagella.filament_radius": 0.04}
    found = np.array([
        rigid_drag("consistent", helix_nodes(1.0, 10.2, length, count), length, "float64", device, values=values)
        for count in (45, 90, 180)
    ])  # fmt: skip
    assert np.abs(found / (41.58, 11.93, 87.77) - 1).max() < 0.02
    # Fourfold refinement changes the drag by half a percent, where the paper's sum loses a tenth of it.
    assert np.abs(found[2] / found[0] - 1).max() < 0.01
    assert np.abs(found[2] / found[1] - 1).max() < 0.002
    printed = [
        rigid_drag("all", helix_nodes(1.0, 10.2, length, count), length, "float64", device, values=values)[0]
        for count in (45, 180)
    ]
    assert printed[1] < 0.9 * printed[0]


def test_pace_is_that_of_the_easiest_motion():
    """With drags kept as in water, a thin fluid still lets flows and the body be as fast as it says."""
    printed = {"fluid.drag_parallel": 1.6e-3, "fluid.drag_perpendicular": 2.8e-3, "fluid.drag_rotation": 1.26e-6}
    for values, expected in (
        ({}, 1.0),
        ({"fluid.viscosity": 1e-2}, 0.1),
        ({"fluid.viscosity": 1e-4}, 10.0),
        ({"fluid.viscosity": 1e-5, **printed}, 100.0),
        ({"fluid.drag_rotation": 1.26e-7}, 10.0),
        ({"fluid.drag_parallel": 0.8e-3, "fluid.drag_perpendicular": 0.7e-3}, 4.0),
    ):
        assert pace(with_values(paper_scene(name="paced"), values)) == pytest.approx(expected), values


@pytest.mark.parametrize("mode", ["all", "within", "consistent"])
def test_a_pair_radius_that_is_refused_names_one_that_is_taken(mode):
    """Rounded up, whatever the segment length, and hardly more than is needed."""
    for h in (0.1, 0.15, 0.2, 0.24, 0.3):
        values = {"hydrodynamics.mode": mode, "flagella.segment_length": h, "hydrodynamics.pair_radius": 1e-3}
        scene = with_values(paper_scene(name="given"), {"flagella.length": 6.0, **values})
        with pytest.raises(SceneError, match="is the least that does not") as caught:
            pair_radii(scene)
        named = float(str(caught.value).partition("indefinite; ")[2].partition(" um")[0])
        enough, less = (with_values(scene, {"hydrodynamics.pair_radius": a}) for a in (named, 0.97 * named))
        assert pair_radii(enough) == [named] * 2
        with pytest.raises(SceneError, match=f"{named:g} um is the least"):
            pair_radii(less)


def test_segments_of_each_length_have_the_pair_radius_of_their_own():
    """In mode consistent; as in a scene of segments of that length alone."""
    mode = {"hydrodynamics.mode": "consistent"}
    both = with_values(Scene(name="unequal"), {**mode, "flagellum.0.segments": 30, "flagellum.1.segments": 60})
    lengths = [spec.segment_length for spec in both.resolved_flagella()]
    alone = [pair_radius(with_values(Scene(name="equal"), {**mode, "flagella.segment_length": h})) for h in lengths]
    assert [pair_radius(both, h) for h in lengths] == pytest.approx(alone, rel=1e-9)
    assert alone[0] != pytest.approx(alone[1], rel=0.1) and pair_radius(both) == pytest.approx(max(alone))
