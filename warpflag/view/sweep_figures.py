"""Figures of a sweep, from its table: curves of numbers against one axis, or maps over two. Needs matplotlib."""

from __future__ import annotations

import csv
import difflib
import math
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpflag.base.output import OutputError, missing, text_of_file
from warpflag.observables.arrays import Array
from warpflag.scene.reading import keys_of, unit_of
from warpflag.view.figures import COLORS, COLUMN, STYLE, TWO_COLUMNS
from warpflag.view.labels import in_equal_ratios, set_levels, told_apart, with_error, with_margin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["DEFAULT_NUMBERS", "Table", "curves", "figure", "is_sweep", "maps", "read"]

DEFAULT_NUMBERS = ("rates.net_speed", "rates.motor_rate_lab", "rates.body_rate", "events.zipped")
_MOST_WITHIN = 6  # lines whose legend stands within the first panel
_BEFORE_NUMBERS = ("member", "point", "repeat", "status", "count")
# Units of a table's numbers by the last part of their name, and what one is in that unit.
_UNITS = {
    "net_speed": ("µm/s", 1.0),
    "body_speed": ("µm/s", 1.0),
    "motor_rate": ("Hz", 1.0),
    "motor_rate_lab": ("Hz", 1.0),
    "body_rate": ("Hz", 1.0),
    "zipped": ("ms", 1e3),
    "synchronised": ("ms", 1e3),
    "time": ("ms", 1e3),
    "motor_torque": ("pN µm", 1.0),
    "elastic_energy": ("pN µm", 1.0),
    "steric_force_density": ("pN/µm", 1.0),
    "wall_time": ("s", 1.0),
}


@dataclass(frozen=True)
class Table:
    """The table of a sweep.

    Attributes:
        name: of the sweep's directory.
        axes: dotted keys that the sweep varies along axes, in order; of keys that vary together one that tells their
            points apart.
        columns: every column of the table as text, by name.
    """

    name: str
    axes: tuple[str, ...]
    columns: dict[str, list[str]]

    def numbers(self, name: str) -> Array:
        """A column as numbers, NaN where it is empty or not finite, shape [row_count].

        Raises:
            OutputError: there is no such column, or it does not hold numbers.
        """
        try:
            found = np.array([float(text) if text else math.nan for text in self.columns[self.full_name(name)]])
        except ValueError:
            raise OutputError(f"{self.name}: column {name} does not hold numbers") from None
        return np.where(np.isfinite(found), found, math.nan)

    @property
    def known(self) -> list[str]:
        """Columns that a figure may be asked for by name: those of single flagella and of the bookkeeping left out."""
        return [column for column in self.columns if column not in _BEFORE_NUMBERS and not column[-1].isdecimal()]

    def full_name(self, name: str) -> str:
        """The column of a name, which may be the last part of one alone: net_speed for rates.net_speed.

        Raises:
            OutputError: there is no such column, or several.
        """
        if name in self.columns:
            return name
        known = self.known
        ending = [column for column in known if column.endswith(f".{name}")]
        if len(ending) == 1:
            return ending[0]
        leaves = {column.rpartition(".")[2]: column for column in known}
        near = [leaves[leaf] for leaf in difflib.get_close_matches(name.rpartition(".")[2], leaves, 3, 0.7)]
        said = f"did you mean {' or '.join(ending or near)}?" if ending or near else f"it has {', '.join(known)}"
        raise OutputError(f"{self.name}: has no column {name}; {said}")

    def whole(self, name: str) -> np.ndarray:
        """Rows whose number stands for what its name says: of rates, those that had zipped when their window began.

        Where no row has zipped, nobody waits for that, and every row counts. Of anything but rates, those that have it.
        """
        if name.startswith("rates.") and {"events.zipped", "rates.from"} <= self.columns.keys():
            zipped = self.numbers("events.zipped")
            if np.isfinite(zipped).any():
                return zipped <= self.numbers("rates.from")
            return np.ones(len(zipped), dtype=bool)
        return np.isfinite(self.numbers(name))

    def positions(self, name: str) -> tuple[Array, list[str]]:
        """Where each row stands along a column, and the words that stand there: none where it holds numbers."""
        try:
            return self.numbers(name), []
        except OutputError:
            words, position = self.levels(name)
            return position.astype(float), words

    def levels(self, name: str) -> tuple[list[str], Array]:
        """Values of an axis as text, each once in order of size, and which of them each row has."""
        texts = self.columns[name]
        try:
            levels = sorted(set(texts), key=float)
        except ValueError:
            levels = list(dict.fromkeys(texts))
        return levels, np.array([levels.index(text) for text in texts])


def is_sweep(directory: str | Path) -> bool:
    """Whether a directory holds a sweep."""
    return (Path(directory) / "sweep.toml").is_file()


def read(directory: str | Path) -> Table:
    """The table of a sweep's directory.

    Raises:
        OutputError: it can't be read, or has no rows.
    """
    path = Path(directory) / "table.csv"
    try:
        header, *rows = csv.reader(text_of_file(path).splitlines(), strict=True)
        axes = tomllib.loads(text_of_file(path.with_name("sweep.toml"))).get("axes", {})
    except OutputError:
        raise
    except (ValueError, RecursionError, csv.Error) as error:
        raise OutputError(f"{path}: can't be read: {' '.join(str(error).split())}") from None
    if not rows:
        raise OutputError(f"{path}: has no rows")
    for number, row in enumerate(rows, 2):
        if len(row) != len(header):
            raise OutputError(f"{path}: line {number} has {len(row)} entries, not {len(header)} as the first line")
    if not isinstance(axes, dict):
        raise OutputError(f"{path.with_name('sweep.toml')}: axes is no table of values by key")
    columns = {name: [row[k] for row in rows] for k, name in enumerate(header)}
    leading = [key for axis in axes for key in _leading([key for key in keys_of(axis) if key in columns], columns)]
    return Table(Path(directory).resolve().name, tuple(leading), columns)


def _leading(keys: list[str], columns: dict[str, list[str]]) -> list[str]:
    """Of keys that vary together the first one that tells all their points apart; all of them where none does."""
    points = len(set(zip(*(columns[key] for key in keys), strict=True)))
    alone = [key for key in keys if len(set(columns[key])) == points]
    return alone[:1] or keys


def figure(
    directories: Sequence[str | Path], kind: str | None = None, x: str | None = None, numbers: Sequence[str] = ()
) -> Figure:
    """The figure of a sweep that the command line asks for.

    Args:
        directories: that of one sweep.
        kind: curves or map; None: a map of two numeric axes unless x is given, else curves.
        x: as in `curves`.
        numbers: as in `curves`.

    Raises:
        OutputError: there are several directories, the kind is one of runs, or there is no such column.
    """
    if len(directories) > 1:
        raise OutputError(f"{directories[0]}: is a sweep; a figure draws one sweep")
    if kind not in (None, "curves", "map"):
        raise OutputError(f"{directories[0]}: is a sweep; it is drawn as curves or a map, not as a {kind}")
    table = read(directories[0])
    long = [axis for axis in table.axes if len(table.levels(axis)[0]) > 2]
    if kind == "map" or (kind is None and x is None and len(long) > 1):
        return maps(table, numbers)
    return curves(table, x, numbers)


@contextmanager
def _style() -> Iterator[None]:
    """The type sizes of print, for all that is drawn within."""
    try:
        import matplotlib
    except ImportError:
        raise OutputError(f"figures need matplotlib: {missing('matplotlib', 'plot')}") from None
    matplotlib.use("agg")
    style: Any = STYLE
    with matplotlib.rc_context(style):
        yield


@_style()
def curves(table: Table, x: str | None = None, numbers: Sequence[str] = ()) -> Figure:
    """A panel per number against one column; mean and standard error where rows share it; a line per second axis.

    A column of words has a place for each. What is a mean over further axes says so. Points against the number of the
    member or repeat are not joined. Without an axis, members are drawn, and their mean with its standard error stands
    above each panel.

    A point is hollow where it does not stand for all that its name says: see `Table.whole`.

    Args:
        table: of a sweep.
        x: column of the abscissa; default: the first axis, or the member where there is none.
        numbers: columns to draw; default: those of `DEFAULT_NUMBERS` that hold something.

    Raises:
        OutputError: there is no such column, or none with anything to draw.
    """
    x, numbers = _abscissa(table, x), _drawn(table, numbers)
    numbered = x in _BEFORE_NUMBERS  # members and repeats have an order, but nothing between them
    (position, words), others = table.positions(x), [axis for axis in table.axes if axis != x]
    lines, line_of = table.levels(others[0]) if others else ([""], np.zeros(len(position), dtype=int))
    from matplotlib.lines import Line2D

    figure, panels = _panels(len(numbers))
    notes: dict[str, None] = {}
    for panel, name in zip(panels, numbers, strict=True):
        values, whole = _UNITS.get(_leaf(name), ("", 1.0))[1] * table.numbers(name), table.whole(name)
        for k in range(len(lines)):
            places = np.unique(position[line_of == k])
            here = [(line_of == k) & (position == place) for place in places]
            rows = [values[at & np.isfinite(values)] for at in here]
            means = np.array([row.mean() if len(row) else math.nan for row in rows])
            errors = [row.std(ddof=1) / math.sqrt(len(row)) if len(row) > 1 else 0.0 for row in rows]
            color = COLORS[k % len(COLORS)]
            line = "none" if words or numbered else "-"
            panel.errorbar(places, means, errors, capsize=2, color=color, linestyle=line)
            full = np.array([bool(whole[at].all()) for at in here])
            panel.plot(places[full], means[full], "o", markersize=3.5, color=color)
            hollow = ~full & np.isfinite(means)
            panel.plot(places[hollow], means[hollow], "o", markersize=3.5, color=color, markerfacecolor="white")
            if hollow.any():
                rate = name.startswith("rates.")
                notes["not bundled when the window of rates began" if rate else "not reached by every repeat"] = None
        panel.set_xlabel(_label(x))
        panel.set_ylabel(_label(name))
        if words:
            set_levels(panel.xaxis, words)
        elif numbered:
            panel.locator_params(axis="x", integer=True)
        elif in_equal_ratios(position):
            panel.set_xscale("log")
        else:
            panel.ticklabel_format(axis="x", scilimits=(-2, 5), useMathText=True)
        panel.set_xlim(*with_margin(position, panel.get_xscale() == "log"))
        _set_height(panel, values[np.isfinite(values)])
        if not table.axes:
            _show_mean(panel, values[np.isfinite(values)])
    if others:
        style: dict[str, Any] = {"marker": "o", "markersize": 3.5, "linestyle": "none" if words or numbered else "-"}
        handles = [Line2D([], [], color=COLORS[k % len(COLORS)], **style) for k in range(len(lines))]
        labels = [f"{_leaf(others[0])} {line}".replace("_", " ") for line in told_apart(lines)]
        if len(lines) > _MOST_WITHIN:
            figure.legend(handles, labels, loc="outside right upper")
        else:
            panels[0].legend(handles, labels)
    _say(figure, _over(table, others[1:]), "hollow: " + "; ".join(notes) if notes else "")
    return figure


def _over(table: Table, axes: Sequence[str]) -> str:
    """What a figure says of axes that it does not show; empty where they have one value each."""
    found = [_label(axis) for axis in axes if len(set(table.columns[axis])) > 1]
    return "means over " + " and ".join(found) if found else ""


def _say(figure: Figure, *notes: str) -> None:
    """Notes below a figure, where there are any."""
    if any(notes):
        figure.supxlabel("; ".join(filter(None, notes)), fontsize=7)


def _set_height(panel: Axes, values: Array) -> None:
    """Values that are equal but for round-off are not drawn apart, and a panel without any says so."""
    if not len(values):
        panel.set_yticks([])
        panel.text(0.5, 0.5, "no member has any", transform=panel.transAxes, ha="center", va="center", fontsize=8)
    elif np.ptp(values) < 1e-6 * (size := float(np.abs(values).max())):
        panel.set_ylim(values.min() - 0.05 * size, values.max() + 0.05 * size)


def _show_mean(panel: Axes, values: Array) -> None:
    """The mean of all members as a line, and above the panel with its standard error."""
    if len(values) > 1:
        error = values.std(ddof=1) / math.sqrt(len(values))
        panel.axhline(values.mean(), color="0.6", linewidth=0.8, zorder=0)
        panel.set_title(with_error(values.mean(), error), fontsize=8)


@_style()
def maps(table: Table, numbers: Sequence[str] = ()) -> Figure:
    """A map per number over the first two axes, means over what else varies; what there is not is left blank.

    Args:
        table: of a sweep with two axes.
        numbers: as in `curves`.

    Raises:
        OutputError: there are not two axes, or there is no such column.
    """
    if len(table.axes) < 2:
        raise OutputError(f"{table.name}: a map takes two axes, the sweep has {len(table.axes)}")
    numbers = _drawn(table, numbers)
    (first, columns), (second, rows) = (table.levels(axis) for axis in table.axes[:2])
    figure, panels = _panels(len(numbers))
    for panel, name in zip(panels, numbers, strict=True):
        values = _UNITS.get(_leaf(name), ("", 1.0))[1] * table.numbers(name)
        image = np.full((len(second), len(first)), math.nan)
        for i in range(len(second)):
            for j in range(len(first)):
                found = values[(rows == i) & (columns == j) & np.isfinite(values)]
                image[i, j] = found.mean() if len(found) else math.nan
        drawn = panel.imshow(image, origin="lower", aspect="auto", cmap="viridis")
        panel.set_facecolor("0.9")
        panel.figure.colorbar(drawn, ax=panel, label=_label(name))
        for axis, levels in ((panel.xaxis, first), (panel.yaxis, second)):
            set_levels(axis, levels, range(0, len(levels), max(1, len(levels) // 6)))
        panel.set_xlabel(_label(table.axes[0]))
        panel.set_ylabel(_label(table.axes[1]))
    _say(figure, _over(table, table.axes[2:]))
    return figure


def _abscissa(table: Table, x: str | None) -> str:
    if x is None:
        return table.axes[0] if table.axes else "member"
    return table.full_name(x)


def _drawn(table: Table, numbers: Sequence[str]) -> list[str]:
    """The columns to draw."""
    if numbers:
        return [table.full_name(name) for name in numbers]
    found = [name for name in DEFAULT_NUMBERS if name in table.columns and np.isfinite(table.numbers(name)).any()]
    if not found and "done" in table.columns.get("status", ()):
        named = ", ".join(map(_leaf, DEFAULT_NUMBERS))
        known = ", ".join(table.known)
        raise OutputError(f"{table.name}: holds none of {named}; name what to draw with --y: it has {known}")
    if not found:
        raise OutputError(f"{table.name}: no member has anything to draw yet")
    return found


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    from matplotlib import pyplot

    columns = min(count, 2)
    rows = -(-count // columns)
    size = (COLUMN if columns == 1 else TWO_COLUMNS, 2.4 * rows)
    figure, axes = pyplot.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for axis in axes.flat[count:]:
        axis.remove()
    return figure, list(axes.flat[:count])


def _leaf(name: str) -> str:
    parts: list[Any] = [part for part in name.split(".") if not part.isdecimal() and part != "error"]
    return parts[-1]


_WORDS = {"motor_rate_lab": "motor rate in the lab", "zipped": "time to zip", "synchronised": "time to synchronise"}


def _label(name: str) -> str:
    """The name of a column in words, with its unit."""
    words = " ".join(
        _WORDS.get(part, part.replace("_", " "))
        for part in name.split(".")
        if part not in ("rates", "observables", "events")
    )
    unit = _UNITS.get(_leaf(name), ("", 1.0))[0] or unit_of(name).replace("um", "µm").replace("^2", "²")
    return f"{words} [{unit}]" if unit else words
