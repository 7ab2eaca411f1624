"""Node velocities: exact Rotne-Prager values, the printed law node by node, and which mobilities are sound."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.base.plan import Plan
from warpflag_kernels.fluid import node_velocity, rotne_prager

from tests.helpers import anchors, attachment, cell, evaluated, free_nodes, placed, shaken, tangents, touching_cell
from tests.oracles import contact_distances, dense_mobility, device_mobility, drag_coefficients, expected_pair_radius
from tests.plans import by_elements, plan
from warpflag.model.terms import switches_of
from warpflag.run.simulation import Simulation
from warpflag.scene import with_values
from warpflag.scene.resistance import pair_radius

# Of the largest velocity or mobility.
TOLERANCE = {"float64": 1e-12, "float32": 2e-5}

MODES = ("none", "within", "between", "all", "as_printed", "consistent")


def two_nodes(scene, separation: np.ndarray):
    """Two flagella of two segments that end side by side along z, at the given separation."""
    nodes = []
    for k in range(2):
        end = np.array([0.0, 0.0, 8.0]) + k * separation
        nodes.append(np.stack([end - np.array([0.0, 0.0, 0.2]), end]))
    return placed(scene, nodes)


def pair_block(scene, separation: np.ndarray, device: str) -> np.ndarray:
    """Velocity of the one last node per force on the other, in units of 1/(6 pi eta a), shape [3, 3]."""
    sim = Simulation(scene, device=device, starts=two_nodes(scene, separation))
    return device_mobility(sim)[3:6, 9:12] * 6 * math.pi * scene.fluid.viscosity * 0.05


def test_rotne_prager_exact_values(precision, device):
    """A force along z on beads of a = 0.05 um at r = 2a: 0.625 along, 0.4375 across; the limits r -> 0 and r -> oo."""
    scene = cell({"flagella.length": 0.4, "hydrodynamics.pair_radius": 0.05}, precision)
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]

    def along_and_across(r: float) -> tuple[float, float]:
        block = turn.T @ pair_block(scene, r * turn[:, 0], device) @ turn
        off_diagonal = block - np.diag(np.diag(block))
        assert np.abs(off_diagonal).max() < 2 * tolerance and abs(block[1, 1] - block[2, 2]) < 2 * tolerance
        return block[0, 0], block[1, 1]

    # r itself is known only as well as a position 8 um from the body.
    tolerance = 100 * TOLERANCE[precision]
    assert along_and_across(0.1) == pytest.approx((0.625, 0.4375), abs=tolerance)
    assert along_and_across(0.1 * (1 + 1e-5)) == pytest.approx((0.625, 0.4375), abs=tolerance + 1e-5)
    assert along_and_across(0.05) == pytest.approx((1 - 6 / 32, 1 - 9 / 32), abs=tolerance)
    assert along_and_across(1e-4) == pytest.approx((1 - 6e-4 / 1.6, 1 - 9e-4 / 1.6), abs=tolerance)
    assert along_and_across(0.0) == pytest.approx((1.0, 1.0), abs=tolerance)
    # Far away: the Oseen tensor 1/(8 pi eta r) (I + rr), up to (a/r)^2.
    oseen = 0.75 * 0.05 / 2.0
    assert along_and_across(2.0) == pytest.approx((2 * oseen, oseen), rel=1e-3)
    assert along_and_across(2.0) == pytest.approx(
        (oseen * (2 - 4 / 3 / 1600), oseen * (1 + 2 / 3 / 1600)), abs=tolerance
    )


@pytest.mark.parametrize("mode", MODES)
def test_velocities_follow_the_dense_mobility(mode, precision, device):
    unequal = {"flagellum.1.length": 1.2, "flagellum.1.segments": 5, "fluid.viscosity": 0.7e-3}
    scene = touching_cell({"hydrodynamics.mode": mode, **unequal}, precision)
    if mode == "consistent":
        scene = touching_cell({"hydrodynamics.mode": mode, "fluid.viscosity": 0.7e-3}, precision)
        radius, drag = pair_radius(scene), consistent_drag(0.2, 0.01, pair_radius(scene), 0.7e-3)
    else:
        radius, drag = expected_pair_radius(scene), None
        assert mode == "as_printed" or pair_radius(scene) == pytest.approx(0.24 / 0.2 * 0.029709, rel=1e-4)
    start = shaken(scene, seed=7, node=0.005)
    found = evaluated(scene, start, device)
    nodes = free_nodes(scene)
    expected = dense_mobility(scene, start, radius, drag) @ found.forces[nodes].ravel()
    assert np.abs(found.velocities[nodes].ravel() - expected).max() < TOLERANCE[precision] * np.abs(expected).max()


def consistent_drag(h: float, radius: float, a_pair: float, viscosity: float) -> tuple[float, float]:
    """Local drag along and across that leaves to the pair sum what it carries itself (see the test below)."""
    shell = math.log(2 * h / (radius * math.sqrt(math.e))) - np.euler_gamma
    beads = 1.2020569031595942 * (a_pair / h) ** 2  # zeta(3), the sum of 1/n^3
    scale = 4 * math.pi * viscosity
    return scale / (2 * shell + 4 / 3 * beads), scale / (1 + shell - 2 / 3 * beads)


def test_consistent_mode_on_a_straight_filament_does_not_depend_on_h(precision, device):
    """Uniform force f per length on a filament of half-length q: Lighthill's theorem gives, with delta = a sqrt(e)/2,
    the middle 2 ln(q/delta) f/(4 pi eta) along and (1 + ln(q/delta)) f/(4 pi eta) across."""
    delta = 0.01 * math.sqrt(math.e) / 2
    for h in (0.05, 0.1, 0.2):
        length = 161 * h  # an odd number of nodes r_1..r_N
        values = {"flagella.count": 1, "flagella.length": length, "flagella.segment_length": h}
        scene = cell({**values, "hydrodynamics.mode": "consistent"}, precision)
        spec = scene.resolved_flagella()[0]
        count = spec.segment_count
        steps = h * np.arange(1, count + 1)[:, None] * np.array([0.0, 0.0, 1.0])
        start = placed(scene, [attachment(scene, spec)[0] + steps])
        sim = Simulation(scene, device=device, starts=start)
        mobility = middle_rows(sim, count)
        log = math.log(length / 2 / delta)
        found = mobility.sum(axis=0) * h * 4 * math.pi * scene.fluid.viscosity
        assert found[2, 2] == pytest.approx(2 * log, rel=2e-4)
        assert found[0, 0] == pytest.approx(1 + log, rel=2e-4)


def middle_rows(sim, count: int) -> np.ndarray:
    """Velocity of the middle node per force on each node, shape [count, 3, 3]."""
    middle = count // 2
    mobility = device_mobility(sim).reshape(count, 3, count, 3)
    return mobility[middle].transpose(1, 0, 2)


def contact_mobility(mode: str, precision: str, device: str, separation: float = 0.042) -> np.ndarray:
    scene = touching_cell({"hydrodynamics.mode": mode}, precision, separation)
    start = shaken(scene, seed=8, node=0.002, spin=0.0)
    return device_mobility(Simulation(scene, device=device, starts=start))


@pytest.mark.parametrize("mode", ["none", "within", "all", "consistent"])
def test_mobility_is_symmetric_and_positive_definite_in_contact(mode, precision, device):
    for separation in (0.042, 0.02):
        mobility = contact_mobility(mode, precision, device, separation)
        assert np.abs(mobility - mobility.T).max() < TOLERANCE[precision] * np.abs(mobility).max()
        # The local term less a bead's own is the floor where the pair radius is derived.
        assert np.linalg.eigvalsh(mobility).min() > 0.05 / (drag_coefficients(cell())[1] * 0.2)


def test_mobility_as_printed_is_not_positive_definite_in_contact(precision, device):
    """Nodes of different flagella closer than about 0.043 um attract where they are pushed apart: hence mode all.

    Two nodes alone: local 1/(gamma_perp h) = 1786 against the Rotne-Prager term of a = 0.010 um along their distance.
    """
    scene = cell({"flagella.length": 0.4, "hydrodynamics.mode": "as_printed"}, precision)
    lowest = []
    for r in (0.045, 0.040):
        sim = Simulation(scene, device=device, starts=two_nodes(scene, np.array([r, 0.0, 0.0])))
        ends = device_mobility(sim)[np.ix_([3, 9], [3, 9])] - np.diag([1 / (2.8e-3 * 0.2)] * 2)  # as inner nodes
        lowest.append(np.linalg.eigvalsh(ends)[0])
    assert lowest[0] > 0 > lowest[1]
    assert lowest[1] == pytest.approx(1 / 0.56e-3 - 1 / (8e-3 * math.pi * 0.04) * (2 - 4 / 3 / 16), rel=1e-3)
    assert np.linalg.eigvalsh(contact_mobility("as_printed", precision, device, separation=0.036)).min() < 0


def test_pairs_between_flagella_alone_are_not_positive_definite_side_by_side(precision, device):
    """Without the flow that keeps a filament's own nodes together, the flow of its neighbour outweighs its drag."""
    assert np.linalg.eigvalsh(contact_mobility("between", precision, device)).min() < 0


def test_free_end_carries_half_a_segment(precision, device):
    """Drag of h at inner nodes and h/2 at the last, there along the last segment."""
    scene = cell({"hydrodynamics.mode": "none"}, precision)
    start = shaken(scene, seed=9)
    found = evaluated(scene, start, device)
    parallel, perpendicular, _ = drag_coefficients(scene)
    (nodes, t) = start.positions[0], tangents(scene, start)[0]
    last, inner = len(nodes) - 1, 3
    for node, direction, length in ((last, t[last], 0.1), (inner, t[inner] + t[inner + 1], 0.2)):
        tangent = direction / np.linalg.norm(direction)
        force = found.forces[node]
        along = (force @ tangent) * tangent
        expected = (along / parallel + (force - along) / perpendicular) / length
        assert np.abs(found.velocities[node] - expected).max() < TOLERANCE[precision] * np.abs(expected).max()


def test_spins_and_anchors(precision, device):
    """Spin is torque over gamma_R h for every segment and the tripod; r_0 goes with the body."""
    scene = cell({"flagellum.0.segments": 5, "flagellum.1.segments": 10}, precision)
    start = shaken(scene, seed=10)
    found = evaluated(scene, start, device)
    h = np.repeat([0.4, 0.2], [6, 11])
    expected = found.torques / (1.26e-6 * h)
    assert np.abs(found.spins - expected).max() < TOLERANCE[precision] * np.abs(expected).max()
    arms = np.concatenate(start.positions)[anchors(scene)] - start.body_position
    carried = found.body_velocity + np.cross(found.body_spin, arms)
    assert np.abs(found.velocities[anchors(scene)] - carried).max() < TOLERANCE[precision] * np.abs(carried).max()


def test_drag_scales_with_viscosity_unless_it_is_given(device):
    """At equal forces ten times the viscosity gives a tenth of every velocity; a given gamma stands."""
    scene = touching_cell()
    start = shaken(scene, seed=11, node=0.002)
    thin = evaluated(scene, start, device)
    thick = evaluated(with_values(scene, {"fluid.viscosity": 1e-2}), start, device)
    for name in ("velocities", "spins", "body_velocity", "body_spin"):
        assert getattr(thick, name) == pytest.approx(getattr(thin, name) / 10, rel=1e-10)
    given = {"fluid.viscosity": 1e-2, "fluid.drag_rotation": 5e-6}
    assert evaluated(with_values(scene, given), start, device).spins == pytest.approx(thin.spins * 1.26 / 5, rel=1e-10)


# Other ways to the same numbers.


def ragged(mode: str, precision: str) -> list:
    """A batch of two, three and two flagella of unequal lengths, of other meshes and fluids."""
    common = {"hydrodynamics.mode": mode}
    unequal = {"flagellum.1.length": 1.2, "flagellum.1.segments": 5}
    three = {"flagella.count": 3, "flagella.segment_length": 0.1, "flagellum.2.length": 0.7, "fluid.viscosity": 2e-3}
    return [
        touching_cell({**common, **unequal}, precision),
        cell({**common, **three}, precision),
        touching_cell({**common, "flagella.length": 0.4}, precision, separation=0.02),
    ]


def velocities(scenes: list, plan: Plan, forces: np.ndarray) -> np.ndarray:
    """Velocities of nodes r_1..r_N of a batch under given forces, as planned."""
    starts = [shaken(scene, seed, node=0.002) for seed, scene in enumerate(scenes)]
    sim = Simulation(scenes, plan=plan, starts=starts)
    sim.evaluate()
    model, state = sim.system.model, sim.system.state
    state.data.active.fill_(1)
    state.data.force.assign(forces[: model.element_count])
    node_velocity.node_velocities(model, state)
    free = np.setdiff1d(np.arange(model.element_count), model.data.first_node.numpy())
    return state.data.velocity.numpy()[free].astype(np.float64)


@pytest.mark.parametrize("pairs", ["same", "float32"])
@pytest.mark.parametrize("mode", ["within", "between", "all"])
def test_every_way_to_the_pair_sum_gives_the_same(mode, pairs, precision, device, monkeypatch):
    """Every pair once for both nodes, as one thread of a CPU does it, or gathered at each, by a thread or by a warp; a
    CPU's fibers stand for the warp's threads."""
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    values = {"hydrodynamics.mode": mode, "numerics.pair_precision": pairs}
    scenes = [with_values(scene, values) for scene in ragged(mode, precision)]
    forces, own = np.random.default_rng(12).uniform(-1, 1, (200, 3)), plan(scenes[0], device)
    forms = {"thread": by_elements(own), "warp": by_elements(own, pair_sum="warp")}
    if wp.get_device(device).is_cpu:
        forms["symmetric"] = own
    found = {name: velocities(scenes, form, forces) for name, form in forms.items()}
    assert own.pair_sum in found
    # To round-off of the terms' type.
    digits = 20 * float(np.finfo("float32" if pairs == "float32" else precision).eps)
    for name, values in found.items():
        assert np.abs(values - found["thread"]).max() < digits * np.abs(found["thread"]).max(), name


SHORT = {"numerics.pair_precision": "float32"}


@pytest.mark.parametrize("form", ["as it comes", "gathered", "strict"])
@pytest.mark.parametrize("mode", ["within", "between", "all"])
def test_pairs_in_float32_change_velocities_by_its_round_off(mode, form, device):
    """Terms in float32, sums in float64: more nodes lose no more digits."""
    scene = cell({"hydrodynamics.mode": mode, "flagella.count": 3, "flagella.segment_length": 0.02})
    found = []
    for values, real in (({}, np.float64), (SHORT, np.float32)):
        own = with_values(scene, values)
        planned = by_elements(plan(own, device)) if form == "gathered" else None
        start = shaken(scene, 4, node=0.002)
        sim = Simulation(own, device=device, starts=start, strict=form == "strict", plan=planned)
        state = sim.system.state
        assert len(state.data.pose.position) > 2 * rotne_prager.FLOAT32_TERMS
        found.append(sim.evaluate().velocities)
        assert all(a.numpy().dtype == real for a in (state.pairs.x, state.pairs.fz))
        assert state.data.velocity.numpy().dtype == np.float64
        symmetric = sim.system.model.plan.pair_sum == "symmetric"
        assert (state.pairs.total_x is not None) == (symmetric and values == SHORT)
    error = np.abs(found[1] - found[0]).max() / np.abs(found[0]).max()
    assert 1e-10 < error < 1e-6


def test_pairs_in_float32_keep_the_mobility_symmetric_and_positive_definite(device):
    scene = touching_cell(SHORT, "float64", 0.03)
    found = device_mobility(Simulation(scene, device=device, starts=shaken(scene, seed=8, node=0.002, spin=0.0)))
    assert np.abs(found - found.T).max() < 1e-6 * np.abs(found).max()
    assert np.linalg.eigvalsh(found).min() > 0.05 / (drag_coefficients(cell())[1] * 0.2)


def test_float32_pairs_in_a_float32_run_are_what_it_has_anyway():
    assert switches_of(cell(SHORT, "float32")) == switches_of(cell({}, "float32"))
    assert switches_of(cell({**SHORT, "hydrodynamics.mode": "none"})) == switches_of(
        cell({"hydrodynamics.mode": "none"})
    )


# The implicit stepper finds flows of force changes in single precision, and all flows of its first iteration.
@pytest.mark.parametrize("stepper, apart", [("rkc", 1e-9), ("implicit", 1e-6)])
def test_fast_and_strict_builds_agree(stepper, apart, device):
    """Reassociation and fused operations change the last digits and nothing else: forces and velocities of a state in
    contact, and where the nodes are after a millisecond in which the motors turn nine times."""
    scene = touching_cell({"numerics.stepper": stepper, "numerics.time_step": 5e-6})
    start = shaken(scene, seed=3, node=1e-3, spin=0.01)
    assert (contact_distances(start) < 0.0448).sum() > 10
    fast, strict = (Simulation(scene, device=device, starts=start, strict=s) for s in (False, True))
    a, b = fast.evaluate(), strict.evaluate()
    for name in ("forces", "torques", "velocities", "spins", "body_force", "body_torque", "body_velocity", "body_spin"):
        found, expected = getattr(a, name), getattr(b, name)
        assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max(), name
    for sim in (fast, strict):
        sim.advance(1e-3)
    x, y = fast.cell_state(), strict.cell_state()
    assert np.abs(x.positions - y.positions).max() < apart * np.abs(y.positions).max()
    assert np.abs(x.directors - y.directors).max() < 5 * apart
    assert y.motor_angle.min() > 9 * 2 * math.pi
