"""The paper's figure 2: the cell at several times, drawn as lines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpflag.observables.arrays import flagella
from warpflag.record import Record
from warpflag.view.figures import COLORS, TWO_COLUMNS, styled
from warpflag.view.poses import body_axes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = np.ndarray


def snapshots(directory: str | Path, times: Sequence[float], columns: int = 4) -> Figure:
    """The cell at several times [ms], body to the left, seen across its first axis: the paper's Fig. 2.

    Every panel follows the body's centre and keeps the directions of time 0; the nearer of two flagella is drawn above.

    Args:
        directory: run directory.
        times: of the panels [ms]; the nearest frames are taken.
        columns: panels side by side.
    """
    with Record(directory) as record:
        frames = [int(np.abs(1e3 * record.times - time).argmin()) for time in times]
        panels = [_strokes(record, frame) for frame in frames]
        labels = [f"{1e3 * record.times[frame]:.1f} ms" for frame in frames]
    ends = np.concatenate([panel[0].reshape(-1, 2) for panel in panels])
    low, high = ends.min(axis=0) - 0.5, ends.max(axis=0) + 0.5
    rows = -(-len(panels) // columns)
    points_per_um = 72 * TWO_COLUMNS / columns / (high - low)[0]
    height = rows * (high - low)[1] * points_per_um / 72
    with styled() as figure_of:
        from matplotlib.collections import LineCollection

        figure = figure_of(figsize=(TWO_COLUMNS, height))
        for k, ((lines, widths, colors), label) in enumerate(zip(panels, labels, strict=True)):
            row, column = divmod(k, columns)
            axes = figure.add_axes((column / columns, 1 - (row + 1) / rows, 1 / columns, 1 / rows))
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            axes.axis("off")
            strokes = LineCollection(
                list(lines), linewidths=widths * points_per_um, colors=colors, capstyle="round", clip_on=False
            )
            axes.add_collection(strokes)
            axes.text(0.02, 0.04, label, transform=axes.transAxes)
        bar = high[0] - 0.4 - np.array([1.0, 0.0])
        axes = figure.axes[-1]
        axes.plot(bar, [low[1] + 0.5] * 2, color="black", linewidth=1.5)
        axes.text(bar.mean(), low[1] + 0.6, "1 µm", ha="center", va="bottom")
    return figure


def _strokes(record: Record, frame: int) -> tuple[Array, Array, list[str]]:
    """Lines, widths [um] and colours of body and flagella, the farthest first; x to the rear, y along e_b1."""
    e1, _, e3 = body_axes(record.body_orientation[0])
    view = np.stack([e3, e1, np.cross(e3, e1)])
    half = (record.body_length - record.body_width) / 2
    rear = body_axes(record.body_orientation[frame])[2]
    points = (record.positions[frame] - record.body_position[frame]) @ view.T
    drawn = [(0.0, np.stack([-half * rear, half * rear])[:, :] @ view.T, record.body_width, "#b9bdb3")]
    for k, rows in enumerate(flagella(record.first_node)):
        for a, b in zip(points[rows][:-1], points[rows][1:], strict=True):
            ends, depth = np.stack([a, b]), (a[2] + b[2]) / 2
            # A white rim shows which of two flagella is in front.
            drawn.append((depth - 1e-6, ends.mean(axis=0) + 0.2 * (ends - ends.mean(axis=0)), 0.16, "#ffffff"))
            drawn.append((depth, ends, 0.08, COLORS[k % len(COLORS)]))
    drawn.sort(key=lambda stroke: stroke[0])
    lines = np.array([line[:, :2] for _, line, _, _ in drawn])
    return lines, np.array([width for _, _, width, _ in drawn]), [color for *_, color in drawn]
