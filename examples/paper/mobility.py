"""The mobility as printed at work: two runs side by side, one of which bursts."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from warpflag.model.shell import rotne_prager
from warpflag.observables import segment_tangents
from warpflag.record import Record
from warpflag.scene import loads
from warpflag.scene.resistance import filament_mobility, pair_radius
from warpflag.view.figures import COLORS, TWO_COLUMNS, styled


def mobility(positions: np.ndarray, first_node: np.ndarray, h: float, radius: float, drag: tuple) -> np.ndarray:
    """The paper's mobility of nodes r_1..r_N of all flagella: local, and Rotne-Prager between all of them.

    h: segment length [um]. radius: of the pair term [um]. drag: mobility of a node along and across the tangent
    [um/(s pN)], and the viscosity. Shape [3 count, 3 count].
    """
    along, across, viscosity = drag
    nodes, tangents, shares = [], [], []
    for first, end in pairwise(first_node):
        t = segment_tangents(positions[first:end])
        mean = t[:-1] + t[1:]
        tangents += [mean / np.linalg.norm(mean, axis=1, keepdims=True), t[-1:]]
        nodes.append(positions[first + 1 : end])
        shares.append(np.append(np.ones(len(t) - 1), 0.5))  # half a segment at the free end
    x, t, share = np.concatenate(nodes), np.concatenate(tangents), np.concatenate(shares)
    pairs = rotne_prager(x, radius, x, radius) / (8 * np.pi * viscosity)
    i = np.arange(len(x))
    tt = t[:, :, None] * t[:, None, :]
    pairs[i, :, i] = (along * tt + across * (np.eye(3) - tt)) / share[:, None, None]
    return pairs.reshape(3 * len(x), 3 * len(x))


def smallest_eigenvalues(record: Record) -> np.ndarray:
    """Smallest eigenvalue of the mobility in every frame, in units of a node's own mobility across the filament."""
    scene = loads(record.scene_text)
    h = scene.resolved_flagella()[0].segment_length
    local = filament_mobility(scene, h)
    law = h, pair_radius(scene), (local.along, local.across, scene.fluid.viscosity)
    found = [np.linalg.eigvalsh(mobility(x, record.first_node, *law))[0] for x in record.positions[:]]
    return np.array(found) / local.across


def figure(runs: dict[str, Path], start: float):
    """Smallest eigenvalue, nearest nodes and contact force of runs from `start` [s] on; by label."""
    with styled() as figure_of:
        drawn = figure_of(figsize=(TWO_COLUMNS, 2.3), layout="constrained")
        panels = drawn.subplots(1, 3)
        for (label, directory), color in zip(runs.items(), COLORS, strict=False):
            with Record(directory) as record:
                middle = int(record.first_node[1])
                times = 1e3 * (start + record.times)
                gap = record.positions[:][:, 1:middle, None] - record.positions[:][:, None, middle + 1 :]
                series = (
                    smallest_eigenvalues(record),
                    np.linalg.norm(gap, axis=-1).min(axis=(1, 2)),
                    record.observables["steric_force_density"],
                )
            for axes, values in zip(panels, series, strict=True):
                axes.plot(times, values, color=color, label=label)
        panels[0].axhline(0.0, color="black", linewidth=0.6)
        labels = ("smallest eigenvalue (local mobility)", "nearest nodes (µm)", r"$f_c$ (pN/µm)")
        for axes, label in zip(panels, labels, strict=True):
            axes.set(xlabel="t (ms)", ylabel=label)
        drawn.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return drawn
