"""The time that `warpflag run` will take for a scene: start-up, stepping, frames, record and movie, as a range."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

import numpy as np

from warpflag.observables import bundle_length, phase_difference
from warpflag.run.simulation import Simulation

__all__ = ["MOVIE", "Needed", "needed", "stepping_time"]

_SAMPLE_SECONDS = 0.3  # of computing: long enough to be timed to some per cent
_MOST_SECONDS = 8.0  # of computing for all samples, so that the whole check takes some ten seconds
_SETTLED = 4e-4  # simulated time [s] from which on steps have their usual length; those of the start are shorter
_SHORTEST = 1e-9  # simulated time [s] that a sample is taken to have, where not one step came to its end
_FRAMES_OBSERVED = 8  # frames whose observables are timed at once, as a run measures blocks of them
_PER_FRAME = 1.5e-4  # s for the record of a frame; measured on zipping.toml
MOVIE, _MOVIE_PER_NODE = 0.2, 5e-7  # s for a movie, and per node of a frame; measured on zipping.toml
# Contacts ask for more and dearer steps. Time of stepping a whole run over what its first steps say, measured
# (docs/tradeoff.md): at least, and at most with up to three flagella; with more that touch already.
_LEAST_FACTOR, _FEW_FACTOR, _TOUCHING_FACTOR = 0.8, 1.4, 1.8
_SLOPE, _LARGEST_CROWD = 0.45, 8  # with n flagella that do not touch yet: 1 + _SLOPE (n - 2), n up to _LARGEST_CROWD


@dataclass(frozen=True)
class Needed:
    """What a run takes, in seconds of computing.

    Attributes:
        startup: until the first step, kernels from the cache.
        compiling: of kernels, in this process; 0 where they were in the cache.
        sampled: of stepping, in the sample from which the rest is told.
        rest: of stepping, without contacts that form later.
        output: frames, record and movie.
        crowd: how many times as long stepping may take once flagella touch.
    """

    startup: float
    compiling: float
    sampled: float
    rest: float
    output: float
    crowd: float

    @property
    def stepping(self) -> float:
        """All of stepping [s], without contacts that form later."""
        return self.sampled + self.rest

    @property
    def least(self) -> float:
        """Lower end of the range of the run's time [s]."""
        return self.startup + self.sampled + _LEAST_FACTOR * self.rest + self.output

    @property
    def most(self) -> float:
        """Upper end of that range [s]."""
        return self.startup + self.sampled + self.crowd * self.rest + self.output


def needed(simulation: Simulation, most: float = _MOST_SECONDS) -> Needed:
    """Measured by starting the run; the simulation is advanced.

    Args:
        simulation: of one scene.
        most: computing time of all samples [s].

    Raises:
        NumericalError: a guard is violated in the first steps.
    """
    scene = simulation.scenes[0]
    compiling = simulation.load(recording=True)
    simulation.prepare(recording=True)
    startup = time.process_time()
    nodes = int(simulation.first_node[-1])
    output = scene.frames * (_observing(simulation) + _PER_FRAME + _MOVIE_PER_NODE * nodes) + MOVIE
    count = len(scene.resolved_flagella())
    few = count < 4
    crowd = _FEW_FACTOR if few or not scene.steric.enabled else 1 + _SLOPE * (min(count, _LARGEST_CROWD) - 2)
    spent, rest = stepping_time(simulation, most)
    if simulation.cell_state().steric_force > 0.0:
        crowd = _FEW_FACTOR if few else _TOUCHING_FACTOR
    return Needed(startup - compiling, compiling, spent, rest, output, crowd)


def _observing(simulation: Simulation) -> float:
    """Seconds for the observables of a frame."""
    state, first_node = simulation.cell_state(), simulation.first_node
    many = (_FRAMES_OBSERVED, 1, 1)
    positions, directors = np.tile(state.positions, many), np.tile(state.directors, many)
    bundle_length(positions[:1], first_node)  # what the first call imports is paid once
    began = time.process_time()
    if len(first_node) > 2:
        phase_difference(positions, directors, first_node)
    bundle_length(positions, first_node)
    return (time.process_time() - began) / _FRAMES_OBSERVED


def stepping_time(simulation: Simulation, most: float) -> tuple[float, float]:
    """Seconds of computing that the sample took, and that the rest of the run takes at its last speed.

    The sample is runs that double until one is long enough to time, or is cut off.
    """
    end = simulation.scenes[0].duration
    reached, spent = 0.0, 0.0
    until = min(_SETTLED / 4, end)
    began = time.process_time()

    def watch() -> None:
        if time.process_time() - began + spent > most:
            raise _Late

    while True:
        began = time.process_time()
        with contextlib.suppress(_Late):
            simulation.advance(until, watch)
        taken = time.process_time() - began
        spent += taken
        stands = float(simulation.times[0])
        settled = reached >= _SETTLED and taken > _SAMPLE_SECONDS
        if settled or until >= end or spent > most:
            return spent, taken / max(stands - reached, _SHORTEST) * max(end - stands, 0.0)
        reached, until = stands, min(2 * until, end)


class _Late(Exception):
    """A sample has taken all of its time."""
