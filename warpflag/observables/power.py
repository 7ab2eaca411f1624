"""The power balance of a cell: the work of motors and external forces, what the fluid dissipates, what is stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warpflag.record.cell_state import Evaluation

__all__ = ["PowerBalance", "power_balance"]


@dataclass(frozen=True)
class PowerBalance:
    """Powers at one moment [pN um/s = 1e-18 W].

    Attributes:
        supplied: by the name of the force term: "motor" or, where the torque is not constant, "motor law", T_m on each
            tripod and -T_m m on the body; "external"; "polymorphs", what ground states that change put in.
        translation: dissipated by the moving nodes, the flow between them included.
        spin: dissipated by the segments' spin about their tangents.
        body: dissipated by the body's translation and rotation.
    """

    supplied: Mapping[str, float]
    translation: float
    spin: float
    body: float

    @property
    def motor(self) -> float:
        """Work of all motors [pN um/s]."""
        return self.supplied.get("motor", 0.0) + self.supplied.get("motor law", 0.0)

    @property
    def dissipated(self) -> float:
        """What the fluid takes [pN um/s]."""
        return self.translation + self.spin + self.body

    @property
    def stored(self) -> float:
        """What is left of the supply: the rate at which elastic and steric energy grow [pN um/s]."""
        return sum(self.supplied.values()) - self.dissipated


def power_balance(found: Evaluation) -> PowerBalance:
    """The powers of one cell. Inertia is absent, so what the fluid takes is the work of all forces on all velocities.

    Args:
        found: what `Simulation.evaluate()` gives.
    """
    work = np.vecdot(found.forces, found.velocities)
    work[found.first] = 0.0  # r_0 is a point of the body, whose share has its force
    return PowerBalance(
        supplied=found.supplied,
        translation=float(work.sum()),
        spin=float(found.torques @ found.spins),
        body=float(found.body_force @ found.body_velocity + found.body_torque @ found.body_spin),
    )
