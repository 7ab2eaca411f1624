"""Figures of runs, made from their records: time series, comparisons, snapshots. Needs matplotlib (extra `plot`).

In print the figures are one column (86 mm) or two wide, with 8 point type.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpflag.base.output import OutputError, whole
from warpflag.observables import STRAY
from warpflag.observables.arrays import Array, flagella, unit
from warpflag.observables.recorded import bundle_lengths
from warpflag.record import Record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Curves", "comparison", "read", "save", "snapshots", "time_series"]

COLUMN, TWO_COLUMNS = 3.39, 7.0  # inches
STYLE = {
    "font.size": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.1,
}
# Okabe & Ito's colours, told apart by colour-blind readers.
COLORS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#000000"]


@dataclass(frozen=True)
class Curves:
    """What is drawn of a run.

    Attributes:
        label: for the legend.
        times: [ms], shape [frame_count].
        phase_difference: <theta>, same shape.
        bundle_length: l_r, same shape; it passes over gaps of `observables.STRAY`.
        steric_force_density: f_c [pN/um], same shape.
        model: times [ms] and l_r of a model, drawn dashed, or None.
    """

    label: str
    times: Array
    phase_difference: Array
    bundle_length: Array
    steric_force_density: Array
    model: tuple[Array, Array] | None = None


def read(directory: str | Path, label: str | None = None, model: tuple[Array, Array] | None = None) -> Curves:
    """The curves of a run; its label is the directory's name unless given.

    Raises RecordError where there is no record, and OutputError for a cell with one flagellum, which has no bundle.
    """
    with Record(directory) as record:
        measured = record.observables
        if "phase_difference" not in measured:
            raise OutputError(f"{record.path}: has one flagellum; it takes two to be in phase and form a bundle")
        return Curves(
            label=label or Path(directory).resolve().name,
            times=1e3 * record.times,
            phase_difference=measured["phase_difference"],
            bundle_length=bundle_lengths(record, gap=STRAY),
            steric_force_density=measured["steric_force_density"],
            model=model,
        )


def time_series(runs: Sequence[Curves], forces_of: Sequence[str] | None = None) -> Figure:
    """Phase difference and bundle length over time, f_c in an inset of each: the paper's Fig. 3(a) and (b).

    forces_of: labels of the runs whose f_c is shown; default: all.
    """
    plt = _pyplot()
    with plt.rc_context(STYLE):
        figure, (above, below) = plt.subplots(2, figsize=(COLUMN, 4.7), sharex=True, layout="constrained")
        shown = [k for k, run in enumerate(runs) if forces_of is None or run.label in forces_of]
        panels = (
            (above, "phase_difference", r"$\langle\theta\rangle$", (0.52, 0.52, 0.46, 0.45)),
            (below, "bundle_length", r"$l_r$", (0.60, 0.14, 0.38, 0.35)),
        )
        for axes, name, symbol, place in panels:
            _draw(axes, runs, name)
            axes.set(ylabel=symbol, xlim=(0.0, max(run.times[-1] for run in runs)))
            inset = _inset(axes, place, r"$f_c$ (pN/µm)")
            for k in shown:
                inset.plot(runs[k].times, runs[k].steric_force_density, color=COLORS[k % len(COLORS)], linewidth=0.8)
            inset.set_ylim(0.0, None)
        for k, run in enumerate(runs):
            if run.model is not None:
                below.plot(*run.model, "--", color=COLORS[k % len(COLORS)], linewidth=0.9)
        below.set_xlabel("t (ms)")
        _legend(figure, above)
        for axes, letter in ((above, "(a)"), (below, "(b)")):
            axes.text(-0.14, 1.0, letter, transform=axes.transAxes, va="top", ha="right")
    return figure


def comparison(runs: Sequence[Curves], dashed: Sequence[str] = ()) -> Figure:
    """Bundle length of several runs over time, their phase differences in the inset: the paper's Fig. 4.

    dashed: labels of the runs that are drawn dashed.
    """
    plt = _pyplot()
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(TWO_COLUMNS * 0.75, 3.1), layout="constrained")
        _draw(axes, runs, "bundle_length", dashed)
        axes.set(xlabel="t (ms)", ylabel=r"$l_r$", xlim=(0.0, max(run.times[-1] for run in runs)))
        _legend(figure, axes)
        inset = _inset(axes, (0.62, 0.15, 0.36, 0.40), r"$\langle\theta\rangle$")
        _draw(inset, runs, "phase_difference", dashed)
    return figure


def snapshots(directory: str | Path, times: Sequence[float], columns: int = 4) -> Figure:
    """The cell at several times [ms], body to the left, seen across its first axis: the paper's Fig. 2.

    Every panel follows the body's centre and keeps the directions of time 0; the nearer of two flagella is drawn above.
    """
    plt = _pyplot()
    with Record(directory) as record:
        frames = [int(np.abs(1e3 * record.times - time).argmin()) for time in times]
        panels = [_strokes(record, frame) for frame in frames]
        labels = [f"{1e3 * record.times[frame]:.1f} ms" for frame in frames]
    ends = np.concatenate([panel[0].reshape(-1, 2) for panel in panels])
    low, high = ends.min(axis=0) - 0.5, ends.max(axis=0) + 0.5
    rows = -(-len(panels) // columns)
    points_per_um = 72 * TWO_COLUMNS / columns / (high - low)[0]
    height = rows * (high - low)[1] * points_per_um / 72
    with plt.rc_context(STYLE):
        from matplotlib.collections import LineCollection

        figure = plt.figure(figsize=(TWO_COLUMNS, height))
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


def save(figure: Figure, path: str | Path, dpi: float = 300) -> None:
    """Writes a figure, the ending of the path says the format (png, pdf, svg, ...), and lets go of it.

    dpi: dots per inch of a format that has them.

    Raises OutputError for an unknown format.
    """
    path, plt = Path(path), _pyplot()
    formats = figure.canvas.get_supported_filetypes()
    if path.suffix.lstrip(".") not in formats:
        raise OutputError(f"{path}: must end in one of .{', .'.join(sorted(formats))}")
    with plt.rc_context(STYLE), whole(path) as temporary:
        figure.savefig(temporary, dpi=dpi)
    plt.close(figure)


def _pyplot() -> Any:
    try:
        import matplotlib
    except ImportError:
        raise OutputError("figures need matplotlib: install warpflag with its extra, warpflag[plot]") from None
    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    return plt


def _draw(axes: Any, runs: Sequence[Curves], name: str, dashed: Sequence[str] = ()) -> None:
    for k, run in enumerate(runs):
        style = "--" if run.label in dashed else "-"
        axes.plot(run.times, getattr(run, name), style, color=COLORS[k % len(COLORS)], label=run.label)
    axes.set_ylim(0.0, 1.05 if name == "bundle_length" else None)


def _inset(axes: Any, place: tuple[float, float, float, float], y: str) -> Any:
    """Small axes over time inside others, on a white ground that holds their labels too."""
    from matplotlib.patches import Rectangle

    left, bottom, width, height = place
    ground = Rectangle((left - 0.12, bottom - 0.14), width + 0.13, height + 0.16, transform=axes.transAxes)
    ground.set(facecolor="white", edgecolor="none", zorder=2.4)  # above lines, below the frame
    axes.add_patch(ground)
    inset = axes.inset_axes(place, zorder=5)
    inset.set_xlabel("t (ms)", fontsize=7, labelpad=1)
    inset.set_ylabel(y, fontsize=7, labelpad=1)
    inset.tick_params(labelsize=6, pad=1.5, length=2)
    inset.set_xlim(*axes.get_xlim())
    return inset


def _legend(figure: Figure, axes: Any) -> None:
    handles, labels = axes.get_legend_handles_labels()
    if len(labels) > 1:
        room = 0.45 + 0.05 * max(map(len, labels))  # inches that an entry takes: handle and 7 point letters
        columns = min(len(labels), max(1, int(figure.get_figwidth() / room)))
        figure.legend(handles, labels, loc="outside upper center", ncols=columns, handlelength=1.8)


def _strokes(record: Record, frame: int) -> tuple[Array, Array, list[str]]:
    """Lines, widths [um] and colours of body and flagella, the farthest first; x to the rear, y along e_b1."""
    e1, _, e3 = _body_axes(record.body_orientation[0])
    view = np.stack([e3, e1, np.cross(e3, e1)])
    half = (record.body_length - record.body_width) / 2
    rear = _body_axes(record.body_orientation[frame])[2]
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


def _body_axes(quaternion: Array) -> Array:
    """e_b1, e_b2, e_b3 in the lab as rows, of a quaternion (x, y, z, w)."""
    x, y, z, w = unit(quaternion)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return (np.eye(3) + 2 * w * cross + 2 * cross @ cross).T
