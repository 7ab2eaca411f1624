"""Linearly implicit stepping of second order: variable-step BDF2 around an extrapolated state.

With delta the last increment, w = dt/dt_last, A = (1 + 2w)/(1 + w) and g = 1/A, a step extrapolates by x = w delta,
evaluates the velocities V there once, and solves for the correction e:

    (1/dt + g M H) e = g [V - w delta/dt] + g M B (F - F_x)

in the chain chart. The matrix holds the local mobility D in place of M, over-weighted by `over_implicit`, which keeps
the explicit flows of the pair sum stable. Contacts are those of a pose nearer to the end of the step, where a path
that is quadratic in time leads: V holds their forces F_x at its gaps, and those that count, F, obey the exact law at
the end of the step. Every step is checked before it is taken: solves, guards and the error estimate. A step that
fails is taken again, shorter.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import banded, chain, compliance, contact_law, contacts, step_control
from warpflag_kernels import chart as chart_stage
from warpflag_kernels.chart import vec6d
from warpflag_kernels.control import NO_FAULT, Control
from warpflag_kernels.guard import Fault, encode
from warpflag_kernels.step_control import StepControl
from warpflag_kernels.types import Precision, structs

# Largest error of a node over the mean of its cell. The mean is what is followed: contacts that open, close or pass a
# vertex make single nodes jump, which does not add up.
PEAK = 4.2
GAP_SHARE = 0.5  # of the error that a step may make, for what the contact law leaves over
GAP_GROWTH = 4.0e9  # so much over dt^3 may be left in any case: what a step leaves over grows like that [um/s^3]


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Implicit`: the clockwork of every cell, per cell [C] unless said otherwise."""
    real = p.real

    @wp.struct
    class Implicit:
        over_implicit: wp.array(dtype=wp.float64)
        last_step: wp.array(dtype=wp.float64)  # [s]
        step_before: wp.array(dtype=wp.float64)  # [s]
        history: wp.array(dtype=wp.int32)  # increments known: 0, 1, 2
        ratio: wp.array(dtype=wp.float64)  # w
        one: wp.array(dtype=wp.float64)  # 1, the scale of a plain retraction
        error: wp.array(dtype=real)  # [K], estimated node errors of a flagellum, their sum [um]
        predicted: wp.array(dtype=real)  # [K], lengths of the displacements predicted for it, their sum [um]
        trust: wp.array(dtype=wp.float64)  # share of a prediction that counts
        accepted: wp.array(dtype=wp.int32)
        evaluations: wp.array(dtype=wp.int32)  # right-hand sides so far

    return Implicit


@functools.cache
def kernels(p: Precision) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State = structs(p).Model, structs(p).State
    Chart, Implicit = chart_stage.struct(p), struct(p)
    Band, Contacts = banded.types(p).Band, contacts.struct(p)
    Law = compliance.struct(p)
    _Pose, Increment, vec6 = chain.types(p).Pose, chain.types(p).Increment, chain.types(p).vec6
    f = step_control.functions(p)
    accept, next_step, smallest = f.accept, f.next_step, f.smallest
    module = p.module("implicit")
    no_fault = wp.constant(wp.int32(NO_FAULT))
    unsolved = wp.constant(wp.int32(encode(Fault.UNSOLVED)))
    peak = wp.constant(wp.float64(PEAK))
    finest, gap_share, gap_growth = (wp.constant(wp.float64(x)) for x in (contact_law.FINEST, GAP_SHARE, GAP_GROWTH))

    @wp.kernel(module=module)
    def begin(
        # Model:
        model: Model,
        # State:
        state: State,
        control: Control,
        steps: StepControl,
        # Out:
        imp: Implicit,
        band: Band,
        contacts_out: Contacts,
        law: Law,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        one = wp.float64(1.0)
        left = control.target[c] - control.time[c]
        dt = next_step(steps, c, control.longest_step[c], left)
        w = wp.float64(0.0)
        if imp.history[c] > 0:
            w = dt / imp.last_step[c]
        g = (one + w) / (one + wp.float64(2.0) * w)
        control.step[c] = dt
        imp.ratio[c] = w
        band.step[c] = dt
        band.weight[c] = g * imp.over_implicit[c]
        band.singular[c] = 0
        law.gain[c] = g
        law.failed[c] = 0
        finest_gap = wp.float64(model.steric_diameter[c]) * finest
        enough = wp.max(gap_share * steps.tolerance[c] * dt, gap_growth * dt * dt * dt)
        law.tolerance[c] = real(wp.max(finest_gap, enough))
        contacts_out.overflow[c] = 0
        imp.evaluations[c] += 1

    @wp.kernel(module=module)
    def right_hand_side(
        # Model:
        model: Model,
        # State:
        state: State,
        imp: Implicit,
        band: Band,
        law: Law,
        last: Increment,
        # Out:
        x: Increment,
        drive: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        gain = real(law.gain[c])
        slope = real(imp.ratio[c] / band.step[c])
        carried = last.node[e]
        spin = gain * (model.spin_mobility[k] * state.spin_torque[e] - slope * carried[3])
        v = vec3(real(0.0))
        if e > model.first_node[k]:
            v = gain * (state.velocity[e] - slope * vec3(carried[0], carried[1], carried[2]))
            drive.node[e] = vec4(v[0], v[1], v[2], spin)
            t = state.tangent[e]
            if e + 1 < model.first_node[k + 1]:
                t = wp.normalize(t + state.tangent[e + 1])
            along = wp.dot(t, v) * t
            v = along / model.mobility_along[e] + (v - along) / model.mobility_across[e]
        else:
            drive.node[e] = vec4(v[0], v[1], v[2], spin)
        if e == model.first_node[model.first_flagellum[c]]:
            u = state.body_velocity[c]
            w = state.body_spin[c]
            rate = gain * (vec6(u[0], u[1], u[2], w[0], w[1], w[2]) - slope * last.body[c])
            x.body[c] = rate
            drive.body[c] = rate
        x.node[e] = vec4(v[0], v[1], v[2], spin / model.spin_mobility[k])

    @wp.kernel(module=module)
    def predict(
        # Model:
        model: Model,
        # State:
        state: State,
        imp: Implicit,
        last: Increment,
        before: Increment,
        # Out:
        x: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        # On a path that is quadratic in time, as the last two increments say.
        scale = real(0.0)
        ratio = real(0.0)
        if imp.history[c] == 2:
            w = imp.ratio[c]
            ratio = real(imp.last_step[c] / imp.step_before[c])
            scale = real(w * (w + wp.float64(1.0)) / (wp.float64(1.0) + imp.step_before[c] / imp.last_step[c]))
        x.node[e] = scale * (last.node[e] - ratio * before.node[e])
        if e == model.first_node[model.first_flagellum[c]]:
            x.body[c] = scale * (last.body[c] - ratio * before.body[c])

    @wp.kernel(module=module)
    def add_increments(
        # Model:
        model: Model,
        # State:
        state: State,
        imp: Implicit,
        last: Increment,
        x: Increment,
        # Out:
        total: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        w = real(imp.ratio[c])
        total.node[e] = w * last.node[e] + x.node[e]
        if e == model.first_node[model.first_flagellum[c]]:
            total.body[c] = w * last.body[c] + x.body[c]

    @wp.kernel(module=module)
    def estimate_error(
        # Model:
        model: Model,
        # State:
        state: State,
        imp: Implicit,
        band: Band,
        last: Increment,
        predicted: Increment,
        x: Increment,
        # Out:
        chart: Chart,
    ):
        k = wp.tid()
        first = model.first_node[k]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        if k == model.first_flagellum[c]:
            chart.commit[c] = 1  # the guards look at this pose
            b = real(imp.ratio[c]) * last.body[c] + x.body[c]
            chart.body_increment[c] = vec6d(
                wp.float64(b[0]),
                wp.float64(b[1]),
                wp.float64(b[2]),
                wp.float64(b[3]),
                wp.float64(b[4]),
                wp.float64(b[5]),
            )
        turn = real(imp.ratio[c]) * last.node[first][3] + x.node[first][3]
        chart.increment[first] = vec4(real(0.0), real(0.0), real(0.0), turn)
        total = real(0.0)
        foreseen = real(0.0)
        if imp.history[c] == 2:
            e = first + 1
            while e < model.first_node[k + 1]:
                d = x.node[e] - predicted.node[e]  # third divided difference of the path
                total += wp.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
                p = predicted.node[e]
                foreseen += wp.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
                e += 1
        imp.error[k] = total / real(12.0)
        imp.predicted[k] = foreseen

    @wp.kernel(module=module)
    def decide(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        contacts_in: Contacts,
        law: Law,
        # Out:
        chart: Chart,
        control: Control,
        steps: StepControl,
        imp: Implicit,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        dt = control.step[c]
        error = wp.float64(0.0)
        k = model.first_flagellum[c]
        foreseen = wp.float64(0.0)
        nodes = int(0)
        while k < model.first_flagellum[c + 1]:
            error += wp.float64(imp.error[k])
            foreseen += wp.float64(imp.predicted[k])
            nodes += model.first_node[k + 1] - model.first_node[k] - 1
            k += 1
        missed = wp.float64(12.0) * error
        error = peak * error / wp.float64(nodes)
        sound = band.singular[c] == 0 and law.failed[c] == 0 and contacts_in.overflow[c] == 0
        sound = sound and control.fault[c] == no_fault and wp.isfinite(error)
        if accept(steps, c, dt, error, wp.float64(0.0), sound, imp.history[c] == 2):
            imp.accepted[c] = 1
            imp.trust[c] = wp.float64(0.0)
            if missed < foreseen:
                imp.trust[c] = wp.float64(1.0) - missed / foreseen
            imp.step_before[c] = imp.last_step[c]
            imp.last_step[c] = dt
            imp.history[c] = wp.min(imp.history[c] + 1, 2)
            control.steps[c] += 1
            t = control.time[c] + dt
            if control.target[c] - t < wp.float64(1.0e-6) * dt:
                t = control.target[c]
            control.time[c] = t
            return
        imp.accepted[c] = 0
        chart.commit[c] = 0
        if dt > smallest:
            control.fault[c] = no_fault
        elif control.fault[c] == no_fault:
            control.fault[c] = unsolved

    @wp.kernel(module=module)
    def keep_elements(
        # Model:
        model: Model,
        # State:
        state: State,
        imp: Implicit,
        next_last: Increment,
        next_before: Increment,
        # Out:
        last: Increment,
        before: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0 or imp.accepted[c] == 0:
            return
        last.node[e] = next_last.node[e]
        before.node[e] = next_before.node[e]

    @wp.kernel(module=module)
    def keep_bodies(
        # State:
        state: State,
        next_last: Increment,
        next_before: Increment,
        imp: Implicit,
        # Out:
        last: Increment,
        before: Increment,
        control: Control,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        if imp.accepted[c] != 0:
            last.body[c] = next_last.body[c]
            before.body[c] = next_before.body[c]
        if control.time[c] >= control.target[c] or control.fault[c] != no_fault:
            state.active[c] = 0
            wp.atomic_sub(control.unfinished, 0, 1)

    return SimpleNamespace(
        begin=begin,
        right_hand_side=right_hand_side,
        add_increments=add_increments,
        predict=predict,
        estimate_error=estimate_error,
        decide=decide,
        keep_elements=keep_elements,
        keep_bodies=keep_bodies,
    )
