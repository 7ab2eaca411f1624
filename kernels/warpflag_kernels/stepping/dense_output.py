"""Dense output: the frames of a record are taken from inside steps, on the device, and no step ends at their times.

Frames that fall into an accepted step are measured on its path (`step_path`) and stored in slots (`frame_slots`), which
the host reads in blocks: frames cost no steps and no transfers of their own, and steps do not depend on them.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import clock
from warpflag_kernels.base.clock import NO_FAULT, Control
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import pair_forces
from warpflag_kernels.rod import comoving_chart, elastic
from warpflag_kernels.stepping import frame_slots, step_path
from warpflag_kernels.stepping.frame_slots import DenseOutput


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real = p.real
    Model, State, Chart = structs(p).Model, structs(p).State, comoving_chart.struct(p)
    Dense = frame_slots.struct(p)
    turns = comoving_chart.turns(p)
    motor_turn, body_turn = turns.motor_turn, turns.body_turn
    advanced, no_fault = clock.functions().advanced, wp.constant(wp.int32(NO_FAULT))
    module = p.module("dense_slots")

    @wp.func(module=module)
    def ask(dense: Dense, c: wp.int32):
        """Whether the next frame of cell c is due."""
        i = dense.taken[c]
        dense.due[c] = 0
        if i < dense.count[c] and dense.time[c * dense.slots + i] <= dense.end[c]:
            dense.due[c] = 1
            dense.any_due[0] = 1

    @wp.kernel(module=module)
    def look(
        # State:
        state: State,
        chart: Chart,
        control: Control,
        counted: wp.int32,
        # Out:
        dense: Dense,
    ):
        """Whether a frame falls into the step just accepted; `counted`: whether the clock has reached its end."""
        c = wp.tid()
        dense.due[c] = 0
        if state.active[c] == 0 or chart.commit[c] == 0 or control.fault[c] != no_fault:
            return
        dense.end[c] = control.time[c]
        dense.steps[c] = control.steps[c]
        dense.begin[c] = control.time[c] - control.step[c]
        if counted == 0:
            dense.begin[c] = control.time[c]
            dense.end[c] = advanced(control, c)
            dense.steps[c] += 1
        ask(dense, c)

    @wp.kernel(module=module)
    def look_again(
        # Out:
        dense: Dense,
    ):
        ask(dense, wp.tid())

    @wp.kernel(module=module)
    def store(
        # Model:
        model: Model,
        # State:
        state: State,
        energy: wp.array(dtype=p.vec3),
        steric: wp.array(dtype=real),
        # Out:
        dense: Dense,
    ):
        e = wp.tid()
        if e == 0:
            dense.any_due[0] = 0
        c = model.cell_of[e]
        if dense.due[c] == 0:
            return
        slot = dense.taken[c]
        i = slot * model.cell_of.shape[0] + e
        dense.position[i] = state.pose.position[e]
        dense.director[i] = state.pose.director[e]
        dense.energy[i] = energy[e]
        if dense.form.shape[0] > 0:
            dense.form[i] = state.forms[0].form[e]
        if dense.steric.shape[0] > 0:
            dense.steric[i] = steric[e]
        k = model.flagellum_of[e]
        if e == model.first_node[k]:
            flagella = model.first_node.shape[0] - 1
            turned = motor_turn(model, dense.start, state.pose, e, k, c)
            dense.motor_angle[slot * flagella + k] = dense.start_motor_angle[k] + turned
            if dense.motor_torque.shape[0] > 0:
                dense.motor_torque[slot * flagella + k] = state.motor[0].torque[k]
            if k == model.first_flagellum[c]:
                i = slot * (model.first_flagellum.shape[0] - 1) + c
                dense.step[i] = dense.steps[c]
                dense.body_position[i] = state.pose.body_position[c]
                dense.body_orientation[i] = state.pose.body_orientation[c]
                dense.body_angle[i] = dense.start_body_angle[c] + body_turn(dense.body[c], state.pose.body_axis[c])

    @wp.kernel(module=module)
    def go_on(
        # Out:
        dense: Dense,
        control: Control,
    ):
        c = wp.tid()
        if dense.due[c] == 0:
            return
        dense.taken[c] += 1
        ask(dense, c)
        if dense.taken[c] == dense.count[c]:
            control.rest[c] = 1  # until the host has read the slots

    return SimpleNamespace(look=look, look_again=look_again, store=store, go_on=go_on)


def take(
    model: DeviceModel, state: DeviceState, chart: Any, control: Control, dense: DenseOutput, counted: bool
) -> None:
    """Takes the frames that fall into the step just accepted; a part of a pass, before the step is committed.

    Args:
        model, state, chart, control: of the batch.
        dense: the slots.
        counted: whether the clocks have been advanced to the end of the step.
    """
    path, device = step_path.kernels(model.precision), model.device
    inputs = [state.data, chart, control, int(counted), dense.data]
    wp.launch(_kernels(model.precision).look, model.cell_count, inputs=inputs, device=device)
    inputs = [model.data, state.data, chart, dense.data]

    def kept() -> None:
        wp.launch(path.keep_path, model.element_count, inputs=inputs, device=device)
        _take_one(model, control, dense)

    wp.capture_while(dense.data.any_due, kept)
    wp.launch(path.remember, model.element_count, inputs=inputs, device=device)


def take_rest(model: DeviceModel, control: Control, dense: DenseOutput) -> None:
    """Takes further frames of the last steps, after the slots were read and given new times."""
    kernel = _kernels(model.precision).look_again
    wp.launch(kernel, model.cell_count, inputs=[dense.data], device=model.device)
    while dense.data.any_due.numpy()[0] > 0:
        _take_one(model, control, dense)


def _take_one(model: DeviceModel, control: Control, dense: DenseOutput) -> None:
    """One frame of every cell in which one is due."""
    path, slot = step_path.kernels(model.precision), _kernels(model.precision)
    device, pose = model.device, dense.state.data.pose
    wp.launch(path.place_bodies, model.cell_count, inputs=[dense.data, pose], device=device)
    wp.launch(path.place_flagella, model.flagellum_count, inputs=[model.data, dense.data, pose], device=device)
    elastic.elastic_energy(model, dense.state, dense.energy)
    if model.switches.steric:
        pair_forces.steric_magnitudes(model, dense.state, dense.steric)
    inputs = [model.data, dense.state.data, dense.energy, dense.steric, dense.data]
    wp.launch(slot.store, model.element_count, inputs=inputs, device=device)
    wp.launch(slot.go_on, model.cell_count, inputs=[dense.data, control], device=device)
