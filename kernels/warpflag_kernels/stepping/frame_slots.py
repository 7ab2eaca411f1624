"""Slots for the frames that are taken inside steps, and what is known of the step into which they fall."""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, allocate_pose, structs
from warpflag_kernels.contact import neighbours
from warpflag_kernels.rod.comoving_chart import vec6d

MOST_SLOTS = 256  # frames of a cell between two transfers to the host
MOST_BYTES = 1 << 26  # of all slots together


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Dense`; C cells, K flagella, E elements, M slots of each cell."""
    real, vec3, vec4, Pose = p.real, p.vec3, p.vec4, structs(p).Pose

    @wp.struct
    class Dense:
        slots: wp.int32  # M
        time: wp.array(dtype=wp.float64)  # [C M], when the frames of this block are, in ascending order [s]
        count: wp.array(dtype=wp.int32)  # [C], frames of this block
        taken: wp.array(dtype=wp.int32)  # [C], how many of them are in their slots
        due: wp.array(dtype=wp.int32)  # [C], 1: the next one falls into the last step
        any_due: wp.array(dtype=wp.int32)  # [1]
        # The pose before the last step and the step that led from it; poses without lengths and body axis.
        before: Pose
        step_before: wp.array(dtype=wp.float64)  # [C]; 0: there is none [s]
        # The step into which frames fall: its times, the pose and the angles at its start, its path.
        begin: wp.array(dtype=wp.float64)  # [C] [s]
        end: wp.array(dtype=wp.float64)  # [C] [s]
        steps: wp.array(dtype=wp.int32)  # [C], steps taken at its end
        start: Pose
        start_motor_angle: wp.array(dtype=wp.float64)  # [K] [rad]
        start_body_angle: wp.array(dtype=wp.float64)  # [C] [rad]
        linear: wp.array(dtype=vec4)  # [E], q_1: rotation vector of a triad [rad], length of its segment [um]
        square: wp.array(dtype=vec4)  # [E], q_2
        body_linear: wp.array(dtype=vec6d)  # [C], q_1: place [um], rotation vector [rad]
        body_square: wp.array(dtype=vec6d)  # [C], q_2
        body: wp.array(dtype=vec6d)  # [C], x at the frame
        # Slots: block after block of all cells, as in the state.
        step: wp.array(dtype=wp.int32)  # [M C]
        position: wp.array(dtype=vec3)  # [M E], relative to the body's centre [um]
        director: wp.array(dtype=vec3)  # [M E]
        energy: wp.array(dtype=vec3)  # [M E], bending, twist, stretching [pN um]
        steric: wp.array(dtype=real)  # [M E], sum of |F| over the pairs of a segment [pN]
        body_position: wp.array(dtype=wp.vec3d)  # [M C] [um]
        body_orientation: wp.array(dtype=wp.quatd)  # [M C]
        motor_angle: wp.array(dtype=wp.float64)  # [M K] [rad]
        body_angle: wp.array(dtype=wp.float64)  # [M C] [rad]
        form: wp.array(dtype=wp.int32)  # [M E], of the joints; only with polymorphs
        motor_torque: wp.array(dtype=real)  # [M K], in the step with the frame; only if not constant [pN um]

    return Dense


@dataclass(frozen=True)
class DenseOutput:
    """Dense output of a batch.

    Attributes:
        data: the struct `Dense`.
        state: what frames are measured on: a state with a pose of its own, active where a frame is due.
        energy: elastic energy of that pose [pN um], shape [element_count, 3].
        steric: contact force of that pose [pN], shape [element_count].
    """

    data: Any
    state: DeviceState
    energy: Any
    steric: Any

    @property
    def slots(self) -> int:
        """Frames of each cell that fit into one block."""
        return int(self.data.slots)

    def memory(self) -> dict[str, Any]:
        """Arrays, by name, that carry over from one step to the next, and into checkpoints."""
        pose = ("position", "tangent", "director", "body_position", "body_orientation")
        kept = {name: getattr(self.data.before, name) for name in pose}
        return {**kept, "step_before": self.data.step_before}


def allocate(model: DeviceModel, state: DeviceState) -> DenseOutput:
    """Empty slots, as many as `MOST_SLOTS` and `MOST_BYTES` allow, and no frame due."""
    p, device = model.precision, model.device
    cells, flagella, elements = model.cell_count, model.flagellum_count, model.element_count

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=device)

    d = struct(p)()
    bytes_per_frame = elements * 10 * wp.types.type_size_in_bytes(p.real) + cells * 100
    m = d.slots = max(1, min(MOST_SLOTS, MOST_BYTES // bytes_per_frame))
    d.time = zeros(cells * m, wp.float64)
    d.begin, d.end, d.step_before, d.start_body_angle = (zeros(cells, wp.float64) for _ in range(4))
    d.count, d.taken, d.due, d.steps = (zeros(cells, wp.int32) for _ in range(4))
    d.any_due = zeros(1, wp.int32)
    allocate_pose(p, cells, elements, device, d.before)
    allocate_pose(p, cells, elements, device, d.start)
    d.start_motor_angle = zeros(flagella, wp.float64)
    d.linear, d.square = zeros(elements, p.vec4), zeros(elements, p.vec4)
    d.body_linear, d.body_square, d.body = (zeros(cells, vec6d) for _ in range(3))
    d.step, d.body_angle = zeros(m * cells, wp.int32), zeros(m * cells, wp.float64)
    d.position, d.director, d.energy = (zeros(m * elements, p.vec3) for _ in range(3))
    d.steric = zeros(m * elements if model.switches.steric else 0, p.real)
    d.body_position, d.body_orientation = zeros(m * cells, wp.vec3d), zeros(m * cells, wp.quatd)
    d.motor_angle = zeros(m * flagella, wp.float64)
    d.form = zeros(m * elements if model.switches.has("polymorphs") else 0, wp.int32)
    d.motor_torque = zeros(m * flagella if model.switches.has("motor law") else 0, p.real)

    own = structs(p).State()
    for name in own._cls.vars:  # what is measured on frames reads none of the others
        if name not in ("pose", "active"):
            setattr(own, name, getattr(state.data, name))
    allocate_pose(p, cells, elements, device, own.pose)
    own.active = d.due
    measured = DeviceState(own, state.optional, state.pairs, state.shell, neighbours.allocate(model))
    return DenseOutput(d, measured, zeros(elements, p.vec3), zeros(elements, p.real))
