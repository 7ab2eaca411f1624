"""What a stepper works on and what it must offer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from warpflag_kernels.types import DeviceModel, DeviceState

__all__ = ["Stepper", "System"]


@dataclass(frozen=True)
class System:
    """Everything on the device: model, evaluation point, chart, clocks and guards."""

    model: DeviceModel
    state: DeviceState
    chart: Any
    control: Any
    guard: Any


class Stepper(Protocol):
    """Advances every active cell toward its target; all its decisions are taken on the device."""

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
