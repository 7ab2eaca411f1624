"""The power balance of a whole run: what the motors do is dissipated or stored, to the accuracy of the steps.

    uv run examples/benchmarks/power_balance.py                      zipping, 15 ms, a few minutes
    uv run examples/benchmarks/power_balance.py --duration 4e-3

Motor work: torque times the angle that the motor has turned relative to the body, as recorded. Dissipation: the work of
all forces on the velocities at sampled states, integrated by the trapezoidal rule. Energy: elastic and steric, at both
ends. Fixed steps are sampled at every second step, so the mismatch, of the work, falls with the square of the step;
with `numerics.accuracy` states are sampled every 5 us.
"""

from __future__ import annotations

import argparse
from itertools import combinations, pairwise
from typing import Any

import numpy as np

from warpflag.observables import closest_parameters, power_balance
from warpflag.run.simulation import CellState, Simulation
from warpflag.scene import FlagellumOverride, Scene, paper_scene, with_values

BEGIN = 2e-5  # of the balance, when the filaments are wound up [s]


def steric_energy(scene: Scene, state: CellState, first_node: np.ndarray) -> float:
    """Energy of all contacts [pN um], the law of `warpflag.observables.steric_force` integrated from the cutoff."""
    strength, diameter = scene.steric.strength, 4 * scene.flagella.filament_radius

    def potential(distance: np.ndarray) -> float:
        x = np.minimum(np.asarray(distance) / diameter, 2 ** (1 / 6))
        y = np.maximum(x, 0.7)
        energy = (y**-12 - y**-6) / 6 + 1 / 24
        force, slope = 2 * 0.7**-13 - 0.7**-7, 26 * 0.7**-14 - 7 * 0.7**-8
        return float((strength * diameter * (energy + force * (y - x) + slope / 2 * (y - x) ** 2)).sum())

    parts = [state.positions[a:b] for a, b in pairwise(first_node)]
    total = 0.0
    for p, q in combinations(parts, 2):
        d, e = np.diff(p, axis=0), np.diff(q, axis=0)
        s, t = closest_parameters(p[:-1, None], d[:, None], q[None, :-1], e[None])
        gaps = p[:-1, None] + s[..., None] * d[:, None] - q[None, :-1] - t[..., None] * e[None]
        total += potential(np.linalg.norm(gaps, axis=-1))
    x, y, z, w = state.body_orientation
    axis, half = np.array([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)]), scene.body.length / 2
    for nodes in parts:
        arms = nodes[1:] - state.body_position
        along = np.clip(arms @ axis, scene.body.width / 2 - half, half - scene.body.width / 2)
        total += potential(np.linalg.norm(arms - along[:, None] * axis, axis=1) - scene.body.width / 2)
    return total


def balance(values: dict[str, Any], duration: float, interval: float) -> tuple[float, float, float, int]:
    """Motor work, dissipation, gain of energy [pN um] from BEGIN to the end, and steps taken."""
    phases = (FlagellumOverride(phase=180.0), FlagellumOverride(phase=280.0))
    scene = with_values(paper_scene(name="balance", flagellum=phases), {"duration": 1.0, **values})
    sim = Simulation(scene, device="cpu")
    torques = np.array([spec.torque for spec in scene.resolved_flagella()])
    dissipated, ends = [], []
    count = round((duration - BEGIN) / interval)
    for k in range(count + 1):
        sim.advance(BEGIN + k * interval)
        state = sim.cell_state()
        dissipated.append(power_balance(sim.evaluate()).dissipated)
        if k in (0, count):
            energy = float(state.elastic_energy.sum()) + steric_energy(scene, state, sim.first_node)
            ends.append((float(torques @ state.motor_angle), energy))
    work, gain = np.subtract(ends[1], ends[0])
    return float(work), float(np.trapezoid(dissipated, dx=interval)), float(gain), int(sim.steps[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--duration", type=float, default=15e-3, help="[s]")
    parser.add_argument("--steps", nargs="*", type=float, default=[1e-5, 5e-6, 2.5e-6], help="fixed ones [s]")
    parser.add_argument("--accuracies", nargs="*", type=float, default=[5e-3, 1e-3], help="[um per ms]")
    args = parser.parse_args()
    runs = [({"numerics.time_step": step}, 2 * step, f"step {step:g}") for step in args.steps]
    runs += [({"numerics.accuracy": a}, 5e-6, f"accuracy {a:g}") for a in args.accuracies]
    print("| setting | steps | motor work pN um | dissipated | stored | mismatch |\n|---|---|---|---|---|---|")
    for values, interval, name in runs:
        work, dissipation, gain, steps = balance(values, args.duration, interval)
        mismatch = (work - dissipation - gain) / work
        print(f"| {name} | {steps} | {work:.4f} | {dissipation:.4f} | {gain:.4f} | {mismatch:.1e} |", flush=True)


if __name__ == "__main__":
    main()
