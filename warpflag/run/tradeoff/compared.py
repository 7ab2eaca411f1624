"""Points compared with their references: errors by source, the Pareto front, and settings to recommend."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpflag.run.tradeoff.choices import REFERENCE
from warpflag.run.tradeoff.points import MEASURES, Point
from warpflag.scene.run_sections import ACCURACY_LEVELS

__all__ = ["LEVELS", "Row", "Summary", "compared", "front", "recommended", "summaries"]

LEVELS = ACCURACY_LEVELS
"""Node error per simulated ms that each level of care allows [um]."""
_TIMED = ("time step", "precision")


@dataclass(frozen=True)
class Row:
    """A point and how far it is off.

    Attributes:
        point: of a window and a choice.
        node_error: largest displacement of a node from the reference in the window [um]; NaN on other meshes.
        off: of each of `MEASURES`, from the reference: the run with the finest steps; of meshes the finest mesh. NaN of
            a reference without a finer mesh beside it, and of all in a window whose reference was stopped.
    """

    point: Point
    node_error: float
    off: dict[str, float]


@dataclass(frozen=True)
class Summary:
    """One choice over all windows in which it was measured.

    Attributes:
        choice: its name.
        source: of its error.
        cost: mean [ms/ms].
        error: largest node error per simulated ms [um].
        windows: in how many it was measured.
        sound: no guard stopped it.
        settings: values of [numerics].
    """

    choice: str
    source: str
    cost: float
    error: float
    windows: int
    sound: bool
    settings: dict[str, object]


def compared(points: Sequence[Point]) -> list[Row]:
    """A row for every point of a window that has a reference."""
    rows = []
    for window in dict.fromkeys(point.window for point in points):
        own = [point for point in points if point.window == window]
        exact = next((point for point in own if point.choice == REFERENCE), None)
        if exact is None:
            continue
        meshes = [point for point in own if point.source == "mesh" and point.status == "done"]
        finest = max([exact, *meshes], key=lambda point: point.positions.shape[1])
        for point in own:
            beside = finest if point.source == "mesh" or point is exact else exact
            off = {name: point.measures[name] - beside.measures[name] for name in MEASURES}
            error = float("nan")
            if exact.status != "done" or (point is exact and beside is exact):
                rows.append(Row(point, error, dict.fromkeys(MEASURES, error)))
                continue
            if point is not exact and point.positions.shape == exact.positions.shape and point.source != "mesh":
                error = float(np.linalg.norm(point.positions - exact.positions, axis=2).max())
            rows.append(Row(point, error, off))
    return rows


def summaries(rows: Sequence[Row], length: float) -> list[Summary]:
    """Every choice over its windows.

    Args:
        rows: of `compared`.
        length: of a window [s].
    """
    found = []
    for name in dict.fromkeys(row.point.choice for row in rows):
        own = [row for row in rows if row.point.choice == name]
        first = own[0].point
        errors = [row.node_error / (length * 1e3) for row in own if not math.isnan(row.node_error)]
        found.append(
            Summary(
                choice=name,
                source=first.source,
                cost=float(np.mean([row.point.cost for row in own])),
                error=max(errors, default=float("nan")),
                windows=len(own),
                sound=all(row.point.status == "done" for row in own),
                settings=dict(first.settings),
            )
        )
    return found


def _candidates(found: Sequence[Summary]) -> list[Summary]:
    """Sound settings of time step and precision that were compared in as many windows as any of them."""
    timed = [s for s in found if s.source in _TIMED and s.sound and not math.isnan(s.error)]
    most = max((s.windows for s in timed), default=0)
    return [s for s in timed if s.windows == most]


def front(found: Sequence[Summary]) -> list[Summary]:
    """Settings that no other beats in both cost and error, from the cheapest to the most accurate."""
    best: list[Summary] = []
    for summary in sorted(_candidates(found), key=lambda s: (s.cost, s.error)):
        if not best or summary.error < best[-1].error:
            best.append(summary)
    return best


def recommended(found: Sequence[Summary]) -> dict[str, Summary]:
    """The cheapest setting that keeps each level, by level; a level that none keeps is missing."""
    best = {}
    for level, allowed in LEVELS.items():
        # Not fixed steps, which may step through a contact elsewhere.
        kept = [s for s in _candidates(found) if s.error <= allowed and not s.settings.get("time_step")]
        if kept:
            best[level] = min(kept, key=lambda s: s.cost)
    return best
