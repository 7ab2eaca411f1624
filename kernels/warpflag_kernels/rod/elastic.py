"""Elastic forces of the flagella: bend, twist and stretch of a discrete Kirchhoff rod, exact gradient.

Joint i couples segments i and i + 1 with tangents t, u and strain h Omega = (w1, w2, w3):

    E = (1/2h) [A (w1 - w1^0)^2 + A (w2 - w2^0)^2 + C (w3 - w3^0)^2],     stretch: (K h / 2) (|s|/h - 1)^2

(the paper's Kirchhoff density; its stretching term has no rest length as printed, here it has one). The motor
joint 0 is a universal joint: no bending rigidity (that of a hook is `motor/hook.py`), no intrinsic twist,
`hook_rigidity` in place of C. Directors follow
a moving tangent by the minimal rotation, so gradients are taken with respect to segment vectors and spin angles.

The bearing of the universal joint hands the torque -m x dE/ds_0 to the body, the part of the joint's torque across the
motor axis m, which the paper's form leaves out; it is a term of its own. s is a segment's vector; s_0 stands for m.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.rod import hessian, rotations


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of the elastic term, and `joint`, the energy gradients of one joint."""
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    r = rotations.functions(p)
    twist, angle, joint_strain = r.twist, r.angle, r.joint_strain

    module = p.module("elastic_functions")

    @wp.func(module=module)
    def joint(model: Model, state: State, e: wp.int32, k: wp.int32):
        """Energy gradients of the joint between segments e and e + 1 of flagellum k."""
        per_length = real(1.0) / model.rod.segment_length[k]
        t = state.pose.tangent[e]
        u = state.pose.tangent[e + 1]
        a1 = state.pose.director[e]
        b1 = state.pose.director[e + 1]
        per_chi = real(1.0) / (real(1.0) + wp.dot(t, u))
        kb = wp.cross(t, u) * (real(2.0) * per_chi)
        sine, cosine = twist(t, u, a1, b1)
        turned = angle(sine, cosine)
        if e == model.first_node[k]:
            if model.rod.hook_rigidity[k] == real(0.0):
                return  # a free end: no gradients, which stay zero, at any angle to the tripod
            moment = model.rod.hook_rigidity[k] * per_length * turned
            gradient = (real(0.5) * moment) * kb
            state.joint_before[e] = gradient
            state.joint_after[e] = gradient / state.pose.length[e + 1]
            state.joint_spin_before[e] = -moment
            state.joint_spin_after[e] = moment
            return
        a2 = wp.cross(t, a1)
        b2 = wp.cross(u, b1)
        rest = model.rod.rest_strain[e]
        w1 = real(0.5) * wp.dot(kb, a1 + b1)
        w2 = real(0.5) * wp.dot(kb, a2 + b2)
        stiffness = model.rod.bending_rigidity[k] * per_length
        m1 = stiffness * (w1 - rest[0])
        m2 = stiffness * (w2 - rest[1])
        m3 = model.rod.twist_rigidity[k] * per_length * (turned - rest[2])
        common = (real(0.5) * m3) * kb - ((m1 * w1 + m2 * w2) * per_chi) * (t + u)
        weighted = ((a1 + b1) * m1 + (a2 + b2) * m2) * per_chi
        state.joint_before[e] = (common + wp.cross(u, weighted)) / state.pose.length[e]
        state.joint_after[e] = (common - wp.cross(t, weighted)) / state.pose.length[e + 1]
        state.joint_spin_before[e] = real(0.5) * (m1 * wp.dot(kb, a2) - m2 * wp.dot(kb, a1)) - m3
        state.joint_spin_after[e] = real(0.5) * (m1 * wp.dot(kb, b2) - m2 * wp.dot(kb, b1)) + m3

    @wp.func(module=module)
    def in_flagellum(model: Model, state: State, k: wp.int32, c: wp.int32):
        e = model.first_node[k]
        while e + 1 < model.first_node[k + 1]:
            joint(model, state, e, k)
            e += 1

    @wp.func(module=module)
    def gradient(model: Model, state: State, e: wp.int32, k: wp.int32):
        """dE/d(segment vector) of segment e >= 1 of flagellum k [pN]."""
        strain = state.pose.length[e] / model.rod.segment_length[k] - real(1.0)
        stretch = (model.rod.stretching_stiffness[k] * strain) * state.pose.tangent[e]
        return state.joint_before[e] + state.joint_after[e - 1] + stretch

    @wp.func(module=module)
    def on_first(model: Model, state: State, e: wp.int32, k: wp.int32, force: vec3):
        return force + gradient(model, state, e, k)

    @wp.func(module=module)
    def on_second(model: Model, state: State, e: wp.int32, k: wp.int32, force: vec3):
        return force - gradient(model, state, e, k)

    @wp.func(module=module)
    def energies(model: Model, state: State, e: wp.int32, k: wp.int32):
        """Bending, twist and stretching energy of segment e and the joint after it [pN um]."""
        first = model.first_node[k]
        h = model.rod.segment_length[k]
        bend = real(0.0)
        twist = real(0.0)
        stretch = real(0.0)
        if e > first:
            strain = state.pose.length[e] / h - real(1.0)
            stretch = real(0.5) * model.rod.stretching_stiffness[k] * h * strain * strain
        if e + 1 < model.first_node[k + 1]:
            w = joint_strain(
                state.pose.tangent[e], state.pose.tangent[e + 1], state.pose.director[e], state.pose.director[e + 1]
            )
            if e == first and model.rod.hook_rigidity[k] == real(0.0):
                twist = real(0.0)
            elif e == first:
                twist = real(0.5) * model.rod.hook_rigidity[k] / h * w[2] * w[2]
            else:
                d = w - model.rod.rest_strain[e]
                bend = real(0.5) * model.rod.bending_rigidity[k] / h * (d[0] * d[0] + d[1] * d[1])
                twist = real(0.5) * model.rod.twist_rigidity[k] / h * d[2] * d[2]
        return vec3(bend, twist, stretch)

    @wp.func(module=module)
    def energy(model: Model, state: State, e: wp.int32, k: wp.int32, energy: wp.float64):
        x = energies(model, state, e, k)
        return energy + wp.float64(x[0]) + wp.float64(x[1]) + wp.float64(x[2])

    return SimpleNamespace(
        joint=joint,
        energies=energies,
        energy=energy,
        in_flagellum=in_flagellum,
        on_first=on_first,
        on_second=on_second,
        on_spin=_on_spin(p),
    )


@functools.cache
def _on_spin(p: Precision):
    """Device function: adds the joints' torque on the spin of a segment."""
    real, Model, State = p.real, structs(p).Model, structs(p).State

    @wp.func(module=p.module("elastic_functions"))
    def on_spin(model: Model, state: State, e: wp.int32, k: wp.int32, torque: real):
        torque -= state.joint_spin_before[e]
        if e > model.first_node[k]:
            torque -= state.joint_spin_after[e - 1]
        return torque

    return on_spin


@functools.cache
def _change_functions(p: Precision) -> SimpleNamespace:
    """Device functions of the elastic term's first variation."""
    vec3, Model, State = p.vec3, structs(p).Model, structs(p).State
    module = p.module("elastic_change_functions")

    @wp.func(module=module)
    def change(state: State, e: wp.int32):
        """Change of dE/d(segment vector) of segment e >= 1 [pN]."""
        return state.joint_before[e] + state.joint_after[e - 1] + state.stretch_change[e]

    @wp.func(module=module)
    def on_first(model: Model, state: State, e: wp.int32, k: wp.int32, force: vec3):
        return force + change(state, e)

    @wp.func(module=module)
    def on_second(model: Model, state: State, e: wp.int32, k: wp.int32, force: vec3):
        return force - change(state, e)

    return SimpleNamespace(on_first=on_first, on_second=on_second, on_spin=_on_spin(p))


@functools.cache
def _bearing_functions(p: Precision) -> SimpleNamespace:
    """Device functions of the bearing torque."""
    vec3, Model, State = p.vec3, structs(p).Model, structs(p).State

    @wp.func(module=p.module("bearing_functions"))
    def on_body(model: Model, state: State, k: wp.int32, force: vec3, torque: vec3):
        first = model.first_node[k]
        return force, torque - wp.cross(state.pose.tangent[first], state.joint_before[first])

    return SimpleNamespace(on_body=on_body)


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    vec3 = p.vec3
    Model, State = structs(p).Model, structs(p).State
    joint, energies = functions(p).joint, functions(p).energies

    @wp.kernel(module=p.module("elastic"))
    def joint_gradients(
        # Model:
        model: Model,
        # Out:
        state: State,
    ):
        e = wp.tid()
        k = model.flagellum_of[e]
        if e + 1 == model.first_node[k + 1] or state.active[model.cell_of[e]] == 0:
            return  # the last segment has no joint after it: its entries stay zero
        joint(model, state, e, k)

    @wp.kernel(module=p.module("elastic_energy"))
    def energy(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        energy_out: wp.array(dtype=vec3),
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] == 0:
            return
        k = model.flagellum_of[e]
        energy_out[e] = energies(model, state, e, k)

    return SimpleNamespace(joint_gradients=joint_gradients, energy=energy)


def joint_gradients(model: DeviceModel, state: DeviceState) -> None:
    """Energy gradients of every joint: by segment vectors into `joint_before/after` [pN], by spins into
    `joint_spin_before/after` [pN um]; that of the hook by the unit vector m is a torque [pN um]."""
    kernel = _kernels(model.precision).joint_gradients
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data], device=model.device)


def elastic_energy(model: DeviceModel, state: DeviceState, energy_out: wp.array) -> None:
    """Bending, twist and stretching energy per element of active cells [pN um], shape [element_count, 3]."""
    kernel = _kernels(model.precision).energy
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data, energy_out], device=model.device)


ELASTIC = Term(
    "elastic",
    launch=joint_gradients,
    functions=functions,
    linearised=Term("elastic change", launch=hessian.joint_changes, functions=_change_functions),
    stiffness=hessian.joint_stiffness,
)
BEARING = Term("bearing", functions=_bearing_functions, linearised=Term("bearing", functions=_bearing_functions))
