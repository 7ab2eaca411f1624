"""Thermal velocities of a step: their covariance is that of the dense mobility, their mean kT times its divergence."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.base.types import structs
from warpflag_kernels.contact import contact_list, search
from warpflag_kernels.fluid import lanczos, lanczos_space, noise
from warpflag_kernels.implicit import delassus
from warpflag_kernels.rod import elastic, forces, hessian
from warpflag_kernels.thermal import equilibrium, strain_gradients

from tests.bench import Bench
from tests.helpers import cell, free_nodes, shaken, touching_cell
from tests.helpers import matrix as rotation_of
from tests.oracles import dense_mobility, drag_coefficients, rotne_prager
from warpflag.model.geometry import InitialState
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, with_values
from warpflag.scene.resistance import filament_mobility, pair_radius, spheroid_mobility

# Relative to the largest value, for what is exact: float64, float32.
TOLERANCE = {"float64": 1e-12, "float32": 1e-5}
WARM = {"fluid.temperature": 300.0, "numerics.stepper": "implicit"}
KT = 1.380649e-5 * 300.0
STEP = 1e-6


class Draw:
    """A batch of cells at rest in their starts, and thermal velocities drawn for them."""

    def __init__(self, scenes: list[Scene], starts: list[InitialState] | None, device: str) -> None:
        self.sim = Simulation(scenes, device=device, starts=starts)
        self.sim.evaluate()
        s = self.sim.system
        self.model, self.state, self.control, self.stepper = s.model, s.state, s.control, self.sim.stepper
        self.control.step.fill_(STEP)
        self.state.data.active.fill_(1)
        self.moving = np.concatenate(
            [
                free_nodes(scene) + s.model.data.first_node.numpy()[c * len(scene.resolved_flagella())]
                for c, scene in enumerate(scenes)
            ]
        )

    def local(self, number: int = 0) -> np.ndarray:
        """Local velocities [um/s] and spins [rad/s] of step `number`, shape [element_count, 4]."""
        self.control.steps.fill_(number)
        noise.draw_local(self.model, self.state, self.control, self.stepper.noise)
        return self.stepper.noise.node.numpy().astype(np.float64)

    def pairs(self, number: int) -> tuple[np.ndarray, np.ndarray]:
        """What the pair sum adds in that step, over (2 kT/dt)^1/2, and the vector z that it is the root of; per moving
        node."""
        before = self.local(number)
        lanczos.draw_pairs(self.model, self.state, self.control, self.stepper.noise, self.stepper.lanczos)
        after = self.stepper.noise.node.numpy().astype(np.float64)
        z = self.stepper.lanczos.data
        sizes = z.size.numpy()[self.model.data.cell_of.numpy()]
        start = z.basis.numpy()[: self.model.element_count] * sizes[:, None]
        scale = (2 * KT / STEP) ** 0.5
        return ((after - before) / scale)[self.moving, :3], start[self.moving].astype(np.float64)


def pair_matrix(scene: Scene, start: InitialState) -> np.ndarray:
    """The Rotne-Prager sum of a cell with its self term, dense."""
    matrix = dense_mobility(scene, start, pair_radius(scene))
    count = len(matrix) // 3
    blocks = matrix.reshape(count, 3, count, 3)
    for i in range(count):
        blocks[i, :, i, :] = np.eye(3) / (6 * np.pi * scene.fluid.viscosity * pair_radius(scene))
    return matrix


def root(matrix: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eigh(matrix)
    assert values.min() > 0
    return vectors * np.sqrt(values) @ vectors.T


@pytest.mark.parametrize("mode", ["none", "within", "all", "consistent"])
def test_local_roots_and_the_pair_sum_make_up_the_mobility(mode, precision, device):
    """S^1/2 S^1/2 + R is the mobility of the nodes, to round-off."""
    scene = cell({"hydrodynamics.mode": mode, "flagella.count": 1, **WARM}, precision)
    start = shaken(scene, 1)
    draw = Draw([scene], [start], device)
    p = draw.model.precision
    f = noise.functions(p, mode != "none")
    excess_root, Model, State = f.excess_root, structs(p).Model, structs(p).State
    columns = []
    found = wp.zeros(draw.model.element_count, dtype=p.vec3, device=draw.model.device)

    @wp.kernel(module="unique")
    def apply(model: Model, state: State, xi: p.vec3, out: wp.array(dtype=p.vec3)):
        e = wp.tid()
        out[e] = excess_root(model, state, e, 0, 0, xi)

    for axis in np.eye(3):
        wp.launch(
            apply, len(found), inputs=[draw.model.data, draw.state.data, p.vec3(*axis), found], device=found.device
        )
        columns.append(found.numpy()[1:].astype(np.float64))
    roots = np.stack(columns, axis=2)
    local = roots @ roots.transpose(0, 2, 1)
    own = 0.0 if mode == "none" else 1 / (6 * np.pi * scene.fluid.viscosity * pair_radius(scene))
    m = filament_mobility(scene, scene.resolved_flagella()[0].segment_length)
    h = scene.resolved_flagella()[0].segment_length
    exact = dense_mobility(scene, start, 0.02, (1 / (m.along * h), 1 / (m.across * h)))
    count = len(exact) // 3
    for i in range(count):
        block = exact[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        assert abs(local[i] + own * np.eye(3) - block).max() < TOLERANCE[precision] * abs(block).max()


@pytest.mark.parametrize("mode", ["within", "all", "consistent"])
def test_lanczos_root_of_the_pair_sum(mode, precision, device):
    """100 vectors, at 20 shapes of two flagella apart or in contact, against the dense root, by what is documented."""
    apart = cell({"hydrodynamics.mode": mode, "flagella.length": 1.2, **WARM}, precision)
    close = touching_cell({"hydrodynamics.mode": mode, "flagella.length": 1.2, **WARM}, precision)
    scenes = [apart] * 10 + [close] * 10
    starts = [shaken(scene, seed, node=0.002) for seed, scene in enumerate(scenes)]
    scenes = [with_values(scene, {"fluid.seed": i}) for i, scene in enumerate(scenes)]
    roots = [root(pair_matrix(scene, start)) for scene, start in zip(scenes, starts, strict=True)]
    for tolerance, most in ((None, 1e-2), (1e-3, 1e-3), (1e-5, 1e-5 if precision == "float64" else 1e-4)):
        wanted = [with_values(scene, {"fluid.noise_tolerance": tolerance}) for scene in scenes]
        draw = Draw(wanted, starts, device)
        for number in range(5 if tolerance is None else 1):
            found, z = (x.reshape(20, -1) for x in draw.pairs(number))
            for v, w, exact in zip(found, z, roots, strict=True):
                assert np.linalg.norm(v - exact @ w) < most * np.linalg.norm(v)
        products = draw.stepper.lanczos.data.products.numpy()
        assert np.all(products == 5) if tolerance is None else products.max() < lanczos_space.MOST_PRODUCTS


def test_lanczos_root_with_a_free_end(precision, device):
    """Of a filament without a body r_0 is a node like the others."""
    own = {"body.enabled": False, "flagella.count": 1, "flagella.length": 1.2, "hydrodynamics.mode": "all"}
    scene = cell({**own, "fluid.noise_tolerance": 1e-5, **WARM}, precision)
    start = shaken(scene, 4, node=0.002)
    (x,), radius = start.positions, pair_radius(scene)
    pairs = rotne_prager(x, radius, scene.fluid.viscosity)
    for i in range(len(x)):
        pairs[i, :, i, :] = np.eye(3) / (6 * np.pi * scene.fluid.viscosity * radius)
    draw = Draw([scene], [start], device)
    draw.moving = np.arange(len(x))
    for number in range(3):
        found, z = draw.pairs(number)
        exact = (root(pairs.reshape(3 * len(x), -1)) @ z.ravel()).reshape(-1, 3)
        assert np.linalg.norm((found - exact)[1:]) < (1e-5 if precision == "float64" else 1e-4) * np.linalg.norm(exact)


def test_velocities_have_the_covariance_of_the_mobility(device):
    """Along 20 directions of nodes, spins and body, over 8000 draws."""
    count, draws = 400, 20
    scene = touching_cell({"flagella.length": 0.6, **WARM})
    start = shaken(scene, 3, node=0.002)
    draw = Draw([with_values(scene, {"fluid.seed": i}) for i in range(count)], [start] * count, device)
    spin = 1 / (drag_coefficients(scene)[2] * scene.resolved_flagella()[0].segment_length)
    body = spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity)
    nodes, spins, bodies = [], [], []
    for number in range(draws):
        draw.local(number)
        lanczos.draw_pairs(draw.model, draw.state, draw.control, draw.stepper.noise, draw.stepper.lanczos)
        v = draw.stepper.noise.node.numpy().copy()
        nodes.append(v[draw.moving, :3].reshape(count, -1))
        spins.append(v[:, 3].reshape(count, -1))
        bodies.append(draw.stepper.noise.body.numpy().copy())
    nodes, spins, bodies = (np.concatenate(x) for x in (nodes, spins, bodies))
    scale = 2 * KT / STEP
    three_errors = 3.5 * (2 / (count * draws)) ** 0.5
    matrix = dense_mobility(scene, start, pair_radius(scene))
    mean = nodes.mean(axis=0)
    for direction in np.random.default_rng(1).standard_normal((20, nodes.shape[1])):
        exact = direction @ matrix @ direction
        assert abs(np.var((nodes - mean) @ direction) / (scale * exact) - 1) < three_errors
    assert np.all(abs(spins.var(axis=0) / (scale * spin) - 1) < 1.2 * three_errors)
    turn = rotation_of(start.body_orientation)
    in_body = np.hstack([bodies[:, :3] @ turn, bodies[:, 3:] @ turn])
    exact = np.array([body.across, body.across, body.along, body.tumble, body.tumble, body.spin])
    assert np.all(abs(in_body.var(axis=0) / (scale * exact) - 1) < three_errors)
    # Spins and the parts of the body's motion are independent of each other and of the nodes.
    drawn = np.hstack([in_body, spins, nodes])
    correlated = np.corrcoef(drawn.T)[: in_body.shape[1] + spins.shape[1]]
    np.fill_diagonal(correlated, 0.0)
    assert np.abs(correlated).max() < 5 / (count * draws) ** 0.5


def test_drift_is_the_divergence_of_the_mobility(precision, device):
    scene = cell({"hydrodynamics.mode": "none", "flagella.count": 1, "flagella.length": 1.0, **WARM}, precision)
    start = shaken(scene, 2)
    draw = Draw([scene], [start], device)
    draw.stepper.noise.energy.fill_(KT)
    parts = []
    for sign in (1.0, -1.0):  # the random part goes as the root of the step, the drift does not depend on it
        draw.control.step.fill_(STEP if sign > 0 else 4 * STEP)
        parts.append(draw.local()[1:, :3])
    found = 2 * parts[1] - parts[0]
    exact, width = np.zeros_like(found), 1e-6
    nodes = start.positions[0]
    for i in range(len(found)):
        for axis in range(3):
            ends = []
            for sign in (1, -1):
                moved = nodes.copy()
                moved[i + 1, axis] += sign * width
                shape = InitialState((moved,), start.directors, start.body_position, start.body_orientation)
                ends.append(dense_mobility(scene, shape, 0.02)[3 * i : 3 * i + 3, 3 * i + axis])
            exact[i] += KT * (ends[0] - ends[1]) / (2 * width)
    tolerance = {"float64": 1e-6, "float32": 3e-2}[precision]  # float32: two random parts a hundred times as large
    assert abs(found - exact).max() < tolerance * abs(exact).max()


def test_random_elastic_force_has_the_covariance_of_the_stiffness(device):
    """Over 8000 draws along 20 directions; unloaded, the stiffness without prestress is the whole Hessian."""
    count, draws = 400, 20
    scene = cell({"flagella.length": 0.6, "flagella.count": 1, "body.contact": False, "motor.torque": 0.0, **WARM})
    draw = Draw([with_values(scene, {"fluid.seed": i}) for i in range(count)], None, device)
    model, state, stiffness = draw.model, draw.state, hessian.allocate(draw.model)
    hessian.joint_stiffness(model, state, stiffness)
    whole = {
        name: getattr(stiffness, name).numpy() for name in ("ee", "ff", "fe", "e_first", "f_second", "spins", "stretch")
    }
    gradients = draw.stepper.strains
    strain_gradients.find(model, state, gradients)
    strain_gradients.stiffness_without_prestress(model, state, gradients, stiffness)
    for name, values in whole.items():
        assert abs(getattr(stiffness, name).numpy() - values).max() < 1e-6 * abs(values).max()
    found = []
    for number in range(draws):
        draw.control.steps.fill_(number)
        elastic.joint_gradients(model, state)
        strain_gradients.add_random_moments(model, state, gradients, draw.stepper.noise, draw.control.steps, 1.0)
        forces.total_forces(model, state)
        forces_on = state.data.force.numpy().reshape(count, -1, 3)[:, 1:]
        found.append(
            np.concatenate([forces_on.reshape(count, -1), state.data.spin_torque.numpy().reshape(count, -1)], axis=1)
        )
    found = np.concatenate(found)
    bench = Bench(with_values(scene, {"fluid.temperature": 0.0}), None, device)
    hessian.joint_stiffness(bench.model, bench.state, bench.stepper.stiffness)
    dense = bench.hessian()
    elements = bench.count
    moving = [6 + 4 * e + i for e in range(1, elements) for i in range(3)] + [6 + 4 * e + 3 for e in range(elements)]
    exact = dense[np.ix_(moving, moving)]
    for direction in np.random.default_rng(1).standard_normal((20, len(moving))):
        variance = direction @ exact @ direction
        assert abs(np.var(found @ direction) / (KT * variance) - 1) < 3.5 * (2 / (count * draws)) ** 0.5


def test_random_contact_forces_have_the_variance_of_the_stiffness(device):
    """Over 4000 draws, each contact by itself, beside the force that acts; none beyond the reach of the law."""
    count, draws, share, acting = 200, 20, 0.5, 0.3
    scene = touching_cell({"flagella.length": 0.6, "body.contact": False, "steric.strength": 0.7, **WARM})
    draw = Draw([with_values(scene, {"fluid.seed": i}) for i in range(count)], None, device)
    contacts = contact_list.allocate(draw.model, True)
    law = delassus.allocate(draw.model, contacts)
    search.find(draw.model, draw.state, draw.state.data.pose, contacts)
    law.force.fill_(acting)
    first, own = contacts.first.numpy()[:-1, None], int(contacts.count.numpy()[0])
    assert (contacts.count.numpy() == own).all()
    listed = first + np.arange(own)
    drawn = wp.zeros_like(law.force)
    found = []
    for number in range(draws):
        draw.control.steps.fill_(number)
        parts = SimpleNamespace(contacts=contacts, law=law, control=draw.control)
        equilibrium.random_contacts(draw.model, draw.state, parts, draw.stepper.noise, share, drawn)
        found.append(drawn.numpy()[listed])
    forces_found = np.concatenate(found)
    x = contacts.gap.numpy()[listed[0]] / 0.04
    stiffness = np.where(x < 2 ** (1 / 6), 0.7 / 0.04 * (26 * x**-14 - 7 * x**-8), 0.0)
    acts = stiffness > 0.0
    assert acts.sum() > 2 and x.min() > 0.7
    np.testing.assert_allclose(forces_found[:, ~acts], acting, rtol=1e-6)
    deviates = (forces_found[:, acts] - acting) / (share * np.sqrt(KT * stiffness[acts]))
    number = len(deviates)
    assert abs(deviates.mean(axis=0)).max() < 4 * number**-0.5
    products = deviates.T @ deviates / number
    assert abs(products - np.eye(len(products))).max() < 4 * (2 / number) ** 0.5
