"""The state of one cell, and its forces and velocities: NumPy arrays in lab coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

__all__ = ["CellState", "Evaluation"]


@dataclass(frozen=True)
class CellState:
    """One cell at one time, as NumPy arrays in lab coordinates.

    Attributes:
        time: simulated time [s].
        step: number of steps taken.
        positions: nodes [um], shape [node_count, 3], flagellum after flagellum, r_0..r_N each.
        directors: e1 of the tripod and the segments, shape [node_count, 3].
        tangents: e3 of the tripod (the motor axis) and the segments, shape [node_count, 3].
        motor_angle: accumulated turn of each motor relative to the body [rad], shape [flagellum_count].
        body_angle: accumulated turn of the body about its axis e_b3 [rad].
        body_position: centre of the body [um], shape [3].
        body_orientation: quaternion (x, y, z, w) from body to lab axes, shape [4].
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
        forces: on the nodes [pN], shape [node_count, 3]; on r_0 that of the anchor on the body.
        torques: on the spins about the tangents [pN um], shape [node_count].
        velocities: of the nodes in the lab [um/s], shape [node_count, 3].
        spins: of the segments about their tangents [rad/s], shape [node_count].
        tangents: e3 of the tripod (the motor axis) and the segments, shape [node_count, 3].
        first: index of r_0 of every flagellum, shape [flagellum_count].
        motor_torques: of the motors about their axes [pN um], shape [flagellum_count].
        supplied: power of motors and of external forces [pN um/s], by the name of the term.
        positions: nodes [um], shape [node_count, 3].
        body_position: centre of the body [um], shape [3].
        body_force: sum of the forces on the body [pN], shape [3].
        body_torque: sum of the torques on the body about its centre [pN um], shape [3].
        body_velocity: of the body's centre [um/s], shape [3].
        body_spin: angular velocity of the body [rad/s], shape [3].
    """

    forces: np.ndarray
    torques: np.ndarray
    velocities: np.ndarray
    spins: np.ndarray
    tangents: np.ndarray
    first: np.ndarray
    motor_torques: np.ndarray
    supplied: Mapping[str, float]
    positions: np.ndarray
    body_position: np.ndarray
    body_force: np.ndarray
    body_torque: np.ndarray
    body_velocity: np.ndarray
    body_spin: np.ndarray
