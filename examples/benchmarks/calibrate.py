"""Measures the constants of the steppers that no derivation gives: error and cost against the value of each.

    uv run examples/benchmarks/calibrate.py --list
    uv run examples/benchmarks/calibrate.py collocation.THETA          one constant, one to three minutes
    uv run examples/benchmarks/calibrate.py collocation.THETA --quick  fewer values and cells, under a minute
    uv run examples/benchmarks/calibrate.py rkc.estimate               RKC's error estimate beside the error

Every value runs in a process of its own, which sets the constant before any kernel is built. The cells are those of
`WINDOWS`: each begins at a saved state, and its error is the largest displacement of a node at the end from RKC at
steps of 0.5 us from the same state [um]. Cost is the CPU time per simulated time [ms/ms], the least of several runs.

A larger constant often buys accuracy with cost. So the last column of a window is what the same error would cost: cost
times the square root of (error over the chosen value's error), since the error of a second-order method goes as the
step squared and its cost as one over the step. The least number there is the best value, if nothing else speaks
against it: steps rejected, runs stopped by a guard.
"""

from __future__ import annotations

import argparse
import functools
import hashlib
import importlib
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from warpflag import load
from warpflag.model.geometry import InitialState
from warpflag.run.simulation import NumericalError, Simulation
from warpflag.scene import FlagellumOverride, Scene, dumps, paper_scene, with_values

EIGHT = Path(__file__).parents[1] / "eight_flagella.toml"
KERNELS = "warpflag_kernels"


@dataclass(frozen=True)
class Window:
    """A stretch of one run.

    Attributes:
        flagella: number of them, 2 or 8.
        start: simulated time at which it begins [s].
        duration: its length [s].
        repeats: runs of which the least cost counts.
        values: settings beside those of `examples/zipping.toml`, by dotted key.
    """

    flagella: int
    start: float
    duration: float
    repeats: int
    values: tuple[tuple[str, float], ...] = ()


WINDOWS = {
    "free": Window(2, 2.0e-5, 1.0e-3, 5),  # the flagella are wound up, nothing touches
    "contact": Window(2, 5.5e-3, 1.0e-3, 5),  # amid the zipping
    "bundle": Window(2, 8.5e-3, 1.0e-3, 5),  # the flagella lie side by side
    "crowd": Window(8, 3.0e-3, 5.0e-4, 2),  # eight flagella, whose contacts are forming
    "entangled": Window(8, 5.0e-3, 5.0e-4, 2),  # the same amid hundreds of contacts
    "onset": Window(2, 0.0, 1.0e-4, 5),  # the motors are switched on
    # Three times the torque: contacts slam shut, steps are rejected.
    "hard": Window(2, 2.0e-3, 2.0e-4, 3, (("motor.torque", 10.0),)),
    # A hundred times the steric force.
    "stiff": Window(2, 5.5e-3, 5.0e-4, 3, (("steric.strength", 80.0),)),
    # A hundred times the stretching stiffness.
    "taut": Window(2, 5.5e-3, 5.0e-4, 3, (("flagella.stretching_stiffness", 1e5),)),
}
TWO = ("free", "contact", "bundle")
TOUCHING = ("contact", "bundle", "crowd")
CONTACT_LAW = ("stiff", "hard", "contact", "crowd")
EXPLICIT = ("free", "contact", "crowd")
CROWDED = ("crowd", "entangled")
UPSET = ("hard", "onset", "crowd")
REFERENCE_STEP = 5.0e-7  # of RKC [s]
ACCURACIES = (5e-2, 5e-3, 5e-4)  # of RKC [um per ms]


@dataclass(frozen=True)
class Constant:
    """One constant and how it is measured.

    Attributes:
        module: where it lies, without the package's name.
        values: those to try; the first of the list is the one in use.
        windows: names of the windows to run.
        numerics: settings of `numerics` for the runs, by name.
        derived: other constants of its module that follow from it, from its value.
        key: entry of the constant that is set, where it is a dictionary.
        package: where the module lies.
    """

    module: str
    values: tuple[float, ...]
    windows: tuple[str, ...]
    numerics: tuple[tuple[str, Any], ...] = ()
    derived: Callable[[Any], dict[str, Any]] = lambda value: {}
    key: str = ""
    package: str = KERNELS


FIXED = (("time_step", 1e-5),)
RKC = (("stepper", "rkc"), ("time_step", 1e-5))
SINGLE = (("precision", "float32"),)
DRIVER = "warpflag"

CONSTANTS = {
    "collocation.THETA": Constant("implicit.collocation", (0.8, 0.72, 0.75, 0.85, 0.9, 1.0), (*TWO, "crowd", "taut")),
    "collocation.ERROR_PER_PREDICTOR": Constant("implicit.collocation", (3.5, 1.0, 2.0, 5.0, 7.0), (*TWO, "crowd")),
    "collocation.BEGUN_WHOLE": Constant("implicit.collocation", (1.3, 0.0, 0.65, 1.0, 1.6), (*TWO, "crowd")),
    "collocation.GAP_SHARE": Constant("implicit.collocation", (0.1, 0.03, 0.05, 0.2, 0.35, 0.7), TOUCHING),
    "collocation.GAP_GROWTH": Constant("implicit.collocation", (4e9, 0.0, 1e9, 1.6e10, 6.4e10), TOUCHING, FIXED),
    "step_control.REJECTED": Constant("stepping.step_control", (5.0, 2.0, 3.0, 10.0, 25.0), (*UPSET, "contact")),
    "accuracy.CORRELATION": Constant("stepping.accuracy", (5e-6, 1e-9, 2e-6, 1e-5, 2e-5), (*TWO, "crowd", "hard")),
    "step_control.SAFETY": Constant("stepping.step_control", (0.8, 0.4, 0.6, 1.0, 1.3), (*TWO, "crowd")),
    "step_control.FADING_STEPS": Constant(
        "stepping.step_control", (20.0, 3.0, 8.0, 50.0, 1e3), (*TWO, "crowd", "hard")
    ),
    "step_control.JUMP": Constant("stepping.step_control", (0.25, 0.13, 0.5, 1.1), UPSET),
    "step_control.SHORTEST_STEP": Constant("stepping.step_control", (2e-8, 1e-9, 2e-7, 1e-6), UPSET),
    "step_control.LARGEST_GROWTH": Constant("stepping.step_control", (2.0, 1.3, 1.6, 2.4, 3.0), UPSET),
    "step_control.LEAST_APART": Constant(
        "stepping.step_control",
        (0.1, 0.01, 0.25, 1.0),
        ("free", "contact"),
        (("stepper", "rkc"), ("accuracy", 1e-3), *SINGLE),
    ),
    "stability.LEAST_OVER_IMPLICIT": Constant("implicit.stability", (1.3, 1.0, 1.1, 1.2, 1.5, 2.0), TWO),
    "stability.OVER_IMPLICIT_PER_KAPPA": Constant("implicit.stability", (0.6, 0.4, 0.5, 0.55, 0.7, 1.0), ("crowd",)),
    "stability.LARGEST_FALL": Constant("implicit.stability", (0.985, 0.5, 0.9, 0.97, 1.0), ("crowd",)),
    "stability.MOST_OVER_IMPLICIT": Constant("implicit.stability", (9.0, 2.0, 3.0, 5.0), CROWDED),
    "stability.LARGE_KAPPA_OF_FLEXIBLE": Constant("implicit.stability", (15.0, 2.6, 3.7, 5.0, 8.3), CROWDED),
    "stability.FIRST_MEASUREMENTS": Constant("implicit.stability", (30, 1, 10, 100), ("crowd",)),
    "stability.INTERVAL": Constant("implicit.stability", (4, 1, 2, 8, 32), ("crowd",)),
    "contact_solve.DIAGONAL_PER_DRAG": Constant("implicit.contact_solve", (0.25, 0.06, 0.12, 0.5, 1.0), CONTACT_LAW),
    "contact_solve.DEEP": Constant("implicit.contact_solve", (0.75, 0.5, 0.65, 0.85, 1.0), CONTACT_LAW),
    "contact_solve.DEEPEST": Constant("implicit.contact_solve", (0.9, 0.7, 0.8, 1.0, 1.1), CONTACT_LAW),
    "contact_solve.CONTACT_ITERATIONS": Constant("implicit.contact_solve", (60, 5, 10, 20, 120), CONTACT_LAW),
    "contact_solve.FINEST": Constant("implicit.contact_solve", (1e-6, 1e-9, 1e-4, 1e-3), CONTACT_LAW),
    "contact_solve.FINEST_SINGLE": Constant("implicit.contact_solve", (1e-5, 1e-6, 1e-4, 1e-3), CONTACT_LAW, SINGLE),
    "contact_solve.NEWTON_STEPS": Constant("implicit.contact_solve", (4, 1, 2, 3, 6), CONTACT_LAW),
    "quasi_newton.SECANTS_KEPT": Constant(
        "implicit.quasi_newton",
        (16, 2, 4, 8, 32),
        CONTACT_LAW,
        derived=lambda kept: {"SYSTEM_ENTRIES": kept * (kept + 1)},
    ),
    "quasi_newton.INDEPENDENT": Constant("implicit.quasi_newton", (0.1, 1e-4, 1e-2, 0.3, 0.6), CONTACT_LAW, SINGLE),
    "search.MARGIN": Constant(
        "contact.search", (0.3, 0.05, 0.15, 0.6), TOUCHING, derived=lambda margin: {"REACH": 2 ** (1 / 6) + margin}
    ),
    "contact_list.PER_NEIGHBOUR": Constant("contact.contact_list", (1.5, 0.15, 0.5, 1.0), CROWDED),
    "neighbours.SKIN": Constant("contact.neighbours", (0.1, 0.025, 0.05, 0.2, 0.4), TOUCHING),
    "plan.STORED_NODES": Constant("base.plan", (512, 0), ("contact", "crowd")),
    "rotne_prager.FLOAT32_TERMS": Constant(
        "fluid.rotne_prager", (64, 16, 32, 128, 256), ("free", "crowd"), (("pair_precision", "float32"),)
    ),
    "rkc.RADIUS_MARGIN": Constant("stepping.rkc", (1.15, 0.9, 1.0, 1.05, 1.3), EXPLICIT, RKC),
    "rkc.FIRST_PROBES": Constant("stepping.rkc", (40, 2, 5, 10, 80), EXPLICIT, RKC),
    "rkc.PROBE_SIZE": Constant(
        "stepping.rkc", (1e-3, 1e-5, 1e-4, 1e-2, 1e-1), EXPLICIT, (*RKC, *SINGLE), key="float32"
    ),
    "rkc.DAMPING": Constant("stepping.rkc", (2 / 13, 0.02, 0.05, 0.5), EXPLICIT, RKC),
    "rkc_estimate.ESTIMATE_SHARE": Constant(
        "stepping.rkc_estimate", (0.1, 0.01, 0.03, 0.3, 1.0), EXPLICIT, (("stepper", "rkc"), ("accuracy", 5e-3))
    ),
    "rkc_estimate.ROUND_OFF_FACTOR": Constant(
        "stepping.rkc_estimate",
        (5.0, 1.0, 20.0, 80.0),
        ("free", "contact"),
        (("stepper", "rkc"), ("accuracy", 5e-2), *SINGLE),
    ),
    "implicit.FIRST_TOLERANCE": Constant("stepping.implicit", (2.0, 0.5, 1.0, 4.0, 16.0), TOUCHING, package=DRIVER),
    "implicit.LONGEST_STEP": Constant(
        "stepping.implicit", (7e-5, 3e-5, 5e-5, 1e-4), (*TWO, "crowd"), (("accuracy", 7e-2),), package=DRIVER
    ),
    "implicit.OVER_IMPLICIT_CROWD": Constant("stepping.implicit", (3.0, 1.3, 2.0, 5.0), ("crowd",), package=DRIVER),
}


def cell(window: str, **numerics: Any) -> Scene:
    """The cell of a window with these settings of `numerics`."""
    values = {"duration": 1.0, **dict(WINDOWS[window].values)}
    values |= {f"numerics.{name}": value for name, value in numerics.items()}
    if WINDOWS[window].flagella == 8:
        return with_values(load(EIGHT), values)
    phases = (FlagellumOverride(phase=180.0), FlagellumOverride(phase=280.0))
    return with_values(paper_scene(name="calibrate", flagellum=phases), values)


def shape(sim: Simulation) -> InitialState:
    """The state reached, as a start at time zero."""
    state, ends = sim.cell_state(), sim.first_node[1:-1]
    positions, directors = np.split(state.positions, ends), np.split(state.directors, ends)
    return InitialState(tuple(positions), tuple(directors), state.body_position, state.body_orientation)


def start_of(window: str, cache: Path) -> tuple[InitialState, np.ndarray]:
    """The state in which a window begins, and the node positions of the reference at its end [um]; cached."""
    w = WINDOWS[window]
    approach, exact = cell(window, accuracy=1e-3), cell(window, stepper="rkc", time_step=REFERENCE_STEP)
    key = hashlib.sha256(f"{dumps(approach)} {dumps(exact)} {w}".encode()).hexdigest()[:16]
    path = cache / f"{window}-{key}.npz"
    if not path.exists():
        sim = Simulation(approach, device="cpu")
        if w.start > 0:
            sim.advance(w.start)
        start = shape(sim)
        finer = Simulation(exact, device="cpu", starts=start)
        finer.advance(w.duration)
        arrays = {"exact": finer.cell_state().positions, "body": start.body_position}
        arrays |= {"turned": start.body_orientation}
        for k, (positions, directors) in enumerate(zip(start.positions, start.directors, strict=True)):
            arrays |= {f"positions{k}": positions, f"directors{k}": directors}
        cache.mkdir(parents=True, exist_ok=True)
        np.savez(path, **arrays)
    saved = np.load(path)
    positions = tuple(saved[f"positions{k}"] for k in range(w.flagella))
    directors = tuple(saved[f"directors{k}"] for k in range(w.flagella))
    return InitialState(positions, directors, saved["body"], saved["turned"]), saved["exact"]


def measured(window: str, cache: Path, numerics: dict[str, Any]) -> dict[str, Any]:
    """Error [um], cost [ms/ms], steps and rejected steps of a window; or what stopped the run."""
    start, exact = start_of(window, cache)
    costs = []
    for _ in range(WINDOWS[window].repeats):
        sim = Simulation(cell(window, **numerics), device="cpu", starts=start)
        sim.prepare()
        begun = time.process_time()
        try:
            sim.advance(WINDOWS[window].duration)
        except NumericalError as stopped:
            return {"stopped": f"{stopped.kind.name.lower()} after {1e3 * stopped.time:.2g} ms"}
        costs.append((time.process_time() - begun) / WINDOWS[window].duration)
    error = float(np.linalg.norm(sim.cell_state().positions - exact, axis=1).max())
    rejected = int(sim.stepper.steps.rejected.numpy()[0])
    return {"error": error, "cost": min(costs), "steps": int(sim.steps[0]), "rejected": rejected}


def probe(name: str, value: Any, windows: list[str], cache: Path) -> dict[str, Any]:
    """Sets a constant, before any kernel is built, and measures these windows."""
    constant, attribute = CONSTANTS[name], name.partition(".")[2]
    module = importlib.import_module(f"{constant.package}.{constant.module}")
    if not hasattr(module, attribute):
        raise SystemExit(f"{module.__name__} has no constant {attribute}")
    in_use = getattr(module, attribute)
    if (in_use[constant.key] if constant.key else in_use) != constant.values[0]:
        raise SystemExit(f"{module.__name__}.{attribute} is {in_use}, not {constant.values[0]} as in this script")
    if constant.key:
        value = {**in_use, constant.key: value}
    setattr(module, attribute, value)
    for other, its_value in constant.derived(value).items():
        setattr(module, other, its_value)
    return {window: measured(window, cache, dict(constant.numerics)) for window in windows}


def in_process(name: str, value: float, windows: list[str], cache: Path) -> dict[str, Any]:
    """`probe` in a process of its own."""
    command = [sys.executable, __file__, name, "--probe", repr(value), "--windows", *windows, "--cache", str(cache)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{name} = {value}: {done.stderr.strip().splitlines()[-1]}")
    return json.loads(done.stdout.strip().splitlines()[-1])


def table(name: str, windows: list[str], rows: dict[float, dict[str, Any]]) -> str:
    """Rows in the order of the values; the chosen one is marked by an asterisk."""
    chosen = CONSTANTS[name].values[0]
    columns = ("steps", "rejected", "cost ms/ms", "error um", "at equal error")
    lines = [f"| {name} | " + " | ".join(f"{w}: {c}" if c == "steps" else c for w in windows for c in columns) + " |"]
    lines.append("|---" * (1 + len(columns) * len(windows)) + "|")
    for value in sorted(rows):
        cells = [f"{value:g}" + (" *" if value == chosen else "")]
        for window in windows:
            found, best = rows[value][window], rows[chosen][window]
            if "stopped" in found:
                cells += [found["stopped"], "", "", "", ""]
                continue
            equal = "" if "stopped" in best else f"{found['cost'] * math.sqrt(found['error'] / best['error']):.1f}"
            cells += [
                str(found["steps"]),
                str(found["rejected"]),
                f"{found['cost']:.1f}",
                f"{found['error']:.1e}",
                equal,
            ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def rkc_estimate(cache: Path) -> str:
    """Of single steps of RKC the error estimate over the error that the step makes, and of runs under its control the
    error at the end over what the accuracy allows."""
    lines = ["| window | step s | estimate um | error um | estimate/error |", "|---|---|---|---|---|"]
    for window in ("free", "contact", "crowd"):
        start, _exact = start_of(window, cache)
        for step in (5e-6, 1e-5, 2e-5):
            run = cell(window, stepper="rkc", accuracy=1.0)  # one step is never rejected
            sim = Simulation(run, device="cpu", starts=start)
            # The first step of a start is FIRST_STEP unless more is asked for.
            sim.stepper.steps.wanted_step.fill_(step)
            sim.advance(step)
            estimate = float(sim.stepper.data.error.numpy().max())
            finer = Simulation(cell(window, stepper="rkc", time_step=step / 16), device="cpu", starts=start)
            finer.advance(step)
            error = np.linalg.norm(sim.cell_state().positions - finer.cell_state().positions, axis=1).max()
            assert int(sim.steps[0]) == 1
            lines.append(f"| {window} | {step:g} | {estimate:.1e} | {error:.1e} | {estimate / error:.1f} |")
    lines += ["", "| window | accuracy um/ms | steps | error um | error/allowed |", "|---|---|---|---|---|"]
    for window in ("free", "contact", "crowd"):
        for accuracy in ACCURACIES:
            found = measured(window, cache, {"stepper": "rkc", "accuracy": accuracy})
            share = found["error"] / (accuracy * 1e3 * WINDOWS[window].duration)
            lines.append(f"| {window} | {accuracy:g} | {found['steps']} | {found['error']:.1e} | {share:.2f} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="CONSTANT", help="names as --list gives them, or all")
    parser.add_argument("--list", action="store_true", help="name the constants that can be measured")
    parser.add_argument("--quick", action="store_true", help="three values, two windows")
    parser.add_argument("--windows", nargs="+", choices=list(WINDOWS), help="instead of the constant's own")
    default = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "warpflag" / "calibrate"
    parser.add_argument("--cache", type=Path, default=default, help="folder of starts and references")
    parser.add_argument("--probe", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.list or not args.names:
        print("\n".join(["rkc.estimate", *CONSTANTS]))
        return
    if unknown := set(args.names) - {"all", "rkc.estimate", *CONSTANTS}:
        parser.error(f"{', '.join(sorted(unknown))}: not a constant of --list")
    if args.probe is not None:
        value = int(args.probe) if isinstance(CONSTANTS[args.names[0]].values[0], int) else args.probe
        print(json.dumps(probe(args.names[0], value, args.windows, args.cache)))
        return
    every = ["rkc.estimate", *CONSTANTS] if "all" in args.names else args.names
    for name in every:
        begun = time.perf_counter()
        if name == "rkc.estimate":
            print(f"\n{rkc_estimate(args.cache)}", flush=True)
            continue
        constant = CONSTANTS[name]
        windows = args.windows or list(constant.windows[:2] if args.quick else constant.windows)
        for window in windows:
            start_of(window, args.cache)
        measure = functools.partial(in_process, name, windows=windows, cache=args.cache)
        rows = {value: measure(value) for value in constant.values[: 3 if args.quick else None]}
        print(f"\n{table(name, windows, rows)}\n\n({time.perf_counter() - begun:.0f} s)", flush=True)


if __name__ == "__main__":
    main()
