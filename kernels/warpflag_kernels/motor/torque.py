"""The motor's torque T_m: on the tripod about the motor axis m, its reaction -T_m m on the body."""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import structs


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of the term, and `motor_torque`, the motor's law."""
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    module = p.module("motor_functions")

    @wp.func(module=module)
    def motor_torque(model: Model, state: State, k: wp.int32):
        """Torque of the motor of flagellum k about its axis [pN um]."""
        return model.motor.torque[k]

    @wp.func(module=module)
    def on_spin(model: Model, state: State, e: wp.int32, k: wp.int32, torque: real):
        if e == model.first_node[k]:
            return torque + motor_torque(model, state, k)
        return torque

    @wp.func(module=module)
    def on_body(model: Model, state: State, k: wp.int32, force: vec3, torque: vec3):
        axis = state.pose.tangent[model.first_node[k]]
        return force, torque - motor_torque(model, state, k) * axis

    return SimpleNamespace(motor_torque=motor_torque, on_spin=on_spin, on_body=on_body)


MOTOR = Term("motor", functions=functions)
