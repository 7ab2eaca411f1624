"""What a stepper works on and what it must offer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from warpflag_kernels.base.types import DeviceModel, DeviceState
from warpflag_kernels.stepping.frame_slots import DenseOutput

__all__ = ["DEFAULT_ACCURACY", "STEP_MEMORY", "Stepper", "System", "restart_step_control"]


@dataclass(frozen=True)
class System:
    """Everything on the device: model, state, chart, clocks and guards."""

    model: DeviceModel
    state: DeviceState
    chart: Any
    control: Any
    guard: Any


DEFAULT_ACCURACY = 5.0e-3
"""Node error per simulated time that step control keeps when `numerics.accuracy` is absent [um/ms]."""
FIRST_STEP = 1.0e-8
"""First step under control after a start, when nothing is known of the motion yet [s]."""


def restart_step_control(c: Any, fixed_start: np.ndarray) -> None:
    """Forgets the estimates; the first step is `FIRST_STEP` under control, `fixed_start` [s] otherwise."""
    c.error_sum.zero_()
    c.error_time.zero_()
    c.rejected_error.zero_()
    c.wanted_step.assign(np.where(c.error_rate.numpy() > 0.0, FIRST_STEP, fixed_start))


STEP_MEMORY = ("wanted_step", "error_sum", "error_time", "rejected")


class Stepper(Protocol):
    """Advances every active cell toward its target; all its decisions are taken on the device."""

    dense: DenseOutput | None
    """Where frames go that fall into steps; None: nowhere. Set before a pass is captured."""

    ends_at_frames: bool
    """Whether a step ends at the time of every frame; if not, frames are taken from inside steps."""

    def launch_pass(self) -> None:
        """Launches one pass of the loop; captured once and replayed."""
        ...

    def restart(self) -> None:
        """Forgets what belongs to an earlier state: after a start or any change from outside."""
        ...

    def memory(self) -> dict[str, np.ndarray]:
        """What a resumed run needs to go on with the same numbers."""
        ...

    def recall(self, memory: dict[str, np.ndarray]) -> None:
        """Takes back what `memory` gave."""
        ...
