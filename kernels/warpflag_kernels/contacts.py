"""Contacts of an implicit step: which pairs may touch, where, and along which direction.

A contact that closes inside a step has no stiffness before it, so linearising its force across the step would let it
pass. The step instead treats the gaps of all pairs that may close as unknowns and solves the force law exactly in
their space. This stage finds the pairs within the cutoff plus a margin, flagellum against flagellum and node against
body, and keeps them in one list per cell: counted per segment, summed, filled; no atomics, the same order every time.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import chain, steric
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

MARGIN = 0.15  # beyond the cutoff, in units of sigma


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Contacts`. A cell's list lies in [first, first + count); `first` are multiples of the group size."""
    real, vec3 = p.real, p.vec3

    @wp.struct
    class Contacts:
        first: wp.array(dtype=wp.int32)  # [C + 1]
        count: wp.array(dtype=wp.int32)  # [C]
        overflow: wp.array(dtype=wp.int32)  # [C], 1: the list is too short for the contacts found
        own: wp.array(dtype=wp.int32)  # [E], contacts found by this segment or node, then where they start
        segment: wp.array(dtype=wp.int32)  # [capacity], the segment (or the node, at the body)
        other: wp.array(dtype=wp.int32)  # [capacity], the segment of the other flagellum; -1: the body
        at: wp.array(dtype=real)  # [capacity], parameter on the segment
        at_other: wp.array(dtype=real)  # [capacity]
        normal: wp.array(dtype=vec3)  # [capacity], from the other to this one
        gap: wp.array(dtype=real)  # [capacity], distance of the centre lines, or of the node from the surface [um]

    return Contacts


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of B: what a unit force at a contact acts on, and how an increment changes its gap."""
    real, vec3, vec4, vec6 = p.real, p.vec3, p.vec4, chain.types(p).vec6
    Model, State, Contacts = structs(p).Model, structs(p).State, struct(p)
    Increment = chain.types(p).Increment
    module = p.module("contacts_functions")

    @wp.func(module=module)
    def extended(f: vec3):
        return vec4(f[0], f[1], f[2], real(0.0))

    @wp.func(module=module)
    def on_body(f: vec3, y: vec3):
        """Force f at a point y of the body as force and torque."""
        torque = wp.cross(y, f)
        return vec6(f[0], f[1], f[2], torque[0], torque[1], torque[2])

    @wp.func(module=module)
    def body_lever(model: Model, state: State, i: wp.int32, contacts_in: Contacts):
        """What a unit force at contact i puts on the body: through anchors, or as the body's reaction."""
        n = contacts_in.normal[i]
        e = contacts_in.segment[i]
        j = contacts_in.other[i]
        if j < 0:
            return on_body(-n, state.position[e])
        lever = vec6(real(0.0))
        if e - 1 == model.first_node[model.flagellum_of[e]]:
            lever += on_body((real(1.0) - contacts_in.at[i]) * n, state.position[e - 1])
        if j - 1 == model.first_node[model.flagellum_of[j]]:
            lever -= on_body((real(1.0) - contacts_in.at_other[i]) * n, state.position[j - 1])
        return lever

    @wp.func(module=module)
    def gap_change(model: Model, state: State, contacts_in: Contacts, i: wp.int32, x: Increment):
        """B^T x of contact i: how an increment changes its gap."""
        n = extended(contacts_in.normal[i])
        e = contacts_in.segment[i]
        j = contacts_in.other[i]
        s = contacts_in.at[i]
        change = s * wp.dot(n, x.node[e])
        change += wp.dot(body_lever(model, state, i, contacts_in), x.body[model.cell_of[e]])
        if j >= 0:
            r = contacts_in.at_other[i]
            change -= r * wp.dot(n, x.node[j])
            if e - 1 != model.first_node[model.flagellum_of[e]]:
                change += (real(1.0) - s) * wp.dot(n, x.node[e - 1])
            if j - 1 != model.first_node[model.flagellum_of[j]]:
                change -= (real(1.0) - r) * wp.dot(n, x.node[j - 1])
        return change

    return SimpleNamespace(extended=extended, body_lever=body_lever, gap_change=gap_change)


@functools.cache
def _kernels(p: Precision, segments: bool, body: bool) -> SimpleNamespace:
    real, _vec3 = p.real, p.vec3
    Model, State, Contacts, Pose = structs(p).Model, structs(p).State, struct(p), chain.types(p).Pose
    closest_parameters, next_near = steric.functions(p).closest_parameters, steric.functions(p).next_near
    reach_factor = real(steric.CUTOFF + MARGIN)
    module = p.module("contacts", ("segments" if segments else "") + ("body" if body else ""))

    @wp.func(module=module)
    def visit(model: Model, pose: Pose, contacts: Contacts, e: wp.int32, write: wp.int32):
        """Contacts that belong to element e: with segments of later flagella, and with the body."""
        k = model.flagellum_of[e]
        c = model.cell_of[e]
        reach = reach_factor * model.steric_diameter[c]
        found = int(0)
        q1 = pose.position[e]
        if wp.static(segments):
            p1 = pose.position[e - 1]
            middle = real(0.5) * (p1 + q1)
            own_reach = real(0.5) * pose.length[e] + reach
            other = k + 1
            while other < model.first_flagellum[c + 1]:
                j = model.first_node[other] + 1
                while j < model.first_node[other + 1]:
                    p2 = pose.position[j - 1]
                    q2 = pose.position[j]
                    away = middle - real(0.5) * (p2 + q2)
                    near = own_reach + real(0.5) * pose.length[j]
                    distance = wp.length(away)
                    if distance < near:
                        st = closest_parameters(p1, q1 - p1, p2, q2 - p2)
                        apart = p1 + st[0] * (q1 - p1) - (p2 + st[1] * (q2 - p2))
                        r = wp.length(apart)
                        if r < reach:
                            if write >= 0:
                                i = write + found
                                contacts.segment[i] = e
                                contacts.other[i] = j
                                contacts.at[i] = st[0]
                                contacts.at_other[i] = st[1]
                                contacts.gap[i] = r
                                if r > real(1.0e-3) * model.steric_diameter[c]:
                                    contacts.normal[i] = apart / r
                                else:
                                    contacts.normal[i] = wp.normalize(wp.cross(q1 - p1, q2 - p2))
                            found += 1
                    j = next_near(pose.length, j, model.first_node[other + 1], distance, own_reach)
                other += 1
        if wp.static(body):
            axis = pose.body_axis[c]
            half = model.body_half_length[c]
            away_from_axis = q1 - wp.clamp(wp.dot(q1, axis), -half, half) * axis
            distance = wp.length(away_from_axis)
            if distance - model.body_radius[c] < reach:
                if write >= 0:
                    i = write + found
                    contacts.segment[i] = e
                    contacts.other[i] = -1
                    contacts.at[i] = real(1.0)
                    contacts.at_other[i] = real(0.0)
                    contacts.gap[i] = distance - model.body_radius[c]
                    contacts.normal[i] = away_from_axis / distance
                found += 1
        return found

    @wp.kernel(module=module)
    def count(
        # Model:
        model: Model,
        # State:
        state: State,
        pose: Pose,
        # Out:
        contacts: Contacts,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] == 0:
            return
        contacts.own[e] = 0
        if e > model.first_node[model.flagellum_of[e]]:
            contacts.own[e] = visit(model, pose, contacts, e, -1)

    @wp.kernel(module=module)
    def sum_up(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        contacts: Contacts,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        total = int(0)
        e = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        capacity = contacts.first[c + 1] - contacts.first[c]
        while e < end:
            own = contacts.own[e]
            if own == 0 or total + own > capacity:
                contacts.own[e] = -1
                if own > 0:
                    contacts.overflow[c] = 1
            else:
                contacts.own[e] = contacts.first[c] + total
                total += own
            e += 1
        contacts.count[c] = total

    @wp.kernel(module=module)
    def fill(
        # Model:
        model: Model,
        # State:
        state: State,
        pose: Pose,
        # Out:
        contacts: Contacts,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] != 0 and contacts.own[e] >= 0:
            visit(model, pose, contacts, e, contacts.own[e])

    @wp.kernel(module=module)
    def measure(
        # Model:
        model: Model,
        # State:
        state: State,
        pose: Pose,
        # Out:
        contacts: Contacts,
    ):
        c, index = wp.tid()
        if state.active[c] == 0 or index >= contacts.count[c]:
            return
        i = contacts.first[c] + index
        e = contacts.segment[i]
        j = contacts.other[i]
        if j < 0:
            axis = pose.body_axis[c]
            half = model.body_half_length[c]
            y = pose.position[e]
            distance = wp.length(y - wp.clamp(wp.dot(y, axis), -half, half) * axis)
            contacts.gap[i] = distance - model.body_radius[c]
        else:
            p1 = pose.position[e - 1]
            p2 = pose.position[j - 1]
            d1 = pose.position[e] - p1
            d2 = pose.position[j] - p2
            st = closest_parameters(p1, d1, p2, d2)
            contacts.gap[i] = wp.length(p1 + st[0] * d1 - p2 - st[1] * d2)

    return SimpleNamespace(count=count, sum_up=sum_up, fill=fill, measure=measure)


def find(model: DeviceModel, state: DeviceState, pose: Any, contacts: Any) -> None:
    """Lists every pair of a pose that is in contact or may come into contact within a step."""
    kernels = _kernels(model.precision, model.switches.steric, model.switches.body_contact)
    inputs, device = [model.data, state.data, pose, contacts], model.device
    wp.launch(kernels.count, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.sum_up, model.cell_count, inputs=[model.data, state.data, contacts], device=device)
    wp.launch(kernels.fill, model.element_count, inputs=inputs, device=device)


def measure(model: DeviceModel, state: DeviceState, pose: Any, contacts: Any, most: int) -> None:
    """The gaps of the listed contacts at another pose.

    Args:
        most: launch size, contacts per cell at most.
    """
    kernels = _kernels(model.precision, model.switches.steric, model.switches.body_contact)
    inputs = [model.data, state.data, pose, contacts]
    wp.launch(kernels.measure, (model.cell_count, most), inputs=inputs, device=model.device)
