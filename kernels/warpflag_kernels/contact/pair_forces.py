"""Contact forces: segment against segment of other flagella or of its own, node against the body surface.

Every pair of segments within the cutoff acts, so a contact near a node counts up to four times. A force at
parameter t of a segment acts by (1 - t) on its first and t on its second node: force and torque are conserved
exactly. Each segment sums its own pairs; both sides evaluate a pair in the same order, hence to the same bits. One
thread that does a whole cell takes every pair once for both sides instead, for the same sums in the same order.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import neighbours, steric
from warpflag_kernels.contact.constants import CUTOFF


@functools.cache
def gathers(p: Precision, with_self: bool) -> SimpleNamespace:
    """Device functions: forces on one segment from others, on all of a cell, and of the body on one node."""
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    Neighbours = neighbours.struct(p)
    law, near_by = steric.functions(p), neighbours.functions(p, with_self)
    steric_force, nearest, direction, off_axis = law.steric_force, law.nearest, law.direction, law.off_axis
    candidates, candidate, first_later = near_by.candidates, near_by.candidate, near_by.first_later
    cutoff = real(CUTOFF)
    module = p.module("pair_forces_functions", "self" if with_self else "")

    @wp.func(module=module)
    def pairs_of(model: Model, state: State, near: Neighbours, e: wp.int32):
        """Forces on the first and second node of segment e from other segments, and the sum of |F|."""
        strength = model.steric.strength[model.cell_of[e]]
        diameter = model.steric.diameter[model.cell_of[e]]
        first = vec3(real(0.0))
        second = vec3(real(0.0))
        total = real(0.0)
        p1 = state.pose.position[e - 1]
        q1 = state.pose.position[e]
        middle = real(0.5) * (p1 + q1)
        reach = real(0.5) * state.pose.length[e] + cutoff * diameter
        n = candidates(model, near, e)
        i = int(0)
        while i < n:
            j = candidate(model, near, e, i)
            i += 1
            if j >= 0:
                p2 = state.pose.position[j - 1]
                q2 = state.pose.position[j]
                away = middle - real(0.5) * (p2 + q2)
                within = reach + real(0.5) * state.pose.length[j]
                if wp.dot(away, away) < within * within:
                    s = real(0.0)
                    gap = vec3(real(0.0))
                    if e < j:
                        s, _t, gap = nearest(p1, q1, p2, q2)
                    else:
                        _s, s, back = nearest(p2, q2, p1, q1)
                        gap = -back
                    r = wp.length(gap)
                    magnitude = steric_force(r, strength, diameter)
                    if magnitude > real(0.0):
                        total += magnitude
                        normal = direction(gap, r, q1 - p1, q2 - p2, diameter)
                        first += ((real(1.0) - s) * magnitude) * normal
                        second += (s * magnitude) * normal
        return first, second, total

    @wp.func(module=module)
    def pairs_of_cell(model: Model, state: State, near: Neighbours, c: wp.int32):
        """The same forces on all segments of cell c, every pair once for both."""
        strength = model.steric.strength[c]
        diameter = model.steric.diameter[c]
        begin = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        e = begin
        while e < end:
            state.steric_first[e] = vec3(real(0.0))
            state.steric_second[e] = vec3(real(0.0))
            e += 1
        e = begin + 1
        while e < end:
            p1 = state.pose.position[e - 1]
            q1 = state.pose.position[e]
            middle = real(0.5) * (p1 + q1)
            reach = real(0.5) * state.pose.length[e] + cutoff * diameter
            n = candidates(model, near, e)
            i = first_later(model, near, e)
            while i < n:
                j = candidate(model, near, e, i)
                i += 1
                if j >= 0:
                    p2 = state.pose.position[j - 1]
                    q2 = state.pose.position[j]
                    away = middle - real(0.5) * (p2 + q2)
                    within = reach + real(0.5) * state.pose.length[j]
                    if wp.dot(away, away) < within * within:
                        s, t, gap = nearest(p1, q1, p2, q2)
                        r = wp.length(gap)
                        magnitude = steric_force(r, strength, diameter)
                        if magnitude > real(0.0):
                            normal = direction(gap, r, q1 - p1, q2 - p2, diameter)
                            state.steric_first[e] += ((real(1.0) - s) * magnitude) * normal
                            state.steric_second[e] += (s * magnitude) * normal
                            state.steric_first[j] -= ((real(1.0) - t) * magnitude) * normal
                            state.steric_second[j] -= (t * magnitude) * normal
            e += 1

    @wp.func(module=module)
    def body_force(model: Model, state: State, e: wp.int32, c: wp.int32):
        """Force of the body of cell c on node e [pN]."""
        away = off_axis(model, state.pose, e, c)
        square = wp.dot(away, away)
        reach = model.body.radius[c] + cutoff * model.steric.diameter[c]
        force = vec3(real(0.0))
        if square < reach * reach:  # few nodes are that near: only they pay for the root
            distance = wp.sqrt(square)
            gap = distance - model.body.radius[c]
            magnitude = steric_force(gap, model.steric.strength[c], model.steric.diameter[c])
            force = (magnitude / distance) * away
        return force

    return SimpleNamespace(pairs_of=pairs_of, pairs_of_cell=pairs_of_cell, body_force=body_force)


@functools.cache
def _segment_functions(p: Precision, with_self: bool) -> SimpleNamespace:
    """Device functions of the term of contact between flagella, each with itself too or not."""
    vec3, Model, State, Neighbours = p.vec3, structs(p).Model, structs(p).State, neighbours.struct(p)
    refresh_cell, pairs_of_cell = neighbours.lists(p, with_self).refresh_cell, gathers(p, with_self).pairs_of_cell
    module = p.module("pair_forces_functions", "self" if with_self else "")

    @wp.func(module=module)
    def in_cell(model: Model, state: State, near: Neighbours, c: wp.int32):
        refresh_cell(model, state, near, c)
        pairs_of_cell(model, state, near, c)

    @wp.func(module=module)
    def on_first(model: Model, state: State, e: wp.int32, k: wp.int32, force: vec3):
        return force + state.steric_first[e]

    @wp.func(module=module)
    def on_second(model: Model, state: State, e: wp.int32, k: wp.int32, force: vec3):
        return force + state.steric_second[e]

    return SimpleNamespace(in_cell=in_cell, on_first=on_first, on_second=on_second)


@functools.cache
def _body_functions(p: Precision) -> SimpleNamespace:
    """Device functions of the term of contact with the body."""
    vec3, Model, State = p.vec3, structs(p).Model, structs(p).State
    body_force = gathers(p, False).body_force
    module = p.module("pair_forces_functions")

    @wp.func(module=module)
    def in_flagellum(model: Model, state: State, k: wp.int32, c: wp.int32):
        e = model.first_node[k] + 1
        while e < model.first_node[k + 1]:
            state.body_contact[e] = body_force(model, state, e, c)
            e += 1

    @wp.func(module=module)
    def on_node(model: Model, state: State, e: wp.int32, k: wp.int32, force: vec3):
        if e == model.first_node[k]:
            return force
        return force + state.body_contact[e]

    @wp.func(module=module)
    def on_body(model: Model, state: State, k: wp.int32, force: vec3, torque: vec3):
        e = model.first_node[k] + 1
        while e < model.first_node[k + 1]:
            reaction = -state.body_contact[e]
            force += reaction
            torque += wp.cross(state.pose.position[e], reaction)
            e += 1
        return force, torque

    return SimpleNamespace(in_flagellum=in_flagellum, on_node=on_node, on_body=on_body)


@functools.cache
def _kernels(p: Precision, with_self: bool) -> SimpleNamespace:
    real, variant = p.real, "self" if with_self else ""
    Model, State, Neighbours = structs(p).Model, structs(p).State, neighbours.struct(p)
    pairs_of = gathers(p, with_self).pairs_of

    @wp.kernel(module=p.module("steric", variant))
    def segments(
        # Model:
        model: Model,
        # State:
        near: Neighbours,
        # Out:
        state: State,
    ):
        e = wp.tid()
        if e == model.first_node[model.flagellum_of[e]] or state.active[model.cell_of[e]] == 0:
            return
        first, second, _total = pairs_of(model, state, near, e)
        state.steric_first[e] = first
        state.steric_second[e] = second

    @wp.kernel(module=p.module("steric_measure", variant))
    def magnitudes(
        # Model:
        model: Model,
        # State:
        state: State,
        near: Neighbours,
        # Out:
        magnitude_out: wp.array(dtype=real),
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] == 0:
            return
        total = real(0.0)
        if e > model.first_node[model.flagellum_of[e]]:
            _first, _second, total = pairs_of(model, state, near, e)
        magnitude_out[e] = total

    return SimpleNamespace(segments=segments, magnitudes=magnitudes)


@functools.cache
def _body_kernel(p: Precision) -> Any:
    Model, State, body_force = structs(p).Model, structs(p).State, gathers(p, False).body_force

    @wp.kernel(module=p.module("steric_body"))
    def body(
        # Model:
        model: Model,
        # Out:
        state: State,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if e == model.first_node[model.flagellum_of[e]] or state.active[c] == 0:
            return
        state.body_contact[e] = body_force(model, state, e, c)

    return body


def segment_contact(model: DeviceModel, state: DeviceState) -> None:
    """Steric forces between flagella, per segment, into `steric_first` and `steric_second` [pN]."""
    neighbours.refresh(model, state)
    inputs = [model.data, state.neighbours, state.data]
    kernel = _kernels(model.precision, model.switches.self_contact).segments
    wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)


def body_contact(model: DeviceModel, state: DeviceState) -> None:
    """Contact force of the body on each node r_1..r_N, into `body_contact` [pN]."""
    kernel = _body_kernel(model.precision)
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data], device=model.device)


def steric_magnitudes(model: DeviceModel, state: DeviceState, magnitude_out: wp.array) -> None:
    """Sum of |F| over the pairs of each segment of active cells [pN], shape [element_count]; every pair counts at both
    sides."""
    neighbours.refresh(model, state)
    inputs = [model.data, state.data, state.neighbours, magnitude_out]
    kernel = _kernels(model.precision, model.switches.self_contact).magnitudes
    wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)


STERIC = Term("steric", launch=segment_contact, functions=lambda p: _segment_functions(p, False), contact=True)
STERIC_WITH_SELF = Term(
    "steric with self", launch=segment_contact, functions=lambda p: _segment_functions(p, True), contact=True
)
BODY_CONTACT = Term("body contact", launch=body_contact, functions=_body_functions, contact=True)
