"""Thermal velocities with flow round the body: roots of the whole mobility, its divergence, a passive cell at rest."""

from __future__ import annotations

from typing import Any

import numpy as np
from warpflag_kernels.fluid import body_noise

from tests.helpers import displaced, free_nodes, matrix, shaken, touching_cell
from tests.oracles import dense_mobility, expected_pair_radius, whole_mobility
from tests.thermal.test_noise import KT, STEP, WARM, Draw, root
from warpflag.model.geometry import InitialState
from warpflag.model.shell import body_shell
from warpflag.scene import Scene, with_values

# Relative to the largest value, for what is exact: float64, float32.
TOLERANCE = {"float64": 1e-10, "float32": 3e-5}
FLOW = {"hydrodynamics.body_flow": True, "hydrodynamics.body_beads": 30, "flagella.length": 0.8, **WARM}


def small_cell(precision: str, values: dict[str, Any] | None = None) -> Scene:
    """Two short flagella in contact, r_1 beside the body."""
    return touching_cell({**FLOW, **(values or {})}, precision)


def whole(scene: Scene, start: InitialState) -> np.ndarray:
    """Mobility of body and moving nodes, dense."""
    shell = body_shell(scene.body.length, scene.body.width, scene.hydrodynamics.body_beads)
    return whole_mobility(scene, start, shell.points, shell.radius)


def beside_held_body(scene: Scene, start: InitialState) -> np.ndarray:
    """Pair mobility of the nodes beside a body that is held: the Schur complement of the whole, less what the local
    mobility has beyond the beads' own."""
    m, radius = whole(scene, start), expected_pair_radius(scene)
    local = dense_mobility(
        with_values(scene, {"hydrodynamics.mode": "none", "hydrodynamics.body_flow": None}), start, radius
    )
    own = np.eye(len(local)) / (6 * np.pi * scene.fluid.viscosity * radius)
    return m[6:, 6:] - m[6:, :6] @ np.linalg.solve(m[:6, :6], m[:6, 6:]) - local + own


def drawn(draw: Draw, number: int, cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Over (2 kT/dt)^1/2, per cell: z, what Lanczos' process makes of it, the bodies' motion, and what that does to
    the nodes."""
    before = draw.local(number)
    stepper, scale = draw.stepper, (2 * KT / STEP) ** 0.5
    added = []
    real_carry, real_divergence = body_noise.carry, body_noise.add_divergence

    def carry(model: Any, state: Any, noise: Any, *rest: Any) -> None:
        added.append(noise.node.numpy().astype(np.float64))
        real_carry(model, state, noise, *rest)
        added.append(noise.node.numpy().astype(np.float64))

    body_noise.carry, body_noise.add_divergence = carry, lambda *_: None
    try:
        stepper.draw_flows(in_single=False)
    finally:
        body_noise.carry, body_noise.add_divergence = real_carry, real_divergence
    by_pairs, by_body = added[0] - before, added[1] - added[0]
    z = stepper.lanczos.data
    sizes = z.size.numpy()[draw.model.data.cell_of.numpy()]
    start = z.basis.numpy()[: draw.model.element_count].astype(np.float64) * sizes[:, None]
    motion = stepper.noise.body.numpy().astype(np.float64) / scale
    return (
        start[draw.moving].reshape(cells, -1),
        (by_pairs[draw.moving, :3] / scale).reshape(cells, -1),
        motion,
        (by_body[draw.moving, :3] / scale).reshape(cells, -1),
    )


def test_roots_make_up_the_whole_mobility(precision, device):
    """100 vectors at 20 shapes: Lanczos' root beside the held body, to its tolerance; the flow of the moving body, and
    the root of its mobility, to round-off."""
    scene = small_cell(precision)
    starts = [shaken(scene, seed, node=0.002) for seed in range(20)]
    exact = [whole(scene, start) for start in starts]
    held = [root(beside_held_body(scene, start)) for start in starts]
    for tolerance, most in ((None, 2e-2), (1e-5, 1e-5 if precision == "float64" else 2e-4)):
        scenes = [with_values(scene, {"fluid.seed": i, "fluid.noise_tolerance": tolerance}) for i in range(20)]
        draw = Draw(scenes, starts, device)
        for number in range(5 if tolerance is None else 1):
            z, pairs, motion, carried = drawn(draw, number, 20)
            for c in range(20):
                m = exact[c]
                assert np.linalg.norm(pairs[c] - held[c] @ z[c]) < most * np.linalg.norm(pairs[c])
                by_body = m[6:, :6] @ np.linalg.solve(m[:6, :6], motion[c])
                assert abs(carried[c] - by_body).max() < TOLERANCE[precision] * abs(by_body).max()
    roots = draw.stepper.noise.body_root.numpy().reshape(20, 6, 6).astype(np.float64)
    for start, m, r in zip(starts, exact, roots, strict=True):
        turn = np.kron(np.eye(2), matrix(start.body_orientation))
        assert abs(turn @ r @ r.T @ turn.T - m[:6, :6]).max() < TOLERANCE[precision] * abs(m[:6, :6]).max()


def test_velocities_have_the_covariance_of_the_whole_mobility(device):
    """Along 20 directions of nodes and body together, over 8000 draws."""
    count, draws = 400, 20
    scene = small_cell("float64", {"flagella.length": 0.4})
    start = shaken(scene, 3, node=0.002)
    draw = Draw([with_values(scene, {"fluid.seed": i}) for i in range(count)], [start] * count, device)
    found = []
    for number in range(draws):
        draw.local(number)
        draw.stepper.draw_flows(in_single=False)
        nodes = draw.stepper.noise.node.numpy()[draw.moving, :3].reshape(count, -1)
        found.append(np.hstack([draw.stepper.noise.body.numpy(), nodes]))
    found = np.concatenate(found)
    found -= found.mean(axis=0)
    scale, m = 2 * KT / STEP, whole(scene, start)
    for direction in np.random.default_rng(1).standard_normal((20, len(m))):
        exact = direction @ m @ direction
        assert abs(np.var(found @ direction) / (scale * exact) - 1) < 3.5 * (2 / (count * draws)) ** 0.5


def test_the_finite_difference_is_the_divergence(precision, device):
    """It is a square form of its deviates: its values at all unit vectors add up to kT div M, of nodes and body, less
    the part of the local mobility, which has a closed form."""
    scene = small_cell(precision)
    start, nodes = shaken(scene, 3, node=0.002), free_nodes(small_cell(precision))
    count = 6 + 3 * len(nodes)
    scenes = [with_values(scene, {"fluid.seed": 0})] * count
    draw = Draw(scenes, [start] * count, device)
    noise, elements = draw.stepper.noise, draw.model.element_count // count
    draw.local()
    probe, shift, turn = np.zeros((count, elements, 3)), np.zeros((count, 3)), np.zeros((count, 3))
    for j in range(count):
        if j < 3:
            shift[j, j] = 1.0
        elif j < 6:
            turn[j, j - 3] = 1.0
        else:
            probe[j, nodes[(j - 6) // 3], j % 3] = 1.0
    noise.probe.assign(probe.reshape(-1, 3))
    noise.probe_shift.assign(shift)
    noise.probe_turn.assign(turn)
    noise.node.zero_()
    noise.body.zero_()
    place = draw.state.data.pose.position.numpy()
    body_noise.add_divergence(draw.model, draw.state, draw.sim.system.chart, noise)
    assert np.array_equal(draw.state.data.pose.position.numpy(), place)
    of_nodes = noise.node.numpy()[draw.moving, :3].reshape(count, -1).sum(axis=0)
    found = np.concatenate([noise.body.numpy().sum(axis=0), of_nodes])
    exact, width = np.zeros(count), 1e-4
    local = np.zeros(count)
    for j in range(count):
        columns = []
        for sign in (1, -1):
            moved = np.zeros((elements, 3))
            if j >= 6:
                moved[nodes[(j - 6) // 3], j % 3] = sign * width
            shape = displaced(
                scene, start, moved, 0.0,
                sign * width * np.eye(6)[min(j, 5), :3] * (j < 6), sign * width * np.eye(6)[min(j, 5), 3:] * (j < 6),
            )  # fmt: skip
            own = dense_mobility(scene, shape, expected_pair_radius(scene))
            columns.append((whole(scene, shape)[:, j], own[:, j - 6] if j >= 6 else np.zeros(count - 6)))
        exact += KT * (columns[0][0] - columns[1][0]) / (2 * width)
        local[6:] += KT * (columns[0][1] - columns[1][1]) / (2 * width)
    exact -= local
    tolerance = {"float64": 1e-4, "float32": 1e-2}[precision]
    assert abs(found - exact).max() < tolerance * abs(exact).max()
