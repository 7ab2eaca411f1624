"""Figures of runs from their records: a dashboard of one, a comparison of several. Needs matplotlib (extra `plot`).

In print the figures are one column (86 mm) or two wide, with 8 point type. Nothing is drawn over curves: each quantity
has a panel of its own, and legends stand outside. A figure displays itself where a notebook's cell ends with it.
"""

from __future__ import annotations

import contextlib
import difflib
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpflag.base.output import OutputError, missing, whole
from warpflag.observables.arrays import Array
from warpflag.record import Record, RecordError
from warpflag.scene import Scene, loads
from warpflag.view.coloring import FLAGELLUM_COLORS, FORM_COLORS, form_names, map_color
from warpflag.view.curves import Curve, curves
from warpflag.view.labels import labels_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["COLORS", "COLUMN", "STYLE", "TWO_COLUMNS", "Run", "comparison", "dashboard", "read", "save", "styled"]

COLUMN, TWO_COLUMNS = 3.39, 7.0
"""Widths of a figure of one and of two columns [inch]."""
STYLE: Any = {
    "font.size": 8,
    "axes.labelsize": 8,
    "axes.titlesize": 8,
    "legend.fontsize": 7,
    "legend.title_fontsize": 7,
    "legend.frameon": False,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "xtick.direction": "in",
    "ytick.direction": "in",
    "axes.linewidth": 0.6,
    "lines.linewidth": 1.1,
}
"""Settings of matplotlib for all figures."""
COLORS = [FLAGELLUM_COLORS[k] for k in (1, 0, *range(2, len(FLAGELLUM_COLORS)))]
"""Colours of runs in their order; beyond twelve runs lines are dashed, then dotted."""

_LINE_STYLES = ("-", "--", ":", "-.")
_BUNDLING = ("phase_difference", "bundle_length", "steric_force_density")
_SWIMMING = ("body_speed", "body_rate")
_MOST_LINES = 4  # lines of a panel that can be told apart; of more, mean and range are drawn
_SHARE_IN_VIEW = 0.99  # of the values of a panel are shown at least: peaks of single frames may be left out
# A panel shows all values where they reach no further than this times what that share needs, which then fills at least
# 1/1.6, five eighths, of its height.
_PEAK = 1.6
_LONG_WORDS = 20  # letters of a title beside which there is no room for more


@dataclass(frozen=True)
class Run:
    """What is drawn of a run.

    Attributes:
        label: its name in a legend; empty: the legend says what differs between the scenes.
        scene: the scene of the record.
        times: of the frames [ms], shape [frame_count].
        curves: the observables by name.
        forms: of the joints of every flagellum, shapes [frame_count, joint_count]; empty without polymorphs.
    """

    label: str
    scene: Scene
    times: Array
    curves: dict[str, Curve]
    forms: tuple[Array, ...] = ()


def read(directory: str | Path, label: str = "") -> Run:
    """The curves of a run.

    Args:
        directory: run directory or run.h5.
        label: name in a legend; by default it says in what its scene differs from the others'.

    Raises:
        RecordError: no record, or one without frames.
    """
    with Record(directory) as record:
        if record.frame_count == 0:
            raise RecordError(f"{record.path}: holds no frames to draw")
        found = {curve.name: curve for curve in curves(record)}
        forms: tuple[Array, ...] = ()
        if record.forms is not None:
            joints = [slice(first + 1, end - 1) for first, end in pairwise(record.first_node.tolist())]
            forms = tuple(record.forms[:, own] for own in joints)
        return Run(label, loads(record.scene_text), 1e3 * record.times, found, forms)


def dashboard(run: Run | str | Path) -> Figure:
    """All curves of one run, a panel each.

    Args:
        run: what `read` gave, or a run directory.

    Raises:
        RecordError: no record, or one without frames.
    """
    run = run if isinstance(run, Run) else read(run)
    count = len(run.curves) + bool(run.forms)
    rows = -(-count // 2)
    with styled() as figure_of:
        figure = figure_of(figsize=(TWO_COLUMNS, 0.5 + 1.25 * rows), layout="constrained")
        panels = [*figure.subplots(rows, 2, sharex=True, squeeze=False).T.ravel()]
        if count < len(panels):
            panels.pop(rows).remove()  # the upper right corner stays free, so that both columns end below
        if run.forms:
            _draw_forms(panels[-1], run)
        for axes, curve in zip(panels[: len(run.curves)], run.curves.values(), strict=True):
            many = curve.values.shape[1] > 1
            if curve.values.shape[1] > _MOST_LINES:
                low, high = curve.values.min(axis=1), curve.values.max(axis=1)
                axes.fill_between(run.times, low, high, color=COLORS[0], alpha=0.25, linewidth=0)
                axes.plot(run.times, curve.values.mean(axis=1), color=COLORS[0])
                _set_range(axes, [curve])
                axes.set_title(f"{_title(curve)}, mean and range of all flagella", loc="left")
                continue
            for k, line in enumerate(curve.values.T):
                color = FLAGELLUM_COLORS[k % len(FLAGELLUM_COLORS)] if many else COLORS[0]
                axes.plot(run.times, line, color=color, linewidth=0.8 if many else None)
            _set_range(axes, [curve])
            each = ", a line per flagellum" if len(curve.words) < _LONG_WORDS else ", each"
            axes.set_title(_title(curve) + (each if many else ""), loc="left")
        _set_times(panels, [run], (panels[rows - 1], panels[-1]))
        count = len(run.scene.resolved_flagella())
        figure.suptitle(f"{run.label or run.scene.name}: {count} {'flagella' if count > 1 else 'flagellum'}")
    return figure


def _draw_forms(axes: Any, run: Run) -> None:
    """Forms along every flagellum over time, one flagellum above the other."""
    from matplotlib.colors import ListedColormap

    names = form_names(run.scene)
    colors = FORM_COLORS[: len(names)]
    specs = run.scene.resolved_flagella()
    base = 0.0
    for k, (spec, forms) in enumerate(zip(specs, run.forms, strict=True)):
        h = spec.segment_length
        edges = np.concatenate([run.times[:1], (run.times[1:] + run.times[:-1]) / 2, run.times[-1:]])
        along = base + h * (0.5 + np.arange(forms.shape[1] + 1))
        axes.pcolormesh(edges, along, forms.T, cmap=ListedColormap(colors), vmin=-0.5, vmax=len(names) - 0.5)
        base += spec.length
        if k + 1 < len(specs):
            axes.axhline(base, color="w", linewidth=1.0)
    axes.set_ylim(0.0, 1.25 * base)  # room for the legend
    axes.set_title("forms, contour from the motor (µm)" + (", flagella stacked" if len(specs) > 1 else ""), loc="left")
    patches = [axes.plot([], [], "s", color=color, label=name)[0] for name, color in zip(names, colors, strict=True)]
    axes.legend(handles=patches, loc="upper right", ncols=len(names), frameon=True, borderpad=0.2)


def comparison(runs: Sequence[Run | str | Path], names: Sequence[str] = ()) -> Figure:
    """Observables of several runs over time, a panel each; of those with a value per flagellum, the mean.

    Args:
        names: of the observables; by default phase difference, bundle length, contact force, speed and body rate, of
            which cells with one flagellum have the last two, and then the elastic energy.
        runs: what `read` gave, or run directories. Runs without a label are labelled by what differs between their
            scenes; where that is one number, they are coloured by it.

    Raises:
        OutputError: some run has no observable of that name.
        RecordError: no record, or one without frames.
    """
    read_runs = [run if isinstance(run, Run) else read(run) for run in runs]
    title, labels, values = labels_of([run.scene for run in read_runs])
    labels = [run.label or label for run, label in zip(read_runs, labels, strict=True)]
    if any(run.label for run in read_runs):
        title, values = "", None
    names = _compared(read_runs, names)
    with styled() as figure_of:
        figure = figure_of(figsize=(TWO_COLUMNS * 0.75, 0.6 + 1.5 * len(names)), layout="constrained")
        panels = figure.subplots(len(names), 1, sharex=True, squeeze=False).ravel()
        for axes, name in zip(panels, names, strict=True):
            for run, style in zip(read_runs, _styles(len(read_runs), values), strict=True):
                axes.plot(run.times, run.curves[name].values.mean(axis=1), **style)
            found = [run.curves[name] for run in read_runs]
            _set_range(axes, found)
            axes.set_title(_title(found[0]), loc="left")
        _set_times(panels, read_runs, panels[-1:])
        if len(read_runs) > 1:
            columns = -(-len(read_runs) // 24)
            figure.legend(panels[0].get_lines(), labels, loc="outside right upper", title=title or None, ncols=columns)
    return figure


def _compared(runs: Sequence[Run], names: Sequence[str]) -> list[str]:
    """The observables to compare: those named, or the usual ones that all runs have."""
    shared = [name for name in runs[0].curves if all(name in run.curves for run in runs)]
    if unknown := [name for name in names if name not in shared]:
        whose = "these runs have no {} in common" if len(runs) > 1 else "this run has no {}"
        last = unknown[0].rpartition("_")[2]  # speed, net_speed: body_speed
        near = [name for name in shared if name.rpartition("_")[2] == last]
        near = near or difflib.get_close_matches(unknown[0], shared, 1)
        hint = f"did you mean {' or '.join(near)}? " if near else ""
        raise OutputError(f"{whose.format(unknown[0])}; {hint}known: {', '.join(shared)}")
    found = list(names) or [name for name in (*_BUNDLING, *_SWIMMING) if name in shared]
    if not names and len(found) < len(_BUNDLING) and "elastic_energy" in shared:
        found.append("elastic_energy")
    if not found:
        raise OutputError("these runs have no observable in common that could be compared")
    return found


def save(figure: Figure, path: str | Path, dpi: float = 300) -> None:
    """Writes a figure; the file is whole or absent.

    Args:
        figure: what this module returned, or any figure of matplotlib.
        path: its ending says the format: png, jpg, pdf, svg, ...
        dpi: dots per inch of a format that has them.

    Raises:
        OutputError: an unknown format.
    """
    path = Path(path)
    formats = figure.canvas.get_supported_filetypes()
    if path.suffix.lstrip(".") not in formats:
        raise OutputError(f"{path}: must end in one of .{', .'.join(sorted(formats))}")
    with styled(), whole(path) as temporary:
        figure.savefig(temporary, dpi=dpi)


@contextlib.contextmanager
def styled() -> Iterator[Any]:
    """Within the block matplotlib has `STYLE`; gives the class of figures that display themselves in a notebook.

    Figures are made without pyplot, so that they neither open a window nor change what a notebook draws with.

    Raises:
        OutputError: matplotlib is not installed.
    """
    try:
        import matplotlib
    except ImportError:
        raise OutputError(f"figures need matplotlib: {missing('matplotlib', 'plot')}") from None
    with matplotlib.rc_context(STYLE):
        yield _figure_class()


@cache
def _figure_class() -> Any:
    from matplotlib.figure import Figure

    class NotebookFigure(Figure):
        def _repr_png_(self) -> bytes:
            buffer = io.BytesIO()
            self.savefig(buffer, format="png", dpi=150)
            return buffer.getvalue()

    return NotebookFigure


def _title(curve: Curve) -> str:
    """Name of a curve with its symbol in italics and its unit."""
    symbols = {"⟨θ⟩": r"$\langle\theta\rangle$", "l_r": "$l_r$", "f_c": "$f_c$", "v": "$v$"}
    parts = [curve.words, symbols.get(curve.symbol, curve.symbol), f"({curve.unit})" if curve.unit else ""]
    return " ".join(filter(None, parts))


def _set_range(axes: Any, found: Sequence[Curve]) -> None:
    """A range that begins at 0 or below; a peak of few frames that would flatten the rest is told, not shown."""
    values = np.concatenate([curve.values.ravel() for curve in found])
    values = values[np.isfinite(values)]
    if len(values) == 0:
        axes.set_yticks([])
        axes.text(0.5, 0.5, "no frame has it", transform=axes.transAxes, ha="center", va="center", fontsize=7)
        return
    for line in axes.get_lines():
        if np.isfinite(line.get_ydata()).sum() == 1:  # a single point joins nothing
            line.set(marker="o", markersize=3)
    low, high = np.minimum(values.min(), 0.0), np.maximum(values.max(), 0.0)
    tail = 0.5 * (1.0 - _SHARE_IN_VIEW)
    most_low, most_high = np.minimum(np.quantile(values, tail), 0.0), np.maximum(np.quantile(values, 1.0 - tail), 0.0)
    beyond = []
    if high > _PEAK * most_high > 0.0:
        beyond, high = [f"up to {_short(high)}"], most_high
    if low < _PEAK * most_low < 0.0:
        beyond, low = [*beyond, f"down to {_short(low)}"], most_low
    if high == low:
        beyond, high = ["zero throughout"], 1.0
    margin = 0.05 * (high - low)
    axes.set_ylim(low - margin if low < 0.0 else -0.4 * margin, high + margin)
    if beyond:
        axes.set_title(", ".join(beyond), loc="right", fontsize=7)


def _short(value: float) -> str:
    """A number to three digits, without an exponent."""
    return np.format_float_positional(value, precision=3, fractional=False, trim="-")


def _set_times(panels: Sequence[Any], runs: Sequence[Run], lowest: Sequence[Any]) -> None:
    """The range of times of all panels, and its label under the lowest."""
    first, last = min(run.times[0] for run in runs), max(run.times[-1] for run in runs)
    for axes in panels:
        if last > first:
            axes.set_xlim(first, last)
    for axes in lowest:
        axes.set_xlabel("t (ms)")


def _styles(count: int, values: Sequence[float] | None) -> list[dict[str, Any]]:
    """Colour and line of each run: along the colour map by a number where more than four differ in one alone."""
    if values is not None and count > 4:
        low, high = min(values), max(values)
        shares = 0.85 * (np.array(values) - low) / ((high - low) or 1.0)  # the last colours are too pale on white
        return [{"color": tuple(map_color(share) / 255.0)} for share in shares]
    return [
        {"color": COLORS[k % len(COLORS)], "linestyle": _LINE_STYLES[k // len(COLORS) % len(_LINE_STYLES)]}
        for k in range(count)
    ]
