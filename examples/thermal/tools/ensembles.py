"""Ensembles of passive cells, one per seed, and how their means and errors are told."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from warpflag import Scene, Simulation, paper_scene, with_values

from .starts import in_equilibrium

KT = 1.380649e-5 * 300.0
BASE = {
    "fluid.temperature": 300.0,
    "motor.torque": 0.0,
    "steric.enabled": False,
    "body.contact": False,
    "flagella.count": 1,
    "duration": 10.0,
}
FREE = {"body.enabled": False}
LOCKED = {"motor.law": "rate", "motor.rate": 0.0}  # motors that do not turn
STRAIGHT = {"flagella.intrinsic_curvature": (0.0, 0.0, 0.0), "flagella.opening_angle": 0.0, "motor.axis_angle": 0.0}


def ensemble(values: dict[str, Any], count: int, sampled: bool = False, first: int = 0) -> tuple[Scene, Simulation]:
    """Cells that differ in their seeds, of the paper's model unless the values say otherwise.

    Args:
        values: of its keys.
        count: of cells.
        sampled: whether they start in equilibrium; hooks that resist bending start unbent.
        first: seed.
    """
    scene = with_values(paper_scene("thermal"), {**BASE, **values})
    scenes, random = [with_values(scene, {"fluid.seed": first + i}) for i in range(count)], np.random.default_rng(first)
    shapes = [in_equilibrium(scene, KT, random) for _ in scenes] if sampled else None
    return scene, Simulation(scenes, device="cpu", starts=shapes)


def looks(sim: Simulation, start: float, interval: float, count: int) -> Iterator[Any]:
    """The cells at `start` and after each interval [s]."""
    for i in range(count + 1):
        sim.advance(start + i * interval)
        yield sim.cells()


def mean(values: np.ndarray) -> tuple[Any, Any]:
    """Mean over the cells, the first axis, and its standard error: cells are independent, a block each."""
    return values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(len(values))


def shown(value: float, error: float) -> str:
    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0 else 4
    return f"{value:.{digits}f} ± {error:.{digits}f}"
