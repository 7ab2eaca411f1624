"""The cell body: sums what the flagella hand to it and moves by the mobility of a prolate spheroid.

Each flagellum hands over the force at its anchor, the reaction -T_m m of the motor, the bearing torque -m x dE/de_0
of the universal joint (the part of the joint's torque across m, which the paper's form leaves out), and the reaction
to the contact of its nodes with the body surface.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.types import DeviceModel, DeviceState, Precision, structs


@functools.cache
def functions(p: Precision, body_contact: bool, bearing_torque: bool) -> SimpleNamespace:
    """Device functions: what one flagellum hands to the body, and the motion of one body."""
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    module = p.module("body_functions", _variant(body_contact, bearing_torque))

    @wp.func(module=module)
    def sum_flagellum(model: Model, state: State, k: wp.int32):
        first = model.first_node[k]
        m = state.tangent[first]
        force = state.force[first]
        torque = wp.cross(state.position[first], force) - model.motor_torque[k] * m
        if wp.static(bearing_torque):
            torque -= wp.cross(m, state.joint_before[first])
        if wp.static(body_contact):
            e = first + 1
            while e < model.first_node[k + 1]:
                reaction = -state.body_contact[e]
                force += reaction
                torque += wp.cross(state.position[e], reaction)
                e += 1
        state.flagellum_force[k] = force
        state.flagellum_torque[k] = torque

    @wp.func(module=module)
    def move(model: Model, state: State, c: wp.int32):
        force = vec3(real(0.0))
        torque = vec3(real(0.0))
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            force += state.flagellum_force[k]
            torque += state.flagellum_torque[k]
            k += 1
        axis = state.body_axis[c]
        force_along = wp.dot(axis, force) * axis
        torque_along = wp.dot(axis, torque) * axis
        state.body_velocity[c] = model.body_mobility_along[c] * force_along + model.body_mobility_across[c] * (
            force - force_along
        )
        state.body_spin[c] = model.body_spin_mobility[c] * torque_along + model.body_tumble_mobility[c] * (
            torque - torque_along
        )

    return SimpleNamespace(sum_flagellum=sum_flagellum, move=move)


@functools.cache
def _kernels(p: Precision, body_contact: bool, bearing_torque: bool) -> SimpleNamespace:
    Model, State = structs(p).Model, structs(p).State
    f = functions(p, body_contact, bearing_torque)
    sum_flagellum, move = f.sum_flagellum, f.move
    module = p.module("body", _variant(body_contact, bearing_torque))

    @wp.kernel(module=module)
    def sum_flagella(
        # Model:
        model: Model,
        # State:
        state: State,
    ):
        k = wp.tid()
        if state.active[model.cell_of[model.first_node[k]]] != 0:
            sum_flagellum(model, state, k)

    @wp.kernel(module=module)
    def move_all(
        # Model:
        model: Model,
        # State:
        state: State,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            move(model, state, c)

    return SimpleNamespace(sum_flagella=sum_flagella, move=move_all)


def _variant(body_contact: bool, bearing_torque: bool) -> str:
    return ("_contact" if body_contact else "") + ("_bearing" if bearing_torque else "")


def body_motion(model: DeviceModel, state: DeviceState) -> None:
    """Velocity [um/s] and angular velocity [rad/s] of every body, into `body_velocity` and `body_spin`."""
    kernels = _kernels(model.precision, model.switches.body_contact, model.switches.bearing_torque)
    inputs = [model.data, state.data]
    wp.launch(kernels.sum_flagella, model.flagellum_count, inputs=inputs, device=model.device)
    move_bodies(model, state)


def move_bodies(model: DeviceModel, state: DeviceState) -> None:
    """The same from the sums of every flagellum, `flagellum_force` and `flagellum_torque`."""
    kernels = _kernels(model.precision, model.switches.body_contact, model.switches.bearing_torque)
    wp.launch(kernels.move, model.cell_count, inputs=[model.data, state.data], device=model.device)
