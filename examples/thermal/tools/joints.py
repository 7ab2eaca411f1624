"""Energies of joints, their bias in the step, lengths of segments, persistence."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from . import exact
from .ensembles import FREE, KT, LOCKED, STRAIGHT, ensemble, looks, mean, shown

SHORT = {"flagella.length": 1.2}
TWO = {"flagella.count": 2}
# Side by side along their whole length, 0.05 um from each other.
BUNDLED = {
    **TWO,
    "flagella.opening_angle": 0.0,
    "flagellum.0.azimuth": 0.0,
    "flagellum.1.azimuth": 2 * math.degrees(math.asin(0.05 / 0.8)),
    "flagella.phase_difference": 0.0,
}
FLOW = {"hydrodynamics.mode": "consistent", "hydrodynamics.body_flow": True, "hydrodynamics.body_beads": 60}
HOOKED = {"hook.length": 0.055, "hook.stiffness": 0.65}
# Their modes take 0.4 ms; they start unbent.
UNBENT = {"hook.length": 0.055, "hook.stiffness": 4.0, "flagella.opening_angle": 110.0, "flagella.on_axis": True}
# Cell, values, step, cells, start, interval of the looks [s], number of looks. Cells without a stiff hook start in
# equilibrium, joint by joint; the stepper's own takes the place of that within the time to the start.
LONG = ((1e-6, 128, 2e-4, 4e-6, 900), (1e-5, 128, 5e-4, 2e-5, 450))
CASES: list[tuple[str, dict[str, Any], float, int, float, float, int]] = [
    *(("free, 1.2 µm", {**FREE, **SHORT}, step, 300, 20 * step, 2 * step, 300) for step in (1e-6, 1e-5)),
    *(("two on a body, 1.2 µm", {**TWO, **SHORT}, step, 200, 20 * step, 2 * step, 300) for step in (1e-6, 1e-5)),
    *(
        ("two 0.05 µm apart, 1.2 µm", {**BUNDLED, **SHORT}, step, 200, 20 * step, 2 * step, 300)
        for step in (1e-6, 1e-5)
    ),
    ("two with hooks, flow round the body, 1.2 µm", {**TWO, **SHORT, **FLOW, **UNBENT}, 1e-5, 100, 1e-3, 2e-5, 300),
    ("two, motors locked, 1.2 µm", {**TWO, **SHORT, **LOCKED}, 1e-6, 200, 2e-5, 2e-6, 300),
    *(("free, 6 µm", FREE, *run) for run in LONG),
    *(("two on a body, 6 µm", TWO, *run) for run in LONG),
    *(("two 0.05 µm apart, 6 µm", BUNDLED, *run) for run in LONG),
    ("free and straight, 1.2 µm", {**FREE, **SHORT, **STRAIGHT}, 1e-5, 300, 2e-4, 2e-5, 300),
    ("free and straight, 6 µm", {**FREE, **STRAIGHT}, *LONG[1]),
]


SEEDS = 1000  # from the first of a row to that of the next


def _row(
    name: str, values: dict[str, Any], step: float, count: int, start: float, interval: float, frames: int, first: int
) -> None:
    scene, sim = ensemble({**values, "numerics.time_step": step}, count, True, first)
    found = [c.elastic_energy / KT for c in looks(sim, start, interval, frames)]
    value, error = mean(np.mean(found, axis=0) / exact.energies(scene))
    print(f"| {name} | {step:g} | " + " | ".join(map(shown, value, error)) + " |", flush=True)


def energies(share: float) -> None:
    """Energy per joint over its exact value."""
    print("\n| cell | step [s] | bend | twist | stretch |\n|---|---|---|---|---|")
    for precision in ("float64", "float32"):
        for row, (name, values, step, count, start, interval, frames) in enumerate(CASES, 1):
            told = name if precision == "float64" else f"{name}, float32"
            values = {**values, "numerics.precision": precision}
            _row(told, values, step, count, start, interval, max(10, int(share * frames)), row * SEEDS)


def order(share: float) -> None:
    """The bias of the energies of a free filament in the step."""
    print("\n| cell | step [s] | bend | twist | stretch |\n|---|---|---|---|---|")
    for step in (5e-6, 1e-5, 2e-5, 4e-5):
        _row("free, 1.2 µm", {**FREE, **SHORT}, step, 300, 20 * step, 2 * step, max(40, int(share * 1000)), 0)


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

    def weighted(power: float) -> float:
        weight = l**power * np.exp(-stiffness * h * (l - 1) ** 2 / (2 * KT))
        return float(np.sum(weight * (l - 1)) / np.sum(weight))

    value, error = mean(np.mean(strains, axis=0))
    print(
        f"\nmean strain, K = {stiffness:g} pN: {shown(1e4 * value, 1e4 * error)}e-4, exact {1e4 * weighted(2.0):.3f}"
        f"e-4; a dumbbell without the drift term {1e4 * weighted(2 * 1.6 / 2.8):.3f}e-4",
        flush=True,
    )


def dumbbell(share: float) -> None:
    """Two nodes on a spring of K = 1 pN, which a run's guards do not let be, by Euler-Maruyama in NumPy: the drift
    kT div M of `warpflag_kernels.fluid.noise` for end nodes, and without it."""
    stiffness, h, step, count = 1.0, 0.2, 2e-7, 20_000
    along, across = 2 / (1.6e-3 * h), 2 / (2.8e-3 * h)
    print("\n| dumbbell, mean l/h - 1 | exact | simulated |\n|---|---|---|")
    l = np.linspace(1e-3, 3.0, 200_001)
    for name, drift, power in (("with the drift", 1.0, 2.0), ("without", 0.0, 2 * 1.6 / 2.8)):
        random = np.random.default_rng(0)
        apart, found = np.tile([0.0, 0.0, h], (count, 1)), []
        for i in range(1000 + max(200, int(1000 * share))):
            length = np.linalg.norm(apart, axis=1, keepdims=True)
            t = apart / length
            # Both nodes move by the same law in opposite directions, the noise of each its own.
            pull = -stiffness * (length / h - 1) * 2 * along
            spread = drift * 2 * KT * (along - across) * 2 / length
            noise = random.standard_normal((count, 3)) * math.sqrt(2 * KT * step * 2)
            axial = np.sum(noise * t, axis=1, keepdims=True) * t
            apart = apart + step * (pull + spread) * t + math.sqrt(along) * axial + math.sqrt(across) * (noise - axial)
            if i >= 1000:
                found.append(np.linalg.norm(apart, axis=1) / h - 1)
        weight = l**power * np.exp(-stiffness * h * (l - 1) ** 2 / (2 * KT))
        known = np.sum(weight * (l - 1)) / np.sum(weight)
        print(f"| {name} | {known:.4f} | {shown(*mean(np.mean(found, axis=0)))} |", flush=True)


def persistence(share: float) -> None:
    """<t.t'> of neighbouring segments, and the persistence length of a straight filament."""
    print("\n| filament, 1.2 µm | exact | simulated |\n|---|---|---|")
    frames = max(50, int(share * 1000))
    for name, values, known in (("straight, free", STRAIGHT, 0.9997634), ("helix, free", {}, 0.965061)):
        _, sim = ensemble({**FREE, **SHORT, **values, "numerics.time_step": 1e-5}, 100)
        cosines = []
        for cells in looks(sim, 1e-3, 2e-5, frames):
            t = np.diff(cells.positions.reshape(100, -1, 3), axis=1)
            t /= np.linalg.norm(t, axis=2, keepdims=True)
            cosines.append(np.sum(t[:, 1:] * t[:, :-1], axis=2).mean(axis=1))
        value, error = mean(np.mean(cosines, axis=0))
        print(f"| 1 - <t.t'>, {name} | {1 - known:.4g} | {shown(1 - value, error)} |", flush=True)
        if name.startswith("straight"):
            length, scatter = -0.2 / math.log(value), 0.2 * error / (1 - value) ** 2
            print(f"| persistence length [µm] | 845 | {shown(length, scatter)} |", flush=True)
