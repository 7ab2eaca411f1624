"""The time that a scene of very many nodes takes, told from two small parts of it.

One step of 330,000 nodes takes minutes, since the pair sum grows as the square of their number. Parts with the same
flagella but fewer of them, and shorter ones where a single one is long, are measured as `time_needed` does, and every
share of the time is taken to grow as p N + q N^2.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from warpflag.run.check.time_needed import MOVIE, Needed, needed
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene

__all__ = ["LARGEST", "grown", "needed_by_parts", "part"]

LARGEST = 3000
"""Nodes up to which a scene is measured itself: some 0.1 s a step on one core."""
PARTS = (500, 1500)
"""Nodes of the two parts, about."""
SECONDS = 2.0
"""Computing time of stepping for each."""


def needed_by_parts(scene: Scene, built: float, device: str | None) -> tuple[Needed, list[int]]:
    """What a run of a scene takes, and the nodes of the parts by which that is told.

    Args:
        scene: of more than `LARGEST` nodes.
        built: time of computing in which its simulation was built [s].
        device: to compute on.

    Raises:
        NumericalError: a guard is violated in the first steps of a part.
    """
    nodes, found = [], []
    for most in PARTS:
        simulation = Simulation(part(scene, most), device=device)
        nodes.append(int(simulation.first_node[-1]))
        found.append(needed(simulation, SECONDS))
    whole = _nodes(scene)
    rest = grown(nodes, [own.stepping for own in found], whole)
    output = MOVIE + grown(nodes, [own.output - MOVIE for own in found], whole)
    startup, compiling = found[0].startup + built, sum(own.compiling for own in found)
    return Needed(startup, compiling, 0.0, rest, output, found[-1].crowd), nodes


def part(scene: Scene, most: int) -> Scene:
    """A scene with its first flagella, two at least, of about so many nodes; all shortened where those are too long."""
    specs = scene.resolved_flagella()
    sizes = np.cumsum([spec.segment_count + 1 for spec in specs])
    count = min(max(int(np.searchsorted(sizes, most, side="right")), 2), len(specs))
    share = min(most / float(sizes[count - 1]), 1.0)
    own = []
    for k, one in enumerate(scene.flagellum[:count]):
        segments = None if one.segments is None else max(math.floor(share * specs[k].segment_count), 2)
        length = None if one.length is None else share * one.length
        own.append(dataclasses.replace(one, length=length, segments=segments))
    group = dataclasses.replace(scene.flagella, count=count, length=share * scene.flagella.length)
    start = type(scene.start)()
    return dataclasses.replace(scene, flagella=group, flagellum=tuple(own), start=start)


def _nodes(scene: Scene) -> int:
    return sum(spec.segment_count + 1 for spec in scene.resolved_flagella())


def grown(nodes: list[int], seconds: list[float], whole: int) -> float:
    """p N + q N^2 through two measured times, neither p nor q negative [s]."""
    (n, m), (s, t) = nodes, seconds
    q = (t / m - s / n) / (m - n) if m > n else 0.0
    p = s / n - q * n
    if q < 0.0:
        p, q = t / m, 0.0
    elif p < 0.0:
        p, q = 0.0, t / m**2
    return p * whole + q * whole**2
