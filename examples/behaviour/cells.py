"""Distributions of what cells do that run and tumble: a report and a figure from the directory of a sweep.

    warpflag sweep examples/behaviour/cells.toml
    uv run --extra plot examples/behaviour/cells.py runs/cells -o cells.png

Runs and tumbles are those of `Record.runs_and_tumbles`; durations are of those that neither begin nor end with
the record, and, with "all counted", the time of all over the number of ends, as of exponential distributions; errors
are standard errors of the mean, of shares and speeds over cells.
"""

import argparse
from pathlib import Path

import numpy as np

from warpflag import Record
from warpflag.observables.behaviour import exponential_mean
from warpflag.record import RecordError

options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
options.add_argument("directory", type=Path)
options.add_argument("--members", type=int, nargs=2, metavar=("FIRST", "COUNT"), default=(0, 10_000))
options.add_argument("-o", dest="output", type=Path, default=Path("cells.png"))
options = options.parse_args()


def of_cell(path: Path) -> dict[str, np.ndarray]:
    """What one cell does; angles [deg], durations [s], speeds [um/s]."""
    with Record(path) as record:
        found = record.runs_and_tumbles()
        length, drive = record.observables["bundle_length"], record.observables["motor_drive"]
        reverse = (drive < 0).any(axis=1)
        late = record.times > 0.15
        # Motors that are in reverse at some time in a tumble, or within the time over which the path is averaged.
        around = [(record.times > a - 0.06) & (record.times < b + 0.06) for a, b in found.tumbles]
        motors = np.array([(drive[window] < 0).any(axis=0).sum() for window in around])
        known = np.isfinite(found.tumble_angles)
    angle, duration = np.degrees(found.tumble_angles[known]), np.diff(found.tumbles, axis=1)[known, 0]
    return {
        "angle": angle,
        "angle, from 10 deg on": angle[angle >= 10.0],
        "angle, from 0.1 s on": angle[duration >= 0.1],
        "angle, from 0.2 s on": angle[duration >= 0.2],
        "angle, one motor": angle[motors[known] <= 1],
        "angle, two or three": angle[motors[known] >= 2],
        "tumble": found.tumble_durations,
        "run": found.run_durations,
        "runs": np.diff(found.runs, axis=1)[:, 0],
        "runs ended": found.run_ended,
        "tumbles": np.diff(found.tumbles, axis=1)[:, 0],
        "tumbles ended": found.tumble_ended,
        "speed": np.array([found.run_speed]),
        "tumbling": np.array([found.tumbling_fraction]),
        "reverse": np.array([reverse.mean()]),
        "bundled forward": np.array([np.mean(length[late & ~reverse]) if (late & ~reverse).any() else np.nan]),
        "bundled in reverse": np.array([np.mean(length[late & reverse]) if (late & reverse).any() else np.nan]),
        "length": record.times[-1:],
    }


cells = []
first, count = options.members
for path in sorted(options.directory.glob("*/run.h5"))[first : first + count]:
    try:
        cells.append(of_cell(path.parent))
    except (RecordError, ValueError) as error:
        print(f"left out: {error}")
lengths = np.concatenate([cell.pop("length") for cell in cells])
cells = [cell for cell, length in zip(cells, lengths, strict=True) if length >= 0.999 * lengths.max()]
values = {name: np.concatenate([cell[name] for cell in cells]) for name in cells[0]}
print(f"{len(cells)} cells of {lengths.max():g} s; {len(lengths) - len(cells)} that did not reach the end are left out")
for name, unit in (
    *((name, "deg") for name in values if name.startswith("angle")),
    ("tumble", "s"),
    ("run", "s"),
    ("speed", "um/s"),
    ("tumbling", "of the time"),
    ("reverse", "of the time a motor"),
    ("bundled forward", "l_r"),
    ("bundled in reverse", "l_r"),
):
    own = values[name][np.isfinite(values[name])]
    if not len(own):
        continue
    error = own.std(ddof=1) / np.sqrt(len(own)) if len(own) > 1 else np.nan
    median = np.median(own) if len(own) else np.nan
    print(f"{name:21s} {own.mean():8.3g} +- {error:<8.2g} median {median:<8.3g} {len(own):4d} values  {unit}")
for name in ("run", "tumble"):
    mean, error = exponential_mean(values[f"{name}s"], values[f"{name}s ended"])
    ends = int(values[f"{name}s ended"].sum())
    print(f"{name + ', all counted':21s} {mean:8.3g} +- {error:<8.2g} {'':15s} {ends:4d} ends    s")


def draw() -> None:
    """Histograms of tumble angles, tumble durations and speeds."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 3, figsize=(9, 2.8))
    for axes, name, bins, label, published in zip(
        panels,
        ("angle", "tumble", "speed"),
        (np.arange(0, 181, 15), np.arange(0, values["tumble"].max(initial=0.9) + 0.1, 0.1), 12),
        ("tumble angle, degrees", "tumble, s", "speed in runs, µm/s"),
        ((68, "Berg & Brown 1972"), (0.14, "Berg & Brown 1972"), (29, "Darnton et al. 2007")),
        strict=True,
    ):
        own = values[name][np.isfinite(values[name])]
        axes.hist(own, bins=bins, color="C0", alpha=0.7)
        axes.axvline(own.mean(), color="k", lw=1, label=f"mean {own.mean():.3g}")
        axes.axvline(published[0], color="C3", ls="--", lw=1, label=f"{published[0]} ({published[1]})")
        axes.set(xlabel=label)
        axes.legend(fontsize=7, frameon=False)
    panels[0].set_ylabel("count")
    figure.tight_layout()
    figure.savefig(options.output, dpi=100)


draw()
