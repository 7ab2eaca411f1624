"""Pairs in float32 in a float64 run (numerics.pair_precision): what the sum gains, and what velocities and runs lose.

    uv run examples/benchmarks/pair_precision.py

First the stage "local drag and pair sum" of cells of N nodes, replayed by a captured loop: float64, float64 with pairs
in float32, all in float32; and the largest error of a velocity under random forces against float64, over the largest
velocity. Then runs of the zipping cell, before and amid the contact: largest distance of a node from where the same run
in float64 has it, and from where one of a fiftieth of the wanted error has it.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from tools.cells import placed, shaken, shape, spread
from tools.harness import Contender, Repeated, interleaved, table
from warpflag_kernels.fluid import node_velocity

from warpflag.model.geometry import InitialState
from warpflag.run.simulation import Simulation
from warpflag.scene import load, with_values

ZIPPING = load(Path(__file__).parents[1] / "zipping.toml")
SIZES = {60: (2, 30), 240: (8, 30), 1000: (10, 100), 5000: (100, 50)}  # flagella, segments of each
FORMS = {
    "float64": {},
    "float32 pairs": {"numerics.pair_precision": "float32"},
    "float32": {"numerics.precision": "float32"},
}
ACCURACY = 1e-3  # um per ms
CONTACT = 7e-3  # s, when the flagella of the zipping cell touch
DURATION = 1e-3  # s


def sums(rounds: int) -> list[list[object]]:
    """A row per size: time of the sum in every form [us], speed and errors against float64."""
    rows = []
    for size, (flagella, segments) in SIZES.items():
        scene = spread(flagella, segments)
        start, contenders, found = shaken(scene), {}, {}
        for name, values in FORMS.items():
            sim = placed(with_values(scene, values), start)
            found[name] = velocities(sim)
            contenders[name] = launched(sim)
        times = interleaved(contenders, rounds)
        exact = found["float64"]
        errors = [np.abs(found[name] - exact).max() / np.abs(exact).max() for name in list(FORMS)[1:]]
        ratios = [times["float64"] / times[name] for name in list(FORMS)[1:]]
        rows.append([size, *(1e6 * t for t in times.values()), *ratios, *(f"{error:.1e}" for error in errors)])
    return rows


def velocities(sim: Simulation) -> np.ndarray:
    """Of every node under random forces, the body at rest."""
    model, data = sim.system.model, sim.system.state.data
    data.force.assign(np.random.default_rng(1).standard_normal((model.element_count, 3)))
    data.body_velocity.zero_()
    data.body_spin.zero_()
    node_velocity.node_velocities(model, sim.system.state)
    return data.velocity.numpy().astype(np.float64)


def launched(sim: Simulation) -> Contender:
    return Repeated(lambda: node_velocity.node_velocities(sim.system.model, sim.system.state))


def runs() -> list[list[object]]:
    """A row per window, stepper and form: steps, ms of computing, distances [um]."""
    approach = Simulation(with_values(ZIPPING, {"numerics.accuracy": ACCURACY}), device="cpu")
    approach.advance(CONTACT)
    rows = []
    for window, start in {"free": None, "contact": shape(approach)}.items():
        reference = end({"numerics.accuracy": ACCURACY / 50}, start)[0]
        for stepper in ("implicit", "rkc"):
            exact = None
            for name, values in FORMS.items():
                wanted = {"numerics.stepper": stepper, "numerics.accuracy": ACCURACY}
                nodes, steps, cost = end({**wanted, **values}, start)
                exact = nodes if exact is None else exact
                away = [np.linalg.norm(nodes - other, axis=1).max() for other in (exact, reference)]
                rows.append([window, stepper, name, steps, 1e3 * cost, *(f"{distance:.1e}" for distance in away)])
    return rows


def end(values: dict[str, object], start: InitialState | None) -> tuple[np.ndarray, int, float]:
    """Nodes after the run, its steps and the time that they took [s]."""
    sim = Simulation(with_values(ZIPPING, values), device="cpu", starts=start)
    sim.prepare()
    begun = time.process_time()
    sim.advance(DURATION)
    cost = time.process_time() - begun
    return sim.cell_state().positions, int(sim.steps[0]), cost


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=31, help="turns of every form")
    args = parser.parse_args()
    short = list(FORMS)[1:]
    head = ["N", *(f"{name}, us" for name in FORMS), *(f"gain, {n}" for n in short), *(f"error, {n}" for n in short)]
    print(table(head, sums(args.rounds)), flush=True)
    print()
    print(table(["window", "stepper", "numbers", "steps", "ms", "from float64 um", "from the reference um"], runs()))


if __name__ == "__main__":
    main()
