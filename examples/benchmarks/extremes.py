"""The implicit stepper at the extremes: right, or stopped with a reason, but never finite garbage.

    uv run examples/benchmarks/extremes.py                 every case, about a minute
    uv run examples/benchmarks/extremes.py --cases "T x 3" hairpin

Every case changes one thing about the zipping cell and runs a short time at the default accuracy. The same start is
run by RKC at a twentieth of it as the reference. Columns: node error at the end [um], the error that
the accuracy allows for that time, steps of both, largest stretch of a segment, computing time per simulated time.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from warpflag.model.geometry import InitialState, initial_state
from warpflag.model.start import starting_state
from warpflag.run.simulation import NumericalError, Simulation
from warpflag.scene import FlagellumOverride, Scene, with_values

ACCURACY = 5e-3
# Changed values, simulated time [s].
CASES: dict[str, tuple[dict[str, Any], float]] = {
    "as it is": ({}, 6e-3),
    "T x 3": ({"motor.torque": 10.2}, 1e-3),
    "T x 10": ({"motor.torque": 34.0}, 3e-4),
    "K x 10": ({"flagella.stretching_stiffness": 1e4}, 6e-3),
    "K x 100": ({"flagella.stretching_stiffness": 1e5}, 2e-3),
    "F_0 x 100": ({"steric.strength": 80.0}, 6e-3),
    "h = 0.05": ({"flagella.segment_length": 0.05, "flagella.stretching_stiffness": 1e4}, 5e-4),
    "h = 0.1": ({"flagella.segment_length": 0.1}, 2e-3),
    "h = 0.4": ({"flagella.segment_length": 0.4}, 6e-3),
    "eta x 10": ({"fluid.viscosity": 1e-2}, 2e-2),
    "eta / 10": ({"fluid.viscosity": 1e-4}, 6e-4),
    "hairpin": ({}, 5e-4),
}


def scene_of(values: dict[str, Any]) -> Scene:
    """The zipping cell at Phi = 90 with other values."""
    phases = (FlagellumOverride(phase=180.0), FlagellumOverride(phase=280.0))
    return with_values(Scene(name="extreme", flagellum=phases), {"duration": 1.0, **values})


def hairpin(scene: Scene) -> InitialState:
    """The scene's start with the outer half of every flagellum bent back along the inner one, over five joints."""
    start = initial_state(scene)
    shapes, directors = [], []
    for nodes, e1 in zip(start.positions, start.directors, strict=True):
        segments, own = np.diff(nodes, axis=0), e1.copy()
        axis = np.cross(nodes[-1] - nodes[0], [0.3, 0.5, 1.0])
        cross = np.cross(np.eye(3), axis / np.linalg.norm(axis))
        angle = np.radians(32.0)
        turn = np.eye(3) - np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        for joint in range(len(segments) // 2, len(segments) // 2 + 5):
            segments[joint:] = segments[joint:] @ turn.T
            own[joint + 1 :] = own[joint + 1 :] @ turn.T  # element 0 is the motor's
        shapes.append(np.vstack([nodes[0], nodes[0] + np.cumsum(segments, axis=0)]))
        directors.append(own)
    return InitialState(tuple(shapes), tuple(directors), start.body_position, start.body_orientation)


def run(scene: Scene, start: InitialState, duration: float) -> tuple[np.ndarray | None, int, float, str]:
    """Node positions at the end, None if it stopped; steps; computing time per simulated time; how it ended."""
    sim = Simulation(scene, device="cpu", starts=start)
    sim.prepare()
    begun = time.process_time()
    try:
        sim.advance(duration)
    except NumericalError as error:
        return None, int(sim.steps[0]), (time.process_time() - begun) / duration, str(error).split(";")[0]
    cost = (time.process_time() - begun) / duration
    return sim.cell_state().positions, int(sim.steps[0]), cost, "ran"


def stretch(scene: Scene, positions: np.ndarray) -> float:
    """Largest strain of a segment."""
    worst, first = 0.0, 0
    for spec in scene.resolved_flagella():
        nodes = positions[first : first + spec.segment_count + 1]
        lengths = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
        worst = max(worst, float(np.abs(lengths / spec.segment_length - 1).max()))
        first += spec.segment_count + 1
    return worst


def row(name: str) -> str:
    values, duration = CASES[name]
    scene = scene_of({**values, "numerics.stepper": "implicit", "numerics.accuracy": ACCURACY})
    start = hairpin(scene) if name == "hairpin" else starting_state(scene)
    found, steps, cost, end = run(scene, start, duration)
    reference = scene_of({**values, "numerics.stepper": "rkc", "numerics.accuracy": ACCURACY / 20})
    exact, exact_steps, exact_cost, exact_end = run(reference, start, duration)
    error = strain = "-"
    if found is not None:
        strain = f"{stretch(scene, found):.1e}"
        if exact is not None:
            error = f"{np.linalg.norm(found - exact, axis=1).max():.1e}"
    ends = end if end == exact_end else f"{end} (rkc: {exact_end})"
    cells = [name, f"{duration * 1e3:g}", error, f"{ACCURACY * duration * 1e3:.1e}", f"{steps} / {exact_steps}"]
    return "| " + " | ".join([*cells, strain, f"{cost:.3g} / {exact_cost:.3g}", ends]) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    args = parser.parse_args()
    print("| case | ms | error um | allowed | steps: implicit / rkc | strain | ms of computing per ms | ended |")
    print("|---|---|---|---|---|---|---|---|")
    for name in args.cases:
        print(row(name), flush=True)


if __name__ == "__main__":
    main()
