"""A scene's initial shape: flagella in their exact discrete ground state, anchored on the body.

At time 0 the body axes e_b1, e_b2, e_b3 are the lab's x, y, z and the body's centre is the origin. Flagellum
k at azimuth alpha has n = cos(alpha) e_b1 + sin(alpha) e_b2, its anchor r_0 = d e_b3 + (width/2) n + (hook length) m,
its helix axis cos(tilt) e_b3 + sin(tilt) n and its motor axis m = cos(angle) e_b3 + sin(angle) n. The paper shows but
does not print these choices; its hook has no length.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from warpflag.observables import local_phase_difference
from warpflag.scene import FlagellumSpec, Scene, SceneError, attachment
from warpflag.scene.helix import DiscreteHelix, across, ground_state, rest_shape, rotation_matrix

__all__ = [
    "DEFAULT_PHASE",
    "DiscreteHelix",
    "InitialState",
    "at_time_0",
    "flagellum_at_rest",
    "ground_state",
    "initial_state",
    "phase_difference_at",
    "rotation_matrix",
    "with_phase",
]

Array = NDArray[np.floating]

DEFAULT_PHASE = 180.0  # deg; where the anchor sits about the helix axis unless the scene says otherwise
_PHASE_TOLERANCE = 1e-6  # of a phase difference: 1 asked for is 1 - 1e-8 found


@dataclass(frozen=True)
class InitialState:
    """Where a simulation starts.

    Attributes:
        positions: nodes r_0..r_N of each flagellum in the lab [um], shape [N + 1, 3] each.
        directors: e1 of the motor tripod and of segments 1..N of each flagellum, shape [N + 1, 3] each.
        body_position: centre of the body in the lab [um], shape [3].
        body_orientation: quaternion (x, y, z, w) from body to lab axes, shape [4].
        time: simulated time [s].
        notes: what was changed of the scene's own shape so that it begins clear of body and other flagella, a line
            each.
        forms: of polymorphs at every node, shape [node_count]; None: all in the ground state.
    """

    positions: tuple[Array, ...]
    directors: tuple[Array, ...]
    body_position: Array
    body_orientation: Array
    time: float = 0.0
    notes: tuple[str, ...] = ()
    forms: NDArray[np.integer] | None = None


def initial_state(scene: Scene) -> InitialState:
    """The scene's shape at time 0. The tripods start without twist of the hook joint.

    A flagellum with an explicit phase has that. Others start at 180 deg, those of odd number shifted, where the scene
    gives `flagella.phase_difference`, by the angle in [0, 180] deg at which flagella 0 and 1 have it.

    Raises:
        SceneError: no shift gives the phase difference, or a motor axis points against the first segment, so that the
            hook joint is undefined.
    """
    shift = _phase_shift(scene)
    specs = [with_phase(spec, k, shift) for k, spec in enumerate(scene.resolved_flagella())]
    return at_time_0(scene, [flagellum_at_rest(scene, spec) for spec in specs])


def at_time_0(scene: Scene, shapes: Sequence[tuple[Array, Array]]) -> InitialState:
    """The cell at the origin with given flagella, tripods without twist of the hook.

    Args:
        scene: of the cell.
        shapes: nodes [um], shape [N + 1, 3], and e1 of segments 1..N, shape [N, 3], of each flagellum.

    Raises:
        SceneError: a motor axis points against the first segment.
    """
    positions, directors = [], []
    for k, (spec, (nodes, e1)) in enumerate(zip(scene.resolved_flagella(), shapes, strict=True)):
        tripod = _tripod(scene, k, spec, e1[0], nodes[1] - nodes[0])
        positions.append(nodes)
        directors.append(np.vstack([tripod, e1]))
    return InitialState(tuple(positions), tuple(directors), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


def with_phase(spec: FlagellumSpec, k: int, shift: float) -> FlagellumSpec:
    """Flagellum k with a phase [deg]: its own, or 180, plus `shift` if k is odd."""
    return spec if spec.phase is not None else replace(spec, phase=DEFAULT_PHASE + shift * (k % 2))


def phase_difference_at(scene: Scene, shift: float) -> float:
    """Contour average of the phase difference of flagella 0 and 1, in [0, 1], with 1 shifted by `shift` [deg].

    It is taken over the segments that both have; segments with antiparallel tangents are left out.
    """
    (nodes_a, e1_a), (nodes_b, e1_b) = (
        flagellum_at_rest(scene, with_phase(spec, k, shift)) for k, spec in enumerate(scene.resolved_flagella()[:2])
    )
    common = min(len(e1_a), len(e1_b))
    tangents = [np.diff(nodes[: common + 1], axis=0) for nodes in (nodes_a, nodes_b)]
    tangents = [edges / np.linalg.norm(edges, axis=1, keepdims=True) for edges in tangents]
    theta = local_phase_difference(e1_a[:common], tangents[0], e1_b[:common], tangents[1])
    return float(np.nanmean(theta))


def _phase_shift(scene: Scene) -> float:
    """The shift delta [deg] that gives the wanted initial phase difference."""
    wanted = scene.flagella.phase_difference
    if wanted is None:
        return 0.0
    grid = np.linspace(0.0, 180.0, 37)
    values = np.array([phase_difference_at(scene, shift) for shift in grid])
    lowest, highest = float(values.min()), float(values.max())
    if not lowest - _PHASE_TOLERANCE <= wanted <= highest + _PHASE_TOLERANCE:
        reach = f"{math.ceil(lowest * 1e4) / 1e4:g} to {math.floor(highest * 1e4) / 1e4:g}"
        problem = f"these flagella reach {reach}, flagellum 1 turned by 0 to 180 deg"
        raise SceneError("flagella.phase_difference", wanted, problem)
    wanted = min(max(wanted, lowest), highest)
    # The last crossing: theta grows with delta but for a dip near 0, 6e-4 deep at 90 deg.
    i = int(np.flatnonzero((values[:-1] - wanted) * (values[1:] - wanted) <= 0)[-1])
    low, high = grid[i], grid[i + 1]
    rising = values[i + 1] >= values[i]
    while high - low > 1e-12 * 180:
        middle = (low + high) / 2
        if (phase_difference_at(scene, middle) < wanted) == rising:
            low = middle
        else:
            high = middle
    return float((low + high) / 2)


def flagellum_at_rest(scene: Scene, spec: FlagellumSpec) -> tuple[Array, Array]:
    """Nodes [um], shape [N + 1, 3], and e1 of segments 1..N, shape [N, 3], on a body at the origin."""
    group, h = scene.flagella, spec.segment_length
    rest = rest_shape(group.strain_at_rest(h), h, spec.segment_count, group.on_axis)
    axis = np.array(attachment.direction(spec.tilt, spec.azimuth))
    outward = _phase_direction(axis, 0.0 if spec.phase is None else spec.phase)
    # Axes of segment 1: its helix axis onto the wanted one, its outward direction onto the phase's.
    first = np.stack([axis, *across(axis, outward)], axis=1) @ rest.helix_axes.T
    frames = first @ rest.frames
    steps = spec.segment_length * frames[:, :, 2]
    anchor = np.array(attachment.anchor(scene, spec))
    nodes = np.vstack([anchor, anchor + np.cumsum(steps, axis=0)])
    return nodes, frames[:, :, 0]


def _phase_direction(axis: Array, phase: float) -> Array:
    """Unit vector across `axis` at `phase` [deg] about it, counted from the lab's x axis projected across it."""
    x = np.array([1.0, 0.0, 0.0])
    # Along x the projection vanishes; its limit for an axis tilted in the x-z plane is taken.
    reference = x if abs(axis[0]) < 1 - 1e-12 else np.array([0.0, 0.0, -axis[0]])
    first, second = across(axis, reference)
    return math.cos(math.radians(phase)) * first + math.sin(math.radians(phase)) * second


def _tripod(scene: Scene, k: int, spec: FlagellumSpec, e1: Array, edge: Array) -> Array:
    """e1 of the motor tripod: that of segment 1 after the minimal rotation of its tangent onto the motor axis."""
    motor_axis = np.array(attachment.motor_axis(spec))
    tangent = edge / np.linalg.norm(edge)
    cosine = float(np.dot(tangent, motor_axis))
    if cosine < -0.999:
        own = scene.flagellum and scene.flagellum[k].motor_axis_angle is not None
        key = f"flagellum.{k}.motor_axis_angle" if own else "motor.axis_angle"
        problem = f"points against the first segment of flagellum {k}: the hook joint is undefined there"
        raise SceneError(key, spec.motor_axis_angle, problem)
    return e1 - np.dot(e1, motor_axis) / (1 + cosine) * (tangent + motor_axis)
