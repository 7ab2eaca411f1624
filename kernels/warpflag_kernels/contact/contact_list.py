"""Contacts of an implicit step: the list of pairs that may touch, and products with their contact Jacobian B.

A contact that closes during a step has no stiffness at its beginning, so a force linearised there would let the
filaments pass through each other. The step instead takes the gaps of all pairs that may close as unknowns and solves
the exact force law for them. `search` fills the list.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.rod import chain_chart

# Contacts per node that a cell has room for. A filament amid a hexagonal bundle lies against six others, and a segment
# of it may touch three of each; pairs are listed once. Measured: 3 in eight bundled flagella, 3.5 in twelve, 4.1 in 20.
NEAREST, PER_NEIGHBOUR, LEAST_PER_NODE = 6, 1.5, 4


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Contacts`. A cell's list lies in [first, first + count)."""
    real, vec3 = p.real, p.vec3

    @wp.struct
    class Contacts:
        first: wp.array(dtype=wp.int32)  # [C + 1]
        count: wp.array(dtype=wp.int32)  # [C]
        position: wp.array(dtype=vec3)  # [E], of the nodes at the last search [um]
        reach: wp.array(dtype=real)  # [C], gap up to which pairs are listed, if above the least [um]
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
    """Device functions of the contact Jacobian: loads of contact forces on nodes and body, changes of a gap."""
    real, vec3, vec6 = p.real, p.vec3, chain_chart.types(p).vec6
    Model, State, Contacts = structs(p).Model, structs(p).State, struct(p)
    Increment = chain_chart.types(p).Increment
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
        """Displacement of a point y of the body under an increment [um]."""
        b = x.body[c]
        return vec3(b[0], b[1], b[2]) + wp.cross(vec3(b[3], b[4], b[5]), y)

    @wp.func(module=module)
    def gap_change(model: Model, state: State, contacts_in: Contacts, i: wp.int32, x: Increment):
        """B^T x of contact i: the change of its gap under an increment [um]."""
        e = contacts_in.segment[i]
        j = contacts_in.other[i]
        if j < 0:
            beside = shift_with_body(x, model.cell_of[e], state.pose.position[e])
            return wp.dot(contacts_in.normal[i], shift(x, e) - beside)
        s = contacts_in.at[i]
        r = contacts_in.at_other[i]
        own = s * shift(x, e)
        other = r * shift(x, j)
        anchored = contacts_in.anchored[i]
        if anchored == 0:
            own += (real(1.0) - s) * shift(x, e - 1)
            other += (real(1.0) - r) * shift(x, j - 1)
        else:
            first = shift_with_body(x, model.cell_of[e], state.pose.position[e - 1])
            if anchored == 2:
                first = shift(x, e - 1)
            own += (real(1.0) - s) * first
            first = shift_with_body(x, model.cell_of[e], state.pose.position[j - 1])
            if anchored == 1:
                first = shift(x, j - 1)
            other += (real(1.0) - r) * first
        return wp.dot(contacts_in.normal[i], own - other)

    @wp.func(module=module)
    def segment_loads(contacts_in: Contacts, magnitude: wp.array(dtype=real), e: wp.int32):
        """Contact forces on the first and second node of segment e >= 1; a contact of node e with the body acts on the
        second."""
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
    def node_loads(
        model: Model, contacts_in: Contacts, magnitude: wp.array(dtype=real), c: wp.int32, out: wp.array(dtype=vec3)
    ):
        """Adds contact forces to those on all nodes of cell c, r_0 included; for one thread."""
        i = contacts_in.first[c]
        stop = i + contacts_in.count[c]
        while i < stop:
            e = contacts_in.segment[i]
            j = contacts_in.other[i]
            f = magnitude[i] * contacts_in.normal[i]
            if j < 0:
                out[e] += f
            else:
                on_second = contacts_in.at[i] * f
                out[e] += on_second
                out[e - 1] += f - on_second
                on_second = contacts_in.at_other[i] * f
                out[j] -= on_second
                out[j - 1] -= f - on_second
            i += 1

    @wp.func(module=module)
    def body_load(
        model: Model, state: State, contacts_in: Contacts, magnitude: wp.array(dtype=real), k: wp.int32, on_anchor: vec3
    ):
        """Force and torque of a flagellum's contacts on the body: through its anchor, and as reactions."""
        load = on_body(on_anchor, state.pose.position[model.first_node[k]])
        i = contacts_in.body_head[k]
        while i >= 0:
            load -= on_body(magnitude[i] * contacts_in.normal[i], state.pose.position[contacts_in.segment[i]])
            i = contacts_in.next[i]
        return load

    return SimpleNamespace(
        gap_change=gap_change, segment_loads=segment_loads, node_loads=node_loads, body_load=body_load
    )


@functools.cache
def acting(p: Precision, body: bool) -> Any:
    """Device function: what `act` does, for one cell by one thread; with contact with the body, or without."""
    real, vec3, node_loads = p.real, p.vec3, functions(p).node_loads
    Model, State, Contacts = structs(p).Model, structs(p).State, struct(p)

    @wp.func(module=p.module("contacts", "cells_body" if body else "cells"))
    def act_on_cell(model: Model, contacts_in: Contacts, magnitude: wp.array(dtype=real), state: State, c: wp.int32):
        node_loads(model, contacts_in, magnitude, c, state.force)
        if wp.static(body):
            e = model.first_node[model.first_flagellum[c]]
            while e < model.first_node[model.first_flagellum[c + 1]]:
                state.body_contact[e] = vec3(real(0.0))
                e += 1
            k = model.first_flagellum[c]
            while k < model.first_flagellum[c + 1]:
                i = contacts_in.body_head[k]
                while i >= 0:
                    state.body_contact[contacts_in.segment[i]] = magnitude[i] * contacts_in.normal[i]
                    i = contacts_in.next[i]
                k += 1

    return act_on_cell


@functools.cache
def _kernels(p: Precision, body: bool) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State, Contacts = structs(p).Model, structs(p).State, struct(p)
    segment_loads, act_on_cell = functions(p).segment_loads, acting(p, body)

    @wp.kernel(module=p.module("contacts", "body" if body else ""))
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

    @wp.kernel(module=p.module("contacts", "cells_body" if body else "cells"))
    def act_on_cells(
        # Model:
        model: Model,
        # State:
        contacts: Contacts,
        magnitude: wp.array(dtype=real),
        # Out:
        state: State,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            act_on_cell(model, contacts, magnitude, state, c)

    return SimpleNamespace(act=act, act_on_cells=act_on_cells)


def allocate(model: DeviceModel, touching: bool) -> Any:
    """Arrays of the struct `Contacts`; room for one contact a cell where nothing can touch."""
    p, device = model.precision, model.device
    nodes = np.diff(model.data.first_node.numpy()[model.data.first_flagellum.numpy()])
    room = nodes * _per_node(model) if touching else np.ones_like(nodes)
    first = np.concatenate([[0], np.cumsum(room)])
    total, cells, elements = int(first[-1]), model.cell_count, model.element_count

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=device)

    c = struct(p)()
    c.first = wp.array(first, dtype=wp.int32, device=device)
    c.count, c.overflow = zeros(cells, wp.int32), zeros(cells, wp.int32)
    c.start, c.stop, c.head = (zeros(elements, wp.int32) for _ in range(3))
    c.reach = zeros(cells, p.real)
    c.found = zeros(elements, wp.uint64)
    c.position = zeros(elements, p.vec3)
    c.body_head = zeros(model.flagellum_count, wp.int32)
    c.segment, c.other, c.next, c.anchored = (zeros(total, wp.int32) for _ in range(4))
    c.at, c.at_other, c.gap = (zeros(total, p.real) for _ in range(3))
    c.normal = zeros(total, p.vec3)
    return c


def _per_node(model: DeviceModel) -> np.ndarray:
    """Contacts per node that a cell has room for, one more with the body, shape [C]."""
    flagella = np.diff(model.data.first_flagellum.numpy())
    near = np.full_like(flagella, NEAREST) if model.switches.self_contact else np.minimum(flagella - 1, NEAREST)
    return np.maximum(LEAST_PER_NODE, np.ceil(PER_NEIGHBOUR * near).astype(int) + 1)


def act(model: DeviceModel, state: DeviceState, contacts: Any, magnitude: wp.array) -> None:
    """Adds forces of these magnitudes at the listed contacts [pN] to `force`; `body_contact` is set."""
    kernels, inputs = (
        _kernels(model.precision, model.switches.has("body contact")),
        [model.data, contacts, magnitude, state.data],
    )
    if model.plan.by_cells:
        wp.launch(kernels.act_on_cells, model.cell_count, inputs=inputs, device=model.device)
    else:
        wp.launch(kernels.act, model.element_count, inputs=inputs, device=model.device)
