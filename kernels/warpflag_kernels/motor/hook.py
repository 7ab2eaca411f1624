"""Bending of the hook: an elastic joint between the motor axis m and the filament's helix axis a.

a is the axis of the helix at rest, fixed in the axes of segment 1. With c = cos(beta) = m.a

    E = (k/2) |2 tan(beta/2)|^2 = 2 k |a x m|^2/(1 + c)^2,     k = k_0 (1 + |T_m|/T_s),

which grows without bound toward 180 degrees. The joint puts the torque t_h = -dE/dc a x m = 4 k/(1 + c)^2 a x m on
segment 1, as a pair of forces across its tangent and a torque about it, and -t_h on the body. The hook's twist
is in `rod/elastic.py`. The second derivatives of the bending are added to those of joint 0, so the linearised elastic
term has the change of these forces, too.

The stiffening takes the motor's torque as a given number, where that is not constant the one at the end of the last
step: it is no part of the derivatives.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.motor import torque
from warpflag_kernels.rod import comoving_chart, hessian


@functools.cache
def joint(p: Precision) -> SimpleNamespace:
    """Device functions: the helix axis in the lab, and the stiffness under the motor's torque."""
    real, Model, State = p.real, structs(p).Model, structs(p).State
    motor_torque = torque.functions(p).motor_torque
    module = p.module("hook_joint")

    @wp.func(module=module)
    def helix_axis(model: Model, state: State, k: wp.int32):
        """a of flagellum k in the lab."""
        e = model.first_node[k] + 1
        t = state.pose.tangent[e]
        e1 = state.pose.director[e]
        own = model.hook[0].helix_axis[k]
        return own[0] * e1 + own[1] * wp.cross(t, e1) + own[2] * t

    @wp.func(module=module)
    def stiffness(model: Model, state: State, k: wp.int32):
        """k of flagellum k [pN um/rad]."""
        torque = motor_torque(model, state, k)
        if state.motor.shape[0] > 0:  # noqa: SIM102 (a kernel evaluates both sides of an `and`)
            if state.motor[0].on_hook.shape[0] > 0:
                torque = state.motor[0].on_hook[k]
        stiffening = model.hook[0].stiffening[k] * wp.abs(torque)
        return model.hook[0].stiffness[k] * (real(1.0) + stiffening)

    @wp.func(module=module)
    def axis_rates(model: Model, state: State, k: wp.int32):
        """First derivatives of a, in the plane across it, by the vector of segment 1, by its spin and by m.

        A change of m is taken into that plane by the minimal rotation of m onto a.
        """
        i = model.first_node[k]
        m = state.pose.tangent[i]
        t = state.pose.tangent[i + 1]
        a = helix_axis(model, state, k)
        c = wp.dot(m, a)
        p_ = wp.cross(a, m)
        by_segment = -(wp.skew(a) * wp.skew(t)) / state.pose.length[i + 1]
        by_spin = wp.cross(t, a)
        carried = c * wp.identity(3, dtype=real) - wp.skew(p_) + wp.outer(p_, p_) / (real(1.0) + c)
        return by_segment, by_spin, carried

    return SimpleNamespace(helix_axis=helix_axis, stiffness=stiffness, axis_rates=axis_rates)


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of the term."""
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    helix_axis, stiffness = joint(p).helix_axis, joint(p).stiffness
    module = p.module("hook_functions")

    @wp.func(module=module)
    def torque_on_segment(model: Model, state: State, k: wp.int32):
        """t_h on segment 1 of flagellum k [pN um]."""
        m = state.pose.tangent[model.first_node[k]]
        a = helix_axis(model, state, k)
        c = real(1.0) + wp.dot(m, a)
        return (real(4.0) * stiffness(model, state, k) / (c * c)) * wp.cross(a, m)

    @wp.func(module=module)
    def pull(model: Model, state: State, e: wp.int32, k: wp.int32):
        """The force of the pair on the second node of segment 1 [pN]."""
        return wp.cross(torque_on_segment(model, state, k), state.pose.tangent[e]) / state.pose.length[e]

    @wp.func(module=module)
    def on_first(model: Model, state: State, e: wp.int32, k: wp.int32, force: vec3):
        if e == model.first_node[k] + 1:
            return force - pull(model, state, e, k)
        return force

    @wp.func(module=module)
    def on_second(model: Model, state: State, e: wp.int32, k: wp.int32, force: vec3):
        if e == model.first_node[k] + 1:
            return force + pull(model, state, e, k)
        return force

    @wp.func(module=module)
    def on_spin(model: Model, state: State, e: wp.int32, k: wp.int32, torque: real):
        if e == model.first_node[k] + 1:
            return torque + wp.dot(torque_on_segment(model, state, k), state.pose.tangent[e])
        return torque

    @wp.func(module=module)
    def on_body(model: Model, state: State, k: wp.int32, force: vec3, torque: vec3):
        return force, torque - torque_on_segment(model, state, k)

    return SimpleNamespace(on_first=on_first, on_second=on_second, on_spin=on_spin, on_body=on_body)


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State, Stiffness = structs(p).Model, structs(p).State, hessian.struct(p)
    Chart = comoving_chart.struct(p)
    helix_axis, stiffness, axis_rates = joint(p).helix_axis, joint(p).stiffness, joint(p).axis_rates
    module = p.module("hook")

    @wp.kernel(module=module)
    def energies(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        energy_out: wp.array(dtype=vec3),
    ):
        k = wp.tid()
        first = model.first_node[k]
        m = state.pose.tangent[first]
        a = helix_axis(model, state, k)
        c = real(1.0) + wp.dot(m, a)
        bend = real(2.0) * stiffness(model, state, k) * wp.length_sq(wp.cross(a, m)) / (c * c)
        energy_out[first] = energy_out[first] + vec3(bend, real(0.0), real(0.0))

    @wp.kernel(module=module)
    def add_stiffness(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        out: Stiffness,
    ):
        k = wp.tid()
        i = model.first_node[k]
        if state.active[model.cell_of[i]] == 0:
            return
        one, two, three = real(1.0), real(2.0), real(3.0)
        m = state.pose.tangent[i]
        t = state.pose.tangent[i + 1]
        length = state.pose.length[i + 1]
        a = helix_axis(model, state, k)
        c = wp.dot(m, a)
        q = two / (one + c)  # 1/cos^2(beta/2)
        s = stiffness(model, state, k)
        p_ = wp.cross(a, m)
        # Second derivatives on the sphere of a: E'' along the meridian through m, E' cot(beta) across it. Both are
        # k q^2 c and, along the meridian, k q^3 sin^2 beta more; the one across is negative beyond 90 deg and left out.
        around = s * q * q * wp.max(c, real(0.0))
        along = s * q * q * q
        if c < real(0.0):
            along = s * q * (three * q - two) / (one - c * c)
        by_segment, by_spin, carried = axis_rates(model, state, k)
        # Derivatives of the cosine c.
        cosine_by_segment = wp.cross(p_, t) / length
        cosine_by_spin = wp.dot(p_, t)
        out.ee[i] = out.ee[i] + around * (wp.transpose(carried) * carried) + along * wp.outer(a, a)
        out.ff[i] = (
            out.ff[i]
            + around * (wp.transpose(by_segment) * by_segment)
            + along * wp.outer(cosine_by_segment, cosine_by_segment)
        )
        out.fe[i] = out.fe[i] - around * (wp.transpose(by_segment) * carried) + along * wp.outer(cosine_by_segment, a)
        out.e_second[i] = out.e_second[i] - around * (wp.transpose(carried) * by_spin) + (along * cosine_by_spin) * a
        out.f_second[i] = (
            out.f_second[i]
            + around * (wp.transpose(by_segment) * by_spin)
            + (along * cosine_by_spin) * cosine_by_segment
        )
        spin = around * wp.dot(by_spin, by_spin) + along * cosine_by_spin * cosine_by_spin
        out.spins[i] = out.spins[i] + vec3(real(0.0), real(0.0), spin)

    @wp.kernel(module=module)
    def follow(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        # Out:
        state: State,
    ):
        k = wp.tid()
        c = model.cell_of[model.first_node[k]]
        if state.active[c] != 0 and chart.commit[c] != 0:
            state.motor[0].on_hook[k] = state.motor[0].torque[k]

    return SimpleNamespace(energies=energies, add_stiffness=add_stiffness, follow=follow)


def add_energy(model: DeviceModel, state: DeviceState, energy_out: wp.array) -> None:
    """Adds the bending energy of every hook to that of its tripod [pN um], shape [element_count, 3]."""
    kernel = _kernels(model.precision).energies
    wp.launch(kernel, model.flagellum_count, inputs=[model.data, state.data, energy_out], device=model.device)


def add_stiffness(model: DeviceModel, state: DeviceState, stiffness: Any) -> None:
    """Adds the second derivatives of the hooks' energy to those of their joints, struct `Stiffness`."""
    kernel = _kernels(model.precision).add_stiffness
    wp.launch(kernel, model.flagellum_count, inputs=[model.data, state.data, stiffness], device=model.device)


def follow(model: DeviceModel, state: DeviceState, chart: Any, _control: Any, _counted: bool) -> None:
    """Sets the torque by which each hook stiffens to that of its motor, once the step has been committed."""
    kernel = _kernels(model.precision).follow
    wp.launch(kernel, model.flagellum_count, inputs=[model.data, chart, state.data], device=model.device)


HOOK = Term("hook", functions=functions, stiffness=add_stiffness)

HOOK_THAT_STIFFENS = Term("hook that stiffens", after_step=follow, carried=("motor.on_hook",))
"""No force of its own: it keeps the torque by which the hook stiffens, where the motor's torque is not constant."""
