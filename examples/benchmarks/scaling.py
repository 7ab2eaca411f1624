"""Cost of one right-hand side against the number of nodes, on one CPU thread.

    uv run examples/benchmarks/scaling.py --png scaling.png
    uv run examples/benchmarks/scaling.py --nodes 60 1000 --precision float32

Cells of 2 to 667 flagella of 31 nodes, spread around a body that grows with the square root of their number, so that
anchors stay as dense as on the body of eight. Everything acts: elasticity, contact with each other and with the body,
drag, the pair sum. At the start, where next to nothing touches; so the contact search costs and the contacts don't.

Of the pair sum every node feels every other, which makes a cost of N^2: the dotted line. The columns "pair sum" and
"contact search" are those two stages alone, the only ones that grow faster than N.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tools.cells import moving_nodes, placed, spread
from tools.harness import Contender, Repeated, interleaved, save_plot, table
from warpflag_kernels.stepping.right_hand_side import launch_right_hand_side, stages

SEGMENTS = 30
NODES = [60, 120, 300, 600, 1200, 2400, 5100, 10200, 20010]
WHOLE = "right-hand side"
BUDGET = 6.0  # s; larger cells take fewer turns


def measured(nodes: int, precision: str, rounds: int) -> tuple[int, dict[str, float]]:
    """Moving nodes, and the times of the right-hand side, of its pair sum and of its contact search [s]."""
    sim = placed(spread(max(2, round(nodes / SEGMENTS)), SEGMENTS, precision))
    model, state = sim.system.model, sim.system.state
    parts = {"pair sum": "pair", "contact search": "steric"}
    launches = {WHOLE: lambda: launch_right_hand_side(model, state)}
    for name, word in parts.items():
        launch = next(launch for stage, launch in stages(model) if word in stage)
        launches[name] = lambda launch=launch: launch(model, state)
    unroll = 8 if model.element_count < 1000 else 1
    contenders: dict[str, Contender] = {name: Repeated(launch, unroll=unroll) for name, launch in launches.items()}
    quick = interleaved({WHOLE: contenders[WHOLE]}, rounds=1)[WHOLE]
    turns = min(rounds, max(3, int(BUDGET / (2 * max(quick, 3e-3)))))
    return int(moving_nodes(sim).sum()), interleaved(contenders, turns)


def report(precision: str, results: dict[int, dict[str, float]]) -> str:
    """The table of one precision."""
    head = ["nodes", "us", "us/node", "ns/pair", "pair sum us", "contact search us"]
    rows = []
    for n, times in results.items():
        own, pairs, contact = (1e6 * times[name] for name in (WHOLE, "pair sum", "contact search"))
        rows.append([n, own, own / n, 1e3 * own / (n * (n - 1)), pairs, contact])
    return f"{precision}\n\n{table(head, rows)}\n"


def draw(axes: Any, results: dict[str, dict[int, dict[str, float]]]) -> None:
    """Times against nodes, and the slope of N^2."""
    for i, (precision, sizes) in enumerate(results.items()):
        for name, style in ((WHOLE, "o-"), ("pair sum", "--"), ("contact search", "-.")):
            axes.loglog(
                list(sizes), [1e3 * t[name] for t in sizes.values()], style, color=f"C{i}", label=f"{name}, {precision}"
            )
    nodes = list(next(iter(results.values())))
    last = next(iter(results.values()))[nodes[-1]][WHOLE]
    axes.loglog(nodes, [1e3 * last * (n / nodes[-1]) ** 2 for n in nodes], "k:", label="N^2")
    axes.set_xlabel("moving nodes")
    axes.set_ylabel("ms per right-hand side")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", nargs="+", type=int, default=NODES, help="rounded to whole flagella of 30")
    parser.add_argument("--precision", nargs="+", choices=["float64", "float32"], default=["float64", "float32"])
    parser.add_argument("--rounds", type=int, default=31, help="turns at most")
    parser.add_argument("--png", type=Path, help="draw the times into this file (needs matplotlib)")
    args = parser.parse_args()
    results: dict[str, dict[int, dict[str, float]]] = {}
    for precision in args.precision:
        results[precision] = dict(measured(nodes, precision, args.rounds) for nodes in args.nodes)
        print(report(precision, results[precision]), flush=True)
    if args.png:
        save_plot(args.png, lambda axes: draw(axes, results))


if __name__ == "__main__":
    main()
