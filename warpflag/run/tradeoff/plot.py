"""Error against cost, as a figure; needs matplotlib (extra plot)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from warpflag.base.output import OutputError
from warpflag.run.tradeoff.compared import Summary, front
from warpflag.view import figures

__all__ = ["FIGURE_NAME", "draw"]

FIGURE_NAME = "tradeoff.png"
_MARKS = {"implicit": "o", "rkc": "D", "fixed steps": "v", "precision": "s", "strict, device": "^"}


def draw(found: Sequence[Summary], title: str, path: Path) -> None:
    """Every choice that has a node error, and the front, whose members are numbered and named beside it.

    Raises:
        OutputError: no choice has one, matplotlib is missing, or the file can't be written.
    """
    shown = [s for s in found if _kind(s) and not math.isnan(s.error) and s.error > 0]
    if not shown:
        raise OutputError("nothing was compared with a reference yet")
    with figures.styled() as figure_of:
        figure = figure_of(figsize=(0.8 * figures.TWO_COLUMNS, 3.0), layout="constrained")
        axis = figure.subplots()
        most = max((s.windows for s in found), default=0)
        for k, (kind, mark) in enumerate(_MARKS.items()):
            label, color = kind, figures.COLORS[k]
            for everywhere in (True, False):
                own = [s for s in shown if _kind(s) == kind and (s.windows == most) == everywhere]
                if own:
                    face = color if everywhere else "none"
                    axis.plot(
                        [s.error for s in own], [s.cost for s in own], mark, ms=4, mfc=face, mec=color, label=label
                    )
                    label = None
        if any(s.windows < most for s in shown):
            axis.plot([], [], "o", ms=4, mfc="none", mec="0.3", label="not in all windows")
        best = front(found)
        axis.plot([s.error for s in best], [s.cost for s in best], "-", lw=0.8, color="0.5", zorder=0, label="front")
        for k, s in enumerate(best):
            beside = (-6, -9) if k % 2 == 0 else (3, 4)
            axis.annotate(f"{k + 1}", (s.error, s.cost), textcoords="offset points", xytext=beside, fontsize=7)
        axis.set(xscale="log", yscale="log")
        axis.set_xlabel("largest node error per simulated ms [µm]")
        axis.set_ylabel("computing per simulated ms [ms]")
        axis.set_title(title, loc="left")
        axis.margins(0.1, 0.15)
        for side, values in ((axis.xaxis, [s.error for s in shown]), (axis.yaxis, [s.cost for s in shown])):
            _set_ticks(side, values)
        names = "\n".join(f"{k + 1}  {s.choice}" for k, s in enumerate(best))
        axis.text(1.03, 0.0, names, transform=axis.transAxes, va="bottom", fontsize=7)
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02))
        figures.save(figure, str(path))


def _set_ticks(side: Any, values: Sequence[float]) -> None:
    """Ticks of a logarithmic axis with plain numbers: at decades, at 1, 2 and 5 of them, or evenly between two."""
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator, StrMethodFormatter

    span = max(values) / min(values)
    subs = (1.0,) if span > 100.0 else (1.0, 2.0, 5.0)
    steps = range(math.floor(math.log10(min(values))), math.ceil(math.log10(max(values))) + 1)
    within = [sub * 10.0**k for k in steps for sub in subs if min(values) <= sub * 10.0**k <= max(values)]
    side.set_major_locator(LogLocator(subs=subs) if len(within) > 1 else MaxNLocator(4))
    side.set_minor_locator(NullLocator())
    side.set_major_formatter(StrMethodFormatter("{x:g}"))


def _kind(s: Summary) -> str:
    if s.source in ("precision", "execution"):
        return s.source if s.source == "precision" else "strict, device"
    if s.source != "time step":
        return ""
    return "rkc" if s.settings["stepper"] == "rkc" else "fixed steps" if s.settings.get("time_step") else "implicit"
