"""Nodes of unequal pair radii: the tensor of two spheres against surface integrals, and meshes of mixed segments."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import warp as wp

from tests.helpers import cell, placed, shaken, touching_cell
from tests.oracles import device_mobility
from tests.plans import by_elements, plan
from warpflag.model.terms import switches_of
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, SceneError, with_values
from warpflag.scene.resistance import pair_radii, pair_radius

# Of the largest velocity or mobility.
TOLERANCE = {"float64": 1e-12, "float32": 2e-5}

ETA = 1e-3


def inside_and_outside(x: np.ndarray, radius: float) -> np.ndarray:
    """Flow at points x of a sphere at the origin whose surface pushes the fluid uniformly, per force, times 8 pi eta.

    Inside it is uniform, 4/(3 radius); outside (1 + radius^2/6 nabla^2) of the Oseen tensor.
    """
    r = np.linalg.norm(x, axis=-1)[:, None, None]
    e = x[:, :, None] * x[:, None, :] / r**2
    s = (radius / r) ** 2
    return np.where(r < radius, 4 / (3 * radius) * np.eye(3), ((1 + s / 3) * np.eye(3) + (1 - s) * e) / r)


def averaged(separation: float, a: float, b: float) -> tuple[float, float]:
    """The tensor of spheres of radii a and b along and across their distance, times 8 pi eta: the mean of the flow of
    one over the surface of the other, by quadrature."""
    cut = (b * b - a * a - separation**2) / (2 * a * separation)  # height at which the surfaces meet, over a
    heights, weights = [], []
    ends = [-1.0, *([cut] if -1 < cut < 1 else []), 1.0]
    x, w = np.polynomial.legendre.leggauss(40)
    for low, high in itertools.pairwise(ends):
        heights.append((high + low) / 2 + (high - low) / 2 * x)
        weights.append((high - low) / 4 * w)
    z, share = np.concatenate(heights), np.concatenate(weights)
    angle = np.linspace(0, 2 * math.pi, 8, endpoint=False)
    rho = np.sqrt(1 - z**2)[:, None]
    points = np.stack(
        [a * rho * np.cos(angle), a * rho * np.sin(angle), separation + a * z[:, None] + 0 * angle], axis=-1
    )
    flow = inside_and_outside(points.reshape(-1, 3), b).reshape(len(z), 8, 3, 3).mean(axis=1)
    mean = np.einsum("i,ijk->jk", share, flow)
    return mean[2, 2], mean[0, 0]


MIXED = {"hydrodynamics.mode": "consistent", "flagellum.0.segments": 10, "flagellum.1.segments": 20}


def mixed(first: int, second: int, precision: str = "float64", **values: object) -> Scene:
    """Two flagella of 2 um in contact, of so many segments each."""
    segments = {"flagellum.0.segments": first, "flagellum.1.segments": second}
    return touching_cell({"hydrodynamics.mode": "consistent", **segments, **values}, precision)


@pytest.mark.parametrize("separation", [0.3, 0.14, 0.12, 0.07, 0.05, 0.005])
def test_the_tensor_is_the_mean_flow_over_the_spheres(separation, precision, device):
    """Apart, overlapping, and one inside the other; pair radii of segments of 0.7 and 0.2 um."""
    scene = cell({"flagella.count": 2, "hydrodynamics.mode": "consistent", "flagella.length": 1.4}, precision)
    scene = with_values(scene, {"flagellum.0.segments": 2, "flagellum.1.segments": 7})
    a, b = pair_radii(scene)
    assert 0.05 < a - b < 0.07 and 0.12 < a + b < 0.14
    start = [np.array([0.0, 0.0, 8.0]) + k * np.array([0.0, 0.0, separation]) for k in range(2)]
    down, up = np.arange(2)[::-1] * 0.7, np.arange(7)[::-1] * 0.2
    nodes = [start[0] - np.outer(down, [0.0, 0.0, 1.0]), start[1] + np.outer(up, [0.0, 0.0, 1.0])]
    nodes[1] = start[1] + np.outer(up, [1.0, 0.0, 0.0])
    nodes[0] = start[0] + np.outer(down, [-1.0, 0.0, 0.0])
    found = device_mobility(Simulation(scene, device=device, starts=placed(scene, nodes)))
    block = found[3:6, -3:] * 8 * math.pi * ETA
    along, across = averaged(separation, a, b)
    assert np.diagonal(block) == pytest.approx(
        [across, across, along], rel={"float64": 1e-6, "float32": 1e-4}[precision]
    )
    assert averaged(separation, b, a) == pytest.approx((along, across), rel=1e-6)  # whichever is averaged over


@pytest.mark.parametrize("first, second", [(10, 66), (4, 66), (10, 20)])
def test_mixed_segments_are_positive_definite(first, second, device):
    """Segments of 0.2 or 0.5 beside 0.03 um, and 0.2 beside 0.1, in contact: one radius for both had -8.5, -1.7e4."""
    scene = mixed(first, second, **{"body.contact": False})
    for seed, node in ((1, 0.002), (2, 0.02), (3, 0.5)):
        found = device_mobility(Simulation(scene, device=device, starts=shaken(scene, seed, node=node, spin=0.0)))
        assert np.abs(found - found.T).max() < TOLERANCE["float64"] * np.abs(found).max()
        assert np.linalg.eigvalsh(found).min() > 0.0


def test_every_form_gives_the_same(precision, device, monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    scene = mixed(10, 25, precision)
    start, own = shaken(scene, 4, node=0.005), plan(scene, device)
    found = {}
    for name, form in {"own": own, "thread": by_elements(own), "warp": by_elements(own, pair_sum="warp")}.items():
        found[name] = Simulation(scene, plan=form, starts=start).evaluate().velocities
    for values in found.values():
        assert np.abs(values - found["thread"]).max() < TOLERANCE[precision] * np.abs(found["thread"]).max()


def test_equal_radii_keep_the_equal_form():
    """Only a cell that has unequal radii gets the dearer tensor and an array for them."""
    for scene, unequal in (
        (mixed(10, 20), True),
        (mixed(10, 10), False),
        (cell({"flagellum.1.segments": 20, "flagellum.0.segments": 10}), False),
    ):
        assert switches_of(scene).flows.unequal is unequal
        sim = Simulation(scene, device="cpu")
        assert (sim.system.state.pairs.radius is not None) == unequal


def test_the_unequal_form_of_equal_radii_is_the_equal_one(device):
    """A mesh whose segment lengths differ by 1e-9: the same velocities to that."""
    scene = mixed(10, 10)
    start = shaken(scene, 5, node=0.005)
    other = with_values(scene, {"flagellum.1.length": 2.0 * (1 + 1e-9)})
    assert switches_of(other).flows.unequal
    a, b = (Simulation(s, device=device, starts=start).evaluate() for s in (scene, other))
    assert np.abs(a.velocities - b.velocities).max() < 1e-5 * np.abs(a.velocities).max()


def test_a_mixed_cell_runs_as_the_explicit_stepper_says(device):
    scene = cell({**MIXED, "motor.torque": 1.0})
    ends = []
    for values in (
        {"numerics.stepper": "rkc", "numerics.time_step": 1e-6},
        {"numerics.stepper": "implicit", "numerics.accuracy": 1e-3},
    ):
        sim = Simulation(with_values(scene, values), device=device)
        sim.advance(2e-4)
        ends.append(sim.state.positions)
    assert np.linalg.norm(ends[0] - ends[1], axis=1).max() < 5 * 1e-3 * 0.2


@pytest.mark.parametrize(
    "values, said",
    [
        ({"hydrodynamics.mode": "all", "hydrodynamics.pair_radius": 0.02}, "0.0298 um is the least"),
        ({"hydrodynamics.mode": "within", "hydrodynamics.pair_radius": 0.02}, "0.0298 um is the least"),
        (  # enough for the segments of 0.2 um, not for those of 0.25 um
            {"hydrodynamics.mode": "all", "hydrodynamics.pair_radius": 0.033, "flagellum.1.segments": 8},
            "0.0372 um is the least",
        ),
        ({"hydrodynamics.mode": "consistent", "hydrodynamics.pair_radius": 0.015}, "um is the least"),
        (
            {
                "flagellum.0.segments": 10,
                "flagellum.1.segments": 66,
                "hydrodynamics.mode": "consistent",
                "hydrodynamics.pair_radius": 0.03,
            },
            "leave it out",
        ),
    ],
)
def test_a_pair_radius_that_makes_it_indefinite_is_refused(values, said):
    """In one line that names what would do, and that does."""
    scene = cell(values)
    with pytest.raises(SceneError, match=said) as error:
        Simulation(scene, device="cpu")
    assert error.value.key == "hydrodynamics.pair_radius" and "\n" not in str(error.value)
    if "least" in said:
        enough = float(str(error.value).partition("indefinite; ")[2].split()[0])
        better = with_values(scene, {"hydrodynamics.pair_radius": enough})
        found = device_mobility(Simulation(better, device="cpu"))
        assert np.linalg.eigvalsh(found).min() > 0 and pair_radius(better) == enough
