"""What the benchmarks share: launches repeated without Python, fair timing, and tables.

On a busy machine a single timing means little. Contenders therefore take turns, forwards and backwards, each turn
lasts a few milliseconds, the clock is the CPU time of this process, and what counts is the median over the turns.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp
from warpflag_kernels.base.program import captured_loop, load

Contender = Callable[[int], None]
"""Does its work so many times over."""


@wp.kernel(enable_backward=False)
def _count_down(left: wp.array(dtype=wp.int32)):
    left[0] = left[0] - 1


class Repeated:
    """Launches captured once and replayed by a loop inside the graph, as `Simulation` does with its passes.

    Args:
        launch: launches kernels, allocates nothing, and may run any number of times.
        unroll: launches per turn of the loop, so that counting the turns costs next to nothing.
    """

    def __init__(self, launch: Callable[[], None], device: str = "cpu", unroll: int = 8) -> None:
        self._left = wp.zeros(1, dtype=wp.int32, device=device)
        self._unroll = unroll

        def turn() -> None:
            for _ in range(unroll):
                launch()
            wp.launch(_count_down, 1, inputs=[self._left], device=device)

        turn()  # kernels load before the capture
        load(wp.get_device(device))
        self._replayed = captured_loop(self._left, turn, wp.get_device(device))

    def __call__(self, repeats: int) -> None:
        """Launches so many times, to the next multiple of `unroll`."""
        self._left.fill_(-(-repeats // self._unroll))
        self._replayed()

    @property
    def granularity(self) -> int:
        return self._unroll


def interleaved(contenders: Mapping[str, Contender], rounds: int = 41, turn: float = 3e-3) -> dict[str, float]:
    """Median CPU time of one repetition of every contender [s].

    Args:
        contenders: by name; one that has a `granularity` repeats in multiples of it, and one that has a method
            `prepare` is prepared before every turn, which is not timed.
        rounds: turns that each contender gets.
        turn: wanted length of a turn [s].
    """
    repeats = {name: _repeats(work, turn) for name, work in contenders.items()}
    order, times = list(contenders), {name: [] for name in contenders}
    for _ in range(rounds):
        for name in order:
            times[name].append(_timed(contenders[name], repeats[name]))
        order.reverse()
    return {name: float(np.median(values)) for name, values in times.items()}


def _timed(work: Contender, repeats: int) -> float:
    prepare = getattr(work, "prepare", None)
    if prepare is not None:
        prepare()
    begun = time.process_time()
    work(repeats)
    return (time.process_time() - begun) / repeats


def _repeats(work: Contender, turn: float) -> int:
    """How often to repeat for a turn of this length."""
    repeats = granularity = getattr(work, "granularity", 1)
    _timed(work, repeats)  # the first time is not like the others
    while (taken := _timed(work, repeats) * repeats) < turn / 4:
        repeats *= 2
    wanted = max(1.0, repeats * turn / taken)
    return granularity * max(1, round(wanted / granularity))


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Rows of texts and numbers as a markdown table; numbers with three significant digits, None as nothing."""
    lines = [head, ["---"] * len(head), *([shown(cell) for cell in row] for row in rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def shown(value: Any) -> str:
    """A cell of a table."""
    if value is None:
        return ""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:#.3g}".rstrip(".")


def save_plot(path: Path, draw: Callable[[Any], None], size: tuple[float, float] = (6.0, 4.5)) -> None:
    """Draws into a file; `draw` gets the axes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=size)
    draw(axes)
    axes.grid(True, which="both", alpha=0.3)
    axes.legend(fontsize="small")
    figure.tight_layout()
    figure.savefig(path, dpi=150)
