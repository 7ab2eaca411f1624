"""The spread of zip times over seeds of thermal noise, at three torques.

    uv run --extra plot examples/thermal/noisy_zip.py --seeds 64 -o noisy_zip.png --times noisy_zip.csv
    uv run --extra plot examples/thermal/noisy_zip.py --from noisy_zip.csv -o noisy_zip.png      # the picture alone

Cells leave their batch when their bundle is complete; steps of 2 us. Beside them the zip time without noise. Times are
written batch by batch. Without an output no picture is drawn.
"""

from __future__ import annotations

import argparse
import csv
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

import warpflag
from warpflag import Simulation, observables, with_values

# Torque [pN um], duration, step, and interval of the looks [s].
RUNS = ((3.4, 0.015, 2e-6, 5e-5), (1.0, 0.08, 2e-6, 1e-4), (0.5, 0.6, 2e-6, 5e-4))
SCENE = Path(__file__).parent.parent / "noisy_zip.toml"
COLUMNS = ("torque [pN um]", "seed", "zipped [ms]")
QUIET = -1  # in place of a seed: without noise


def zip_times(torque: float, duration: float, step: float, interval: float, seeds: int, first: int) -> np.ndarray:
    """When each cell's bundle is complete first [s], NaN where it is not within the duration; no seeds: one cell
    without noise, in steps under control."""
    frames = round(duration / interval)
    base = with_values(warpflag.load(SCENE), {"motor.torque": torque, "duration": duration, "frames": frames})
    if seeds:
        noisy = with_values(base, {"numerics.time_step": step})
        sim = Simulation([with_values(noisy, {"fluid.seed": first + i}) for i in range(seeds)], device="cpu")
    else:
        sim = Simulation([with_values(base, {"fluid.temperature": 0.0, "numerics.time_step": None})], device="cpu")
    found = np.full(max(seeds, 1), np.nan)
    for looks in sim.cell_frames():
        for cell, frame in looks.items():
            if np.isnan(found[cell]) and frame.observables["bundle_length"] >= observables.ZIPPED:
                found[cell] = frame.time
                sim.exclude(cell)
    for cell, fault in sim.faults.items():
        print(f"  seed {first + cell}: {fault}")
    return found


def simulated(
    torques: list[float], seeds: range, batch: int, keep: Callable[[float, Sequence[int], np.ndarray], None]
) -> dict[float, tuple[np.ndarray, float]]:
    """Zip times [ms] of all seeds and without noise, by torque; `keep` gets those of every batch, with their seeds."""
    found = {}
    for torque, duration, step, interval in RUNS:
        if torque not in torques:
            continue
        quiet = 1e3 * zip_times(torque, duration, step, interval, 0, 0)
        keep(torque, [QUIET], quiet)
        times = []
        for i in range(0, len(seeds), batch):
            own = seeds[i : i + batch]
            times.append(1e3 * zip_times(torque, duration, step, interval, len(own), own[0]))
            keep(torque, own, times[-1])
        found[torque] = np.concatenate(times), float(quiet[0])
        tell(torque, 1e3 * duration, *found[torque])
    return found


def read(paths: list[str]) -> dict[float, tuple[np.ndarray, float]]:
    """What files of zip times hold, as `simulated` returns it."""
    rows = []
    for path in paths:
        with open(path, newline="") as file:
            rows += [[float(x) for x in row] for row in list(csv.reader(file))[1:]]
    found = {}
    for torque, duration, *_ in RUNS:
        times = {seed: t for own, seed, t in rows if own == torque}  # none twice
        if times:
            quiet = times.pop(QUIET)
            found[torque] = np.array(list(times.values())), quiet
            tell(torque, 1e3 * duration, *found[torque])
    return found


def tell(torque: float, duration: float, times: np.ndarray, quiet: float) -> None:
    """A line: mean and its standard error, spread, and the cell without noise; all in ms."""
    done = times[np.isfinite(times)]
    line = f"{torque} pN um: {len(done)} of {len(times)} zipped within {duration:g} ms"
    if len(done) > 1:
        spread = done.std(ddof=1)
        line += f"; mean {done.mean():.2f} ± {spread / math.sqrt(len(done)):.2f}, spread {spread:.2f}"
        line += f" ± {spread / math.sqrt(2 * len(done) - 2):.2f}, from {done.min():.2f} to {done.max():.2f}"
    line += f"; without noise {quiet:.2f}" if math.isfinite(quiet) else "; without noise not at all"
    print(line, flush=True)


def draw(found: dict[float, tuple[np.ndarray, float]], output: str) -> None:
    """Shares of cells that have zipped against time, with standard errors of the binomial distribution."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 3.8), layout="constrained")
    for torque, (times, quiet) in found.items():
        done = np.sort(times[np.isfinite(times)])
        share = np.arange(1, len(done) + 1) / len(times)
        error = np.sqrt(share * (1 - share) / len(times))
        (line,) = axes.step(done, share, where="post", label=f"{torque} pN µm")
        axes.fill_between(done, share - error, share + error, step="post", color=line.get_color(), alpha=0.25, lw=0)
        if math.isfinite(quiet):
            axes.axvline(quiet, color=line.get_color(), ls="--", lw=1)
    axes.plot([], [], color="0.4", ls="--", lw=1, label="without noise")
    axes.set(xlabel="time [ms]", ylabel="share of cells that have zipped", xscale="log", ylim=(0, 1.02))
    marks = [5, 7, 10, 20, 30, 50, 100, 200, 400]
    axes.set_xticks(marks, [str(m) for m in marks])
    axes.minorticks_off()
    axes.legend(loc="lower right")
    figure.savefig(output, dpi=150)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--torques", type=float, nargs="+", default=[run[0] for run in RUNS], help="some [pN um]")
    parser.add_argument("--seeds", type=int, default=64)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--batch", type=int, default=64, help="cells that are advanced together")
    parser.add_argument("--times", help="CSV file for the zip times")
    parser.add_argument("--from", dest="sources", nargs="+", help="such files, instead of runs")
    parser.add_argument("-o", "--output", help="picture")
    chosen = parser.parse_args()
    if chosen.sources:
        found = read(chosen.sources)
    else:
        with open(chosen.times or os.devnull, "w", newline="") as file:
            out = csv.writer(file)
            out.writerow(COLUMNS)

            def keep(torque: float, seeds: Sequence[int], times: np.ndarray) -> None:
                out.writerows([torque, seed, f"{t:.3f}"] for seed, t in zip(seeds, times, strict=True))
                file.flush()

            seeds = range(chosen.first, chosen.first + chosen.seeds)
            found = simulated(chosen.torques, seeds, chosen.batch, keep)
    if chosen.output:
        draw(found, chosen.output)


if __name__ == "__main__":
    main()
