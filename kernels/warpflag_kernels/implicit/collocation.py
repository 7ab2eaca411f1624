"""Linearly implicit stepping of second order: collocation of a quadratic path, solved in two iterations.

The path leads through the last two states and the next one, and obeys the equations of motion at the collocation point,
the time theta dt of the step. With delta the last increment, w = dt/dt_last and mu = w/(1 + w), it passes there at
theta w delta + e, so

    e/dt = g [V - w delta/dt],    rho = theta (1 - (1 - theta) mu),    g = rho/(1 + (2 theta - 1) mu),

and the whole step is w delta + e/rho. The error is proportional to 3 theta^2 - 1, and stiff modes are damped for any
theta above 2^-1/2, but alternate in sign for some steps below 1. So the last step of an advance takes theta = 1, which
is BDF2: forces and energies at its end are those of an equilibrated state. Steps with frames inside keep `THETA`. Each
iteration evaluates V once, at the pose known so far, and solves for what is missing of e; the first one begins with a
share of the e that the last three states predict:

    (1/dt + g M H) z = g [V - w delta/dt] - e/dt + g M B (F - F_x)

in the chain chart, F the contact forces, B the contact Jacobian, F_x the contact forces that V was evaluated with. The
matrix holds the local mobility D in place of M, and s = g times the over-implicitness in place of g, which keeps the
explicit flows of the pair sum stable. The second iteration squares the relative error that this leaves, and evaluates
V, contacts and Jacobian anew where the first one led. F obeys the exact steric law at the gaps that the step leads to.
Every step is checked before it is taken: solves, guards and the error estimate. A step that fails is taken again,
shorter.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import clock
from warpflag_kernels.base.clock import NO_FAULT, Control
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, structs
from warpflag_kernels.contact import contact_list, search
from warpflag_kernels.contact.constants import CUTOFF
from warpflag_kernels.implicit import block_band, contact_solve, delassus
from warpflag_kernels.rod import chain_chart
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.stepping import accuracy, balance, step_control
from warpflag_kernels.stepping.health import Fault, encode
from warpflag_kernels.stepping.step_control import StepControl

# Collocation point of a step that is not the last of an advance, as a fraction of the step. The truncation error
# falls with it as 3 theta^2 - 1, but stiff modes die out more slowly: a step leaves 0.67 of them at
# 0.8 and 0.84 at 0.75 (docs/numerics.md).
THETA = 0.8
# Error estimate over the mean predictor error of the nodes of a flagellum, that with the largest mean, for theta = 1;
# measured. The mean is controlled, since contacts that open, close or pass a node make single nodes jump, which does
# not add up over time.
ERROR_PER_PREDICTOR = 3.5
# Over-implicitness up to which a step begins with the whole prediction, equal to the least that a step has,
# `stability.LEAST_OVER_IMPLICIT`. With more, two iterations leave so much of a prediction in stiff modes that an
# extrapolation through three states would ring (docs/numerics.md).
BEGUN_WHOLE = 1.3
GAP_SHARE = 0.1  # residual of the gaps that the contact solve may leave, over the error that a step may make
# A residual of this times dt^3 is always allowed [um/s^3]: the truncation error of a step grows as dt^3, too.
GAP_GROWTH = 4.0e9


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Implicit`: step history and coefficients of the current step, per cell [C] unless said otherwise."""
    real = p.real

    @wp.struct
    class Implicit:
        over_implicit: wp.array(dtype=wp.float64)
        last_step: wp.array(dtype=wp.float64)  # [s]
        step_before: wp.array(dtype=wp.float64)  # [s]
        history: wp.array(dtype=wp.int32)  # how many earlier increments there are: 0, 1, 2
        ratio: wp.array(dtype=wp.float64)  # w
        theta: wp.array(dtype=wp.float64)  # collocation point as a fraction of the step
        ahead: wp.array(dtype=wp.float64)  # theta w, scale of the extrapolation by the last increment
        rho: wp.array(dtype=wp.float64)  # the correction e at the collocation point over that at the end of the step
        curvature: wp.array(dtype=wp.float64)  # factor of the second difference of earlier increments in predicted e
        ratio_before: wp.array(dtype=wp.float64)  # w of the last step
        one: wp.array(dtype=wp.float64)  # 1, the scale of a retraction by a whole increment
        predictor_error: wp.array(dtype=real)  # [K], predictor error: sum over the nodes of |e - predicted e| [um]
        along: wp.array(dtype=real)  # [K], sum over the nodes of e . predicted e [um^2]
        predicted: wp.array(dtype=real)  # [K], sum over the nodes of |predicted e|^2 [um^2]
        error: wp.array(dtype=wp.float64)  # estimate of the step [um]
        share: wp.array(dtype=wp.float64)  # of predicted e in e of the last step, by least squares, from 0 to 1
        share_after: wp.array(dtype=wp.float64)  # the same of the present step
        begun: wp.array(dtype=wp.float64)  # share of predicted e that this step begins with
        awaited: wp.array(dtype=wp.float64)  # share of predicted e that gaps are predicted with beyond that
        accepted: wp.array(dtype=wp.int32)
        evaluations: wp.array(dtype=wp.int32)  # steps attempted so far

    return Implicit


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `Implicit`, zero but for `one`."""
    p, device = model.precision, model.device
    i = struct(p)()
    floats = ("over_implicit", "last_step", "step_before", "ratio", "ratio_before", "theta", "ahead", "rho")
    for name in (*floats, "curvature", "error", "share", "share_after", "begun", "awaited"):
        setattr(i, name, wp.zeros(model.cell_count, dtype=wp.float64, device=device))
    for name in ("history", "accepted", "evaluations"):
        setattr(i, name, wp.zeros(model.cell_count, dtype=wp.int32, device=device))
    for name in ("predictor_error", "along", "predicted"):
        setattr(i, name, wp.zeros(model.flagellum_count, dtype=p.real, device=device))
    i.one = wp.ones(model.cell_count, dtype=wp.float64, device=device)
    return i


@functools.cache
def kernels(p: Precision) -> SimpleNamespace:
    """Kernels of the collocation of one step: `begin`, `right_hand_side`, `complete`, `decide`, and what is kept."""
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State = structs(p).Model, structs(p).State
    Chart, Implicit = chart_stage.struct(p), struct(p)
    Band, Contacts = block_band.types(p).Band, contact_list.struct(p)
    Law = delassus.struct(p)
    Increment, vec6 = chain_chart.types(p).Increment, chain_chart.types(p).vec6
    drag = block_band.functions(p).drag
    f = step_control.functions(p, independent=True)
    allowed, accept, next_step, smallest = f.allowed, f.accept, f.next_step, f.smallest
    add_estimate = accuracy.functions(independent=True).add
    advanced = clock.functions().advanced
    module = p.module("collocation")
    Balance, counted = balance.struct(p), balance.functions(p).count
    theta_inside, whole_up_to = wp.constant(wp.float64(THETA)), wp.constant(wp.float64(BEGUN_WHOLE))
    no_fault = wp.constant(wp.int32(NO_FAULT))
    unsolved, crowded, inaccurate, unbalanced = (
        wp.constant(wp.int32(encode(kind))) for kind in (Fault.UNSOLVED, Fault.CROWDED, Fault.ACCURACY, Fault.BALANCE)
    )
    cutoff, per_error = wp.constant(wp.float64(CUTOFF)), wp.constant(wp.float64(search.MARGIN_PER_ERROR))
    most_margin = wp.constant(wp.float64(search.MOST_MARGIN))
    least = contact_solve.FINEST_SINGLE if p.name == "float32" else contact_solve.FINEST
    finest, gap_share, gap_growth = (wp.constant(wp.float64(x)) for x in (least, GAP_SHARE, GAP_GROWTH))

    @wp.kernel(module=module)
    def begin(
        # Model:
        model: Model,
        # State:
        state: State,
        steps: StepControl,
        # Out:
        control: Control,
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
        theta = theta_inside
        if dt >= left:
            theta = one
        mu = w / (one + w)
        rho = theta * (one - (one - theta) * mu)
        g = rho / (one + (wp.float64(2.0) * theta - one) * mu)
        control.step[c] = dt
        imp.ratio[c] = w
        imp.theta[c] = theta
        imp.ahead[c] = theta * w
        imp.rho[c] = rho
        imp.curvature[c] = wp.float64(0.0)
        imp.ratio_before[c] = wp.float64(0.0)
        if imp.history[c] == 2:
            imp.ratio_before[c] = imp.last_step[c] / imp.step_before[c]
            imp.curvature[c] = rho * w * (w + one) / (one + imp.step_before[c] / imp.last_step[c])
        most = wp.min(one, whole_up_to / imp.over_implicit[c])
        imp.begun[c] = imp.share[c] * most * most
        imp.awaited[c] = imp.share[c] - imp.begun[c]
        band.step[c] = dt
        band.weight[c] = g * imp.over_implicit[c]
        band.singular[c] = 0
        law.gain[c] = g
        law.failed[c] = 0
        diameter = wp.float64(model.steric.diameter[c])
        may_err = allowed(steps, c, dt)
        enough = wp.max(gap_share * may_err, gap_growth * dt * dt * dt)
        law.gap_tolerance[c] = real(wp.max(finest * diameter, enough))
        contacts_out.reach[c] = real(cutoff * diameter + wp.min(per_error * may_err, most_margin * diameter))
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
        found: Increment,
        weight: wp.array(dtype=wp.float64),
        # Out:
        x: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        gain = real(law.gain[c])
        inv_dt = real(wp.float64(1.0) / band.step[c])
        slope = gain * real(imp.ratio[c] / band.step[c])
        part = real(weight[c]) * inv_dt
        known = slope * last.node[e] + part * found.node[e]
        spin = gain * model.drag.spin_mobility[k] * state.spin_torque[e] - known[3]
        v = vec3(real(0.0))
        if e > model.first_node[k]:
            v = gain * state.velocity[e] - vec3(known[0], known[1], known[2])
            v = drag(band, e, v)
        elif k == model.first_flagellum[c]:
            u = state.body_velocity[c]
            w = state.body_spin[c]
            rate = gain * vec6(u[0], u[1], u[2], w[0], w[1], w[2])
            x.body[c] = rate - slope * last.body[c] - part * found.body[c]
        x.node[e] = vec4(v[0], v[1], v[2], spin / model.drag.spin_mobility[k])

    @wp.kernel(module=module)
    def complete(
        # Model:
        model: Model,
        # State:
        state: State,
        last: Increment,
        found: Increment,
        predicted: Increment,
        x: Increment,
        # Out:
        imp: Implicit,
        total: Increment,
        remaining: Increment,
        chart: Chart,
    ):
        """The whole step, what remains of it from the present pose, and how far a flagellum is from its prediction."""
        k = wp.tid()
        first = model.first_node[k]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        w = real(imp.ratio[c])
        ahead = real(imp.ahead[c])
        whole = real(wp.float64(1.0) / imp.rho[c])
        predictor_error = real(0.0)
        along = real(0.0)
        squared = real(0.0)
        e = first
        while e < model.first_node[k + 1]:
            f = found.node[e] + x.node[e]
            p = predicted.node[e]
            d = f - p  # third divided difference of the path
            t = w * last.node[e] + whole * f
            total.node[e] = t
            remaining.node[e] = t - ahead * last.node[e] - found.node[e]
            if e > first:
                predictor_error += wp.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
                along += f[0] * p[0] + f[1] * p[1] + f[2] * p[2]
                squared += p[0] * p[0] + p[1] * p[1] + p[2] * p[2]
            e += 1
        if imp.history[c] != 2:
            predictor_error = real(0.0)
        imp.predictor_error[k] = whole * predictor_error
        imp.along[k] = along
        imp.predicted[k] = squared
        chart.increment[first] = vec4(real(0.0), real(0.0), real(0.0), total.node[first][3])
        if k == model.first_flagellum[c]:
            b = w * last.body[c] + whole * (found.body[c] + x.body[c])
            total.body[c] = b
            remaining.body[c] = b - ahead * last.body[c] - found.body[c]
            chart.commit[c] = 1  # the guards check this pose
            for r in range(6):
                chart.body_increment[c][r] = wp.float64(b[r])

    @wp.kernel(module=module)
    def decide(
        # State:
        band: Band,
        contacts_in: Contacts,
        law: Law,
        active: wp.array(dtype=wp.int32),
        # Out:
        chart: Chart,
        control: Control,
        steps: StepControl,
        imp: Implicit,
        powers: Balance,
    ):
        c = wp.tid()
        if active[c] == 0:
            return
        dt = control.step[c]
        error = imp.error[c]
        sound = band.singular[c] == 0 and law.failed[c] == 0 and contacts_in.overflow[c] == 0
        sound = sound and control.fault[c] == no_fault and wp.isfinite(error)
        lasts = bool(False)
        kept = powers.kept[c] != 0
        if sound and powers.known[c] != 0:
            lasts = counted(powers, c, kept)
        sound = sound and kept
        known = imp.history[c] == 2
        if accept(steps, c, dt, error, wp.float64(0.0), sound, known):
            if known and add_estimate(steps.achieved, c, dt, error, advanced(control, c), steps.shortest[c]):
                control.fault[c] = inaccurate
            powers.stored[c] = powers.stored_after[c]
            powers.known[c] = 1
            imp.accepted[c] = 1
            imp.share[c] = imp.share_after[c]
            imp.step_before[c] = imp.last_step[c]
            imp.last_step[c] = dt
            imp.history[c] = wp.min(imp.history[c] + 1, 2)
            control.steps[c] += 1
            control.time[c] = advanced(control, c)
            return
        imp.accepted[c] = 0
        chart.commit[c] = 0
        if lasts:
            control.fault[c] = unbalanced
        elif dt > smallest:
            control.fault[c] = no_fault
        elif control.fault[c] == no_fault:
            failed = wp.where(contacts_in.overflow[c] != 0, crowded, unsolved)
            control.fault[c] = wp.where(kept, failed, unbalanced)

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
        next_last: Increment,
        next_before: Increment,
        imp: Implicit,
        # Out:
        state: State,
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
        ends = control.time[c] >= control.target[c] or control.fault[c] != no_fault
        if ends or (control.rest[c] != 0 and imp.accepted[c] != 0):
            state.active[c] = 0
            wp.atomic_sub(control.unfinished, 0, 1)

    return SimpleNamespace(
        begin=begin,
        right_hand_side=right_hand_side,
        complete=complete,
        decide=decide,
        keep_elements=keep_elements,
        keep_bodies=keep_bodies,
    )
