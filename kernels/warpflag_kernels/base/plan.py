"""How a run is executed: every choice between ways to make the same calculation, made once.

All ways give the same numbers to round-off. A CPU works through the threads of a launch one after the
other, so one thread takes a whole cell, every pair of nodes once, and several flagella in the lanes of a vector
register. A GPU has threads to spare: one for every element, a warp for the pairs of a node, a block for the contacts
of a cell. A strict build on a CPU takes launches and sums as a GPU does, for comparisons to the last bit.
"""

from dataclasses import dataclass, replace
from typing import Any

from warpflag_kernels.base.precision import Precision

WARP = 32  # threads of a warp
CONTACT_BLOCK = 128  # threads that solve the contacts of one cell on a GPU: an SM's four warp schedulers, one warp each
GATHERING_BLOCK = 256  # threads of a block that gathers pairs on a GPU: Warp's default
# Nodes of a cell up to which the coefficients of its pairs are stored during a step: N^2/2 pairs of four float32 are
# 2 MB then, what a core's second-level cache holds; beyond, reading them takes as long as computing them.
STORED_NODES = 512


@dataclass(frozen=True)
class Flows:
    """Which flows act, as kernels are compiled for them.

    Attributes:
        pairs: which nodes the Rotne-Prager sum couples: "none", "within" one flagellum, "between" flagella, or "all";
            "free": those of a free filament, r_0 among them.
        unequal: whether the nodes of a cell have unequal pair radii.
        body: whether the body's surface obstructs the flow and carries it along.
    """

    pairs: str
    unequal: bool = False
    body: bool = False

    @property
    def variant(self) -> str:
        """Name of the choice, for kernel modules."""
        return "_".join([self.pairs, *["unequal"] * self.unequal, *["body"] * self.body])

    @property
    def of_nodes(self) -> "Flows":
        """The flows that nodes cause themselves."""
        return replace(self, body=False)

    @property
    def within(self) -> bool:
        """Whether nodes of one flagellum are coupled."""
        return self.pairs in ("within", "all", "free")

    @property
    def between(self) -> bool:
        """Whether nodes of different flagella are coupled."""
        return self.pairs in ("between", "all")


@dataclass(frozen=True)
class Switches:
    """The terms that the scenes of a batch ask for. What is off is not compiled, allocated or launched.

    Attributes:
        flows: which flows act.
        terms: names of the force terms, see `warpflag_kernels.stepping.terms`.
        short_pairs: whether a float64 run has the pairs of the sum in float32, and their sums in float64.
        noise: whether there is thermal noise.
    """

    flows: Flows
    terms: tuple[str, ...]
    short_pairs: bool = False
    noise: bool = False

    @property
    def pairs(self) -> str:
        """Which nodes the Rotne-Prager sum couples."""
        return self.flows.pairs

    def has(self, term: str) -> bool:
        """Whether a force term is on."""
        return term in self.terms

    @property
    def steric(self) -> bool:
        """Whether flagella repel: each other, or each other and themselves."""
        return self.has("steric") or self.self_contact

    @property
    def self_contact(self) -> bool:
        """Whether a flagellum repels itself, too."""
        return self.has("steric with self")


@dataclass(frozen=True)
class Plan:
    """How the kernels of a run are executed.

    Attributes:
        device: Warp's device.
        precision: of positions and forces, and the build.
        pair_precision: of the terms of the Rotne-Prager sum.
        launch: "cells": one thread takes a whole cell, all its forces in one launch; "elements": one
            thread for every node, flagellum or cell, stage by stage.
        pair_sum: "symmetric": every pair once for both nodes; "warp" or "thread": pairs gathered at every node, by the
            threads of a warp or by one; "none": no pairs.
        step_pairs: the sum over pairs at positions that stand still during an implicit step. "stored": symmetric, with
            the coefficients of every pair kept; "symmetric"; "gathered" at every node.
        chains: "simd": flagella side by side in the lanes of a vector register; "serial": one thread a flagellum.
        contact_block: threads that solve the contacts of one cell.

    Raises:
        ValueError: a choice is unknown, or two of them exclude each other.
    """

    device: Any
    precision: Precision
    pair_precision: Precision
    launch: str
    pair_sum: str
    step_pairs: str
    chains: str
    contact_block: int

    def __post_init__(self) -> None:
        allowed = {
            "launch": ("cells", "elements"),
            "pair_sum": ("none", "symmetric", "warp", "thread"),
            "step_pairs": ("stored", "symmetric", "gathered"),
            "chains": ("simd", "serial"),
        }
        for name, known in allowed.items():
            if getattr(self, name) not in known:
                raise ValueError(f"plan: {name} is one of {', '.join(known)}, not {getattr(self, name)!r}")
        if "symmetric" in (self.pair_sum, self.step_pairs) and self.launch != "cells":
            raise ValueError("plan: a symmetric pair sum needs one thread per cell, launch = 'cells'")
        if self.step_pairs == "stored" and self.launch != "cells":
            raise ValueError("plan: stored pairs need one thread per cell, launch = 'cells'")
        if self.contact_block > 1 and (self.step_pairs != "gathered" or self.chains != "serial"):
            raise ValueError("plan: a contact block of several threads needs gathered step_pairs and serial chains")
        if self.chains == "simd" and not self.device.is_cpu:
            raise ValueError("plan: chains = 'simd' is for a CPU")

    @property
    def by_cells(self) -> bool:
        """Whether one thread takes a whole cell."""
        return self.launch == "cells"

    @property
    def gathering_threads(self) -> int:
        """Threads that gather the pairs of one node together."""
        return WARP if self.pair_sum == "warp" else 1

    @property
    def gathering_block(self) -> int:
        """Threads of a block that gathers pairs; on a CPU one warp, run as fibers that wait for each other."""
        return WARP if self.gathering_threads > 1 and self.device.is_cpu else GATHERING_BLOCK

    def summary(self) -> str:
        """The choices in one line, as `warpflag check` prints it."""
        build = "strict build" if self.precision.strict else "fast build"
        pairs = "" if self.pair_precision == self.precision else f" with pairs in {self.pair_precision.name}"
        launch = "forces of a cell in one launch" if self.by_cells else "a launch per stage"
        sums = "local drag alone"
        if self.pair_sum != "none":
            sums = f"{self.pair_sum} pair sum{pairs}, {self.step_pairs} within an implicit step"
        block = "one thread" if self.contact_block == 1 else f"blocks of {self.contact_block} threads"
        ways = f"{launch}, {sums}, {self.chains} chains, contacts by {block}"
        return f"{self.device.alias}, {self.precision.name}, {build}: {ways}"


def choose_plan(device: Any, precision: Precision, switches: Switches, largest_cell: int) -> Plan:
    """The plan for a batch.

    Args:
        device: Warp's device.
        precision: of positions and forces, and the build.
        switches: terms of the scenes.
        largest_cell: moving nodes of the largest cell.
    """
    by_cells = device.is_cpu and not precision.strict
    pair_sum = "symmetric" if by_cells else "warp" if device.is_cuda else "thread"
    step_pairs = "gathered"
    if switches.pairs == "none":
        pair_sum = "none"
    elif by_cells and switches.pairs != "free":  # nothing touches a free filament
        step_pairs = "stored" if largest_cell <= STORED_NODES else "symmetric"
    return Plan(
        device=device,
        precision=precision,
        pair_precision=precision.single if switches.short_pairs else precision,
        launch="cells" if by_cells else "elements",
        pair_sum=pair_sum,
        step_pairs=step_pairs,
        chains="simd" if by_cells else "serial",
        contact_block=CONTACT_BLOCK if device.is_cuda else 1,
    )
