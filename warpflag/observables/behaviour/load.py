"""Where motors work: torque and rate under their load, and the point of a torque-speed curve that a load asks for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from warpflag.observables.arrays import Array
from warpflag.observables.motion import motor_rate

__all__ = ["LoadPoint", "load_points", "operating_rate", "torque_at"]


@dataclass(frozen=True)
class LoadPoint:
    """Where a motor works, over a window of frames.

    Attributes:
        rate: relative to the body, positive right-handed about its axis [Hz].
        torque: mean over time [pN um].
    """

    rate: float
    torque: float

    @property
    def drag(self) -> float:
        """Of what the motor turns: torque over angular velocity [pN um s]; NaN for a motor that stands."""
        return self.torque / (2 * np.pi * self.rate) if self.rate else float("nan")


def load_points(times: ArrayLike, motor_angles: ArrayLike, torques: ArrayLike) -> list[LoadPoint]:
    """The load point of each motor.

    Args:
        times: of the frames [s], shape [frame_count], at least two.
        motor_angles: accumulated, relative to the body [rad], shape [frame_count, flagellum_count].
        torques: of the motors in each interval [pN um], shape [frame_count - 1, flagellum_count], or of the whole
            window, shape [flagellum_count].

    Raises:
        ValueError: fewer than two frames, or times that do not increase.
    """
    intervals = np.diff(np.asarray(times, float))
    rates = motor_rate(times, motor_angles)
    torques = np.broadcast_to(np.asarray(torques, float), (len(intervals), len(rates)))
    means = np.average(torques, axis=0, weights=intervals)
    return [LoadPoint(float(rate), float(torque)) for rate, torque in zip(rates, means, strict=True)]


def torque_at(rate: ArrayLike, stall: float, knee: float, no_load: float) -> Array:
    """Torque of a motor on its torque-speed curve [pN um]: a plateau to the knee, from there linear to zero.

    Beyond the no-load rate the torque is zero; a motor that is driven backwards keeps its plateau.

    Args:
        rate: relative to the body [Hz].
        stall: torque of the plateau [pN um].
        knee: rate where the plateau ends [Hz].
        no_load: rate without load [Hz], above the knee.
    """
    return stall * np.clip((no_load - np.asarray(rate, float)) / (no_load - knee), 0.0, 1.0)


def operating_rate(drag: ArrayLike, stall: float, knee: float, no_load: float) -> Array:
    """Rate at which a load works on a torque-speed curve [Hz]: where 2 pi drag rate meets it.

    Args:
        drag: torque over angular velocity of the load [pN um s].
        stall: torque of the plateau [pN um].
        knee: rate where the plateau ends [Hz].
        no_load: rate without load [Hz], above the knee.
    """
    per_turn = 2 * np.pi * np.asarray(drag, float)  # torque per rate [pN um s]
    slope = stall / (no_load - knee)
    sloped = slope * no_load / (per_turn + slope)
    return np.where(per_turn * knee >= stall, stall / np.maximum(per_turn, np.finfo(float).tiny), sloped)
