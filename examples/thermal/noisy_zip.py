"""The spread of zip times over seeds of thermal noise, at three torques.

    uv run --extra plot examples/thermal/noisy_zip.py --seeds 64 -o noisy_zip.png

A batch per torque; steps of 2 to 5 us. Without an output no picture is drawn.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

import warpflag
from warpflag import Simulation, observables, with_values

# Torque [pN um], duration and step [s].
RUNS = ((3.4, 0.015, 2e-6), (1.0, 0.06, 5e-6), (0.5, 0.1, 5e-6))
SCENE = Path(__file__).parent.parent / "noisy_zip.toml"


def zip_times(torque: float, duration: float, step: float, seeds: int) -> np.ndarray:
    """When each cell's bundle is complete first [s], NaN where it is not within the duration."""
    values = {"motor.torque": torque, "duration": duration, "frames": 200, "numerics.time_step": step}
    base = with_values(warpflag.load(SCENE), values)
    found = np.full(seeds, np.nan)
    sim = Simulation([with_values(base, {"fluid.seed": i}) for i in range(seeds)], device="cpu")
    for frames in sim.cell_frames():
        for cell, frame in frames.items():
            if np.isnan(found[cell]) and frame.observables["bundle_length"] >= observables.ZIPPED:
                found[cell] = frame.time
                sim.exclude(cell)
    for cell, fault in sim.faults.items():
        print(f"  seed {cell}: {fault}")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seeds", type=int, default=64)
    parser.add_argument("-o", "--output")
    chosen = parser.parse_args()
    times = {}
    for torque, duration, step in RUNS:
        times[torque] = 1e3 * zip_times(torque, duration, step, chosen.seeds)
        done = times[torque][np.isfinite(times[torque])]
        spread = (
            f"{done.mean():.2f} ± {done.std(ddof=1):.2f} ms, {done.min():.2f} to {done.max():.2f}"
            if len(done) > 1
            else ""
        )
        print(
            f"{torque} pN um: {len(done)} of {chosen.seeds} zipped within {1e3 * duration:g} ms; {spread}", flush=True
        )
    if chosen.output:
        import matplotlib.pyplot as plt

        figure, axes = plt.subplots(figsize=(6, 3.5), layout="constrained")
        for torque, found in times.items():
            done = np.sort(found[np.isfinite(found)])
            axes.step(done, np.arange(1, len(done) + 1) / len(found), where="post", label=f"{torque} pN µm")
        axes.set(xlabel="time [ms]", ylabel="share of cells that have zipped", xscale="log", ylim=(0, 1))
        axes.legend()
        figure.savefig(chosen.output, dpi=150)


if __name__ == "__main__":
    main()
