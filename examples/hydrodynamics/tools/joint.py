"""A rigid coaxial flagellum on a joint: when a cell with one polar flagellum swims straight, and how fast.

Body and flagellum are two rigid bodies that share the end of the hook. Given the torque of the joint their motion
follows from the dense mobility of body and nodes in mode all, with or without flow round the body. Seen from the
flagellum, the motor axis m then moves by an equation without time, whose linear part A at its fixed point is found by
differences: straight swimming is stable where the real part of A's eigenvalues is negative.

Runs beside it take a filament ten times as stiff as the paper's. Elasticity adds 2 % to the growth at 0.38 pN um and
5 % at 1, in proportion to the torque over the rigidity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import cells
import numpy as np

from warpflag.base import rotations
from warpflag.model.geometry import InitialState, at_time_0, flagellum_at_rest, rotation_matrix
from warpflag.model.shell import rotne_prager
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, with_values
from warpflag.scene.helix import rest_shape
from warpflag.scene.resistance import filament_mobility, pair_radius, spheroid_mobility

STEP = 1e-3  # rad, of the differences
ROUNDS = 3  # of Newton's method for the fixed point
TILT = 0.02  # rad, between neighbouring starts of runs


def polar_cell(torque: float, stiffness: float, body_flow: bool, length: float = 6.0, rigid: float = 10.0) -> Scene:
    """A cell with one flagellum on the body's axis, `rigid` times as stiff as the paper's.

    torque in pN um, stiffness of the hook in pN um/rad, length in um.
    """
    values = {
        "flagella.count": 1,
        "flagella.length": length,
        "flagella.on_axis": True,
        "flagella.opening_angle": 0.0,
        "flagella.anchor_offset": 1.25,
        "flagella.bending_rigidity": 3.5 * rigid,
        "flagella.twist_rigidity": 3.5 * rigid,
        "motor.torque": torque,
        "motor.axis_angle": 0.0,
        "hook.length": 0.055,
        "hook.stiffness": stiffness,
        "body.contact": False,
        "hydrodynamics.mode": "all",
        "hydrodynamics.body_flow": body_flow,
    }
    return with_values(Scene(name="polar"), values)


def tilted(scene: Scene, tilt: tuple[float, float]) -> InitialState:
    """The flagellum turned about r_0 by a rotation vector across the body's axis [rad], the motor axis e_b3."""
    nodes, e1 = flagellum_at_rest(scene, scene.resolved_flagella()[0])
    turn = _turn(tilt)
    return at_time_0(scene, [(nodes[0] + (nodes - nodes[0]) @ turn.T, e1 @ turn.T)])


def seen_from_flagellum(scene: Scene, m: np.ndarray, tangent: np.ndarray, e1: np.ndarray) -> np.ndarray:
    """Components of the motor axis m across the helix axis, in the flagellum's own axes; of segment 1 given."""
    spec = scene.resolved_flagella()[0]
    rest = rest_shape(scene.flagella.strain_at_rest(spec.segment_length), spec.segment_length, spec.segment_count, True)
    return np.array([m @ e1, m @ np.cross(tangent, e1), m @ tangent]) @ rest.helix_axes[:, 1:]


@dataclass(frozen=True)
class Stability:
    """Small tilts of a coaxial flagellum: growth rate [1/s] and precession [rad/s], seen from the flagellum."""

    growth: float
    precession: float


def stability(scene: Scene) -> Stability:
    """Of straight swimming with this hook."""
    tilt = np.zeros(2)
    for _ in range(ROUNDS):
        rate, matrix = _linear(scene, tilt)
        # m seen from the flagellum moves against the flagellum's tilt d: it is (-d_y, d_x).
        step = np.linalg.solve(matrix, rate)
        tilt = tilt + np.array([-step[1], step[0]])
    _, matrix = _linear(scene, tilt)
    values = np.linalg.eigvals(matrix)
    return Stability(float(values.real.mean()), float(np.abs(values.imag).mean()))


def threshold(torque: float, body_flow: bool, length: float = 6.0) -> float:
    """Hook stiffness below which straight swimming is unstable [pN um/rad]: the growth rate is linear in it."""
    low, high = 0.3 * torque, 0.7 * torque
    found = [stability(polar_cell(torque, k, body_flow, length)).growth for k in (low, high)]
    return low + (high - low) * found[0] / (found[0] - found[1])


def rigid_speed(scene: Scene) -> tuple[float, float]:
    """Speed ahead [um/s], and motor rate relative to the body [Hz], with the flagellum kept on the body's axis."""
    resistance, load = _balance(scene, tilted(scene, (0.0, 0.0)))
    kept = np.zeros((9, 7))
    kept[:6, :6], kept[6:, 3:6], kept[8, 6] = np.eye(6), np.eye(3), 1.0
    found = np.linalg.solve(kept.T @ resistance @ kept, kept.T @ load)
    return -found[2], found[6] / (2 * math.pi)


def growth_rates(scenes: list[Scene], time: float, device: str = "cpu") -> np.ndarray:
    """Growth rates of small tilts in runs of a time [s], one per scene [1/s].

    They tell how m, seen from the flagellum, moves from three neighbouring starts.
    """
    tilts = ((0.0, 0.0), (TILT, 0.0), (0.0, TILT))
    starts = [tilted(scene, tilt) for scene in scenes for tilt in tilts]
    sim = Simulation([scene for scene in scenes for _ in tilts], device=device, starts=starts)

    def apart() -> np.ndarray:
        seen = []
        for c in range(len(starts)):
            state = sim.cell_state(c)
            m = rotations.matrix(state.body_orientation)[:, 2]
            seen.append(seen_from_flagellum(scenes[c // 3], m, state.tangents[1], state.directors[1]))
        base, one, two = np.moveaxis(np.reshape(seen, (-1, 3, 2)), 1, 0)
        return np.stack([one - base, two - base], axis=2)

    before = apart()
    sim.advance(time)
    return np.log(np.abs(np.linalg.det(apart() @ np.linalg.inv(before)))) / (2 * time)


def speed_of_run(scene: Scene, motor: float, device: str = "cpu") -> tuple[float, float]:
    """Speed ahead [um/s] and motor rate [Hz] of a run, over two turns at the motor rate given, after half a turn."""
    sim = Simulation(scene, device=device)
    ahead, states = 0.0, []
    for time in np.linspace(0.5 / motor, 2.5 / motor, 101):
        sim.advance(time)
        states.append(sim.state)
    for a, b in pairwise(states):
        axes = [rotations.matrix(x.body_orientation)[:, 2] for x in (a, b)]
        ahead -= (b.body_position - a.body_position) @ (axes[0] + axes[1]) / 2
    lasted = states[-1].time - states[0].time
    turned = states[-1].motor_angle[0] - states[0].motor_angle[0]
    return float(ahead / lasted), float(turned / lasted / (2 * math.pi))


def _linear(scene: Scene, tilt: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rate of m seen from the flagellum at a tilt, and its derivative by m."""

    def moving(d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        resistance, load = _balance(scene, tilted(scene, (d[0], d[1])))
        motion = np.linalg.solve(resistance, load)
        to_flagellum = _turn((d[0], d[1])).T
        m = np.array([0.0, 0.0, 1.0])
        return (to_flagellum @ np.cross(motion[3:6] - motion[6:], m))[:2], (to_flagellum @ m)[:2]

    steps = [[moving(tilt + sign * step) for sign in (1, -1)] for step in STEP * np.eye(2)]
    rates = np.stack([plus[0] - minus[0] for plus, minus in steps], axis=1)
    moves = np.stack([plus[1] - minus[1] for plus, minus in steps], axis=1)
    return moving(tilt)[0], rates @ np.linalg.inv(moves)


def _balance(scene: Scene, start: InitialState) -> tuple[np.ndarray, np.ndarray]:
    """Resistance [9, 9] and load [9]: motions are the body's velocity and spin, and the spin of the flagellum."""
    spec, x = scene.resolved_flagella()[0], start.positions[0]
    h, anchor, free = spec.segment_length, x[0], x[1:]
    t = np.diff(x, axis=0) / h
    motions = np.zeros((6 + free.size, 9))
    motions[:6, :6] = np.eye(6)
    motions[6:, :3] = np.tile(np.eye(3), (len(free), 1))
    motions[6:, 3:6] = np.tile(_spins(anchor[None]), (len(free), 1))
    motions[6:, 6:] = _spins(free - anchor)
    spins = np.hstack([np.zeros((len(free), 6)), t])
    spin_drag = 1 / filament_mobility(scene, h).spin
    resistance = motions.T @ np.linalg.solve(_mobility(scene, free, t), motions) + spin_drag * spins.T @ spins
    # The hook: its moment M along both shafts is the motor's torque less the drag of the tripod's spin.
    m, e1 = np.array([0.0, 0.0, 1.0]), start.directors[0][1]
    rest = rest_shape(scene.flagella.strain_at_rest(h), h, spec.segment_count, True).helix_axes[:, 0]
    axis = rest[0] * e1 + rest[1] * np.cross(t[0], e1) + rest[2] * t[0]
    shaft = (m + t[0]) / (1 + m @ t[0])
    bending = 4 * scene.hook.stiffness / (1 + m @ axis) ** 2 * np.cross(axis, m)
    load = np.concatenate([np.zeros(3), -spec.torque * shaft - bending, spec.torque * shaft + bending])
    tripod = spin_drag * np.outer(np.concatenate([np.zeros(3), m - shaft, shaft]), np.append(np.zeros(6), m))
    return resistance + tripod, load


def _mobility(scene: Scene, x: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Of the body and nodes r_1..r_N of one flagellum with tangents t of its segments, shape [6 + 3 N] squared."""
    eta, radius = scene.fluid.viscosity, pair_radius(scene)
    h = scene.resolved_flagella()[0].segment_length
    local = filament_mobility(scene, h)
    means = np.vstack([t[:-1] + t[1:], t[-1:]])
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    weight = np.append(np.ones(len(x) - 1), 2.0)[:, None, None]
    blocks = weight * (local.across * np.eye(3) + (local.along - local.across) * means[:, :, None] * means[:, None, :])
    pairs = rotne_prager(x, radius, x, radius) / (8 * math.pi * eta)
    pairs[np.arange(len(x)), :, np.arange(len(x)), :] = blocks
    pairs = pairs.reshape(3 * len(x), -1)
    if not scene.hydrodynamics.body_flow:
        free = spheroid_mobility(scene.body.length, scene.body.width, eta)
        own = np.diag([free.across, free.across, free.along, free.tumble, free.tumble, free.spin])
        return np.block([[own, np.zeros((6, x.size))], [np.zeros((x.size, 6)), pairs]])
    found = cells.response(scene.hydrodynamics.body_beads, x, np.full(len(x), radius))
    taken, pushed, own = (part / (8 * math.pi * eta) for part in found)
    return np.block([[own, pushed], [pushed.T, pairs + taken]])


def _spins(x: np.ndarray) -> np.ndarray:
    """Velocities of points x for unit spins about three axes, shape [3 count, 3]."""
    return np.stack([np.cross(axis, x).ravel() for axis in np.eye(3)], axis=1)


def _turn(tilt: tuple[float, float]) -> np.ndarray:
    angle = math.hypot(*tilt)
    return rotation_matrix(np.array([*tilt, 0.0]) / angle, angle) if angle else np.eye(3)
