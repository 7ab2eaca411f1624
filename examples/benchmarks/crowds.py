"""Many flagella with the implicit stepper: what one of them costs in a crowd, and how far the accuracy holds.

    uv run examples/benchmarks/crowds.py                     two, three, four and eight flagella
    uv run examples/benchmarks/crowds.py --counts 2 4 --finer 2e-3

10 ms from the start at one accuracy, 1e-2 um per ms; eight are examples/eight_flagella.toml. Cost: CPU time per
simulated time, and the same per node, in units of the first row's. Error: the largest displacement of a node, at any
full millisecond, from a run at a finer accuracy.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from warpflag import load
from warpflag.run.simulation import Simulation
from warpflag.scene import FlagellumOverride, Scene, paper_scene, with_values

ACCURACY = 1e-2  # [um per ms]
EIGHT = Path(__file__).parents[1] / "eight_flagella.toml"


def crowd(count: int, accuracy: float) -> Scene:
    """The zipping cell (Phi = 90) of two flagella, more of them evenly around the body, or the example of eight."""
    values = {"numerics.stepper": "implicit", "numerics.accuracy": accuracy, "duration": 1.0}
    if count == 8:
        return with_values(load(EIGHT), values)
    if count == 2:
        phases = (FlagellumOverride(phase=180.0), FlagellumOverride(phase=280.0))
        return with_values(paper_scene(name="crowd", flagellum=phases), values)
    return with_values(paper_scene(name="crowd"), {"flagella.count": count, **values})


def run(scene: Scene, milliseconds: int) -> tuple[np.ndarray, int, float]:
    """Node positions at every millisecond [um], steps, CPU time over simulated time."""
    sim = Simulation(scene, device="cpu")
    sim.prepare()
    begun, positions = time.process_time(), []
    for k in range(1, milliseconds + 1):
        sim.advance(1e-3 * k)
        positions.append(sim.cell_state().positions)
    return np.array(positions), int(sim.steps[0]), (time.process_time() - begun) / (1e-3 * milliseconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--counts", nargs="+", type=int, default=[2, 3, 4, 8])
    parser.add_argument("--milliseconds", type=int, default=10)
    parser.add_argument("--finer", type=float, default=1e-3, help="accuracy of the runs to compare with [um per ms]")
    args = parser.parse_args()
    print("| flagella | steps | ms of computing per ms | per node | node error um |\n|---|---|---|---|---|")
    first = 0.0
    for count in args.counts:
        run(crowd(count, ACCURACY), 1)  # kernels load
        found, steps, cost = run(crowd(count, ACCURACY), args.milliseconds)
        exact = run(crowd(count, args.finer), args.milliseconds)[0]
        error = np.linalg.norm(found - exact, axis=2).max()
        first = first or cost / found.shape[1]
        print(f"| {count} | {steps} | {cost:.0f} | {cost / found.shape[1] / first:.1f} | {error:.1e} |", flush=True)


if __name__ == "__main__":
    main()
