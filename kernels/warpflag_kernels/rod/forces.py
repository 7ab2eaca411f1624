"""Total force on every node and torque on every spin: gathers elastic, motor and steric shares.

The net force of node i is the difference of the energy gradients of its two segments; nothing is scattered. On r_0,
which belongs to the body, the entry holds what the anchor hands to the body.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.types import DeviceModel, DeviceState, Precision, structs


@functools.cache
def functions(p: Precision, steric: bool, body_contact: bool) -> SimpleNamespace:
    """Device function: the sums of one node and its spin."""
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    module = p.module("forces_functions", _variant(steric, body_contact))

    @wp.func(module=module)
    def segment_gradient(model: Model, state: State, e: wp.int32, k: wp.int32):
        """dE/d(segment vector) of segment e >= 1 of flagellum k [pN]."""
        strain = state.length[e] / model.segment_length[k] - real(1.0)
        stretch = (model.stretching_stiffness[k] * strain) * state.tangent[e]
        return state.joint_before[e] + state.joint_after[e - 1] + stretch

    @wp.func(module=module)
    def gather(model: Model, state: State, e: wp.int32, k: wp.int32):
        """Force on node e of flagellum k and torque on its spin."""
        force = vec3(real(0.0))
        torque = -state.joint_spin_before[e]
        if e + 1 < model.first_node[k + 1]:
            force += segment_gradient(model, state, e + 1, k)
            if wp.static(steric):
                force += state.steric_first[e + 1]
        if e == model.first_node[k]:
            state.force[e] = force
            state.spin_torque[e] = torque + model.motor_torque[k]
            return
        force -= segment_gradient(model, state, e, k)
        torque -= state.joint_spin_after[e - 1]
        if wp.static(steric):
            force += state.steric_second[e]
        if wp.static(body_contact):
            force += state.body_contact[e]
        state.force[e] = force
        state.spin_torque[e] = torque

    return SimpleNamespace(gather=gather)


@functools.cache
def _kernel(p: Precision, steric: bool, body_contact: bool):
    Model, State = structs(p).Model, structs(p).State
    gather = functions(p, steric, body_contact).gather

    @wp.kernel(module=p.module("forces", _variant(steric, body_contact)))
    def total(
        # Model:
        model: Model,
        # State:
        state: State,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] != 0:
            gather(model, state, e, model.flagellum_of[e])

    return total


def _variant(steric: bool, body_contact: bool) -> str:
    return ("_steric" if steric else "") + ("_body" if body_contact else "")


def total_forces(model: DeviceModel, state: DeviceState) -> None:
    """Force on every node [pN] and torque on every spin [pN um], into `force` and `spin_torque`."""
    kernel = _kernel(model.precision, model.switches.steric, model.switches.body_contact)
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data], device=model.device)
