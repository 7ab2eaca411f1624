"""A cell at rest with its implicit stepper's buffers, and dense NumPy matrices of the parts of a step.

Dense matrices have six unknowns of the body first, then four of every element: displacement (none for r_0, which moves
with the body) and spin.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from warpflag_kernels.base.plan import Plan
from warpflag_kernels.implicit import linearised
from warpflag_kernels.rod import chain_chart

from tests.helpers import anchors, cell, matrix, shaken
from tests.oracles import dense_mobility, drag_coefficients, expected_pair_radius, whole_mobility
from tests.plans import plan
from warpflag.model.geometry import InitialState
from warpflag.model.shell import body_shell
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, with_values
from warpflag.scene.resistance import spheroid_mobility

# Relative to the largest value of its kind, unless said otherwise: float64, float32.
TOLERANCE = {"float64": 1e-8, "float32": 2e-3}
# Where flows of force changes come in, which are found in single precision in either build.
FLOW_TOLERANCE = {"float64": 2e-5, "float32": 2e-3}


def close(found: Any, exact: Any, precision: str, factor: float = 1.0, tolerance: Any = TOLERANCE) -> bool:
    """Within `factor` times the tolerance."""
    found, exact = np.asarray(found, dtype=np.float64), np.asarray(exact, dtype=np.float64)
    return float(np.abs(found - exact).max()) <= factor * tolerance[precision] * float(np.abs(exact).max())


class Bench:
    """A scene at rest in its start, its stepper's buffers, and the kernels on them. Vectors are (body, nodes)."""

    def __init__(self, scene: Scene, start: InitialState | None, device: str, plan: Plan | None = None) -> None:
        scene = with_values(scene, {"numerics.stepper": "implicit"})
        self.scene, self.sim = scene, Simulation(scene, device=device, starts=start, plan=plan)
        self.sim.evaluate()
        s, self.stepper = self.sim.system, self.sim.stepper
        self.model, self.state, self.data = s.model, s.state, s.state.data
        self.count = self.model.element_count
        self.first = anchors(scene)
        self.start = start
        self.data.active.fill_(1)
        linearised.allocate(self.model, self.state)

    def increment(self, body: Any = 0.0, nodes: Any = 0.0) -> Any:
        p, device = self.model.precision, self.model.device
        x = chain_chart.types(p).Increment()
        x.node = wp.array(np.zeros((self.count, 4)) + nodes, dtype=p.vec4, device=device)
        x.body = wp.array(np.zeros((1, 6)) + body, dtype=chain_chart.types(p).vec6, device=device)
        return x

    def retract(self, x: Any, scale: float = 1.0, other: Any = None) -> Any:
        """Moves the state to the pose that scale * x leads to from the start; returns `other`, transported there."""
        out, unused = self.increment(), self.increment()
        scales = wp.full(1, scale, dtype=wp.float64, device=self.model.device)
        transported = (other or self.increment(), self.increment(), out, unused)
        base, pose = self.sim.system.chart.base, self.data.pose
        chain_chart.retract(self.model, self.state, base, scales, x, pose, transported)
        return out

    def factorise(self, step: float, weight: float) -> Any:
        band, stiffness = self.stepper.band, self.stepper.stiffness
        band.step.fill_(step)
        band.weight.fill_(weight)
        band.singular.zero_()
        linearised.set_stiffness(self.model, self.state, stiffness)
        linearised.factorise(self.model, self.state, stiffness, band)
        return band

    def force_change(self, body: Any, nodes: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """-H x: change of the body's force and torque, of the forces, and of the spin torques."""
        linearised.force_changes(self.model, self.state, self.stepper.stiffness, self.increment(body, nodes))
        forces, torques = self.data.force.numpy().astype(float), self.data.spin_torque.numpy().astype(float)
        on_body, torque = self.data.flagellum_force.numpy(), self.data.flagellum_torque.numpy()
        return np.concatenate([on_body.sum(axis=0), torque.sum(axis=0)]).astype(float), forces, torques

    def hessian(self) -> np.ndarray:
        """Dense H, shape [6 + 4 count, 6 + 4 count]; rows and columns of the displacement of r_0 are zero."""
        columns = []
        for i in range(6 + 4 * self.count):
            x = np.zeros(6 + 4 * self.count)
            x[i] = 1.0
            nodes = x[6:].reshape(-1, 4)
            if i >= 6 and (i - 6) % 4 < 3 and (i - 6) // 4 in self.first:
                nodes[:] = 0.0
            body, forces, torques = self.force_change(x[:6], nodes)
            forces[self.first] = 0.0
            columns.append(-np.concatenate([body, np.hstack([forces, torques[:, None]]).ravel()]))
        return np.stack(columns, axis=1)

    def mobility(self, mode: str | None = None) -> np.ndarray:
        """Dense M of (body, nodes); the displacement of r_0 has none.

        mode: other hydrodynamics than the scene's, without flow round the body; the body's own mobility stays that of
        its shell if the scene has one.
        """
        other = {"hydrodynamics.mode": mode, "hydrodynamics.body_flow": False}
        scene = self.scene if mode is None else with_values(self.scene, other)
        size = 6 + 4 * self.count
        mobility = np.zeros((size, size))
        free = np.setdiff1d(np.arange(self.count), self.first)
        where = (6 + 4 * free[:, None] + np.arange(3)).ravel()
        mobility[np.ix_(where, where)] = dense_mobility(scene, self.start, expected_pair_radius(self.scene))
        spins = np.arange(9, size, 4)
        h = np.repeat([s.segment_length for s in scene.resolved_flagella()], [len(x) for x in self.start.positions])
        mobility[spins, spins] = 1 / (drag_coefficients(scene)[2] * h)
        b, body = spheroid_mobility(scene.body.length, scene.body.width, scene.fluid.viscosity), scene.body
        axis = matrix(self.start.body_orientation)[:, 2]
        if not body.anchored:
            turn = b.spin * body.axial_rotation
            for i, along, across in ((0, b.along, b.across), (3, turn, b.tumble)):
                mobility[i : i + 3, i : i + 3] = across * np.eye(3) + (along - across) * np.outer(axis, axis)
        if self.scene.hydrodynamics.body_flow:
            shell = body_shell(body.length, body.width, scene.hydrodynamics.body_beads)
            whole = whole_mobility(self.scene, self.start, shell.points, shell.radius)
            coupled = np.concatenate([np.arange(6), where]) if mode is None else np.arange(6)
            mobility[np.ix_(coupled, coupled)] = whole[: len(coupled), : len(coupled)]
        return mobility

    def local_inverse(self) -> np.ndarray:
        """D^-1 of the nodes (pseudo-inverse: r_0 has none), 1 for the body: what `solve` wants its velocities times."""
        d = self.mobility("none")
        d[:6] = d[:, :6] = 0.0
        inverse = np.linalg.pinv(d, hermitian=True)
        inverse[:6, :6] = np.eye(6)
        return inverse


def flat(x: Any) -> np.ndarray:
    """An increment as one vector (body, nodes)."""
    return np.concatenate([x.body.numpy().ravel(), x.node.numpy().ravel()]).astype(np.float64)


def bench(
    values: dict[str, Any],
    precision: str,
    device: str,
    seed: int = 1,
    planned: Callable[[Plan], Plan] = lambda own: own,
    **shake: float,
) -> Bench:
    """A disturbed cell; planned: of the plan that is chosen for it, the one that is to be used."""
    scene = cell({"flagella.length": 1.0, **values}, precision)
    start = shaken(scene, seed, **{"node": 2e-3, "spin": 0.05, **shake})
    return Bench(scene, start, device, planned(plan(scene, device)))


def dense_system(b: Bench, step: float, weight: float) -> np.ndarray:
    """1/dt + s M_0 H with the local mobility, multiplied by D^-1 in the rows of the nodes."""
    system = b.local_inverse() / step
    system[:6, :6] = np.eye(6) / step
    h, mobility = b.hessian(), b.mobility("none")
    system[6:] += weight * h[6:]
    system[:6] += weight * mobility[:6, :6] @ h[:6]
    pinned = (6 + 4 * b.first[:, None] + np.arange(3)).ravel()
    system[:, pinned] = system[pinned] = 0.0
    system[pinned, pinned] = 1.0
    return system


def displacements(b: Bench) -> np.ndarray:
    """Where the displacements of nodes r_1..r_N stand in a dense vector."""
    free = np.setdiff1d(np.arange(b.count), b.first)
    return (6 + 4 * free[:, None] + np.arange(3)).ravel()


def spins(b: Bench) -> np.ndarray:
    return np.arange(9, 6 + 4 * b.count, 4)


def dense_solver(b: Bench, step: float, weight: float) -> np.ndarray:
    """P: from velocities of (body, nodes) to the increment, with the local mobility in the matrix."""
    return np.linalg.solve(dense_system(b, step, weight), b.local_inverse())
