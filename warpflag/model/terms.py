"""The stages of one right-hand side that a scene requires, in order. A stage it does not need does not exist here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from warpflag_kernels.base.types import DeviceModel, DeviceState, Switches
from warpflag_kernels.contact import steric
from warpflag_kernels.fluid import body, node_velocity
from warpflag_kernels.rod import elastic, forces
from warpflag_kernels.stepping import whole_cell

__all__ = ["Stage", "launch_right_hand_side", "right_hand_side"]


@dataclass(frozen=True)
class Stage:
    """One step of the right-hand side: its name and the function that launches its kernels."""

    name: str
    launch: Callable[[DeviceModel, DeviceState], None]


def right_hand_side(switches: Switches) -> tuple[Stage, ...]:
    """From positions and directors to velocities: the stages that these switches ask for."""
    stages = [Stage("elastic", elastic.joint_gradients)]
    if switches.steric:
        stages.append(Stage("steric", steric.segment_contact))
    if switches.body_contact:
        stages.append(Stage("body contact", steric.body_contact))
    terms = switches.pairs + (", terms in float32" if switches.short_pairs else "")
    pairs = "local drag" if switches.pairs == "none" else f"local drag and pair sum ({terms})"
    stages += [
        Stage("forces", forces.total_forces),
        Stage("body", body.body_motion),
        Stage(pairs, node_velocity.node_velocities),
    ]
    return tuple(stages)


def launch_right_hand_side(model: DeviceModel, state: DeviceState) -> None:
    """Forces, torques and velocities at the current evaluation point: on a CPU in one launch, else stage by stage."""
    if model.one_thread_per_cell:
        whole_cell.right_hand_side(model, state)
        return
    for stage in right_hand_side(model.switches):
        stage.launch(model, state)
