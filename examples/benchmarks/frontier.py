"""Cost against error of the steppers over one simulated millisecond, in two windows of the zipping scene.

    uv run examples/benchmarks/frontier.py                        both windows, about half a minute
    uv run examples/benchmarks/frontier.py --precision float32
    uv run examples/benchmarks/frontier.py --segment-length 0.1 --windows free --reference-step 2.5e-7 --at 1e-2

Window "free" begins 20 us after the motors start, when the filaments are wound up and nothing touches; "contact"
begins at 5.5 ms, amid the zipping, with some ten closed contacts. Error: largest displacement of a node from the
reference at the end [um]. Cost: CPU time of this process per simulated millisecond [ms/ms], the least of several runs,
without compiling; so it holds on a busy machine, too, if not to the last percent.

The reference is RKC at steps of 0.5 us (free) and 0.2 us (contact) in float64, kept in the cache folder. The right
columns compare at equal error: what RKC would cost at this row's error, by interpolation between the logarithms of its
own rows, over what this row costs. The lines below do so at given errors for both steppers.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from warpflag.model.geometry import InitialState
from warpflag.run.simulation import Simulation
from warpflag.scene import FlagellumOverride, Scene, dumps, paper_scene, with_values

DURATION = 1.0e-3
WINDOWS = {"free": 20e-6, "contact": 5.5e-3}  # where they begin [s]
REFERENCE_STEP = {"free": 5e-7, "contact": 2e-7}
RKC_STEPS = [2e-6, 5e-6, 1e-5, 2e-5, 4e-5]
IMPLICIT_STEPS = [2.5e-6, 5e-6, 1e-5, 2e-5, 3e-5]
ACCURACIES = [5e-2, 2e-2, 5e-3, 2e-3, 1e-3]
REPEATS = {"rkc": 3, "implicit": 7}


def scene(args: argparse.Namespace, **numerics: Any) -> Scene:
    """The zipping cell at Phi = 90 with these settings of `numerics`."""
    phases = (FlagellumOverride(phase=180.0), FlagellumOverride(phase=280.0))
    values = {"flagella.segment_length": args.segment_length, "duration": 1.0}
    values |= {f"numerics.{key}": value for key, value in numerics.items()}
    return with_values(paper_scene(name="frontier", flagellum=phases), values)


def shape(sim: Simulation) -> InitialState:
    """The state reached, as a start at time zero."""
    state, ends = sim.cell_state(), sim.first_node[1:-1]
    positions, directors = np.split(state.positions, ends), np.split(state.directors, ends)
    return InitialState(tuple(positions), tuple(directors), state.body_position, state.body_orientation)


def advanced(run: Scene, start: InitialState | None, duration: float) -> tuple[Simulation, float]:
    """The simulation after so much time, and its CPU time per simulated time."""
    sim = Simulation(run, device="cpu", starts=start)
    sim.prepare()
    begun = time.process_time()
    sim.advance(duration)
    return sim, (time.process_time() - begun) / duration


def window_start(args: argparse.Namespace, window: str) -> InitialState:
    """The state in which a window begins."""
    run = {"stepper": "rkc", "time_step": 1e-7} if window == "free" else {"stepper": "implicit", "accuracy": 5e-4}
    return shape(advanced(scene(args, **run), None, WINDOWS[window])[0])


def reference(args: argparse.Namespace, window: str, start: InitialState) -> np.ndarray:
    """Node positions at the end of a window, shape [node_count, 3] [um]; computed once and cached."""
    run = scene(args, stepper="rkc", time_step=REFERENCE_STEP[window])
    if args.reference_step:
        run = scene(args, stepper="implicit", time_step=args.reference_step)
    key = dumps(run).encode() + b"".join(x.astype(np.float32).tobytes() for x in start.positions)
    path = args.cache / f"{window}-{hashlib.sha256(key).hexdigest()[:16]}.npy"
    if not path.exists():
        args.cache.mkdir(parents=True, exist_ok=True)
        np.save(path, advanced(run, start, DURATION)[0].cell_state().positions)
    return np.load(path)


def measured(args: argparse.Namespace, start: InitialState, exact: np.ndarray, **numerics: Any) -> dict[str, Any]:
    """One row: stepper, setting, steps, cost, error."""
    run = scene(args, precision=args.precision, **numerics)
    costs = []
    for _ in range(REPEATS[numerics["stepper"]]):
        sim, cost = advanced(run, start, DURATION)
        costs.append(cost)
    error = np.linalg.norm(sim.cell_state().positions - exact, axis=1).max()
    setting = f"step {numerics['time_step']:g}" if "time_step" in numerics else f"accuracy {numerics['accuracy']:g}"
    row = {"stepper": numerics["stepper"], "setting": setting, "steps": int(sim.steps[0]), "cost": min(costs)}
    return {**row, "error": float(error), "controlled": "accuracy" in numerics}


def cost_at(rows: list[dict[str, Any]], error: float) -> float | None:
    """Cost at an error between those of the rows, by interpolating logarithms; None outside."""
    points = sorted((np.log(row["error"]), np.log(row["cost"])) for row in rows)
    x, y = np.array(points).T if points else (np.empty(0), np.empty(0))
    if not len(x) or not x[0] <= np.log(error) <= x[-1]:
        return None
    return float(np.exp(np.interp(np.log(error), x, y)))


def curve(rows: list[dict[str, Any]], stepper: str, controlled: bool) -> list[dict[str, Any]]:
    return [row for row in rows if (row["stepper"], row["controlled"]) == (stepper, controlled)]


def table(rows: list[dict[str, Any]]) -> str:
    lines = ["| stepper | setting | steps | ms of computing per ms | error um | RKC at this error | ratio |"]
    lines.append("|---|---|---|---|---|---|---|")
    for row in rows:
        line = f"| {row['stepper']} | {row['setting']} | {row['steps']} | {row['cost']:.1f} | {row['error']:.1e} "
        equal = cost_at(curve(rows, "rkc", False), row["error"]) if row["stepper"] != "rkc" else None
        lines.append(line + ("| | |" if equal is None else f"| {equal:.0f} | {equal / row['cost']:.1f} |"))
    return "\n".join(lines)


def comparison(rows: list[dict[str, Any]], error: float) -> str:
    """Both steppers at one error, in a line; the implicit one with fixed and with controlled steps."""
    rkc = cost_at(curve(rows, "rkc", False), error)
    line = f"at {error:g} um: rkc {'?' if rkc is None else f'{rkc:.0f}'}"
    for controlled, how in ((False, "fixed"), (True, "controlled")):
        cost = cost_at(curve(rows, "implicit", controlled), error)
        if cost is not None:
            line += f"; implicit, {how} {cost:.1f}" + ("" if rkc is None else f", ratio {rkc / cost:.1f}")
    return line


def plot(tables: dict[str, list[dict[str, Any]]], path: Path) -> None:
    """Draws the frontier of every window into a file."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, len(tables), figsize=(4.5 * len(tables), 4), sharey=True, squeeze=False)
    kinds = {
        "RKC": ("rkc", False),
        "implicit, fixed step": ("implicit", False),
        "implicit, controlled": ("implicit", True),
    }
    for axis, (window, rows) in zip(axes[0], tables.items(), strict=True):
        for label, kind in kinds.items():
            points = [(row["error"], row["cost"]) for row in curve(rows, *kind)]
            if points:
                axis.loglog(*zip(*sorted(points), strict=True), "o-", label=label)
        axis.set_title(window)
        axis.set_xlabel("node error after 1 ms [um]")
        axis.grid(True, which="both", alpha=0.3)
    axes[0][0].set_ylabel("ms of computing per simulated ms")
    axes[0][0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=150)


def main() -> None:
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "warpflag" / "frontier"
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--precision", choices=["float64", "float32"], default="float64")
    parser.add_argument("--segment-length", type=float, default=0.2, help="[um]")
    parser.add_argument("--windows", nargs="+", choices=list(WINDOWS), default=list(WINDOWS))
    parser.add_argument("--rkc-steps", nargs="*", type=float, default=RKC_STEPS, help="[s]")
    parser.add_argument("--steps", nargs="*", type=float, default=IMPLICIT_STEPS, help="fixed steps of implicit [s]")
    parser.add_argument("--accuracies", nargs="*", type=float, default=ACCURACIES, help="of implicit [um per ms]")
    parser.add_argument("--at", nargs="*", type=float, default=[5e-3, 1e-3], help="errors to compare at [um]")
    parser.add_argument("--reference-step", type=float, help="take implicit at this step for the reference [s]")
    parser.add_argument("--cache", type=Path, default=cache, help="folder of the references")
    parser.add_argument("--png", type=Path, help="draw the frontier into this file (needs matplotlib)")
    args = parser.parse_args()
    runs = [{"stepper": "rkc", "time_step": step} for step in args.rkc_steps]
    runs += [{"stepper": "implicit", "time_step": step} for step in args.steps]
    runs += [{"stepper": "implicit", "accuracy": accuracy} for accuracy in args.accuracies]
    tables = {}
    for window in args.windows:
        start = window_start(args, window)
        exact = reference(args, window, start)
        tables[window] = [measured(args, start, exact, **run) for run in runs]
        print(f"\n{window}, h = {args.segment_length:g} um, {args.precision}\n\n{table(tables[window])}\n")
        print("\n".join(comparison(tables[window], error) for error in args.at), flush=True)
    if args.png:
        plot(tables, args.png)


if __name__ == "__main__":
    main()
