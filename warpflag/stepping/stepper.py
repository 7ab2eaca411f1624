"""What a stepper works on and what it must offer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Protocol

import numpy as np
from warpflag_kernels.base.types import DeviceModel, DeviceState
from warpflag_kernels.stepping import accuracy, step_control
from warpflag_kernels.stepping.frame_slots import DenseOutput

from warpflag.scene import Scene
from warpflag.scene.resistance import pace
from warpflag.scene.run_sections import ACCURACY_LEVELS

__all__ = [
    "DEFAULT_ACCURACY",
    "Stepper",
    "System",
    "allocated_control",
    "recalled",
    "restart_step_control",
    "step_memory",
]


_POSE = ("position", "tangent", "director", "body_position", "body_orientation")
_ANGLES = ("flagellum_spin", "motor_angle", "body_angle")


@dataclass(frozen=True)
class System:
    """Everything on the device: model, state, chart, clocks and guards."""

    model: DeviceModel
    state: DeviceState
    chart: Any
    control: Any
    guard: Any

    def carried(self) -> dict[str, Any]:
        """Arrays, by name, that carry over from step to step, beside those of the stepper and of the frames."""
        control, chart = self.control, self.chart
        carried = {"control.time": control.time, "control.steps": control.steps}
        carried |= {f"chart.base_{name}": getattr(chart.base, name) for name in _POSE}
        carried |= {f"chart.{name}": getattr(chart, name) for name in _ANGLES}
        if self.model.switches.steric:
            carried["guard.position"] = self.guard.position
        names = [name for term in self.model.terms for name in term.carried]
        return carried | {name: attrgetter(name)(self.state.optional) for name in names}


DEFAULT_ACCURACY = ACCURACY_LEVELS["standard"]
"""Node error per simulated time that step control keeps when `numerics.accuracy` is absent [um/ms]."""
FIRST_STEP = 1.0e-8
"""First step under control after a start, when nothing is known of the motion yet [s]."""


def restart_step_control(c: Any, fixed_start: np.ndarray) -> None:
    """Forgets the estimates of earlier steps and sets the first step.

    Args:
        c: struct `StepControl`.
        fixed_start: first step of cells with fixed steps [s], shape [cell_count]. Under control it is `FIRST_STEP`,
            shorter in thin fluids.
    """
    c.error_sum.zero_()
    c.error_time.zero_()
    c.rejected_error.zero_()
    c.lowered.fill_(1.0)
    first = FIRST_STEP / step_control.SHORTEST_STEP * c.shortest.numpy()
    c.wanted_step.assign(np.where(c.error_rate.numpy() > 0.0, first, fixed_start))


def allocated_control(scenes: Sequence[Scene], fixed: Sequence[bool], device: Any) -> Any:
    """The struct `StepControl` of scenes, of which some have fixed steps."""
    accuracies = [scene.numerics.asked for scene in scenes]
    stopping = [scene.numerics.on_accuracy == "stop" for scene in scenes]
    return step_control.allocate(accuracies, fixed, stopping, [pace(scene) for scene in scenes], device)


_CONTROL_MEMORY = ("wanted_step", "error_sum", "error_time", "lowered", "rejected")
_ACHIEVED_MEMORY = (*accuracy.SUMS, "at_shortest")


def step_memory(steps: Any) -> dict[str, np.ndarray]:
    """What a resumed run needs of the struct `StepControl`."""
    kept = {name: getattr(steps, name).numpy().copy() for name in _CONTROL_MEMORY}
    return kept | {f"achieved_{name}": getattr(steps.achieved, name).numpy().copy() for name in _ACHIEVED_MEMORY}


def recalled(steps: Any, memory: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Restores what `step_memory` gave; returns the entries of `memory` that are not of the step control."""
    arrays = {name: getattr(steps, name) for name in _CONTROL_MEMORY}
    arrays |= {f"achieved_{name}": getattr(steps.achieved, name) for name in _ACHIEVED_MEMORY}
    for name, array in arrays.items():
        array.assign(memory[name])
    return {name: values for name, values in memory.items() if name not in arrays}


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
