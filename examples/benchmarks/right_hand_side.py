"""Cost of one right-hand side, stage by stage, and of a whole pass of the stepper, on one CPU thread.

    uv run examples/benchmarks/right_hand_side.py
    uv run examples/benchmarks/right_hand_side.py --precision float32 --scene examples/zipping_23.toml

A run replays one captured pass. The RKC stepper chooses the point at which to evaluate next: a stage of its step, or a
probe of the spectral radius. The chart places nodes and directors there, the right-hand side turns them into forces
and velocities, the chart turns those into rates of its increments, and the stepper keeps them and goes on to its next
stage. A pass that ends a step looks at the guards, judges the error and commits the state besides. So a pass is one
right-hand side and what it takes to be part of a step.

Each row is replayed alone, many times over in a captured loop, at the start of the scene and amid its contacts (5.5 ms
later). The pass is timed as the loop does it: a stretch of a run, over the right-hand sides in it; "stepper" is what
remains of it when the rows above are taken off. A CPU takes the forces of a cell and their sums in one launch and
the pair sum in another; the stages below are those of a GPU, each with its own launches, and "saved" is what they take
together beyond that. One launch costs what the row "a launch" says and, besides, a look at its arguments by every
thread. C++ is the plain all-pairs sum over the same moving nodes, see pair_sum.py.

The second table has the whole right-hand side of larger cells, eight flagella, and 100 flagella of 51 nodes each; and
two of its stages by themselves, where contact takes every pair twice.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

import warp as wp
from tools.cells import moving_nodes, placed, shape, spread
from tools.harness import Contender, Repeated, interleaved, table
from tools.native import NativePairSum, compiler
from warpflag_kernels.rod import comoving_chart, reconstruction
from warpflag_kernels.stepping.right_hand_side import launch_right_hand_side, stages

from warpflag.model.geometry import InitialState
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, load, with_values
from warpflag.scene.resistance import pair_radius

EXAMPLES = Path(__file__).parents[1]
CONTACT_TIME = 5.5e-3  # s; the zipping scene has some ten closed contacts then
STRETCH = 2e-4  # s, of a run; twenty default steps of RKC
RECONSTRUCTION, RATES, LAUNCH = "reconstruction (chart)", "rates (chart)", "a launch"
WHOLE, PASS, CPP = "right-hand side", "pass", "C++ pair sum"


@wp.kernel(enable_backward=False)
def _nothing(anything: wp.array(dtype=wp.int32)):
    pass


class Pass:
    """Passes of the stepper over a stretch of a run, which starts from the same state every time."""

    def __init__(self, scene: Scene, start: InitialState | None) -> None:
        self._sim = Simulation(scene, device="cpu", starts=start)
        self._sim.advance(STRETCH / 10)  # past the first probes of the spectral radius
        self._saved = self._sim.checkpoint()
        before = self._evaluations()
        self(1)
        self.granularity = self._evaluations() - before  # passes in the stretch

    def prepare(self) -> None:
        """Back to the beginning of the stretch."""
        self._sim.restore(self._saved)

    def __call__(self, repeats: int) -> None:
        self._sim.advance(STRETCH * 1.1)

    def _evaluations(self) -> int:
        return int(self._sim.stepper.memory()["evaluations"][0])


def with_rkc(scene: Scene, precision: str) -> Scene:
    """The scene under the stepper whose pass is one right-hand side, in its default steps."""
    values = {"numerics.stepper": "rkc", "numerics.time_step": 1e-5, "numerics.accuracy": None}
    return with_values(scene, {**values, "numerics.precision": precision})


def contact_state(scene: Scene) -> InitialState:
    """The state amid the contacts, by the scene's own stepper."""
    sim = Simulation(with_values(scene, {"numerics.precision": "float64"}), device="cpu")
    sim.advance(CONTACT_TIME)
    return shape(sim)


def native_pair_sum(sim: Simulation, scene: Scene) -> NativePairSum:
    """The C++ sum over the moving nodes of a placed simulation."""
    moving = moving_nodes(sim)
    forces, positions = sim.system.state.data.force.numpy(), sim.system.state.data.pose.position.numpy()
    return NativePairSum(positions[moving], forces[moving], pair_radius(scene), scene.numerics.precision)


def staged(scene: Scene, start: InitialState | None, rounds: int) -> dict[str, float]:
    """Time of every stage, of the right-hand side, of a pass and of the C++ sum [s]."""
    sim = placed(scene, start)
    model, state = sim.system.model, sim.system.state
    anything = wp.zeros(1, dtype=wp.int32, device="cpu")
    launches: dict[str, Callable[[], Any]] = {
        RECONSTRUCTION: lambda: reconstruction.reconstruct(model, state, sim.system.chart)
    }
    for name, launch in stages(model):
        launches[name] = lambda launch=launch: launch(model, state)
    launches[RATES] = lambda: comoving_chart.increment_rates(model, state, sim.system.chart)
    launches[WHOLE] = lambda: launch_right_hand_side(model, state)
    launches[LAUNCH] = lambda: wp.launch(_nothing, model.element_count, inputs=[anything], device="cpu")
    contenders: dict[str, Contender] = {name: Repeated(launch) for name, launch in launches.items()}
    contenders[PASS] = Pass(scene, start)
    if compiler():
        contenders[CPP] = native_pair_sum(sim, scene)
    return interleaved(contenders, rounds)


def stage_table(at_start: dict[str, float], in_contact: dict[str, float]) -> str:
    """Parts of a pass and their shares of it, the stages of the right-hand side by themselves, and C++."""
    parts = (RECONSTRUCTION, WHOLE, RATES)
    own = [name for name in at_start if name not in (*parts, PASS, CPP, LAUNCH)]
    rows = []
    for name in [*parts, "stepper", PASS, *own, "saved", LAUNCH, CPP, "right-hand side / C++", "pass / C++"]:
        row: list[Any] = [name]
        for times in (at_start, in_contact):
            rest = times[PASS] - sum(times[part] for part in parts)
            saved = sum(times[stage] for stage in own) - times[WHOLE]
            values = {**times, "stepper": rest, "saved": saved}
            if name.endswith("/ C++"):
                row += [times[name.removesuffix(" / C++")] / times[CPP] if CPP in times else None, None]
                continue
            value = values.get(name)
            share = f"{100 * value / times[PASS]:.0f} %" if name in (*parts, "stepper", PASS) else None
            row += [None if value is None else 1e6 * value, share]
        rows.append(row)
    return table(["stage", "us at the start", "share", "us in contact", "share"], rows)


def whole_row(name: str, scene: Scene, start: InitialState | None, rounds: int) -> list[Any]:
    """The right-hand side of one cell as a row: cell, nodes, precision, times, ratio to C++."""
    sim = placed(scene, start)
    model, state = sim.system.model, sim.system.state
    large = model.element_count > 1000
    launches: dict[str, Callable[[], Any]] = {WHOLE: lambda: launch_right_hand_side(model, state)}
    for word in ("steric", "pair"):
        stage, launch = next((name, launch) for name, launch in stages(model) if word in name)
        launches[stage] = lambda launch=launch: launch(model, state)
    contenders: dict[str, Contender] = {key: Repeated(do, unroll=1 if large else 8) for key, do in launches.items()}
    if compiler():
        contenders[CPP] = native_pair_sum(sim, scene)
    times = interleaved(contenders, max(5, rounds // 3) if large else rounds)
    ratio = times[WHOLE] / times[CPP] if CPP in times else None
    own = [1e6 * times[key] for key in launches]
    nodes = int(moving_nodes(sim).sum())
    return [name, nodes, scene.numerics.precision, *own, 1e6 * times[CPP] if CPP in times else None, ratio]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", type=Path, default=EXAMPLES / "zipping.toml", help="for the first table")
    parser.add_argument("--precision", choices=["float64", "float32"], default="float64", help="of the first table")
    parser.add_argument("--rounds", type=int, default=41, help="turns of every row")
    parser.add_argument("--only-stages", action="store_true", help="leave out the larger cells")
    args = parser.parse_args()
    if not compiler():
        print("C++ left out: no g++ here\n")
    scene = load(args.scene)
    run = with_rkc(scene, args.precision)
    in_contact = staged(run, contact_state(scene), args.rounds)
    print(f"{scene.name}, {args.precision}\n\n{stage_table(staged(run, None, args.rounds), in_contact)}\n", flush=True)
    if args.only_stages:
        return
    eight, rows = load(EXAMPLES / "eight_flagella.toml"), []
    bundled = contact_state(eight)
    for precision in ("float64", "float32"):
        rows.append(whole_row("eight flagella", with_rkc(eight, precision), None, args.rounds))
        rows.append(whole_row("eight flagella, in contact", with_rkc(eight, precision), bundled, args.rounds))
    for precision in ("float64", "float32"):
        rows.append(whole_row("100 flagella of 51 nodes", spread(100, 50, precision), None, args.rounds))
    head = ["cell", "moving nodes", "precision", "right-hand side us", "steric", "pair sum", "C++ pair sum us"]
    print(table([*head, "right-hand side / C++"], rows))


if __name__ == "__main__":
    main()
