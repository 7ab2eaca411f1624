"""The paper's figures 2, 3 and 4 and what belongs to them, by one command:

    uv run --extra plot python examples/paper/figures.py

Runs what has no finished run in examples/paper/runs, in parallel processes, then writes figures/*.png and table.md.
Interrupted, it goes on where it was. README.md beside it says what the figures show and where they differ.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import insets
import mobility
import numpy as np
import scenes
import snapshots
import table
from batch import run_missing

from warpflag.model import zipper
from warpflag.record import Record
from warpflag.view import figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HERE = Path(__file__).resolve().parent
PAPER_NAMES = {
    "standard": "(i) standard",
    "no-hi-between": "(ii) no HI among flagella",
    "no-axial-rotation": "(iii) no axial rotation",
    "no-translation": "(iv) no translation",
    "no-steric": "(v) no steric forces",
    "no-steric-no-hi-between": "(vi) neither (v) nor (ii)",
    "no-hi": "no HI at all",
    "anchored": "anchored",
}


def figure_3(runs: Path, length: int) -> Figure:
    """Opening angles; dashed the analytic model with v_e and l_r(0) fitted (with R instead of v_e none fits)."""
    curves = []
    for angle in scenes.ANGLES:
        directory = runs / f"L{length}-phi{angle}"
        with Record(directory) as record:
            times, lengths = zipper.zipping(record)
            model = zipper.measured(record, times[0], times[-1])
        fitted = zipper.fit(model, times - times[0], lengths, "phase_velocity").zipper
        curve = 1e3 * times, zipper.bundle_length(fitted, times - times[0])
        curves.append(insets.curves_of(directory, f"Φ = {angle}°", curve))
    return insets.time_series(curves, forces_of=[f"Φ = {angle}°" for angle in (44, 90)])


def figure_4(runs: Path, torque: str) -> Figure:
    """The ablations."""
    curves = [insets.curves_of(runs / f"T{torque}-{name}", label) for name, label in PAPER_NAMES.items()]
    return insets.comparison(curves, dashed=[PAPER_NAMES["no-hi"], PAPER_NAMES["anchored"]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=HERE / "runs", metavar="DIR", help="where the runs are")
    parser.add_argument("--processes", type=int, help="default: one per core")
    options = parser.parse_args()
    runs = options.runs.resolve()
    groups = {
        "Opening angles (Fig. 3)": scenes.figure_3(),
        "Ablations (Fig. 4)": scenes.figure_4(),
        "Initial phase difference, torque on the body, steppers": scenes.choices(),
        "Motor torque": scenes.torques(),
        "The mobility as printed": scenes.printed_mobility(),
    }
    run_missing({name: scene for group in groups.values() for name, scene in group.items()}, runs, options.processes)
    groups["Continued from others"] = scenes.continued(runs)
    run_missing(groups["Continued from others"], runs, options.processes)

    output = HERE / "figures"
    output.mkdir(exist_ok=True)
    drawn = {
        "figure-2": snapshots.snapshots(runs / "L8-phi90", np.arange(0.0, 17.6, 2.5)),
        "figure-3": figure_3(runs, 8),
        "figure-3-short": figure_3(runs, 6),
        "figure-4": figure_4(runs, "3.4"),
        "figure-4-T2": figure_4(runs, "2"),
        "mobility": mobility.figure(
            {"as printed": runs / "printed-closely", "positive definite": runs / "derived-closely"}, scenes.BURST
        ),
    }
    for name, figure in drawn.items():
        figures.save(figure, output / f"{name}.png", dpi=180)
    text = table.markdown(runs, {title: list(group) for title, group in groups.items()})
    (HERE / "table.md").write_text(text, encoding="utf-8")
    print(f"{output}, {HERE / 'table.md'}")


if __name__ == "__main__":
    main()
