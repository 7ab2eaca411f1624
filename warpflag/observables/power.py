"""The power balance of a cell: the work of the motors, what the fluid dissipates, and what is stored."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from warpflag.observables.arrays import Array, flagella

if TYPE_CHECKING:
    from warpflag.record.cell_state import Evaluation

__all__ = ["PowerBalance", "power_balance"]


@dataclass(frozen=True)
class PowerBalance:
    """Powers at one moment [pN um/s = 1e-18 W].

    Attributes:
        motor: work of all motors, T_m on each tripod and -T_m m on the body.
        translation: dissipated by the moving nodes, the flow between them included.
        spin: dissipated by the segments' spin about their tangents.
        body: dissipated by the body's translation and rotation.
    """

    motor: float
    translation: float
    spin: float
    body: float

    @property
    def stored(self) -> float:
        """What is left of the motors' work [pN um/s]: the rate at which elastic and steric energy grow."""
        return self.motor - self.translation - self.spin - self.body


def power_balance(
    found: Evaluation, torques: Array, motor_axes: Array, first_node: NDArray[np.integer]
) -> PowerBalance:
    """The powers of one cell. Inertia is absent, so what the fluid takes is the work of all forces on all velocities.

    Args:
        found: forces and velocities, from `Simulation.evaluate()`.
        torques: T_m of the motors [pN um], shape [flagellum_count].
        motor_axes: unit vectors m in the lab, shape [flagellum_count, 3].
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
    """
    first = np.array([rows.start for rows in flagella(first_node)])
    work = np.vecdot(found.forces, found.velocities)
    work[first] = 0.0  # r_0 is a point of the body, whose share has its force
    return PowerBalance(
        motor=float(np.asarray(torques) @ (found.spins[first] - np.asarray(motor_axes) @ found.body_spin)),
        translation=float(work.sum()),
        spin=float(found.torques @ found.spins),
        body=float(found.body_force @ found.body_velocity + found.body_torque @ found.body_spin),
    )
