"""The paper's figures 3 and 4 as it draws them: curves over time with a second quantity in an inset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpflag.base.output import OutputError
from warpflag.view.figures import COLORS, COLUMN, TWO_COLUMNS, read, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = np.ndarray


@dataclass(frozen=True)
class Curves:
    """What is drawn of a run.

    Attributes:
        label: for the legend.
        times: [ms], shape [frame_count].
        phase_difference: <theta>, shape [frame_count].
        bundle_length: l_r, shape [frame_count]; it passes over gaps of `observables.STRAY`.
        steric_force_density: f_c [pN/um], shape [frame_count].
        model: times [ms] and l_r of a model, drawn dashed, or None.
    """

    label: str
    times: Array
    phase_difference: Array
    bundle_length: Array
    steric_force_density: Array
    model: tuple[Array, Array] | None = None


def curves_of(directory: str | Path, label: str, model: tuple[Array, Array] | None = None) -> Curves:
    """The curves of a run.

    Raises:
        RecordError: no record.
        OutputError: a cell with one flagellum, which has no bundle.
    """
    run = read(directory)
    names = ("phase_difference", "bundle_length", "steric_force_density")
    if not all(name in run.curves for name in names):
        raise OutputError(f"{directory}: has one flagellum; it takes two to be in phase and form a bundle")
    return Curves(label, run.times, *(run.curves[name].values[:, 0] for name in names), model)


def time_series(runs: Sequence[Curves], forces_of: Sequence[str] | None = None) -> Figure:
    """Phase difference and bundle length over time, f_c in an inset of each: the paper's Fig. 3(a) and (b).

    Args:
        runs: what is drawn.
        forces_of: labels of the runs whose f_c is shown; default: all.
    """
    with styled() as figure_of:
        figure = figure_of(figsize=(COLUMN, 4.7), layout="constrained")
        above, below = figure.subplots(2, sharex=True)
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

    Args:
        runs: what is drawn.
        dashed: labels of the runs that are drawn dashed.
    """
    with styled() as figure_of:
        figure = figure_of(figsize=(TWO_COLUMNS * 0.75, 3.1), layout="constrained")
        axes = figure.subplots()
        _draw(axes, runs, "bundle_length", dashed)
        axes.set(xlabel="t (ms)", ylabel=r"$l_r$", xlim=(0.0, max(run.times[-1] for run in runs)))
        _legend(figure, axes)
        inset = _inset(axes, (0.62, 0.15, 0.36, 0.40), r"$\langle\theta\rangle$")
        _draw(inset, runs, "phase_difference", dashed)
    return figure


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
