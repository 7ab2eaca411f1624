"""Thermal equilibrium and diffusion, simulated beside their exact values: the tables of docs/thermal.md.

    uv run examples/thermal/tables.py                   # all, some twenty minutes of a core
    uv run examples/thermal/tables.py energies drift    # some
    uv run examples/thermal/tables.py --share 0.1       # with a tenth of the samples

Ensembles are batches: one cell per seed. Every number comes with its standard error over the cells, which are
independent, so that correlations in time need no correction. Units um, pN, s.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from warpflag import Scene, Simulation, with_values

KT = 1.380649e-5 * 300.0
BASE = {
    "fluid.temperature": 300.0,
    "motor.torque": 0.0,
    "steric.enabled": False,
    "body.contact": False,
    "flagella.count": 1,
    "duration": 10.0,
}
FREE = {"body.enabled": False}
JOINT = np.array([0.99977, 0.50006, 0.50002])  # bend, twist, stretch of a joint over kT, by quadrature


def ensemble(values: dict[str, Any], count: int) -> tuple[Scene, Simulation]:
    """Cells that differ in their seeds."""
    scene = with_values(Scene(name="thermal"), {**BASE, **values})
    return scene, Simulation([with_values(scene, {"fluid.seed": i}) for i in range(count)], device="cpu")


def looks(sim: Simulation, start: float, interval: float, count: int) -> Iterator[Any]:
    """The cells at `start` and after each interval [s]."""
    for i in range(count + 1):
        sim.advance(start + i * interval)
        yield sim.cells()


def mean(values: np.ndarray) -> tuple[Any, Any]:
    """Mean over the cells, the first axis, and its standard error."""
    return values.mean(axis=0), values.std(axis=0, ddof=1) / math.sqrt(len(values))


def shown(value: float, error: float) -> str:
    digits = max(0, 1 - math.floor(math.log10(error))) if error > 0 else 4
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def energies(share: float) -> None:
    """Energy per joint over its exact value."""
    print("\n| cell | step [s] | bend | twist | stretch |\n|---|---|---|---|---|")
    cases = [
        ("free, 1.2 µm", {**FREE, "flagella.length": 1.2}, 1e-6, 100, 1e-3, 4e-6, 400),
        ("free, 1.2 µm", {**FREE, "flagella.length": 1.2}, 1e-5, 100, 1e-3, 2e-5, 400),
        ("free, 1.2 µm", {**FREE, "flagella.length": 1.2}, 3e-5, 100, 1e-3, 6e-5, 400),
        ("two on a body, 1.2 µm", {"flagella.count": 2, "flagella.length": 1.2}, 1e-6, 100, 5e-4, 4e-6, 300),
        ("two on a body, 1.2 µm", {"flagella.count": 2, "flagella.length": 1.2}, 1e-5, 100, 5e-4, 2e-5, 300),
        ("two on a body, 6 µm", {"flagella.count": 2}, 1e-5, 24, 2e-2, 2e-4, 100),
    ]
    single = [
        ("the same, float32", {**values, "numerics.precision": "float32"}, *rest) for _, values, *rest in cases[4:5]
    ]
    for name, values, step, count, start, interval, frames in cases + single:
        scene, sim = ensemble({**values, "numerics.time_step": step}, count)
        found = [c.elastic_energy / KT for c in looks(sim, start, interval, max(10, int(share * frames)))]
        hook = np.array([0.0, 0.5, 0.0]) if scene.body.enabled else np.zeros(3)
        segments = [spec.segment_count for spec in scene.resolved_flagella()]
        exact = sum(JOINT * [n - 1, n - 1, n] + hook for n in segments)
        value, error = mean(np.mean(found, axis=0) / exact)
        print(f"| {name} | {step:g} | " + " | ".join(map(shown, value, error)) + " |", flush=True)


def drift(share: float) -> None:
    """Mean velocity of a passive helix along its own axis [um/s], exactly zero."""
    print("\n| cell | step [s] | drift [µm/s] |\n|---|---|---|")
    for name, values, frames in (("free, 6 µm", FREE, 400), ("on a body, 6 µm", {}, 400)):
        for step in (1e-5, 1e-6):
            _, sim = ensemble({**values, "numerics.time_step": step}, 64)
            nodes, way, before = 31, np.zeros(64), None
            count = max(20, int(share * frames))
            for cells in looks(sim, 2e-4, step, count):
                x = cells.positions.reshape(64, nodes, 3)
                axis = x[:, -1] - x[:, 1]
                axis /= np.linalg.norm(axis, axis=1, keepdims=True)
                now = (x[:, 1:].mean(axis=1), axis)
                if before is not None:
                    way += np.sum((now[0] - before[0]) * (now[1] + before[1]) / 2, axis=1)
                before = now
            print(f"| {name} | {step:g} | {shown(*mean(way / (count * step)))} |", flush=True)


def fitted(x: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Rotations that take a reference shape onto shapes x [cells, nodes, 3], by Kabsch's method."""
    centred = x - x.mean(axis=1, keepdims=True)
    u, _, v = np.linalg.svd(np.einsum("ni,bnj->bij", reference, centred))
    sign = np.linalg.det(u @ v)
    flip = np.zeros((len(x), 3, 3))
    flip[:, 0, 0] = flip[:, 1, 1] = 1.0
    flip[:, 2, 2] = sign
    return np.swapaxes(u @ flip @ v, 1, 2)


def diffusion(share: float) -> None:
    """A free helix of 6 um: mean square displacements in its own axes, between lags of 0.5 and 1.5 ms."""
    _, sim = ensemble({**FREE, "numerics.time_step": 1e-5}, 96)
    interval, count = 5e-4, max(16, int(share * 80))
    shapes = np.array([c.positions.reshape(96, 31, 3) for c in looks(sim, 2e-3, interval, count)])
    reference = Simulation(sim.scenes[0], device="cpu").state.positions
    second = reference[1:-3] + reference[3:-1] - 2 * reference[2:-2]
    axis = np.cross(second[0], second[1])
    axis /= np.linalg.norm(axis)
    reference = reference - reference.mean(axis=0)
    across = np.cross(axis, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    turns = np.array([fitted(x, reference) for x in shapes])
    axes, sides, middles = turns @ axis, turns @ across, shapes.mean(axis=2)
    rates = {}
    for lag in (1, 3):
        moved = middles[lag:] - middles[:-lag]
        along = np.sum(moved * axes[:-lag], axis=2)
        tilt = axes[lag:] - axes[:-lag]
        # Spin: of the side vector about the axis, both carried back onto the old axis.
        third = np.cross(axes[:-lag], sides[:-lag])
        angle = np.arctan2(np.sum(sides[lag:] * third, axis=2), np.sum(sides[lag:] * sides[:-lag], axis=2))
        rates[lag] = [
            (along**2).mean(axis=0) / 2,
            ((moved**2).sum(axis=2) - along**2).mean(axis=0) / 4,
            (angle**2).mean(axis=0) / 2,
            (tilt**2).sum(axis=2).mean(axis=0) / 4,
        ]
    print("\n| free helix, 6 µm | exact, rigid | simulated |\n|---|---|---|")
    names = ("along [µm²/s]", "across [µm²/s]", "spin [rad²/s]", "tumble [rad²/s]")
    for name, exact, first, second in zip(names, (0.689, 0.446, 7.56, 0.168), rates[1], rates[3], strict=True):
        print(f"| {name} | {exact} | {shown(*mean((second - first) / (2 * interval)))} |", flush=True)


def lengths(share: float) -> None:
    """Mean strain of a segment, which tells whether kT div M is there: weight l^2 exp(-U/kT)."""
    stiffness, h = 300.0, 0.2
    values = {**FREE, "flagella.length": 0.4, "flagella.stretching_stiffness": stiffness, "numerics.time_step": 2e-7}
    _, sim = ensemble(values, 200)
    strains = []
    for cells in looks(sim, 4e-5, 1e-6, max(50, int(share * 2000))):
        x = cells.positions.reshape(200, 3, 3)
        strains.append((np.linalg.norm(np.diff(x, axis=1), axis=2) / h - 1).mean(axis=1))
    l = np.linspace(0.9, 1.1, 200_001)

    def exact(power: float) -> float:
        weight = l**power * np.exp(-stiffness * h * (l - 1) ** 2 / (2 * KT))
        return float(np.sum(weight * (l - 1)) / np.sum(weight))

    value, error = mean(np.mean(strains, axis=0))
    print(f"\nmean strain, K = {stiffness:g} pN: {shown(1e4 * value, 1e4 * error)}e-4, exact {1e4 * exact(2.0):.3f}e-4;"
          f" a dumbbell without the drift term {1e4 * exact(2 * 1.6 / 2.8):.3f}e-4", flush=True)  # fmt: skip


def tip(share: float) -> None:
    """A straight rod on a hook that resists bending: variance of the tip across [um^2] is kT (L^3/3A + L^2/k)."""
    values = {
        "flagella.length": 2.0,
        "flagella.intrinsic_curvature": (0.0, 0.0, 0.0),
        "flagella.opening_angle": 0.0,
        "motor.axis_angle": 0.0,
        "hook.stiffness": 4.0,
        "body.anchored": True,
        "hydrodynamics.mode": "none",
        "numerics.time_step": 1e-5,
    }
    _, sim = ensemble(values, 100)
    tips = [c.positions.reshape(100, -1, 3)[:, -1, :2] for c in looks(sim, 1e-2, 5e-4, max(16, int(share * 160)))]
    tips = np.array(tips)
    tips = tips - tips.mean(axis=(0, 1))
    value, error = mean((tips**2).mean(axis=(0, 2)))
    # Discretely: joints of the rod stand at h, 2 h, ... from the hook, L - i h of rod beyond each.
    beyond = 2.0 - 0.2 * np.arange(1, 10)
    exact = KT * (np.sum(beyond**2) * 0.2 / 3.5 + 4.0 / 4.0)
    print(f"\ntip variance of a rod of 2 µm: {shown(1e3 * value, 1e3 * error)}e-3 µm², exact {1e3 * exact:.3f}e-3")


def cost(share: float) -> None:
    """Computing time of a step of the default cell [us], with the thermal velocities and without drawing them."""
    found: dict[str, list[float]] = {"all": [], "without": []}
    for _ in range(max(2, int(share * 6))):
        for name in found:
            _, sim = ensemble({"flagella.count": 2, "steric.enabled": True, "numerics.time_step": 1e-6}, 1)
            if name == "without":
                sim.stepper._draw_pairs = lambda *_: None  # type: ignore[attr-defined]
            sim.prepare()
            sim.advance(1e-5)
            began = time.process_time()
            sim.advance(1.01e-3)
            found[name].append(time.process_time() - began)
    both = [1e3 * min(times) for times in found.values()]
    print(
        f"\nstep: {both[0]:.0f} µs, without the noise of the pair sum {both[1]:.0f} µs, {both[0] / both[1]:.2f} times"
    )


TABLES: dict[str, Callable[[float], None]] = {f.__name__: f for f in (energies, drift, diffusion, lengths, tip, cost)}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("tables", nargs="*", default=list(TABLES), help=", ".join(TABLES))
    parser.add_argument("--share", type=float, default=1.0, help="of the samples")
    chosen = parser.parse_args()
    for name in chosen.tables:
        TABLES[name](chosen.share)
