"""What a study says: the table on the screen and in tradeoff.csv, and blocks of settings to paste."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from warpflag.base.output import whole
from warpflag.run.tradeoff.choices import REFERENCE, SOURCES
from warpflag.run.tradeoff.compared import LEVELS, Row, Summary, front, recommended
from warpflag.run.tradeoff.points import MEASURES
from warpflag.run.tradeoff.windows import Course

__all__ = ["CSV_NAME", "text", "write_csv"]

CSV_NAME = "tradeoff.csv"
_UNITS = {"f_c": "pN/um", "motor_rate": "Hz", "body_rate": "Hz", "speed": "um/s"}
_STANDARD = "accuracy 0.005"


def write_csv(rows: Sequence[Row], course: Course, path: Path) -> None:
    """Every point in a line."""
    begins = {window.name: window.time for window in course.windows}
    head = ["window", "begins_s", "length_s", "choice", "source", "status", "steps", "cost_ms_per_ms", "node_error_um"]
    with whole(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        table.writerow([*head, *MEASURES, *(f"{name}_off" for name in MEASURES)])
        for row in rows:
            p = row.point
            begin = [p.window, f"{begins[p.window]:.6g}", f"{course.length:.6g}", p.choice, p.source, p.status, p.steps]
            numbers = [p.cost, row.node_error, *(p.measures[name] for name in MEASURES), *row.off.values()]
            table.writerow([*begin, *(f"{x:.6g}" for x in numbers)])


def text(
    rows: Sequence[Row], found: Sequence[Summary], course: Course, unstartable: Mapping[str, str] | None = None
) -> str:
    """The report of a study: costs, errors by source, lengths of runs, settings to paste.

    Args:
        rows: of `compared`.
        found: of `summaries`.
        course: that the windows belong to.
        unstartable: why no run begins with a window's shape, by window.
    """
    windows = ", ".join(f"{window.name} from {1e3 * window.time:.3g} ms" for window in course.windows)
    lines = [f"windows of {1e3 * course.length:.3g} ms: {windows}"]
    if course.cut:
        lines.append(f"the course was followed to {1e3 * course.until:.4g} ms, not to the scene's end: {course.cut}")
    lines += [f"no run begins with the shape of window {name}: {why}" for name, why in (unstartable or {}).items()]
    for row in rows:
        if row.point.choice == REFERENCE and row.point.status != "done":
            lines.append(f"nothing is compared in window {row.point.window}: its reference was {row.point.status}")
    lines += ["", *_costs(found, course)]
    lines += _sources(rows)
    lines += _lengths(course)
    lines += _blocks(found, len(course.windows))
    return "\n".join(lines)


def _costs(found: Sequence[Summary], course: Course) -> list[str]:
    best = {summary.choice for summary in front(found)}
    lines = [
        f"{'choice':30}{'source':12}{'ms per ms':>10}{'node error um/ms':>18}{'windows':>9}",
        "-" * 79,
    ]
    for source in SOURCES:
        for s in sorted((s for s in found if s.source == source), key=lambda s: (math.isnan(s.cost), s.cost)):
            error = "-" if math.isnan(s.error) else f"{s.error:.1e}"
            mark = " *" if s.choice in best else ("" if s.sound else " stopped")
            lines.append(
                f"{s.choice:30}{s.source:12}{_number(s.cost):>10}{error:>18}{s.windows:6d}/{len(course.windows)}{mark}"
            )
    front_is = "* on the Pareto front: nothing cheaper is as accurate; " if best else ""
    return [*lines, f"{front_is}mean cost, largest error of all windows", ""]


def _number(x: float) -> str:
    return "-" if math.isnan(x) else f"{x:.3g}"


def _sources(rows: Sequence[Row]) -> list[str]:
    """The largest deviation by source, in each measure, over all windows."""
    lines = [
        "off from the converged run, largest of all windows (rates over their reference)",
        f"{'source':30}" + "".join(f"{name:>12}" for name in MEASURES),
        "-" * 102,
    ]
    shown = [("time step at 5e-3", [r for r in rows if r.point.choice == _STANDARD])]
    shown += [("mesh of the scene", [r for r in rows if r.point.choice == REFERENCE])]
    others = dict.fromkeys(r.point.choice for r in rows if r.point.source in ("precision", "mesh", "model"))
    shown += [(name, [r for r in rows if r.point.choice == name]) for name in others]
    for name, own in shown:
        cells = []
        for measure in MEASURES:
            values = [_relative(row, measure) for row in own]
            worst = max((x for x in values if not math.isnan(x)), key=abs, default=float("nan"))
            cells.append(f"{'-' if math.isnan(worst) else _shown(worst, measure):>12}")
        if own:
            lines.append(f"{name:30}" + "".join(cells))
    return [*lines, ""]


def _relative(row: Row, measure: str) -> float:
    off, value = row.off[measure], row.point.measures[measure]
    if measure not in _UNITS:
        return off
    beside = value - off
    return off / abs(beside) if abs(beside) > 1e-3 else float("nan")


def _shown(x: float, measure: str) -> str:
    if measure not in _UNITS:
        return f"{x:+.1e}"
    return f"{100 * x:+.2g} %" if abs(x) < 0.995 else f"{100 * x:+.0f} %"


def _lengths(course: Course) -> list[str]:
    """How long a run must be for a mean to be known to 1 %, from how its parts differ.

    Means over n parts that are independent differ by the spread of the parts over the root of n. No time below a part
    is told: how shorter ones differ was not looked at.
    """
    lines = [f"means over the last third of {1e3 * course.until:.4g} ms, and the time that knows them to 1 %:"]
    for name, (mean, spread) in course.rates.items():
        if mean == spread == 0.0:
            lines.append(f"  {name}: 0 throughout")
            continue
        if math.isnan(spread):
            lines.append(f"  {name}: {mean:.4g}, from a single frame: unknown")
            continue
        parts = (spread / (0.01 * abs(mean))) ** 2 if mean else float("nan")
        told = f"{1e3 * course.span * parts:.3g} ms" if parts > 1.0 else "one part will do"
        if math.isnan(parts):
            told = "unknown"
        lines.append(f"  {name}: {mean:.4g}, parts of {1e3 * course.span:.3g} ms differ by {spread:.2g}: {told}")
    return [*lines, ""]


def _blocks(found: Sequence[Summary], windows: int) -> list[str]:
    best = recommended(found)
    if not front(found):
        return ["# no settings to recommend: none was compared with a reference and came to its end", ""]
    lines = []
    for level, allowed in LEVELS.items():
        if level not in best:
            lines += [f"# {level}: nothing measured keeps {allowed:g} um per ms here", ""]
            continue
        s = best[level]
        where = "" if s.windows == windows else f", in {s.windows} of {windows} windows"
        said = f"# {level}: {s.choice}, {s.cost:.3g} ms per ms, node error {s.error:.1e} um per ms{where}"
        lines += [said, "[numerics]"]
        for key, value in s.settings.items():
            if value is not None:
                lines.append(f"{key} = " + (f'"{value}"' if isinstance(value, str) else f"{value:g}"))
        lines.append("")
    return lines
