"""The search for contacts: which pairs may touch in a step, their closest points and their normals.

Pairs within the cutoff plus a margin, flagellum against flagellum and node against body, go into one list per cell:
counted per segment, summed up, filled in, and linked for the segments of the other side; no atomics, the same order
every time. The margin grows with what the step may err.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import contact_list, neighbours, steric
from warpflag_kernels.contact.constants import CUTOFF

# Pairs are listed up to the cutoff plus a margin for the error of the predicted pose: three times what the step may
# err, at least MARGIN, at most MOST_MARGIN.
MARGIN, MOST_MARGIN = 0.3, 1.0  # [sigma]
MARGIN_PER_ERROR = 3.0
REACH = CUTOFF + MARGIN  # least gap up to which every pair is listed [sigma]


@functools.cache
def _kernels(p: Precision, segments: bool, body: bool, with_self: bool) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State, Pose, Contacts = structs(p).Model, structs(p).State, structs(p).Pose, contact_list.struct(p)
    Neighbours = neighbours.struct(p)
    law = steric.functions(p)
    nearest, direction, off_axis = law.nearest, law.direction, law.off_axis
    near_by = neighbours.functions(p, with_self)
    candidates, candidate, first_later, beside = (
        near_by.candidates, near_by.candidate, near_by.first_later, near_by.beside,
    )  # fmt: skip
    all_slots, all_asked = wp.constant(neighbours.SLOTS), wp.constant(wp.uint64(2**64 - 1))
    reach_factor = real(REACH)
    parts = [name for name, on in (("segments", segments), ("body", body), ("self", with_self)) if on]
    module = p.module("contact_search", "".join(parts))

    @wp.func(module=module)
    def set_pair(
        model: Model, pose: Pose, listed: Contacts, i: wp.int32, e: wp.int32, j: wp.int32,
        at: real, at_other: real, apart: vec3, r: real,
    ):  # fmt: skip
        """Parameters, gap and normal of contact i, of segments e and j at the distance r."""
        listed.at[i] = at
        listed.at_other[i] = at_other
        listed.gap[i] = r
        along = pose.position[e] - pose.position[e - 1]
        other = pose.position[j] - pose.position[j - 1]
        listed.normal[i] = direction(apart, r, along, other, model.steric.diameter[model.cell_of[e]])

    @wp.func(module=module)
    def set_node(model: Model, listed: Contacts, i: wp.int32, away: vec3, c: wp.int32):
        """Gap and normal of contact i, of a node with the body; away: from the body's axis to the node."""
        distance = wp.length(away)
        listed.gap[i] = distance - model.body.radius[c]
        listed.normal[i] = away / distance

    @wp.func(module=module)
    def visit(
        model: Model,
        pose: Pose,
        near: Neighbours,
        listed: Contacts,
        e: wp.int32,
        start: wp.int32,
        room: wp.int32,
        asked: wp.uint64,
    ):
        """Lists the contacts of element e with later segments and with the body, from `start` on.

        Returns how many there are, listed only if there is room, and a bit for each candidate that is one. Of at most
        64 candidates those whose bit is set in `asked` are tested, of more candidates all.
        """
        k = model.flagellum_of[e]
        c = model.cell_of[e]
        reach = wp.max(reach_factor * model.steric.diameter[c], listed.reach[c])
        found = int(0)
        seen = wp.uint64(0)
        q1 = pose.position[e]
        if wp.static(segments):
            p1 = pose.position[e - 1]
            middle = real(0.5) * (p1 + q1)
            own_reach = real(0.5) * pose.length[e] + reach
            n = candidates(model, near, e)
            entry = first_later(model, near, e)
            bit = wp.uint64(1)
            while entry < n:
                j = candidate(model, near, e, entry)
                if j >= 0 and (n > all_slots or (asked & bit) != wp.uint64(0)):
                    p2 = pose.position[j - 1]
                    q2 = pose.position[j]
                    away = middle - real(0.5) * (p2 + q2)
                    half = real(0.5) * pose.length[j]
                    within = own_reach + half
                    if wp.dot(away, away) < within * within and not beside(
                        away, pose.tangent[e], pose.tangent[j], half, reach
                    ):
                        at, at_other, apart = nearest(p1, q1, p2, q2)
                        r = wp.length(apart)
                        if r < reach:
                            if found < room:
                                i = start + found
                                listed.segment[i] = e
                                listed.other[i] = j
                                set_pair(model, pose, listed, i, e, j, at, at_other, apart, r)
                                anchored = wp.where(e - 1 == model.first_node[k], 1, 0)
                                first = model.first_node[model.flagellum_of[j]]
                                listed.anchored[i] = anchored + wp.where(j - 1 == first, 2, 0)
                            found += 1
                            seen = seen | bit
                entry += 1
                bit = bit << wp.uint64(1)
        if wp.static(body):
            away = off_axis(model, pose, e, c)
            if wp.length(away) - model.body.radius[c] < reach:
                if found < room:
                    i = start + found
                    listed.segment[i] = e
                    listed.other[i] = -1
                    listed.at[i] = real(1.0)
                    listed.at_other[i] = real(0.0)
                    set_node(model, listed, i, away, c)
                found += 1
        return found, seen

    @wp.kernel(module=module)
    def count(
        # Model:
        model: Model,
        # State:
        state: State,
        pose: Pose,
        near: Neighbours,
        # Out:
        listed: Contacts,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] == 0:
            return
        listed.stop[e] = 0
        listed.position[e] = pose.position[e]
        if e > model.first_node[model.flagellum_of[e]]:
            found, seen = visit(model, pose, near, listed, e, 0, 0, all_asked)
            listed.stop[e] = found
            listed.found[e] = seen

    @wp.kernel(module=module)
    def sum_up(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        listed: Contacts,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        begin = listed.first[c]
        total = int(0)
        e = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        while e < end:
            own = listed.stop[e]
            if begin + total + own > listed.first[c + 1]:
                listed.overflow[c] = 1
                own = 0
            listed.start[e] = begin + total
            total += own
            listed.stop[e] = begin + total
            e += 1
        listed.count[c] = total

    @wp.kernel(module=module)
    def fill(
        # Model:
        model: Model,
        # State:
        state: State,
        pose: Pose,
        near: Neighbours,
        # Out:
        listed: Contacts,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] != 0 and listed.stop[e] > listed.start[e]:
            visit(model, pose, near, listed, e, listed.start[e], listed.stop[e] - listed.start[e], listed.found[e])

    @wp.kernel(module=module)
    def link(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        listed: Contacts,
    ):
        k = wp.tid()
        begin = model.first_node[k]
        end = model.first_node[k + 1]
        c = model.cell_of[begin]
        if state.active[c] == 0:
            return
        e = begin
        while e < end:
            listed.head[e] = -1
            e += 1
        if wp.static(segments):
            i = listed.first[c] + listed.count[c] - 1
            while i >= listed.first[c]:
                j = listed.other[i]
                if j >= begin and j < end:
                    listed.next[i] = listed.head[j]
                    listed.head[j] = i
                i -= 1
        head = int(-1)
        if wp.static(body):
            e = end - 1
            while e > begin:
                i = listed.stop[e] - 1  # a node's contact with the body is the last it lists
                if i >= listed.start[e] and listed.other[i] < 0:
                    listed.next[i] = head
                    head = i
                e -= 1
        listed.body_head[k] = head

    @wp.kernel(module=module)
    def list_cells(
        # Model:
        model: Model,
        # State:
        state: State,
        pose: Pose,
        near: Neighbours,
        # Out:
        listed: Contacts,
    ):
        """The list of a whole cell by one thread, for a CPU: every pair is tested once."""
        c = wp.tid()
        if state.active[c] == 0:
            return
        begin = listed.first[c]
        i = int(begin)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            e = model.first_node[k]
            while e < model.first_node[k + 1]:
                found = int(0)
                if e > model.first_node[k]:
                    room = listed.first[c + 1] - i
                    found, _seen = visit(model, pose, near, listed, e, i, room, all_asked)
                    if found > room:
                        listed.overflow[c] = 1
                        found = int(0)
                listed.start[e] = i
                i += found
                listed.stop[e] = i
                listed.head[e] = -1
                listed.position[e] = pose.position[e]
                e += 1
            listed.body_head[k] = -1
            k += 1
        listed.count[c] = i - begin
        i -= 1
        while i >= begin:
            j = listed.other[i]
            if j >= 0:
                listed.next[i] = listed.head[j]
                listed.head[j] = i
            else:
                k = model.flagellum_of[listed.segment[i]]
                listed.next[i] = listed.body_head[k]
                listed.body_head[k] = i
            i -= 1

    @wp.kernel(module=module)
    def renew(
        # Model:
        model: Model,
        # State:
        state: State,
        pose: Pose,
        # Out:
        listed: Contacts,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        i = listed.start[e]
        while i < listed.stop[e]:
            j = listed.other[i]
            if j < 0:
                set_node(model, listed, i, off_axis(model, pose, e, c), c)
            else:
                p1, p2 = pose.position[e - 1], pose.position[j - 1]
                at, at_other, apart = nearest(p1, pose.position[e], p2, pose.position[j])
                set_pair(model, pose, listed, i, e, j, at, at_other, apart, wp.length(apart))
            i += 1

    return SimpleNamespace(count=count, sum_up=sum_up, fill=fill, link=link, list_cells=list_cells, renew=renew)


def find(model: DeviceModel, state: DeviceState, pose: Any, contacts_out: Any) -> None:
    """Lists every pair of a pose that is in contact or may come into contact within a step.

    Args:
        model, state: of the batch.
        pose: the pose of `state`.
        contacts_out: struct `Contacts`.
    """
    if model.switches.steric:
        neighbours.refresh(model, state)
    kernels = _kernels_of(model)
    inputs, device = [model.data, state.data, pose, state.neighbours, contacts_out], model.device
    if model.plan.by_cells:
        wp.launch(kernels.list_cells, model.cell_count, inputs=inputs, device=device)
        return
    wp.launch(kernels.count, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.sum_up, model.cell_count, inputs=[model.data, state.data, contacts_out], device=device)
    wp.launch(kernels.fill, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.link, model.flagellum_count, inputs=[model.data, state.data, contacts_out], device=device)


def renew(model: DeviceModel, state: DeviceState, pose: Any, contacts_out: Any) -> None:
    """Closest points, gaps and normals of the listed contacts in another pose; arguments as in `find`."""
    inputs = [model.data, state.data, pose, contacts_out]
    wp.launch(_kernels_of(model).renew, model.element_count, inputs=inputs, device=model.device)


def _kernels_of(model: DeviceModel) -> SimpleNamespace:
    switches = model.switches
    return _kernels(model.precision, switches.steric, switches.has("body contact"), switches.self_contact)
