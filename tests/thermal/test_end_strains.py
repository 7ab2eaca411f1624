"""What the strains at the end of a step are, beyond the linear step: forces of the joints set it right."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from warpflag_kernels.implicit import linearised
from warpflag_kernels.rod import chain_chart, reconstruction
from warpflag_kernels.thermal import additive_chart, end_strains, strain_gradients

from tests.helpers import anchors, cell, free_nodes, shaken, tangents
from tests.oracles import strains
from warpflag.model.geometry import InitialState
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene

# Of strains, over the largest error of the linear step; of forces, over their sum.
TOLERANCE = {"float64": 1e-4, "float32": 2e-2}
BALANCE = {"float64": 1e-6, "float32": 2e-2}
LONG = {"float64": 1e2, "float32": 1e-2}  # a step in which every strain is stiff [s]
WARM = {
    "numerics.stepper": "implicit",
    "fluid.temperature": 300.0,
    "flagella.length": 1.2,
    "hydrodynamics.mode": "none",
    "steric.enabled": False,
}
STRAIGHT = {"flagella.intrinsic_curvature": (0.0, 0.0, 0.0)}


class Step:
    """A cell at the start of a long step, its matrix factorised, and an increment of 0.01 um, spins of 0.1."""

    def __init__(self, scene: Scene, device: str, step: float, start: InitialState | None = None) -> None:
        # Gradients of bends of straight joints leave spins out, which is exact without twist.
        curved = any(scene.flagella.intrinsic_curvature[:2])
        self.scene, self.start = scene, start or shaken(scene, 4, node=0.002, spin=0.1 * curved)
        self.sim = Simulation(scene, device=device, starts=self.start)
        self.sim.evaluate()
        s, stepper = self.sim.system, self.sim.stepper
        self.model, self.state, self.chart, self.stepper = s.model, s.state, s.chart, stepper
        self.state.data.active.fill_(1)
        stepper.band.step.fill_(step)
        stepper.band.weight.fill_(1.0)
        reconstruction.go_back(self.model, self.state, self.chart)
        strain_gradients.find(self.model, self.state, stepper.strains)
        strain_gradients.stiffness_without_prestress(self.model, self.state, stepper.strains, stepper.stiffness)
        linearised.factorise(self.model, self.state, stepper.stiffness, stepper.band)
        random = np.random.default_rng(5)
        self.work, self.x = additive_chart.allocate(self.model), chain_chart.allocate(self.model)
        self.nodes = 0.006 * random.standard_normal((self.model.element_count, 4))
        self.nodes[anchors(scene), :3] = 0.0
        self.nodes[:, 3] *= 10
        self.body = 0.003 * random.standard_normal((1, 6))
        if not scene.body.enabled:
            self.body[0, 3:] = 0.0
            self.nodes[anchors(scene), 3] = 0.0
        self.assign(1.0)

    def assign(self, share: float) -> None:
        self.x.node.assign(share * self.nodes)
        self.x.body.assign(share * self.body)

    def ended(self) -> np.ndarray:
        """Strains where the increment leads; bends of straight joints in axes that have not turned."""
        additive_chart.retract(self.model, self.state, self.chart, self.x, self.work)
        pose, spin = self.state.data.pose, self.x.node.numpy()[:, 3].astype(np.float64)
        t, e1 = pose.tangent.numpy().astype(np.float64), pose.director.numpy().astype(np.float64)
        found = []
        for first, spec in zip(anchors(self.scene), self.scene.resolved_flagella(), strict=True):
            own = slice(first, first + spec.segment_count + 1)
            w = strains(t[own], e1[own])
            w[0, :2] = 0.0  # the hook bends freely
            if not any(self.scene.flagella.intrinsic_curvature[:2]):
                turned = (spin[own][1:] + spin[own][:-1]) / 2
                bends = (w[:, 0] + 1j * w[:, 1]) * np.exp(1j * turned)
                w[1:, 0], w[1:, 1] = bends.real[1:], bends.imag[1:]
            found.append(w[0 if self.scene.body.enabled else 1 :])
        reconstruction.go_back(self.model, self.state, self.chart)
        return np.concatenate(found)

    def correct(self) -> None:
        room = chain_chart.allocate(self.model), chain_chart.allocate(self.model)
        stepper = self.stepper
        end_strains.correct(
            self.model, self.state, self.chart, stepper.strains, stepper.band, self.work, room, self.x
        )  # fmt: skip


def scene_of(values: dict[str, Any], precision: str) -> Scene:
    return cell({**WARM, **values}, precision)


CASES = [{}, STRAIGHT, {"body.enabled": False, "flagella.count": 1}, {"hydrodynamics.mode": "consistent"}]


def meant(values: dict[str, Any], device: str) -> np.ndarray:
    """w + J x, with J from small increments."""
    step, share, ends = Step(scene_of(values, "float64"), device, 1.0), 1e-4, []
    for sign in (1.0, -1.0):
        step.assign(sign * share)
        ends.append(step.ended())
    return (ends[0] + ends[1]) / 2 + (ends[0] - ends[1]) / (2 * share)


@pytest.mark.parametrize("values", CASES)
def test_stiff_strains_become_what_the_linear_step_means(values, precision, device, monkeypatch):
    """In a step in which all are stiff, after many iterations; two leave a tenth at most."""
    step, linear = Step(scene_of(values, precision), device, LONG[precision]), meant(values, device)
    missed = step.ended() - linear
    assert abs(missed).max() > 2e-3
    step.correct()
    assert np.linalg.norm(step.ended() - linear) < 0.1 * np.linalg.norm(missed)
    monkeypatch.setattr(end_strains, "STRAIN_ITERATIONS", 20)
    step.assign(1.0)
    step.correct()
    assert abs(step.ended() - linear).max() < TOLERANCE[precision] * abs(missed).max()


def test_forces_come_in_pairs(precision, device):
    """What they displace is balanced by the drag of nodes and body."""
    step = Step(scene_of({}, precision), device, 1e-5)
    step.correct()
    moved = (step.x.node.numpy().astype(np.float64) - step.nodes)[:, :3]
    along, across = step.model.data.drag.mobility_along.numpy(), step.model.data.drag.mobility_across.numpy()
    t, first = np.concatenate(tangents(step.scene, step.start)), anchors(step.scene)
    total, size = np.zeros(3), 0.0
    for e in free_nodes(step.scene):
        mean = t[e] if e + 1 in first or e + 1 == len(t) else (t[e] + t[e + 1]) / np.linalg.norm(t[e] + t[e + 1])
        part = (mean @ moved[e]) * mean
        force = part / along[e] + (moved[e] - part) / across[e]
        total += force
        size += np.abs(force).sum()
    axis, m = step.state.data.pose.body_axis.numpy()[0].astype(np.float64), step.model.data.body
    beyond = step.x.body.numpy()[0, :3].astype(np.float64) - step.body[0, :3]
    part = (axis @ beyond) * axis
    on_body = part / m.mobility_along.numpy()[0] + (beyond - part) / m.mobility_across.numpy()[0]
    assert abs(total).max() > 1e-3 * size
    assert abs(total + on_body).max() < BALANCE[precision] * size


def test_the_pose_is_left_at_the_start(device):
    """And its lengths, and the axis of a free end."""
    step = Step(scene_of({"body.enabled": False, "flagella.count": 1}, "float64"), device, 1e-5)
    pose = step.state.data.pose
    before = [getattr(pose, name).numpy().copy() for name in ("position", "tangent", "director", "length", "body_axis")]
    step.correct()
    after = [getattr(pose, name).numpy() for name in ("position", "tangent", "director", "length", "body_axis")]
    for old, new in zip(before, after, strict=True):
        assert np.allclose(new, old, rtol=0, atol=1e-14)
