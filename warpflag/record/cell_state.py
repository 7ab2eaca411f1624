"""What a simulation hands out of one cell: where it is, and what acts on it. Arrays on the host, lab coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

__all__ = ["CellState", "Evaluation"]


@dataclass(frozen=True)
class CellState:
    """One cell at one time, on the host, in lab coordinates.

    Attributes:
        time: [s].
        step: steps taken.
        positions: nodes [um], shape [node_count, 3], flagellum after flagellum, r_0..r_N each.
        directors: e1 of the tripod and the segments, shape [node_count, 3].
        tangents: e3 of the tripod (the motor axis) and the segments, shape [node_count, 3].
        motor_angle: accumulated turn of each motor relative to the body [rad], shape [flagellum_count].
        body_angle: accumulated turn of the body about its axis e_b3 [rad].
        body_position: [um], shape [3].
        body_orientation: quaternion (x, y, z, w), shape [4].
        elastic_energy: bending, twist, stretching [pN um], shape [3].
        steric_force: sum of the contact forces between flagella, each pair once [pN].
    """

    time: float
    step: int
    positions: np.ndarray
    directors: np.ndarray
    tangents: np.ndarray
    motor_angle: np.ndarray
    body_angle: float
    body_position: np.ndarray
    body_orientation: np.ndarray
    elastic_energy: np.ndarray
    steric_force: float

    def __repr__(self) -> str:
        count = len(self.motor_angle)
        cell = f"{count} flagell{'a' if count > 1 else 'um'}, {len(self.positions)} nodes"
        return f"<CellState at {1e3 * self.time:g} ms, step {self.step}: {cell}>"


@dataclass(frozen=True)
class Evaluation:
    """Forces and velocities of one cell at its present state.

    Attributes:
        forces: on the nodes [pN], shape [node_count, 3]; on r_0: what the anchor hands to the body.
        torques: on the spins about the tangents [pN um], shape [node_count].
        velocities: of the nodes in the lab [um/s], shape [node_count, 3].
        spins: of the segments about their tangents [rad/s], shape [node_count].
        tangents: e3 of the tripod (the motor axis) and the segments, shape [node_count, 3].
        first: index of r_0 of every flagellum, shape [flagellum_count].
        supplied: power that motors and forces from outside bring in [pN um/s], by the name of the term.
        body_force, body_torque: on the body, all shares [pN], [pN um], shape [3]; torque about its centre.
        body_velocity, body_spin: of the body [um/s], [rad/s], shape [3].
    """

    forces: np.ndarray
    torques: np.ndarray
    velocities: np.ndarray
    spins: np.ndarray
    tangents: np.ndarray
    first: np.ndarray
    supplied: Mapping[str, float]
    body_force: np.ndarray
    body_torque: np.ndarray
    body_velocity: np.ndarray
    body_spin: np.ndarray
