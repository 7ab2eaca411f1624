"""Speed of the Rotne-Prager pair sum on one CPU thread, beside numba, PyStokes and plain C++.

    uv run --with numba --with pystokes examples/benchmarks/pair_sum.py --png pair_sum.png
    uv run examples/benchmarks/pair_sum.py --sizes 60 1000 --precision float64

Node positions and forces in, node velocities out: warpflag's stage "local drag and pair sum" (so with the drag, and
over the anchors as well, which the others need not know), replayed by a captured loop as in a run; C++ of
pair_sum.cpp, compiled here with g++ -O3 -march=native -ffast-math, over all pairs and over i < j only; numba, written
plainly and tuned (numba_sum.py); PyStokes' Rbm.mobilityTT, which is double precision, has no form for overlapping
spheres and is called from Python once per sum. What is not installed is left out.

Before timing, all must give the same velocities (1e-10 in float64, 1e-4 in float32, of the largest): at the scene's
pair radius, and, but for PyStokes, at one so large that neighbours overlap.

A pair is one of the N (N - 1) ordered pairs of the N moving nodes, whatever a program really evaluates. Ratios: how
many times faster than the other warpflag is; PyStokes is in double precision in the float32 table, too. All take turns
in one process, see harness.py.
"""

from __future__ import annotations

import os

# PyStokes runs on all cores otherwise; has to be set before it loads.
os.environ["OMP_NUM_THREADS"] = "1"

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tools import numba_sum
from tools.cells import moving_nodes, placed, shaken, spread
from tools.harness import Contender, Repeated, interleaved, save_plot, table
from tools.native import NativePairSum, compiler
from warpflag_kernels.fluid import node_velocity

from warpflag.scene import Scene
from warpflag.scene.resistance import filament_mobility, pair_radius

SIZES = {60: (2, 30), 100: (2, 50), 200: (4, 50), 1000: (10, 100), 4000: (40, 100)}  # flagella, segments of each
PRECISIONS = ("float64", "float32")
TOLERANCE = {"float64": 1e-10, "float32": 1e-4}
OVERLAPPING = 0.15  # um, a radius at which neighbours of 0.2 um overlap
CONTENDERS = ("C++", "C++ i<j", "numba, plain", "numba, tuned", "PyStokes")


@dataclass(frozen=True)
class Case:
    """A cell with random forces: what goes into the sum, and the sum that warpflag makes of it.

    positions, forces: of the moving nodes, shape [n, 3]; radius: of the pair term; pair: its flow of these nodes in
    units of 1/(8 pi eta), without the local drag; launch: warpflag's stage.
    """

    precision: str
    positions: np.ndarray
    forces: np.ndarray
    radius: float
    pair: np.ndarray
    launch: Callable[[], None]


def case(size: int, precision: str, radius: float | None = None) -> Case:
    """The cell of so many moving nodes."""
    values = {} if radius is None else {"hydrodynamics__pair_radius": radius}
    # Contact would only add to the forces.
    scene = spread(*SIZES[size], precision, steric__enabled=False, body__contact=False, **values)
    sim = placed(scene, shaken(scene))
    found = sim.evaluate()
    positions = sim.cell_state().positions
    model, state = sim.system.model, sim.system.state
    state.data.active.fill_(1)
    moving = moving_nodes(sim)
    drag = local_drag(scene, positions, found.forces, sim.first_node)
    pair = (found.velocities - drag)[moving] * 8 * np.pi * scene.fluid.viscosity

    def launch() -> None:
        node_velocity.node_velocities(model, state)

    return Case(precision, positions[moving], found.forces[moving], pair_radius(scene), pair, launch)


def local_drag(scene: Scene, positions: np.ndarray, forces: np.ndarray, first_node: np.ndarray) -> np.ndarray:
    """Velocity of every node by its own force alone, shape [node_count, 3]; nonsense at the anchors."""
    velocities = []
    for spec, first, end in zip(scene.resolved_flagella(), first_node[:-1], first_node[1:], strict=True):
        segments = np.diff(positions[first:end], axis=0)
        t = segments / np.linalg.norm(segments, axis=1, keepdims=True)
        tangent = np.vstack([t[:1], t[:-1] + t[1:], t[-1:]])
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        weight = np.ones((len(tangent), 1))
        weight[-1] = 2.0  # the free end carries half a segment
        own, f = filament_mobility(scene, spec.segment_length), forces[first:end]
        along = np.sum(tangent * f, axis=1, keepdims=True) * tangent
        velocities.append(weight * (own.along * along + own.across * (f - along)))
    return np.concatenate(velocities)


class StokesPairSum:
    """As `NativePairSum`, in PyStokes."""

    def __init__(self, module: Any, given: Case) -> None:
        self._x, self._f = (np.ascontiguousarray(a.T).ravel() for a in (given.positions, given.forces))
        self._v, self._radius = np.zeros_like(self._x), given.radius
        # Viscosity 1/(8 pi): velocities come in the same units.
        self._rbm = module.unbounded.Rbm(radius=given.radius, particles=len(given.positions), viscosity=1 / (8 * np.pi))

    def __call__(self, repeats: int) -> None:
        for _ in range(repeats):
            self._rbm.mobilityTT(self._v, self._x, self._f)

    @property
    def velocities(self) -> np.ndarray:
        """Of one sum; PyStokes adds to what is there, and moves a sphere by its own force, too."""
        self._v[:] = 0.0
        self(1)
        return (self._v - 4 / 3 / self._radius * self._f).reshape(3, -1).T


def peers(given: Case, far_only: bool = True) -> Iterator[tuple[str, Any]]:
    """Every other program at hand, by name."""
    if compiler():
        for name, symmetric in (("C++", False), ("C++ i<j", True)):
            yield name, NativePairSum(given.positions, given.forces, given.radius, given.precision, symmetric)
    if numba_sum.available():
        arrays = (given.positions, given.forces, given.radius, given.precision)
        yield "numba, plain", numba_sum.PlainPairSum(*arrays)
        yield "numba, tuned", numba_sum.TunedPairSum(*arrays)
    if far_only:
        try:
            import pystokes
        except ImportError:
            return
        yield "PyStokes", StokesPairSum(pystokes, given)


def check(given: Case, far_only: bool) -> None:
    """Refuses to compare programs that do not give the same numbers."""
    distances = np.linalg.norm(given.positions[:, None] - given.positions[None], axis=2)
    overlaps = int((distances < 2 * given.radius).sum()) - len(distances)
    assert (overlaps == 0) == far_only, f"{overlaps} overlapping pairs"
    scale = np.abs(given.pair).max()
    for name, peer in peers(given, far_only):
        peer(1)
        error = np.abs(peer.velocities - given.pair).max() / scale
        assert error < TOLERANCE[given.precision], f"{name} differs by {error:.1e} in {given.precision}"


def measured(size: int, precision: str, rounds: int) -> dict[str, float]:
    """Time of one sum by contender [s]."""
    given = case(size, precision)
    check(given, far_only=True)
    contenders: dict[str, Contender] = {"warpflag": Repeated(given.launch), **dict(peers(given))}
    return interleaved(contenders, rounds)


def report(precision: str, results: dict[int, dict[str, float]]) -> str:
    """The table of one precision."""
    others = [name for name in CONTENDERS if name in next(iter(results.values()))]
    head = ["N", "us", "ns/pair", "M pairs/s", *others, *(f"/ {name}" for name in others)]
    rows = []
    for size, times in results.items():
        pairs, own = size * (size - 1), times["warpflag"]
        speeds = [round(pairs / times[name] / 1e6) for name in ("warpflag", *others)]
        rows.append([size, own * 1e6, own * 1e9 / pairs, *speeds, *(times[name] / own for name in others)])
    return f"{precision}\n\n{table(head, rows)}\n"


def draw(axes: Any, results: dict[str, dict[int, dict[str, float]]]) -> None:
    """Speed against size."""
    for precision, sizes in results.items():
        for i, name in enumerate(next(iter(sizes.values()))):
            if name == "PyStokes" and precision == "float32":
                continue  # the same double precision again
            points = [(n, n * (n - 1) / times[name] / 1e6) for n, times in sizes.items()]
            style = "-" if precision == "float64" else "--"
            axes.loglog(*zip(*points, strict=True), f"o{style}", color=f"C{i}", label=f"{name}, {precision}")
    axes.set_xlabel("moving nodes")
    axes.set_ylabel("M pairs/s")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", nargs="+", type=int, choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--precision", nargs="+", choices=PRECISIONS, default=list(PRECISIONS))
    parser.add_argument("--rounds", type=int, default=31, help="turns of every contender")
    parser.add_argument("--png", type=Path, help="draw the speeds into this file (needs matplotlib)")
    args = parser.parse_args()
    results: dict[str, dict[int, dict[str, float]]] = {}
    for precision in args.precision:
        check(case(60, precision, OVERLAPPING), far_only=False)
        results[precision] = {size: measured(size, precision, args.rounds) for size in args.sizes}
        print(report(precision, results[precision]), flush=True)
    have = next(iter(next(iter(results.values())).values()))
    for name in CONTENDERS:
        if name not in have:
            print(f"{name} left out: {'no g++ here' if 'C++' in name else 'not installed'}")
    if args.png:
        save_plot(args.png, lambda axes: draw(axes, results))


if __name__ == "__main__":
    main()
