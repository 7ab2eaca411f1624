"""Contacts of an implicit step: which pairs may touch, where, and along which direction.

A contact that closes inside a step has no stiffness before it, so linearising its force across the step would let it
pass. The step instead treats the gaps of all pairs that may close as unknowns and solves the force law exactly in
their space. This stage finds the pairs within the cutoff plus a margin, flagellum against flagellum and node against
body, and keeps them in one list per cell: counted per segment, summed, filled, and chained for the segments of the
other side; no atomics, the same order every time.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels import chain, neighbours, steric
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

PER_NODE = 4  # contacts that a cell has room for (eight bundled flagella have three)
MARGIN = 0.3  # beyond the cutoff, for what the predicted pose is wrong by [sigma]


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Contacts`. A cell's list lies in [first, first + count); `first` are multiples of the group size."""
    real, vec3 = p.real, p.vec3

    @wp.struct
    class Contacts:
        first: wp.array(dtype=wp.int32)  # [C + 1]
        count: wp.array(dtype=wp.int32)  # [C]
        overflow: wp.array(dtype=wp.int32)  # [C], 1: the list is too short for the contacts found
        found: wp.array(dtype=wp.uint64)  # [E], which neighbours of a segment are contacts, a bit each
        start: wp.array(dtype=wp.int32)  # [E], contacts found by this segment or node lie in [start, stop)
        stop: wp.array(dtype=wp.int32)  # [E]
        head: wp.array(dtype=wp.int32)  # [E], first contact whose other side is this segment; -1: none
        body_head: wp.array(dtype=wp.int32)  # [K], first contact of this flagellum with the body; -1: none
        segment: wp.array(dtype=wp.int32)  # [capacity], the segment (or the node, at the body)
        other: wp.array(dtype=wp.int32)  # [capacity], the segment of the other flagellum; -1: the body
        at: wp.array(dtype=real)  # [capacity], parameter on the segment
        at_other: wp.array(dtype=real)  # [capacity]
        normal: wp.array(dtype=vec3)  # [capacity], from the other to this one
        gap: wp.array(dtype=real)  # [capacity], distance of the centre lines, or of the node from the surface [um]
        next: wp.array(dtype=wp.int32)  # [capacity], next with that other side, or of that flagellum with the body
        anchored: wp.array(dtype=wp.int32)  # [capacity], 1: the segment begins at r_0, 2: the other one does, 3: both

    return Contacts


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of B: what forces at the contacts act on, and how an increment changes a gap."""
    real, vec3, vec6 = p.real, p.vec3, chain.types(p).vec6
    Model, State, Contacts = structs(p).Model, structs(p).State, struct(p)
    Increment = chain.types(p).Increment
    module = p.module("contacts_functions")

    @wp.func(module=module)
    def on_body(f: vec3, y: vec3):
        """Force f at a point y of the body as force and torque."""
        torque = wp.cross(y, f)
        return vec6(f[0], f[1], f[2], torque[0], torque[1], torque[2])

    @wp.func(module=module)
    def shift(x: Increment, e: wp.int32):
        d = x.node[e]
        return vec3(d[0], d[1], d[2])

    @wp.func(module=module)
    def shift_with_body(x: Increment, c: wp.int32, y: vec3):
        """How an increment moves a point y of the body."""
        b = x.body[c]
        return vec3(b[0], b[1], b[2]) + wp.cross(vec3(b[3], b[4], b[5]), y)

    @wp.func(module=module)
    def gap_change(model: Model, state: State, contacts_in: Contacts, i: wp.int32, x: Increment):
        """B^T x of contact i: how an increment changes its gap."""
        e = contacts_in.segment[i]
        j = contacts_in.other[i]
        if j < 0:
            return wp.dot(contacts_in.normal[i], shift(x, e) - shift_with_body(x, model.cell_of[e], state.position[e]))
        s = contacts_in.at[i]
        r = contacts_in.at_other[i]
        own = s * shift(x, e)
        other = r * shift(x, j)
        anchored = contacts_in.anchored[i]
        if anchored == 0:
            own += (real(1.0) - s) * shift(x, e - 1)
            other += (real(1.0) - r) * shift(x, j - 1)
        else:
            first = shift_with_body(x, model.cell_of[e], state.position[e - 1])
            if anchored == 2:
                first = shift(x, e - 1)
            own += (real(1.0) - s) * first
            first = shift_with_body(x, model.cell_of[e], state.position[j - 1])
            if anchored == 1:
                first = shift(x, j - 1)
            other += (real(1.0) - r) * first
        return wp.dot(contacts_in.normal[i], own - other)

    @wp.func(module=module)
    def segment_loads(contacts_in: Contacts, magnitude: wp.array(dtype=real), e: wp.int32):
        """Contact forces on the first and second node of segment e >= 1; the second also takes its node's with the
        body."""
        on_first = vec3(real(0.0))
        on_second = vec3(real(0.0))
        i = contacts_in.start[e]
        while i < contacts_in.stop[e]:
            f = magnitude[i] * contacts_in.normal[i]
            s = contacts_in.at[i]
            on_first += (real(1.0) - s) * f
            on_second += s * f
            i += 1
        i = contacts_in.head[e]
        while i >= 0:
            f = magnitude[i] * contacts_in.normal[i]
            r = contacts_in.at_other[i]
            on_first -= (real(1.0) - r) * f
            on_second -= r * f
            i = contacts_in.next[i]
        return on_first, on_second

    @wp.func(module=module)
    def body_load(
        model: Model, state: State, contacts_in: Contacts, magnitude: wp.array(dtype=real), k: wp.int32, on_anchor: vec3
    ):
        """What the contact forces of a flagellum put on the body: through its anchor, and as reactions."""
        load = on_body(on_anchor, state.position[model.first_node[k]])
        i = contacts_in.body_head[k]
        while i >= 0:
            load -= on_body(magnitude[i] * contacts_in.normal[i], state.position[contacts_in.segment[i]])
            i = contacts_in.next[i]
        return load

    return SimpleNamespace(gap_change=gap_change, segment_loads=segment_loads, body_load=body_load)


@functools.cache
def _kernels(p: Precision, segments: bool, body: bool) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State, Contacts, Pose = structs(p).Model, structs(p).State, struct(p), chain.types(p).Pose
    Neighbours, closest_parameters = structs(p).Neighbours, steric.functions(p).closest_parameters
    near_by = neighbours.functions(p)
    candidates, candidate, first_later, beside = (
        near_by.candidates, near_by.candidate, near_by.first_later, near_by.beside,
    )  # fmt: skip
    all_slots = wp.constant(neighbours.SLOTS)
    reach_factor, segment_loads = real(steric.CUTOFF + MARGIN), functions(p).segment_loads
    module = p.module("contacts", ("segments" if segments else "") + ("body" if body else ""))

    @wp.func(module=module)
    def direction(apart: vec3, r: real, d1: vec3, d2: vec3, diameter: real):
        """Normal of two segments along d1, d2 that are apart by a vector of length r."""
        if r > real(1.0e-3) * diameter:
            return apart / r
        return wp.normalize(wp.cross(d1, d2))  # centre lines that touch: part them across both

    @wp.func(module=module)
    def visit(model: Model, pose: Pose, near: Neighbours, contacts: Contacts, e: wp.int32, write: wp.int32):
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
            n = candidates(model, near, e)
            seen = wp.uint64(0)  # which candidates are contacts; those of a longer list are looked at twice
            if write >= 0 and n <= all_slots:
                seen = contacts.found[e]
            entry = first_later(model, near, e)
            bit = wp.uint64(1)
            while entry < n:
                j = candidate(model, near, e, entry)
                skipped = write >= 0 and n <= all_slots and (seen & bit) == wp.uint64(0)
                if j >= 0 and not skipped:
                    p2 = pose.position[j - 1]
                    q2 = pose.position[j]
                    away = middle - real(0.5) * (p2 + q2)
                    half = real(0.5) * pose.length[j]
                    within = own_reach + half
                    if wp.dot(away, away) < within * within and not beside(
                        away, pose.tangent[e], pose.tangent[j], half, reach
                    ):
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
                                anchored = wp.where(e - 1 == model.first_node[k], 1, 0)
                                first = model.first_node[model.flagellum_of[j]]
                                contacts.anchored[i] = anchored + wp.where(j - 1 == first, 2, 0)
                                diameter = model.steric_diameter[c]
                                contacts.normal[i] = direction(apart, r, q1 - p1, q2 - p2, diameter)
                            found += 1
                            seen = seen | bit
                entry += 1
                bit = bit << wp.uint64(1)
            if write < 0:
                contacts.found[e] = seen
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
        near: Neighbours,
        # Out:
        contacts: Contacts,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] == 0:
            return
        contacts.stop[e] = 0
        if e > model.first_node[model.flagellum_of[e]]:
            contacts.stop[e] = visit(model, pose, near, contacts, e, -1)

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
        begin = contacts.first[c]
        total = int(0)
        e = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        while e < end:
            own = contacts.stop[e]
            if begin + total + own > contacts.first[c + 1]:
                contacts.overflow[c] = 1
                own = 0
            contacts.start[e] = begin + total
            total += own
            contacts.stop[e] = begin + total
            e += 1
        contacts.count[c] = total

    @wp.kernel(module=module)
    def fill(
        # Model:
        model: Model,
        # State:
        state: State,
        pose: Pose,
        near: Neighbours,
        # Out:
        contacts: Contacts,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] != 0 and contacts.stop[e] > contacts.start[e]:
            visit(model, pose, near, contacts, e, contacts.start[e])

    @wp.kernel(module=module)
    def link(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        contacts: Contacts,
    ):
        k = wp.tid()
        begin = model.first_node[k]
        end = model.first_node[k + 1]
        c = model.cell_of[begin]
        if state.active[c] == 0:
            return
        e = begin
        while e < end:
            contacts.head[e] = -1
            e += 1
        if wp.static(segments):
            i = contacts.first[c] + contacts.count[c] - 1
            while i >= contacts.first[c]:
                j = contacts.other[i]
                if j >= begin and j < end:
                    contacts.next[i] = contacts.head[j]
                    contacts.head[j] = i
                i -= 1
        head = int(-1)
        if wp.static(body):
            e = end - 1
            while e > begin:
                i = contacts.stop[e] - 1  # a node's contact with the body is the last it lists
                if i >= contacts.start[e] and contacts.other[i] < 0:
                    contacts.next[i] = head
                    head = i
                e -= 1
        contacts.body_head[k] = head

    @wp.kernel(module=module)
    def act(
        # Model:
        model: Model,
        # State:
        contacts: Contacts,
        magnitude: wp.array(dtype=real),
        # Out:
        state: State,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] == 0:
            return
        _before, load = segment_loads(contacts, magnitude, e)
        if e + 1 < model.first_node[model.flagellum_of[e] + 1]:
            on_first, _after = segment_loads(contacts, magnitude, e + 1)
            load += on_first
        state.force[e] = state.force[e] + load
        if wp.static(body):
            i = contacts.stop[e] - 1
            reaction = vec3(real(0.0))
            if i >= contacts.start[e] and contacts.other[i] < 0:
                reaction = magnitude[i] * contacts.normal[i]
            state.body_contact[e] = reaction

    return SimpleNamespace(count=count, sum_up=sum_up, fill=fill, link=link, act=act)


def allocate(model: DeviceModel, touching: bool) -> Any:
    """Arrays of the struct `Contacts`; next to none where nothing can touch."""
    p, device = model.precision, model.device
    nodes = np.diff(model.data.first_node.numpy()[model.data.first_flagellum.numpy()])
    first = np.concatenate([[0], np.cumsum(PER_NODE * nodes if touching else np.ones_like(nodes))])
    total, cells, elements = int(first[-1]), model.cell_count, model.element_count

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=device)

    c = struct(p)()
    c.first = wp.array(first, dtype=wp.int32, device=device)
    c.count, c.overflow = zeros(cells, wp.int32), zeros(cells, wp.int32)
    c.start, c.stop, c.head = (zeros(elements, wp.int32) for _ in range(3))
    c.found = zeros(elements, wp.uint64)
    c.body_head = zeros(model.flagellum_count, wp.int32)
    c.segment, c.other, c.next, c.anchored = (zeros(total, wp.int32) for _ in range(4))
    c.at, c.at_other, c.gap = (zeros(total, p.real) for _ in range(3))
    c.normal = zeros(total, p.vec3)
    return c


def find(model: DeviceModel, state: DeviceState, pose: Any, contacts: Any) -> None:
    """Lists every pair of a pose that is in contact or may come into contact within a step.

    Args:
        pose: the one that `state` holds.
    """
    if model.switches.steric:
        neighbours.refresh(model, state)
    kernels = _kernels(model.precision, model.switches.steric, model.switches.body_contact)
    inputs, device = [model.data, state.data, pose, state.neighbours, contacts], model.device
    wp.launch(kernels.count, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.sum_up, model.cell_count, inputs=[model.data, state.data, contacts], device=device)
    wp.launch(kernels.fill, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.link, model.flagellum_count, inputs=[model.data, state.data, contacts], device=device)


def act(model: DeviceModel, state: DeviceState, contacts: Any, magnitude: wp.array) -> None:
    """Adds forces of these magnitudes at the listed contacts [pN] to `force`; `body_contact` is set."""
    kernels = _kernels(model.precision, model.switches.steric, model.switches.body_contact)
    inputs = [model.data, contacts, magnitude, state.data]
    wp.launch(kernels.act, model.element_count, inputs=inputs, device=model.device)
