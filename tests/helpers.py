"""Scenes for the physics tests, rotations, and shapes: disturbed, moved, or placed node by node.

A shape is an `InitialState`. Arrays over all elements have the tripod and r_0 first in each flagellum, as in the
program. Units um, pN, s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from warpflag.model.geometry import InitialState, initial_state
from warpflag.run.simulation import CellState, Evaluation, Simulation
from warpflag.scene import FlagellumSpec, Scene, paper_scene, with_values


def cell(values: Mapping[str, Any] | None = None, precision: str = "float64") -> Scene:
    """Two short flagella on a body, every term of the model acting, with other values by dotted key; RKC steps it."""
    common = {"flagella.length": 2.0, "numerics.precision": precision, "numerics.stepper": "rkc"}
    return with_values(paper_scene(name="cell"), {**common, **(values or {})})


def touching_cell(
    values: Mapping[str, Any] | None = None, precision: str = "float64", separation: float = 0.042
) -> Scene:
    """Two flagella, one the other displaced by `separation` [um]: in contact all along, and with the body near r_1."""
    side_by_side = {
        "flagella.opening_angle": 0.0,
        "flagellum.0.azimuth": 0.0,
        "flagellum.1.azimuth": 2 * math.degrees(math.asin(separation / 0.8)),
    }
    return cell({**side_by_side, **(values or {})}, precision)


def rod(values: Mapping[str, Any] | None = None) -> Scene:
    """One straight flagellum without contact or flow: nothing but elasticity and local drag."""
    bare = {
        "flagella.count": 1,
        "flagella.intrinsic_curvature": (0.0, 0.0, 0.0),
        "hydrodynamics.mode": "none",
        "body.contact": False,
    }
    return cell({**bare, **(values or {})})


# Rotations.


def rotation(vector: Any) -> np.ndarray:
    """Rotation matrix by |vector| about it."""
    angle = float(np.linalg.norm(vector))
    x, y, z = np.asarray(vector) / (angle or 1.0)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def quaternion(vector: Any) -> np.ndarray:
    """The same rotation as a quaternion (x, y, z, w)."""
    half = float(np.linalg.norm(vector)) / 2
    return np.array([*(np.asarray(vector) * (0.5 * np.sinc(half / math.pi))), math.cos(half)])


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of two quaternions: b first, then a."""
    return np.array([*(a[3] * b[:3] + b[3] * a[:3] + np.cross(a[:3], b[:3])), a[3] * b[3] - a[:3] @ b[:3]])


def matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrix of a unit quaternion (x, y, z, w)."""
    x, y, z, w = q
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def carried(v: np.ndarray, t: np.ndarray, u: np.ndarray) -> np.ndarray:
    """v turned by the minimal rotation that takes t onto u: half a turn about t, then one about t + u."""

    def half_turn(w: np.ndarray, axis: np.ndarray) -> np.ndarray:
        return 2 * np.sum(w * axis, axis=-1, keepdims=True) * axis - w

    return half_turn(half_turn(v, t), unit(t + u))


# Shapes.


def attachment(scene: Scene, spec: FlagellumSpec) -> tuple[np.ndarray, np.ndarray]:
    """Anchor and motor axis in body axes: r_0 = d e_b3 + (width/2) n + (hook length) m, m = cos e_b3 + sin n; on a cap
    with the radius of the sphere there in place of width/2."""
    azimuth, angle = math.radians(spec.azimuth), math.radians(spec.motor_axis_angle)
    normal, rear = np.array([math.cos(azimuth), math.sin(azimuth), 0.0]), np.array([0.0, 0.0, 1.0])
    m = math.cos(angle) * rear + math.sin(angle) * normal
    radius = scene.body.width / 2
    on_cap = max(abs(spec.anchor_offset) - (scene.body.length - scene.body.width) / 2, 0.0)
    if not scene.body.enabled:
        return np.zeros(3), m
    surface = spec.anchor_offset * rear + math.sqrt(radius**2 - on_cap**2) * normal
    return surface + scene.hook.length * m, m


def tangents(scene: Scene, start: InitialState) -> list[np.ndarray]:
    """Motor axis and tangents of the segments, one array [N + 1, 3] per flagellum."""
    turn = matrix(start.body_orientation)
    axes = [turn @ attachment(scene, spec)[1] for spec in scene.resolved_flagella()]
    return [np.vstack([m, unit(np.diff(x, axis=0))]) for m, x in zip(axes, start.positions, strict=True)]


def displaced(
    scene: Scene, start: InitialState, nodes: Any = 0.0, spins: Any = 0.0, translation: Any = 0.0, turn: Any = 0.0
) -> InitialState:
    """The shape after nodes r_1..r_N and the body have moved; frames follow by the minimal rotation, then spin.

    nodes: displacements [um], shape [element_count, 3], rows of r_0 unused; spins: [rad], shape [element_count];
    translation, turn: of the body [um], rotation vector [rad].
    """
    count = sum(len(x) for x in start.positions)
    nodes, spins = np.broadcast_to(nodes, (count, 3)), np.broadcast_to(spins, count)
    centre = start.body_position + translation
    orientation = product(quaternion(np.zeros(3) + turn), start.body_orientation)
    positions, directors, first = [], [], 0
    for spec, old in zip(scene.resolved_flagella(), start.positions, strict=True):
        new = old + nodes[first : first + len(old)]
        new[0] = centre + matrix(orientation) @ attachment(scene, spec)[0]
        positions.append(new)
        first += len(old)
    moved = InitialState(tuple(positions), start.directors, centre, orientation, start.time)
    first = 0
    for e1, t, u in zip(start.directors, tangents(scene, start), tangents(scene, moved), strict=True):
        angle = spins[first : first + len(e1), None]
        followed = carried(e1, t, u)
        directors.append(followed * np.cos(angle) + np.cross(u, followed) * np.sin(angle))
        first += len(e1)
    return InitialState(tuple(positions), tuple(directors), centre, orientation, start.time)


def shaken(scene: Scene, seed: int, node: float = 0.01, spin: float = 0.1, body: float = 0.5) -> InitialState:
    """The scene's shape, disturbed: body and flagella turned and shifted as one, then every node and spin by itself."""
    random = np.random.default_rng(seed)
    start = initial_state(scene)
    count = sum(len(x) for x in start.positions)
    start = displaced(scene, start, node * random.uniform(-1, 1, (count, 3)), spin * random.uniform(-1, 1, count))
    return moved_rigidly(start, body * random.uniform(-1, 1, 3), body * random.uniform(-1, 1, 3))


def moved_rigidly(start: InitialState, turn: Any, translation: Any) -> InitialState:
    """The whole cell turned about the lab origin by a rotation vector and then shifted."""
    q = rotation(turn)
    return InitialState(
        tuple(x @ q.T + translation for x in start.positions),
        tuple(e1 @ q.T for e1 in start.directors),
        q @ start.body_position + translation,
        product(quaternion(turn), start.body_orientation),
        start.time,
    )


def ground_state_frames(count: int, h: float, strain: Any) -> np.ndarray:
    """Frames (columns e1, e2, e3) of the discrete helix with strain (0, Omega_2, Omega_3) at every joint.

    Zero bend about the mean e1 asks for a binormal at 90 deg + twist/2 from e1, of length h Omega_2/cos(twist/2).
    """
    twist = h * strain[2]
    bend = 2 * math.atan(h * strain[1] / math.cos(twist / 2) / 2)
    binormal = np.array([-math.sin(twist / 2), math.cos(twist / 2), 0.0])
    joint = rotation(bend * binormal) @ rotation([0.0, 0.0, twist])
    frames = [np.eye(3)]
    for _ in range(count - 1):
        frames.append(frames[-1] @ joint)
    return np.array(frames)


def helix_axis(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Direction of the helix axis and a point on it: second differences of the nodes point at the axis."""
    inward = unit(x[1:-3] + x[3:-1] - 2 * x[2:-2])
    axis = unit(np.cross(inward[0], inward[1]))
    axis *= np.sign(axis @ (x[-1] - x[0]))
    angle = math.acos(inward[0] @ inward[1])
    chord = (x[3] - x[2]) - (x[3] - x[2]) @ axis * axis
    return axis, x[2] + np.linalg.norm(chord) / (2 * math.sin(angle / 2)) * inward[0]


def as_start(scene: Scene, state: CellState) -> InitialState:
    """The shape that a simulation has reached."""
    ends = np.cumsum([spec.segment_count + 1 for spec in scene.resolved_flagella()])[:-1]
    positions, directors = np.split(state.positions, ends), np.split(state.directors, ends)
    return InitialState(tuple(positions), tuple(directors), state.body_position, state.body_orientation, state.time)


def placed(scene: Scene, nodes: list[np.ndarray], directors: list[np.ndarray] | None = None) -> InitialState:
    """Flagella with given nodes r_1..r_N, shape [N, 3] each, on a body at the origin; the hook joint untwisted.

    directors: e1 of segments 1..N, shape [N, 3] each; default: no twist at any joint.
    """
    positions, frames = [], []
    for k, (spec, free) in enumerate(zip(scene.resolved_flagella(), nodes, strict=True)):
        anchor, m = attachment(scene, spec)
        x = np.vstack([anchor, free])
        t = unit(np.diff(x, axis=0))
        if directors is None:
            e1 = [unit(np.cross(t[0], np.eye(3)[np.argmin(abs(t[0]))]))]
            for before, after in pairwise(t):
                e1.append(carried(e1[-1], before, after))
        else:
            e1 = list(directors[k])
        positions.append(x)
        frames.append(np.vstack([carried(e1[0], t[0], m), *e1]))
    return InitialState(tuple(positions), tuple(frames), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))


def evaluated(scene: Scene, start: InitialState, device: str) -> Evaluation:
    """Forces and velocities of one shape."""
    return Simulation(scene, device=device, starts=start).evaluate()


def anchors(scene: Scene) -> np.ndarray:
    """Elements that are r_0 and tripod, shape [flagellum_count]."""
    counts = [spec.segment_count + 1 for spec in scene.resolved_flagella()]
    return np.concatenate([[0], np.cumsum(counts)[:-1]])


def free_nodes(scene: Scene) -> np.ndarray:
    """Elements that are r_1..r_N of some flagellum."""
    count = sum(spec.segment_count + 1 for spec in scene.resolved_flagella())
    return np.setdiff1d(np.arange(count), anchors(scene))
