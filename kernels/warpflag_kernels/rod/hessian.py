"""Second derivatives of the elastic energy of every joint and segment.

A joint's energy depends on two segment vectors e, f and their spins. With W = m1 w1 + m2 w2, the sum of bending moments
times strains, and S_e, S_f the directors weighted by the moments, the closed forms below are those of discrete elastic
rods (Bergou 2010), written for directors that follow their tangents. They are the symmetric part: the antisymmetric one
is half the net spin torque of a segment, which its small spin drag keeps near zero.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.rod import chain_chart, rotations


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Stiffness`: second derivatives per joint with respect to (e, f, spin of e, spin of f)."""
    vec3, mat33 = p.vec3, p.mat33

    @wp.struct
    class Stiffness:
        ee: wp.array(dtype=mat33)  # [E] [pN/um]
        ff: wp.array(dtype=mat33)  # [E]
        fe: wp.array(dtype=mat33)  # [E], rows f, columns e
        e_first: wp.array(dtype=vec3)  # [E], e with the spin of e [pN]
        e_second: wp.array(dtype=vec3)  # [E], e with the spin of f
        f_first: wp.array(dtype=vec3)  # [E]
        f_second: wp.array(dtype=vec3)  # [E]
        spins: wp.array(dtype=vec3)  # [E]: first-first, first-second, second-second [pN um]
        stretch: wp.array(dtype=mat33)  # [E], of segment i [pN/um]

    return Stiffness


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State, Stiffness = structs(p).Model, structs(p).State, struct(p)
    Increment, displacement = chain_chart.types(p).Increment, chain_chart.displacement(p)
    twist_angle = rotations.functions(p).twist_angle
    module = p.module("hessian")

    @wp.func(module=module)
    def symmetric(a: vec3, b: vec3):
        return wp.outer(a, b) + wp.outer(b, a)

    @wp.kernel(module=module)
    def joints(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        stiffness: Stiffness,
    ):
        i = wp.tid()
        if state.active[model.cell_of[i]] == 0:
            return
        k = model.flagellum_of[i]
        first = model.first_node[k]
        h = model.rod.segment_length[k]
        t = state.pose.tangent[i]
        le = state.pose.length[i]
        identity = wp.identity(3, dtype=real)
        tt = wp.outer(t, t)
        if i > first:
            stretching = model.rod.stretching_stiffness[k]
            strain = le / h - real(1.0)
            stiffness.stretch[i] = (stretching / h) * tt + (stretching * strain / le) * (identity - tt)
        if i + 1 == model.first_node[k + 1]:
            return
        if i == first and model.rod.hook_rigidity[k] == real(0.0):
            return  # a free end: all of it stays zero
        u = state.pose.tangent[i + 1]
        lf = state.pose.length[i + 1]
        a1 = state.pose.director[i]
        b1 = state.pose.director[i + 1]
        chi = real(1.0) + wp.dot(t, u)
        kb = wp.cross(t, u) * (real(2.0) / chi)
        tm = (t + u) / chi
        twist = twist_angle(t, u, a1, b1)
        half = real(0.5)
        quarter = real(0.25)
        c3 = model.rod.twist_rigidity[k] / h
        w3 = twist - model.rod.rest_strain[i][2]
        if i == first:
            c3 = model.rod.hook_rigidity[k] / h
            w3 = twist
        m3 = c3 * w3
        # Bending. That of the hook, joint 0, is added by `motor/hook.py`.
        c = real(0.0)
        m1 = real(0.0)
        m2 = real(0.0)
        a2 = wp.cross(t, a1)
        b2 = wp.cross(u, b1)
        w1 = half * wp.dot(kb, a1 + b1)
        w2 = half * wp.dot(kb, a2 + b2)
        if i > first:
            c = model.rod.bending_rigidity[k] / h
            m1 = c * (w1 - model.rod.rest_strain[i][0])
            m2 = c * (w2 - model.rod.rest_strain[i][1])
        d1 = (a1 + b1) / chi
        d2 = (a2 + b2) / chi
        # Derivatives of w1, w2 with respect to the spins.
        ka1 = half * wp.dot(kb, a1)
        ka2 = half * wp.dot(kb, a2)
        kb1 = half * wp.dot(kb, b1)
        kb2 = half * wp.dot(kb, b2)
        big_w = m1 * w1 + m2 * w2
        se = m1 * a1 + m2 * a2
        sf = m1 * b1 + m2 * b2
        stiffness.spins[i] = vec3(
            c3 + c * (ka2 * ka2 + ka1 * ka1) - half * wp.dot(kb, se),
            c * (ka2 * kb2 + ka1 * kb1) - c3,
            c3 + c * (kb2 * kb2 + kb1 * kb1) - half * wp.dot(kb, sf),
        )
        # A turn takes e1 to e2 and e2 to -e1.
        ra = m1 * a2 - m2 * a1
        rb = m1 * b2 - m2 * b1
        along_first = (half * c3) * kb + (half * wp.dot(kb, ra)) * tm
        along_second = (half * c3) * kb - (half * wp.dot(kb, rb)) * tm
        sm = (se + sf) / chi
        both = (c3 * quarter) * wp.outer(kb, kb) + (real(2.0) * big_w) * wp.outer(tm, tm)
        # Gradients of w1, w2 with respect to e, times the segment's length; each result is stored as soon as it
        # is known, since all of them together would not fit into the registers of a GPU.
        g1e = wp.cross(u, d1) - w1 * tm
        g2e = wp.cross(u, d2) - w2 * tm
        us = wp.cross(u, sm)
        ee = both + c * (wp.outer(g1e, g1e) + wp.outer(g2e, g2e)) - (big_w / chi) * (identity - tt)
        ee -= symmetric(us, tm) + symmetric(kb, quarter * (m3 * (t + tm) - se))
        stiffness.ee[i] = ee / (le * le)
        stiffness.e_first[i] = (c * (ka2 * g1e - ka1 * g2e) - along_first + wp.cross(u, ra) / chi) / le
        stiffness.e_second[i] = (c * (kb2 * g1e - kb1 * g2e) + along_second + wp.cross(u, rb) / chi) / le
        # ... and to f.
        g1f = -wp.cross(t, d1) - w1 * tm
        g2f = -wp.cross(t, d2) - w2 * tm
        ts = wp.cross(t, sm)
        ff = both + c * (wp.outer(g1f, g1f) + wp.outer(g2f, g2f)) - (big_w / chi) * (identity - wp.outer(u, u))
        ff += symmetric(ts, tm) - symmetric(kb, quarter * (m3 * (u + tm) - sf))
        stiffness.ff[i] = ff / (lf * lf)
        stiffness.f_first[i] = (c * (ka2 * g1f - ka1 * g2f) - along_first - wp.cross(t, ra) / chi) / lf
        stiffness.f_second[i] = (c * (kb2 * g1f - kb1 * g2f) + along_second - wp.cross(t, rb) / chi) / lf
        fe = both + c * (wp.outer(g1f, g1e) + wp.outer(g2f, g2e)) - (big_w / chi) * (identity + wp.outer(u, t))
        fe += wp.outer(ts, tm) - wp.outer(tm, us + (m3 * half) * kb) + wp.skew(sm - (m3 / chi) * t)
        stiffness.fe[i] = fe / (le * lf)

    @wp.kernel(module=module)
    def joint_changes(
        # Model:
        model: Model,
        # State:
        stiffness: Stiffness,
        x: Increment,
        # Out:
        state: State,
    ):
        i = wp.tid()
        c = model.cell_of[i]
        k = model.flagellum_of[i]
        if state.active[c] == 0:
            return
        b = x.body[c]
        here = displacement(model, state.pose.position, x, i, k)
        e = wp.cross(vec3(b[3], b[4], b[5]), state.pose.tangent[i])
        if i > model.first_node[k]:
            e = here - displacement(model, state.pose.position, x, i - 1, k)
        if i + 1 < model.first_node[k + 1]:
            f = displacement(model, state.pose.position, x, i + 1, k) - here
            first = x.node[i][3]
            second = x.node[i + 1][3]
            ge = stiffness.ee[i] * e + wp.transpose(stiffness.fe[i]) * f
            state.joint_before[i] = ge + first * stiffness.e_first[i] + second * stiffness.e_second[i]
            gf = stiffness.fe[i] * e + stiffness.ff[i] * f
            state.joint_after[i] = gf + first * stiffness.f_first[i] + second * stiffness.f_second[i]
            spins = stiffness.spins[i]
            turn_first = wp.dot(stiffness.e_first[i], e) + wp.dot(stiffness.f_first[i], f)
            turn_second = wp.dot(stiffness.e_second[i], e) + wp.dot(stiffness.f_second[i], f)
            state.joint_spin_before[i] = turn_first + spins[0] * first + spins[1] * second
            state.joint_spin_after[i] = turn_second + spins[1] * first + spins[2] * second
        if i > model.first_node[k]:
            state.stretch_change[i] = stiffness.stretch[i] * e

    return SimpleNamespace(joints=joints, joint_changes=joint_changes)


def joint_stiffness(model: DeviceModel, state: DeviceState, stiffness: Any) -> None:
    """Second derivatives of the elastic energy at every joint, into `stiffness`."""
    kernel = _kernels(model.precision).joints
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data, stiffness], device=model.device)


def joint_changes(model: DeviceModel, state: DeviceState, stiffness: Any, x: Any) -> None:
    """First variation of the joints' energy gradients under an increment, in place of the gradients themselves.

    Args:
        model, state: of the batch; `joint_before/after`, `joint_spin_before/after` and `stretch_change` are set.
        stiffness: second derivatives at the state's pose.
        x: the increment, struct `Increment`.
    """
    kernel = _kernels(model.precision).joint_changes
    wp.launch(kernel, model.element_count, inputs=[model.data, stiffness, x, state.data], device=model.device)


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `Stiffness`, zero."""
    p, k = model.precision, struct(model.precision)()
    for name in ("ee", "ff", "fe", "stretch"):
        setattr(k, name, wp.zeros(model.element_count, dtype=p.mat33, device=model.device))
    for name in ("e_first", "e_second", "f_first", "f_second", "spins"):
        setattr(k, name, wp.zeros(model.element_count, dtype=p.vec3, device=model.device))
    return k
