"""Error against cost, as a figure; needs matplotlib (extra plot)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from warpflag.run.tradeoff.compared import Summary, front
from warpflag.view import figures

__all__ = ["FIGURE_NAME", "draw"]

FIGURE_NAME = "tradeoff.png"
_MARKS = {"implicit": "o", "rkc": "D", "fixed steps": "v", "precision": "s", "strict, device": "^"}


def draw(found: Sequence[Summary], title: str, path: Path) -> None:
    """Every choice that has a node error, and the front, whose members are numbered and named beside it.

    Raises:
        OutputError: matplotlib is missing, or the file can't be written.
    """
    with figures.styled() as figure_of:
        figure = figure_of(figsize=(0.8 * figures.TWO_COLUMNS, 3.0), layout="constrained")
        axis = figure.subplots()
        for k, (kind, mark) in enumerate(_MARKS.items()):
            own = [s for s in found if _kind(s) == kind and not math.isnan(s.error) and s.error > 0]
            if own:
                errors, costs = [s.error for s in own], [s.cost for s in own]
                axis.plot(errors, costs, mark, ms=4, label=kind, color=figures.COLORS[k])
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
        names = "\n".join(f"{k + 1}  {s.choice}" for k, s in enumerate(best))
        axis.text(1.03, 0.0, names, transform=axis.transAxes, va="bottom", fontsize=7)
        axis.legend(loc="upper left", bbox_to_anchor=(1.0, 1.02))
        figures.save(figure, str(path))


def _kind(s: Summary) -> str:
    if s.source in ("precision", "execution"):
        return s.source if s.source == "precision" else "strict, device"
    if s.source != "time step":
        return ""
    return "rkc" if s.settings["stepper"] == "rkc" else "fixed steps" if s.settings.get("time_step") else "implicit"
