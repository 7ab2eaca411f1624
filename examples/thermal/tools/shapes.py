"""Tips of clamped filaments, and contact of two."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from warpflag import Simulation

from . import exact
from .ensembles import KT, LOCKED, STRAIGHT, ensemble, looks, mean, shown

CLAMPED = {"body.anchored": True, "hydrodynamics.mode": "none", **LOCKED}


def tip(share: float) -> None:
    """Variance of the tip of a filament on a held body, whose hook resists bending, per direction across."""
    print("\n| tip variance across [µm²] | exact | simulated |\n|---|---|---|")
    straight = {**STRAIGHT, "flagella.length": 2.0, "hook.stiffness": 4.0, "numerics.time_step": 1e-5}
    axial = {"flagella.opening_angle": 0.0, "motor.axis_angle": 0.0, "flagella.on_axis": True}
    helix = {**axial, "hook.stiffness": 1e3, "numerics.time_step": 4e-5}
    cases = (
        ("rod of 2 µm, hook of 4 pN µm/rad", straight, 1e-2, 5e-4, 300),
        ("helix of 6 µm, clamped", helix, 0.2, 2e-2, 60),
    )
    for name, values, start, interval, frames in cases:
        count = 96
        scene, sim = ensemble({**CLAMPED, **values}, count)
        rest = Simulation(scene, device="cpu").state.positions
        axis = np.array([0.0, 0.0, 1.0])
        known = exact.clamped_tip(scene, rest, axis)
        tips = np.array(
            [
                c.positions.reshape(count, -1, 3)[:, -1, :2]
                for c in looks(sim, start, interval, max(16, int(share * frames)))
            ]
        )
        tips = tips - tips.mean(axis=(0, 1))
        value, error = mean((tips**2).mean(axis=(0, 2)))
        print(f"| {name} | {known:.4g} | {shown(value, error)} |", flush=True)


APART = 0.045
BESIDE = {
    **STRAIGHT,
    "flagella.count": 2,
    "flagella.length": 0.6,
    "flagellum.0.azimuth": 0.0,
    "flagellum.1.azimuth": 2 * math.degrees(math.asin(APART / 0.8)),
    "hook.stiffness": 4.0,
    "body.anchored": True,
}


def _beside(share: float, touching: bool, edges: tuple[float, ...], runs: list[tuple[str, float, int, int]]) -> None:
    """A table of mean contact energies and shares of least distances of two filaments; by exact sampling, too.

    Args:
        share: of the samples.
        touching: whether they have contact.
        edges: of the shares [um].
        runs: mode, step [s], number of cells and of looks of every column.
    """
    values = {**BESIDE, "steric.enabled": touching}
    scene, _ = ensemble(values, 1)
    columns = []
    for seed in range(20):
        least, energy, weight = exact.sampled_contact(scene, APART, 100_000, seed)
        if not touching:
            weight = np.ones_like(weight)
        shares = [np.sum(weight[(least >= a) & (least < b)]) for a, b in pairwise(edges)]
        columns.append(np.array([np.sum(weight * energy * touching), *shares]) / np.sum(weight))
    told = {"exact": mean(np.array(columns))}
    diameter = 4 * scene.flagella.filament_radius
    for mode, step, count, frames in runs:
        _, sim = ensemble({**values, "numerics.time_step": step, "hydrodynamics.mode": mode}, count)
        found = []
        for cells in looks(sim, 4e-4, max(5 * step, 5e-6), max(20, int(share * frames))):
            x = cells.positions.reshape(count, 2, 4, 3)
            least, energy = np.full(count, np.inf), np.zeros(count)
            for i in range(3):
                for j in range(3):
                    p, d, q, e = x[:, 0, i], x[:, 0, i + 1] - x[:, 0, i], x[:, 1, j], x[:, 1, j + 1] - x[:, 1, j]
                    s, t = exact.closest_parameters(p, d, q, e)
                    distance = np.linalg.norm(p + s[:, None] * d - q - t[:, None] * e, axis=1)
                    least = np.minimum(least, distance)
                    if touching:
                        energy += exact.potential(distance, scene.steric.strength, diameter) / KT
            found.append([energy, *((least >= a) & (least < b) for a, b in pairwise(edges))])
        told[f"{mode}, {step:g}"] = mean(np.array(found, float).mean(axis=0).T)
    print("\n| | " + " | ".join(told) + " |\n|---|" + "---|" * len(told))
    names = ["contact energy [kT]", *(f"{a:.3f} to {b:.3f} µm" for a, b in pairwise(edges))]
    for i, name in enumerate(names):
        if touching or i:
            print(f"| {name} | " + " | ".join(shown(v[i], e[i]) for v, e in told.values()) + " |", flush=True)


def contact(share: float) -> None:
    """Two straight filaments of 0.6 um, 0.045 um apart: least distance and contact energy."""
    runs = [("none", 1e-6, 400, 600), ("all", 3e-7, 400, 400), ("all", 1e-6, 400, 800), ("all", 5e-6, 200, 1000)]
    _beside(share, True, (0.0, 0.037, 0.038, 0.040, 0.042, 0.044), runs)


def neighbours(share: float) -> None:
    """The same two filaments without contact: nothing but the flow couples them."""
    _beside(share, False, (0.0, 0.01, 0.02, 0.03, 0.04, 0.044), [("none", 1e-6, 400, 1600), ("all", 1e-6, 400, 1200)])
