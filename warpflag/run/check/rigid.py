"""A single stiff flagellum that a motor turns about its helix axis: a rough rate, and how it depends on the mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warpflag.model.shell import rotne_prager
from warpflag.observables.arrays import Array, unit
from warpflag.scene import FlagellumSpec, Scene, SceneError, with_values
from warpflag.scene.helix import ground_state
from warpflag.scene.resistance import filament_mobility, pair_radius

__all__ = ["Turning", "mesh_dependence", "turning"]


@dataclass(frozen=True)
class Turning:
    """A stiff flagellum of the scene under its motor's torque, free to move along its axis.

    Attributes:
        rate: of its rotation [Hz].
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


def turning(scene: Scene, segment_length: float | None = None) -> Turning:
    """The longest flagellum of a scene, with other segments where a length is given [um].

    Nodes have the scene's local mobility and, in modes that sum pairs of one flagellum, its Rotne-Prager sum.

    Raises:
        SceneError: segments of this length are not allowed.
    """
    if segment_length is not None:
        scene = with_values(scene, {"flagella.segment_length": segment_length, "hydrodynamics.pair_radius": None})
    spec = max(scene.resolved_flagella(), key=lambda own: own.length)
    h = spec.segment_length
    helix = ground_state(scene.flagella.strain_at_rest(h), h)
    turn = helix.angle * (np.arange(spec.segment_count + 1))
    x = np.stack([helix.radius * np.cos(turn), helix.radius * np.sin(turn), helix.rise * np.arange(len(turn))], axis=1)
    mobility = _mobility(scene, spec, x)
    moves = np.zeros((2, len(x), 3))  # unit rotation about z, and unit translation along it
    moves[0, :, 0], moves[0, :, 1], moves[1, :, 2] = -x[:, 1], x[:, 0], 1.0
    flat = moves.reshape(2, -1)
    resistance = flat @ np.linalg.solve(mobility, flat.T)
    spin = spec.segment_count / filament_mobility(scene, h).spin  # segments also turn about themselves
    about = resistance[0, 0] + spin * (helix.rise / h) ** 2 - resistance[0, 1] ** 2 / resistance[1, 1]
    rate = abs(spec.torque) / about
    drag = float(2 * np.pi * about)
    return Turning(rate / (2 * np.pi), float(x[-1, 2]), helix.radius, rate * helix.radius, drag)


def _mobility(scene: Scene, spec: FlagellumSpec, x: Array) -> Array:
    """Of the nodes of one flagellum, shape [3 node_count, 3 node_count]."""
    count, local = len(x), filament_mobility(scene, spec.segment_length)
    tangents = unit(np.gradient(x, axis=0))
    along = np.einsum("ni,nj->nij", tangents, tangents)
    weight = np.where(np.arange(count) == count - 1, 2.0, 1.0)[:, None, None]
    own = weight * (local.along * along + local.across * (np.eye(3) - along))
    m = np.zeros((count, 3, count, 3))
    if scene.hydrodynamics.mode in ("within", "all", "as_printed", "consistent"):
        a = pair_radius(scene, spec.segment_length)
        m += rotne_prager(x, a, x, a) / (8 * np.pi * scene.fluid.viscosity)
    m[np.arange(count), :, np.arange(count), :] = own
    return m.reshape(3 * count, 3 * count)


def mesh_dependence(scene: Scene, finer: float) -> float | None:
    """Relative change of the stiff flagellum's rate from segments `finer` times as long to the scene's; None: not
    allowed."""
    try:
        h = max(spec.segment_length for spec in scene.resolved_flagella())
        return turning(scene).rate / turning(scene, finer * h).rate - 1.0
    except (SceneError, np.linalg.LinAlgError):
        return None
