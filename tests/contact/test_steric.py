"""Contact between flagella and with the body: the force law, where it acts, and that it conserves what it must."""

# No postponed annotations here: a kernel needs its types.

import math

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.contact import steric

from tests.helpers import anchors, attachment, cell, evaluated, free_nodes, matrix, placed, shaken, touching_cell, unit
from tests.oracles import (
    CUTOFF,
    body_gaps,
    contact_distances,
    energy,
    energy_gradient,
    segment_distances,
    steric_energy,
)
from warpflag.run.simulation import Simulation

# Of the largest force in the state; float32 knows a distance of 0.04 um some um from the body to 1e-5.
TOLERANCE = {"float64": 1e-7, "float32": 2e-3}

F_0, SIGMA = 0.8, 0.040  # the paper's strength [pN] and 4 a with a = 0.010 um


def contacts(sim: Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Forces of contact on the first and second node of every segment and of the body on every node."""
    sim.evaluate()
    state = sim.system.state.data
    return state.steric_first.numpy(), state.steric_second.numpy(), state.body_contact.numpy()


def crossed_segments(scene, gap: float, s: float = 0.5, t: float = 0.5, angle: float = math.pi / 2):
    """Last segments of the two flagella cross at parameters s and t and distance gap, far from everything else."""
    centre, h = np.array([0.0, 0.0, 3.0]), 0.2
    along = [np.array([1.0, 0.0, 0.0]), np.array([math.cos(angle), math.sin(angle), 0.0])]
    nodes = []
    for k, (spec, parameter, direction) in enumerate(zip(scene.resolved_flagella(), (s, t), along, strict=True)):
        middle = centre + np.array([0.0, 0.0, gap * k])
        last = np.stack([middle - parameter * h * direction, middle + (1 - parameter) * h * direction])
        anchor, _ = attachment(scene, spec)
        # The rest leads away on its own side: below for the one, above for the other.
        away = last[0] + np.array([0.0, 0.0, -1.0 if k == 0 else 1.0]) - 0.5 * direction
        nodes.append(np.vstack([0.5 * (anchor + away), away, last]))
    return placed(scene, nodes)


FOUR = {"flagella.length": 0.8}


def test_force_law_and_its_linear_continuation(precision, device):
    scene = cell(FOUR, precision)
    x = np.array([0.3, 0.5, 0.69999, 0.7, 0.70001, 0.9, 1.0, 1.05, 1.1224, CUTOFF + 1e-5, 1.3])
    sim = Simulation([scene] * len(x), device=device, starts=[crossed_segments(scene, SIGMA * r) for r in x])
    first, second, body = contacts(sim)
    of_cell = np.arange(10 * len(x)).reshape(len(x), 10)
    pushed_down = -(first + second)[of_cell[:, 4], 2]

    force, slope = F_0 * (2 * 0.7**-13 - 0.7**-7), F_0 / SIGMA * (26 * 0.7**-14 - 7 * 0.7**-8)
    assert (force, slope) == pytest.approx((155.4, 7.424e4), rel=3e-4)
    expected = np.where(x < 0.7, force + slope * SIGMA * (0.7 - x), F_0 * (2 * x**-13 - x**-7)) * (x < CUTOFF)
    assert expected[x == 1.0] == F_0
    allowed = 10 * TOLERANCE[precision] * np.maximum(expected, F_0)
    assert (np.abs(pushed_down - expected) < allowed).all()
    if precision == "float64":  # smooth across 0.7 sigma: the same slope on both sides
        across = np.diff(pushed_down[2:5]) / np.diff(SIGMA * x[2:5])
        assert across == pytest.approx(-slope, rel=1e-3)
    assert np.abs(body).max() == 0.0


def test_force_acts_at_the_closest_points(precision, device):
    """(1 - s) of it on the first node of a segment and s on the second, the opposite on the other flagellum."""
    scene = cell(FOUR, precision)
    s, t = 0.3, 0.8
    start = crossed_segments(scene, 0.9 * SIGMA, s, t, angle=1.1)
    first, second, _ = contacts(Simulation(scene, device=device, starts=start))
    force = F_0 * (2 * 0.9**-13 - 0.9**-7) * np.array([0.0, 0.0, 1.0])
    allowed = 10 * TOLERANCE[precision] * force[2]
    for element, share, sign in ((4, s, -1), (9, t, 1)):
        assert first[element] == pytest.approx(sign * (1 - share) * force, abs=allowed)
        assert second[element] == pytest.approx(sign * share * force, abs=allowed)
    others = np.setdiff1d(np.arange(10), [4, 9])
    assert np.abs(first[others]).max() == np.abs(second[others]).max() == 0.0


@pytest.mark.parametrize(
    "values, precision",
    [({}, "float64"), ({}, "float32"), ({"body.contact": False}, "float64"), ({"steric.enabled": False}, "float64")],
)
def test_total_force_is_the_energy_gradient(values, precision, device):
    """Elastic and steric forces together, in contact all along; what is switched off contributes nothing."""
    scene = touching_cell(values, precision)
    start = shaken(scene, seed=3, node=0.002, spin=0.05, body=0.3)
    between = contact_distances(start) < CUTOFF * SIGMA
    nodes = free_nodes(scene)
    with_body = body_gaps(scene, start, np.concatenate(start.positions)[nodes]) < CUTOFF * SIGMA
    assert between.sum() > 20 and with_body.any()
    expected = energy_gradient(scene, start, energy)
    found = evaluated(scene, start, device)
    largest = np.abs(expected.forces).max()
    assert np.abs(found.forces[nodes] - expected.forces[nodes]).max() < TOLERANCE[precision] * largest
    assert np.abs(found.body_force - expected.body_force).max() < TOLERANCE[precision] * largest
    reaction = sum(
        spec.torque * matrix(start.body_orientation) @ attachment(scene, spec)[1] for spec in scene.resolved_flagella()
    )
    assert np.abs(found.body_torque + reaction - expected.body_torque).max() < TOLERANCE[precision] * largest


def test_potential_is_the_integral_of_the_printed_force():
    """The oracle above: shifted to vanish at the cutoff, and -dU/dr is the force."""
    scene = cell(FOUR)
    at_cutoff, at_diameter = (steric_energy(scene, crossed_segments(scene, r)) for r in (CUTOFF * SIGMA, SIGMA))
    assert at_cutoff == pytest.approx(0.0, abs=1e-15)
    assert at_diameter == pytest.approx(F_0 * SIGMA / 24)
    grid = np.linspace(0.9 * SIGMA, CUTOFF * SIGMA, 20001)
    force = F_0 * (2 * (SIGMA / grid) ** 13 - (SIGMA / grid) ** 7)
    work = np.sum((force[1:] + force[:-1]) / 2) * (grid[1] - grid[0])
    assert steric_energy(scene, crossed_segments(scene, 0.9 * SIGMA)) == pytest.approx(work, rel=1e-6)


def test_contact_conserves_force_and_torque(precision, device):
    scene = touching_cell({"flagella.count": 3, "flagellum.2.azimuth": 3.0}, precision)
    start = shaken(scene, seed=4, node=0.002, spin=0.0, body=0.0)
    first, second, _ = contacts(Simulation(scene, device=device, starts=start))
    x = np.concatenate(start.positions)
    force = np.vstack([first, second])
    arm = np.vstack([np.roll(x, 1, axis=0), x])
    assert np.abs(first).max() > F_0
    # To round-off of the type, not to the tolerance of this file.
    epsilon = 100 * float(np.finfo(precision).eps)
    assert np.abs(force.sum(axis=0)).max() < epsilon * np.abs(force).sum()
    torque = np.cross(arm, force)
    assert np.abs(torque.sum(axis=0)).max() < epsilon * np.abs(torque).sum()


def test_sum_of_magnitudes_counts_every_pair_once(precision, device):
    scene = touching_cell({}, precision)
    start = shaken(scene, seed=5, node=0.002, spin=0.0)
    sim = Simulation(scene, device=device, starts=start)
    sim.evaluate()
    r = contact_distances(start) / SIGMA
    assert r.min() > 0.7
    expected = F_0 * np.where(r < CUTOFF, 2 * r**-13 - r**-7, 0.0).sum()
    assert sim.cell_state().steric_force == pytest.approx(expected, rel=TOLERANCE[precision])


def test_parallel_and_touching_segments_stay_finite(precision, device):
    scene = cell(FOUR, precision)
    starts = [
        crossed_segments(scene, 0.9 * SIGMA, angle=0.0),
        crossed_segments(scene, 0.9 * SIGMA, angle=math.pi),
        crossed_segments(scene, 0.9 * SIGMA, angle=1e-5),
        crossed_segments(scene, 0.0),
        crossed_segments(scene, 0.0, angle=0.0),
    ]
    sim = Simulation([scene] * len(starts), device=device, starts=starts)
    first, second, _ = contacts(sim)
    on_last = (first + second).reshape(len(starts), 2, 5, 3)[:, :, 4]
    assert np.isfinite(first).all() and np.isfinite(second).all()
    # Side by side, the segment touches its partner and the end of the one before that: two pairs.
    strength = 2 * F_0 * (2 * 0.9**-13 - 0.9**-7)
    assert on_last[:3, 0, 2] == pytest.approx(-strength, rel=10 * TOLERANCE[precision])
    largest = np.abs([first, second]).reshape(2, len(starts), -1).max(axis=(0, 2))
    assert (np.abs(on_last[:, 0] + on_last[:, 1]).max(axis=1) < 1e-5 * largest).all()
    assert np.linalg.norm(on_last[3, 0]) > 100 * F_0  # exactly crossed: parted across both


def test_body_pushes_nodes_off_its_surface(precision, device):
    """By the force law at their distance from the spherocylinder, along its normal, with the reaction on the body."""
    scene = cell({"flagella.length": 1.2}, precision)
    normal, slant, front = np.array([0.0, 1.0, 0.0]), unit(np.array([0.3, 0.5, 0.6])), unit(np.array([0.3, 0.5, -0.2]))
    gap = np.array([1.0, 0.9, 1.05, 0.95]) * SIGMA
    touching = [
        np.array([0.0, 0.0, 0.2]) + (0.4 + gap[0]) * normal,  # on the cylinder
        np.array([0.0, 0.0, 0.85]) + (0.4 + gap[1]) * slant,  # on the rear cap
        np.array([0.0, 0.0, 1.25 + gap[2]]),  # on its tip
        np.array([0.0, 0.0, -0.85]) + (0.4 + gap[3]) * front,  # on the front cap
    ]
    directions = np.stack([normal, slant, [0.0, 0.0, 1.0], front])
    far = [np.array([-2.0, 0.0, 1.0 + 0.2 * i]) for i in range(6)]
    lead = [np.array([0.6, 0.1, 0.5]), np.array([0.5, 0.7, 0.3])]
    start = placed(scene, [np.array([*lead, *touching]), np.array(far)])
    sim = Simulation(scene, device=device, starts=start)
    _, _, body = contacts(sim)
    x = gap / SIGMA
    expected = (F_0 * (2 * x**-13 - x**-7))[:, None] * directions
    assert body[3:7] == pytest.approx(expected, abs=10 * TOLERANCE[precision])
    others = np.setdiff1d(np.arange(len(body)), [3, 4, 5, 6])
    assert np.abs(body[others]).max() == 0.0
    # What the body feels: the anchors' pull, the motors, and the reaction with its torque.
    found = sim.evaluate()
    first = anchors(scene)
    pull = found.forces[first].sum(axis=0)
    largest = np.abs(found.forces).max()
    assert found.body_force == pytest.approx(pull - expected.sum(axis=0), abs=TOLERANCE[precision] * largest)


def test_distance_of_segments_against_brute_force(precision, device):
    """The device's closest points are never farther than the best of a fine grid, and as near as it can tell."""
    p = Precision(precision)
    random = np.random.default_rng(6)
    count = 300
    start, along, start_2, along_2 = random.uniform(-1, 1, (4, count, 3))
    along_2[:30] = along[:30] * random.uniform(-2, 2, (30, 1))  # parallel
    start_2[:10] = start[:10] + along[:10] * random.uniform(-2, 2, (10, 1))  # on one line
    inputs = [wp.array(a, dtype=p.vec3, device=device) for a in (start, along, start_2, along_2)]
    out = wp.zeros(count, dtype=steric.functions(p).vec2, device=device)
    wp.launch(closest_kernel(p), count, inputs=[*inputs, out], device=device)
    s, t = out.numpy().astype(np.float64).T
    assert ((s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)).all()
    found = np.linalg.norm(start + s[:, None] * along - start_2 - t[:, None] * along_2, axis=1)

    grid = np.linspace(0, 1, 51)
    points = start[:, None] + grid[None, :, None] * along[:, None]
    points_2 = start_2[:, None] + grid[None, :, None] * along_2[:, None]
    brute = np.linalg.norm(points[:, :, None] - points_2[:, None], axis=-1).min(axis=(1, 2))
    arrays = (start, along, start_2, along_2)
    exact = np.array([segment_distances(*(a[i : i + 1] for a in arrays))[0, 0] for i in range(count)])
    assert (exact <= brute + 1e-12).all() and (brute <= exact + 0.05).all()
    assert np.abs(found - exact).max() < {"float64": 1e-7, "float32": 1e-3}[precision]


def closest_kernel(p: Precision):
    vec3, vec2, closest = p.vec3, steric.functions(p).vec2, steric.functions(p).closest_parameters

    @wp.kernel(module=p.module("test_closest"))
    def closest_points(
        p1: wp.array(dtype=vec3),
        d1: wp.array(dtype=vec3),
        p2: wp.array(dtype=vec3),
        d2: wp.array(dtype=vec3),
        out: wp.array(dtype=vec2),
    ):
        i = wp.tid()
        out[i] = closest(p1[i], d1[i], p2[i], d2[i])

    return closest_points
