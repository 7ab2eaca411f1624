"""Cells for the benchmarks: any number of flagella spread around a body, and simulations ready to evaluate."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from warpflag.model.geometry import InitialState, initial_state
from warpflag.run.simulation import Simulation
from warpflag.scene import Body, Flagella, FlagellumOverride, Scene, paper_scene, with_values

SEGMENT = 0.2  # um, that of the zipping scene
GOLDEN_ANGLE = 180.0 * (3.0 - math.sqrt(5.0))  # deg; turned by it, no two flagella come to lie in one row


def spread(count: int, segments: int, precision: str = "float64", **values: Any) -> Scene:
    """A cell of `count` flagella that fan out all round; its body grows so that the anchors stay as dense.

    Args:
        values: further values by dotted key, a double underscore for the dot.
    """
    grown = max(1.0, math.sqrt(count / 8.0))
    body = Body(length=2.5 * grown, width=0.8 * grown)
    half = 0.95 * (body.length - body.width) / 2
    along = np.linspace(-1.0, 1.0, 2 * count + 1)[1::2]  # from the front to the rear, without the ends
    flagella = tuple(
        FlagellumOverride(
            azimuth=k * GOLDEN_ANGLE % 360.0,
            # The smallest offset allowed is 1e-4 um.
            anchor_offset=half * x if abs(half * x) > 1e-3 else 1e-3,
            tilt=90.0 - 50.0 * x,
            length=SEGMENT * segments,
            segments=segments,
        )
        for k, x in enumerate(along)
    )
    scene = paper_scene(name=f"spread-{count}", body=body, flagella=Flagella(count=count), flagellum=flagella)
    given = {key.replace("__", "."): value for key, value in values.items()}
    return with_values(scene, {"numerics.precision": precision, "numerics.stepper": "rkc", **given})


def shaken(scene: Scene, size: float = 1e-3) -> InitialState:
    """The scene's shape with every node but the anchor displaced at random [um], so that forces act everywhere."""
    start, random = initial_state(scene), np.random.default_rng(0)
    positions = []
    for nodes in start.positions:
        moved = size * random.standard_normal(nodes.shape)
        moved[0] = 0.0
        positions.append(nodes + moved)
    return InitialState(tuple(positions), start.directors, start.body_position, start.body_orientation)


def shape(sim: Simulation) -> InitialState:
    """The state that a simulation has reached, as a start at time zero."""
    state, ends = sim.cell_state(), sim.first_node[1:-1]
    positions, directors = np.split(state.positions, ends), np.split(state.directors, ends)
    return InitialState(tuple(positions), tuple(directors), state.body_position, state.body_orientation)


def moving_nodes(sim: Simulation) -> np.ndarray:
    """Which nodes are not anchors, shape [node_count]: those move by the pair sum, the anchors with the body."""
    moving = np.ones(sim.first_node[-1], dtype=bool)
    moving[sim.first_node[:-1]] = False
    return moving


def placed(scene: Scene, start: InitialState | None = None) -> Simulation:
    """A simulation whose right-hand side has been evaluated once and can be launched again, stage by stage."""
    sim = Simulation(scene, device="cpu", starts=start)
    sim.evaluate()
    sim.system.state.data.active.fill_(1)
    return sim
