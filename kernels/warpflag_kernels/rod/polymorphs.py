"""Polymorphs: every joint of a flagellum is in one of three forms, helices of their own, and flips between them.

The forms are that of the scene's ground state, 0, a target, 1, and one that joints of the target go on to, 2. What
flips a joint is the moment about the helix axis against the handedness of form 0, as a reversed motor winds a filament
up. Joints near the root or the tip flip by themselves (nucleation) when their moment along the ground state,

    m = -(A (Omega - Omega_0)) . Omega_0/|Omega_0|,     Omega_0: ground state of form 0,

exceeds one threshold; in a helix that is wound up uniformly it is the moment about the axis. They flip back when the
moment about the axis falls below another. Any joint flips beside one of the other form (propagation) at lower
thresholds. There the local m says little: a joint of semicoiled form amid the normal one has an eighth of it, and a
kinked filament is bent by its thrust. What counts is the mean moment over a turn of the helix about the mean tangent,
in which bending cancels; near the ends over less, as much to either side, so that it is the moment at the joint.

From times on that are drawn before the run begins, joints of form 1 go on to form 2, one after the other from the root,
as long as the motor winds the filament up. They flip back to form 0 as those of form 1 do.

A joint's ground state goes over within a ramp, as a smooth step, so that the steppers see quadratic energies that
change with time. Joints neither flip nor lead to a flip while their ramp lasts, and a joint that a neighbour leads
flips with that one, not by itself. They are looked at where a step has been accepted, but flip from the time on at
which they had reason to: when the last ramp of theirs or of the neighbour that leads them was over, and when the moment
passed its threshold, in a straight line between two looks; one after the other in the order of these times, since a
flip gives neighbours a reason and takes it from others. The next step begins with that part of the ramp behind it. Were
it the end of the step, a front would lag by half a step per joint.

Source: Hotani, J. Mol. Biol. 156, 791 (1982): torques of -1.1 and +0.4 pN um take filaments from normal to semicoiled
and back, in transitions that travel along the filament.
"""

import functools
import math
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import clock
from warpflag_kernels.base.clock import Control
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.rod import rotations

# Contour length at either end in which joints flip by themselves [um]. The very first ones are not in the state of a
# uniform helix: under 1.26 pN um they carry 0.95, 1.18, 1.16.
END_LENGTH = 0.5


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of the term: the ground states at the time of an evaluation."""
    Model, State = structs(p).Model, structs(p).State
    module = p.module("polymorph_functions")

    @wp.func(module=module)
    def ground_state(model: Model, state: State, e: wp.int32, k: wp.int32, time: wp.float64):
        """Ground state of joint e at a time [rad]."""
        own = model.polymorphs[0].rest_strain[3 * e + state.forms[0].form[e]]
        share = (time - state.forms[0].changed[e]) / model.polymorphs[0].ramp[k]
        if share < wp.float64(1.0):
            s = p.real(wp.max(share, wp.float64(0.0)))
            s = s * s * (p.real(3.0) - p.real(2.0) * s)
            own = (p.real(1.0) - s) * model.polymorphs[0].rest_strain[3 * e + state.forms[0].before[e]] + s * own
        return own

    @wp.func(module=module)
    def ramped(model: Model, state: State, e: wp.int32, k: wp.int32, c: wp.int32):
        """Sets the ground state of joint e to that at the time of the evaluation."""
        state.forms[0].rest_strain[e] = ground_state(model, state, e, k, state.time[c])

    @wp.func(module=module)
    def in_flagellum(model: Model, state: State, k: wp.int32, c: wp.int32):
        e = model.first_node[k]
        while e + 1 < model.first_node[k + 1]:
            ramped(model, state, e, k, c)
            e += 1

    return SimpleNamespace(ramped=ramped, in_flagellum=in_flagellum, ground_state=ground_state)


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State, Chart = structs(p).Model, structs(p).State, chart_stage.struct(p)
    ramped, ground_state = functions(p).ramped, functions(p).ground_state
    joint_strain = rotations.functions(p).joint_strain
    advanced = clock.functions().advanced
    end_length, half_turn = wp.constant(real(END_LENGTH)), wp.constant(real(math.pi))
    module = p.module("polymorphs")

    @wp.kernel(module=module)
    def ground_states(
        # Model:
        model: Model,
        # Out:
        state: State,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] != 0:
            ramped(model, state, e, model.flagellum_of[e], c)

    @wp.func(module=module)
    def strain_change(model: Model, state: State, chart: Chart, e: wp.int32, k: wp.int32, now: wp.float64):
        """Strain of joint e beyond its ground state now [rad]."""
        w = joint_strain(
            chart.base.tangent[e], chart.base.tangent[e + 1], chart.base.director[e], chart.base.director[e + 1]
        )
        return w - ground_state(model, state, e, k, now)

    @wp.func(module=module)
    def end_moment(model: Model, state: State, chart: Chart, e: wp.int32, k: wp.int32, now: wp.float64):
        """Moment of joint e of form 0 along its ground state, against its handedness [pN um]."""
        rest = model.polymorphs[0].rest_strain[3 * e]
        d = strain_change(model, state, chart, e, k, now)
        a = model.rod.bending_rigidity[k]
        moment = vec3(a * d[0], a * d[1], model.rod.twist_rigidity[k] * d[2])
        return wp.float64(-wp.dot(moment, rest) / (wp.length(rest) * model.rod.segment_length[k]))

    @wp.func(module=module)
    def axial_moment(
        model: Model,
        state: State,
        chart: Chart,
        e: wp.int32,
        k: wp.int32,
        now: wp.float64,
        root: wp.int32,
        tip: wp.int32,
    ):
        """Moment about the helix axis at joint e against the handedness of form 0 [pN um].

        The axis is the mean tangent over a turn around e, at the ends over the first or the last one.
        """
        rest = model.polymorphs[0].rest_strain[3 * e]
        half = wp.int32(half_turn / wp.length(rest))
        moment = vec3(real(0.0))
        along = vec3(real(0.0))
        count = real(0.0)
        beside = wp.min(e - root, tip - e)
        j = wp.max(wp.min(e - half, tip - 2 * half), root)
        last = wp.min(wp.max(e + half, root + 2 * half), tip)
        a = model.rod.bending_rigidity[k]
        c = model.rod.twist_rigidity[k]
        while j <= last:
            t = chart.base.tangent[j]
            u = chart.base.tangent[j + 1]
            along += t + u
            if wp.abs(j - e) <= beside:
                a1 = chart.base.director[j] + chart.base.director[j + 1]
                a2 = wp.cross(t, chart.base.director[j]) + wp.cross(u, chart.base.director[j + 1])
                d = strain_change(model, state, chart, j, k, now)
                moment += real(0.5) * (a * d[0] * a1 + a * d[1] * a2 + c * d[2] * (t + u))
                count += real(1.0)
            j += 1
        m = wp.abs(wp.dot(moment, wp.normalize(along))) / (count * model.rod.segment_length[k])
        i = model.first_node[k]
        hook = joint_strain(
            chart.base.tangent[i], chart.base.tangent[i + 1], chart.base.director[i], chart.base.director[i + 1]
        )
        if hook[2] * rest[2] > real(0.0):
            m = -m
        return wp.float64(m)

    @wp.func(module=module)
    def flips(since: wp.float64, able: wp.float64, now: wp.float64, before: wp.float64, after: wp.float64):
        """When a joint flips that is able to from a time on [s], between two looks; -1 if it does not.

        Its moment was beyond the threshold by `before` at the first look, and is by `after` at the second [pN um].
        """
        if able > now:
            return wp.float64(-1.0)
        if before + (after - before) * (able - since) / (now - since) > wp.float64(0.0):
            return able
        if after > wp.float64(0.0):
            return now - (now - since) * after / (after - before)
        return wp.float64(-1.0)

    @wp.func(module=module)
    def going_on(model: Model, k: wp.int32, now: wp.float64):
        """Since when joints of form 1 go on to form 2 [s], -1 if they do not now."""
        i = model.polymorphs[0].first_second[k]
        while i < model.polymorphs[0].first_second[k + 1]:
            interval = model.polymorphs[0].second[i]
            if now >= interval[0] and now < interval[1]:
                return interval[0]
            i += 1
        return wp.float64(-1.0)

    @wp.func(module=module)
    def look_at(
        model: Model,
        state: State,
        chart: Chart,
        e: wp.int32,
        k: wp.int32,
        now: wp.float64,
        root: wp.int32,
        tip: wp.int32,
        at_end: wp.bool,
    ):
        """What the moment at joint e is beyond the thresholds of nucleation and propagation [pN um]; 0 where the joint
        can't flip so."""
        left = wp.min(state.forms[0].form[e], 1)
        nucleates = wp.float64(0.0)
        propagates = wp.float64(0.0)
        beside = bool(False)
        if e > root:
            beside = wp.min(state.forms[0].form[e - 1], 1) != left
        if e < tip:
            beside = beside or wp.min(state.forms[0].form[e + 1], 1) != left
        if at_end and left == 0:
            nucleates = end_moment(model, state, chart, e, k, now) - model.polymorphs[0].nucleation[k][0]
        if beside or (at_end and left == 1):
            m = axial_moment(model, state, chart, e, k, now, root, tip)
            if at_end and left == 1:
                nucleates = model.polymorphs[0].nucleation[k][1] - m
            if beside and left == 1:
                propagates = model.polymorphs[0].propagation[k][1] - m
            if beside and left == 0:
                propagates = m - model.polymorphs[0].propagation[k][0]
        return wp.vec2d(nucleates, propagates)

    @wp.func(module=module)
    def next_flip(
        model: Model,
        state: State,
        e: wp.int32,
        k: wp.int32,
        now: wp.float64,
        root: wp.int32,
        tip: wp.int32,
        at_end: wp.bool,
        begun: wp.float64,
    ):
        """When joint e flips by what has been looked at [s], -1 if it does not, and its form then."""
        form = state.forms[0].form[e]
        left = wp.min(form, 1)
        ramp = model.polymorphs[0].ramp[k]
        when = wp.float64(-1.0)
        becomes = 1 - left
        since = state.forms[0].looked[e]
        able = wp.max(since, state.forms[0].changed[e] + ramp)
        leads = now + wp.float64(1.0)  # from when on a neighbour of the other form leads it
        follows = e == root
        ready = begun
        if e > root:
            before = state.forms[0].changed[e - 1]
            if state.forms[0].flipped[e - 1] == now:
                able = wp.max(able, before)
            if wp.min(state.forms[0].form[e - 1], 1) != left:
                leads = before + ramp
            follows = state.forms[0].form[e - 1] == 2
            ready = wp.max(ready, before + ramp)
        if e < tip:
            after = state.forms[0].changed[e + 1]
            if state.forms[0].flipped[e + 1] == now:
                able = wp.max(able, after)
            if wp.min(state.forms[0].form[e + 1], 1) != left:
                leads = wp.min(leads, after + ramp)
        if state.forms[0].flipped[e] == now or able > now:
            return when, becomes
        was = state.forms[0].beyond[e]
        is_now = state.forms[0].reached[e]
        if leads <= now:
            when = flips(since, wp.max(able, leads), now, was[1], is_now[1])
        if at_end:
            alone = flips(since, able, now, was[0], is_now[0])
            if alone >= wp.float64(0.0) and alone < leads and (when < wp.float64(0.0) or alone < when):
                when = alone
        if form == 1 and follows and begun >= wp.float64(0.0):
            ready = wp.max(ready, able)
            if ready <= now and (when < wp.float64(0.0) or ready < when):
                when = ready
                becomes = 2
        return when, becomes

    @wp.kernel(module=module)
    def flip(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        control: Control,
        counted: wp.int32,
        # Out:
        state: State,
    ):
        """Flips joints of a flagellum at the end of an accepted step; `counted`: whether the clock has reached that."""
        k = wp.tid()
        first = model.first_node[k]
        c = model.cell_of[first]
        if state.active[c] == 0 or chart.commit[c] == 0:
            return
        now = control.time[c]
        if counted == 0:
            now = advanced(control, c)
        root = first + 1
        tip = model.first_node[k + 1] - 2
        reach = 1 + wp.int32(real(end_length) / model.rod.segment_length[k])
        begun = going_on(model, k, now)
        e = root
        while e <= tip:
            at_end = e - root < reach or tip - e < reach
            state.forms[0].reached[e] = look_at(model, state, chart, e, k, now, root, tip, at_end)
            e += 1
        # One flip after the other in the order of their times: it may give a neighbour its reason or take that away.
        found = int(root)
        while found >= 0:
            found = int(-1)
            earliest = wp.float64(0.0)
            form = int(0)
            e = root
            while e <= tip:
                at_end = e - root < reach or tip - e < reach
                when, becomes = next_flip(model, state, e, k, now, root, tip, at_end, begun)
                if when >= wp.float64(0.0) and (found < 0 or when < earliest):
                    found = e
                    earliest = when
                    form = becomes
                e += 1
            if found >= 0:
                state.forms[0].before[found] = state.forms[0].form[found]
                state.forms[0].form[found] = form
                state.forms[0].changed[found] = earliest
                state.forms[0].flipped[found] = now
                e = wp.max(found - 1, root)
                while e <= wp.min(found + 1, tip):
                    at_end = e - root < reach or tip - e < reach
                    state.forms[0].reached[e] = look_at(model, state, chart, e, k, now, root, tip, at_end)
                    e += 1
        e = root
        while e <= tip:
            state.forms[0].beyond[e] = state.forms[0].reached[e]
            state.forms[0].looked[e] = now
            e += 1

    return SimpleNamespace(ground_states=ground_states, flip=flip)


def ground_states(model: DeviceModel, state: DeviceState) -> None:
    """Ground states of all joints at the time of the evaluation, into `rest_strain`, which the elastic term reads."""
    kernel = _kernels(model.precision).ground_states
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data], device=model.device)


def flip(model: DeviceModel, state: DeviceState, chart: Any, control: Any, counted: bool) -> None:
    """Flips joints at the ends of accepted steps; a part of a pass, after the step is committed.

    Args:
        model, state, chart, control: of the batch.
        counted: whether the clocks have been advanced to the end of the step.
    """
    inputs = [model.data, chart, control, int(counted), state.data]
    wp.launch(_kernels(model.precision).flip, model.flagellum_count, inputs=inputs, device=model.device)


POLYMORPHS = Term(
    "polymorphs",
    launch=ground_states,
    functions=functions,
    timed=True,
    after_step=flip,
    jumps=True,
    carried=tuple(f"forms.{name}" for name in ("form", "before", "changed", "flipped", "looked", "beyond")),
)
