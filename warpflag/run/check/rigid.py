"""A stiff flagellum that a motor turns about its helix axis, alone or in a bundle: its rate, and how that depends on
the mesh."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from warpflag.model.shell import rotne_prager
from warpflag.observables.arrays import Array, unit
from warpflag.scene import FlagellumSpec, Scene, SceneError, with_values
from warpflag.scene.helix import ground_state
from warpflag.scene.resistance import filament_mobility, pair_radius, steric_diameter

__all__ = ["Turning", "mesh_dependence", "turning"]

_SPACING = 2.5  # of flagella in a bundle [sigma], at which rates change with the mesh as measured; docs/tradeoff.md
_MOST_NODES = 1000  # of such a bundle: larger ones are represented by fewer flagella


MOST_SEGMENTS = 500
"""Of the flagellum whose resistance is solved for, by dense matrices: more would take minutes and gigabytes."""


@dataclass(frozen=True)
class Turning:
    """A stiff flagellum of the scene under its motor's torque, free to move along its axis.

    Attributes:
        rate: of its rotation, by the law of its motor [Hz]; 0 without a body.
        axial_length: of the helix [um].
        radius: of the helix [um].
        tip_speed: of a node [um/s].
        drag: torque over rate [pN um s].
    """

    rate: float
    axial_length: float
    radius: float
    tip_speed: float
    drag: float


def turning(scene: Scene, segment_length: float | None = None, together: int = 1) -> Turning:
    """The longest flagellum of a scene, with other segments where a length is given [um].

    Nodes have the scene's local mobility and, in modes that sum pairs, its Rotne-Prager sum.

    Args:
        scene: to look at.
        segment_length: of other segments [um].
        together: so many such flagella side by side in a ring, in phase, each turning about its own axis.

    A flagellum of more than `MOST_SEGMENTS` is taken with as many.

    Raises:
        SceneError: segments of this length are not allowed.
    """
    if segment_length is not None:
        scene = with_values(scene, {"flagella.segment_length": segment_length, "hydrodynamics.pair_radius": None})
        own = tuple(dataclasses.replace(one, segments=None) for one in scene.flagellum)
        scene = dataclasses.replace(scene, flagellum=own)
    spec = max(scene.resolved_flagella(), key=lambda own: own.length)
    if spec.segment_count > MOST_SEGMENTS:
        scene, spec = _coarser(scene, spec)
    h = spec.segment_length
    helix = ground_state(scene.flagella.strain_at_rest(h), h)
    turn = helix.angle * (np.arange(spec.segment_count + 1))
    x = np.stack([helix.radius * np.cos(turn), helix.radius * np.sin(turn), helix.rise * np.arange(len(turn))], axis=1)
    mobility = _mobility(scene, spec, x, together)
    moves = np.zeros((2, together, len(x), 3))  # unit rotation about z, and unit translation along it
    moves[0, :, :, 0], moves[0, :, :, 1], moves[1, :, :, 2] = -x[:, 1], x[:, 0], 1.0
    flat = moves.reshape(2, -1)
    resistance = flat @ np.linalg.solve(mobility, flat.T) / together
    spin = spec.segment_count / filament_mobility(scene, h).spin  # segments also turn about themselves
    about = resistance[0, 0] + spin * (helix.rise / h) ** 2 - resistance[0, 1] ** 2 / resistance[1, 1]
    drag = float(2 * np.pi * about)
    rate = _rate(scene, spec, drag)
    return Turning(rate, float(x[-1, 2]), helix.radius, 2 * np.pi * rate * helix.radius, drag)


def _rate(scene: Scene, spec: FlagellumSpec, drag: float) -> float:
    """Rate at which a motor turns a drag [pN um s] forward [Hz]; that relative to the body is taken as that in the
    fluid."""
    if not scene.body.enabled:
        return 0.0
    if spec.law == "rate":
        return abs(spec.rate)
    held = abs(spec.torque)
    if spec.law == "constant" or held / drag <= spec.knee:
        return held / drag
    return held * spec.no_load / (held + drag * (spec.no_load - spec.knee))


def _coarser(scene: Scene, spec: FlagellumSpec) -> tuple[Scene, FlagellumSpec]:
    """A scene of one flagellum alone, with `MOST_SEGMENTS` segments, and that flagellum."""
    own = {"count": 1, "length": spec.length, "segment_length": spec.length / MOST_SEGMENTS, "phase_difference": None}
    alone = dataclasses.replace(
        scene,
        flagella=dataclasses.replace(scene.flagella, **own),
        flagellum=(),
        hydrodynamics=dataclasses.replace(scene.hydrodynamics, pair_radius=None),
    )
    return alone, dataclasses.replace(alone.resolved_flagella()[0], torque=spec.torque)


def _mobility(scene: Scene, spec: FlagellumSpec, x: Array, together: int) -> Array:
    """Of the nodes of flagella of this shape side by side, shape [3 nodes, 3 nodes]."""
    local, mode = filament_mobility(scene, spec.segment_length), scene.hydrodynamics.mode
    tangents = unit(np.gradient(x, axis=0))
    along = np.einsum("ni,nj->nij", tangents, tangents)
    weight = np.where(np.arange(len(x)) == len(x) - 1, 2.0, 1.0)[:, None, None]
    own = weight * (local.along * along + local.across * (np.eye(3) - along))
    turn = 2 * np.pi * np.arange(together) / together
    radius = 0.0 if together == 1 else _SPACING * steric_diameter(scene) / (2 * np.sin(np.pi / together))
    axes = radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(together)], axis=1)
    nodes = (axes[:, None] + x).reshape(-1, 3)
    count = len(nodes)
    m = np.zeros((count, 3, count, 3))
    if mode != "none":
        a = pair_radius(scene, spec.segment_length)
        m += rotne_prager(nodes, a, nodes, a) / (8 * np.pi * scene.fluid.viscosity)
        flagellum = np.repeat(np.arange(together), len(x))
        same = flagellum[:, None] == flagellum
        summed = {"within": same, "between": ~same}.get(mode)
        if summed is not None:
            m *= summed[:, None, :, None]
    m[np.arange(count), :, np.arange(count), :] = np.tile(own, (together, 1, 1))
    return m.reshape(3 * count, 3 * count)


def mesh_dependence(scene: Scene, finer: float) -> float | None:
    """Relative change of a stiff flagellum's rate under a given torque from segments `finer` times as long to the
    scene's, in a bundle of as many as the scene has; None: not allowed."""
    if max(spec.segment_count for spec in scene.resolved_flagella()) > finer * MOST_SEGMENTS:
        return None
    try:
        specs = scene.resolved_flagella()
        h = max(specs, key=lambda own: own.length).segment_length
        nodes = max(own.segment_count for own in specs) / finer + 1
        together = min(len(specs), max(1, int(_MOST_NODES / nodes)))
        return turning(scene, finer * h, together).drag / turning(scene, None, together).drag - 1.0
    except (SceneError, np.linalg.LinAlgError):
        return None
