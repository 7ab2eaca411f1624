"""The Rotne-Prager sum at positions that stand still during an implicit step, for many different forces.

The contact solve needs it: two filaments that push each other apart drag the fluid between them along, which makes the
gap several times harder to open than with local drag alone. So do the velocities of a step's first iteration, and the
measurement of its stability. Single precision is enough for all three: they enter through changes within a step, or are
corrected by the second iteration.

Nodes are reordered: the slots of a cell hold its moving nodes, first those that contacts can load, then the others,
both flagellum after flagellum. A CPU stores the coefficients of every pair (i, j < i) of a cell, row after row, unless
the cell is so large that reading them takes as long as computing them (`Plan.step_pairs`).
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels.base.native import native
from warpflag_kernels.base.plan import Flows
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import contact_list
from warpflag_kernels.fluid import body_flow, node_velocity, rotne_prager, shell_flow
from warpflag_kernels.fluid import shell as shell_stage


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `StepFlow`: the order of nodes in the sum, and the coefficients of their pairs."""
    PairSum, Shell, single = rotne_prager.struct(p.single), shell_stage.struct(p.single), p.single.real

    @wp.struct
    class StepFlow:
        loaded: wp.array(dtype=wp.int32)  # [K], number of nodes that a contact may load
        start: wp.array(dtype=wp.int32)  # [K], slots of these nodes lie in [start, start + loaded)
        first_other: wp.array(dtype=wp.int32)  # [K], first slot of the flagellum's other nodes
        node: wp.array(dtype=wp.int32)  # [E], node of a slot; a cell's slots begin where its elements do
        slot: wp.array(dtype=wp.int32)  # [E], slot of a node; -1: of r_0, which is not in the sum
        sum: PairSum  # by slot
        shell: Shell  # of the flow round the body; by node
        # Coefficients c, q of the pairs, flow = c f + q (q . f); only where they are stored.
        first_pair: wp.array(dtype=wp.int32)  # [C], of a cell's pairs
        c: wp.array(dtype=single)  # [pairs], of the force [1/um]
        qx: wp.array(dtype=single)  # [pairs], along the nodes' distance [um^-1/2]
        qy: wp.array(dtype=single)
        qz: wp.array(dtype=single)

    return StepFlow


@functools.cache
def rows(p: Precision) -> Any:
    """Device function: the index from which the pairs (i, j) of a row are counted by j."""
    Flow = struct(p)

    @wp.func(module=p.module("flow_rows"))
    def row_of(flow: Flow, first: wp.int32, c: wp.int32, i: wp.int32):
        n = i - first
        return flow.first_pair[c] + n * (n - 1) / 2 - first

    return row_of


@functools.cache
def functions(p: Precision, flows: Flows, step_pairs: str, threads: int = 1) -> SimpleNamespace:
    """Device functions for one block of threads: `load`, `spread` where pairs are taken once, then `flow_at`.

    They are called in this order, each for all nodes, and the block synchronises in between.

    Args:
        p: precision of the run.
        flows: which nodes are coupled.
        step_pairs: as in `Plan`.
        threads: that share the pairs gathered at a node: one, or those of a warp.
    """
    real, vec3, single = p.real, p.vec3, p.single
    Model, Flow = structs(p).Model, struct(p)
    row_of = rows(p)
    row = rotne_prager.rows(single, flows.unequal, threads)
    add_row, gather_pairs, warp_sum = row.add_row, row.gather_pairs, rotne_prager.over_warp(single)
    within, between = flows.within, flows.between
    zero = wp.constant(single.real(0.0))
    symmetric, stored = step_pairs != "gathered", step_pairs == "stored"
    module = p.module("flow_functions", f"{flows.variant}_{step_pairs}_{threads}")

    @wp.func(module=module)
    def load(flow: Flow, slot: wp.int32, f: vec3):
        """Puts a force on the node of a slot [pN]."""
        flow.sum.fx[slot] = single.real(f[0])
        flow.sum.fy[slot] = single.real(f[1])
        flow.sum.fz[slot] = single.real(f[2])
        if wp.static(symmetric):
            flow.sum.ux[slot] = zero
            flow.sum.uy[slot] = zero
            flow.sum.uz[slot] = zero

    @wp.func(module=module)
    def slots_end(model: Model, c: wp.int32):
        """Where the slots of a cell end."""
        return model.first_node[model.first_flagellum[c + 1]] - model.first_flagellum[c + 1] + model.first_flagellum[c]

    @wp.func(module=module)
    def loaded_end(model: Model, flow: Flow, c: wp.int32):
        """Where the slots of a cell's nodes end that contacts can load."""
        last = model.first_flagellum[c + 1] - 1
        return flow.start[last] + flow.loaded[last]

    @wp.func_native(native(__file__, "stored_row", single))
    def add_stored_row(s: Flow, row: wp.int32, i: wp.int32, begin: wp.int32, end: wp.int32): ...

    @wp.func(module=module)
    def add(model: Model, flow: Flow, c: wp.int32, i: wp.int32, begin: wp.int32, end: wp.int32):
        if begin < end:
            if wp.static(stored):
                first = model.first_node[model.first_flagellum[c]]
                add_stored_row(flow, row_of(flow, first, c, i), i, begin, end)
            else:
                add_row(flow.sum, i, begin, end, single.real(model.pairs.radius[model.first_flagellum[c]]))

    @wp.func(module=module)
    def spread(model: Model, flow: Flow, c: wp.int32, sources: wp.int32):
        """The symmetric sum of a whole cell by one thread; slots from `sources` on carry no force."""
        begin = model.first_node[model.first_flagellum[c]]
        end = slots_end(model, c)
        i = begin
        while i < end:
            stop = wp.min(i, sources)
            if wp.static(within and between):
                add(model, flow, c, i, begin, stop)
            else:
                own = model.flagellum_of[flow.node[i]]
                start = flow.start[own]
                loaded = start + flow.loaded[own]
                first_other = flow.first_other[own]
                if wp.static(within):
                    add(model, flow, c, i, start, wp.min(loaded, stop))
                    add(model, flow, c, i, first_other, stop)
                else:
                    add(model, flow, c, i, begin, wp.min(start, stop))
                    add(model, flow, c, i, loaded, wp.min(first_other, stop))
            i += 1

    @wp.func(module=module)
    def flow_at(model: Model, flow: Flow, e: wp.int32, k: wp.int32, c: wp.int32, sources: wp.int32, thread: wp.int32):
        """Velocity of node e of flagellum k that the forces cause through the pair sum [um/s]."""
        i = flow.slot[e]
        ux = zero
        uy = zero
        uz = zero
        if wp.static(symmetric):
            ux = flow.sum.ux[i]
            uy = flow.sum.uy[i]
            uz = flow.sum.uz[i]
        else:
            begin = model.first_node[model.first_flagellum[c]]
            radius = single.real(model.pairs.radius[model.first_flagellum[c]])
            u = single.vec3(zero)
            if wp.static(within and between):
                u = gather_pairs(flow.sum, i, begin + thread, sources, radius)
            else:
                start = flow.start[k]
                loaded = start + flow.loaded[k]
                first_other = flow.first_other[k]
                others = first_other + model.first_node[k + 1] - model.first_node[k] - 1 - flow.loaded[k]
                if wp.static(within):
                    u = gather_pairs(flow.sum, i, start + thread, wp.min(loaded, sources), radius)
                    u += gather_pairs(flow.sum, i, first_other + thread, wp.min(others, sources), radius)
                else:
                    u = gather_pairs(flow.sum, i, begin + thread, wp.min(start, sources), radius)
                    u += gather_pairs(flow.sum, i, loaded + thread, wp.min(first_other, sources), radius)
                    u += gather_pairs(flow.sum, i, others + thread, sources, radius)
            if wp.static(threads > 1):
                u = warp_sum(u, thread)
            ux = u[0]
            uy = u[1]
            uz = u[2]
        return model.pairs.mobility[c] * vec3(real(ux), real(uy), real(uz))

    return SimpleNamespace(load=load, spread=spread, flow_at=flow_at, loaded_end=loaded_end, slots_end=slots_end)


@functools.cache
def _kernels(p: Precision, touching: bool, flows: Flows, by_cells: bool) -> SimpleNamespace:
    real = p.single.real
    Model, State, Contacts, Flow = structs(p).Model, structs(p).State, contact_list.struct(p), struct(p)
    row_of = rows(p)
    beads = shell_flow.functions(p, p.single, by_cells)
    axes_of, place, find = beads.axes_of, beads.place, beads.find
    names = ["touching"] * touching + ["unequal"] * flows.unequal + ["body", *["cells"] * by_cells] * flows.body
    module = p.module("flow", "_".join(names))

    @wp.func(module=module)
    def may_be_loaded(contacts_in: Contacts, e: wp.int32, end: wp.int32):
        """Whether node e of a flagellum that ends before `end` has contacts, itself or through its segments."""
        if wp.static(not touching):
            return False
        if contacts_in.stop[e] > contacts_in.start[e] or contacts_in.head[e] >= 0:
            return True
        return e + 1 < end and (contacts_in.stop[e + 1] > contacts_in.start[e + 1] or contacts_in.head[e + 1] >= 0)

    @wp.kernel(module=module)
    def count(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        # Out:
        flow: Flow,
    ):
        k = wp.tid()
        e = model.first_node[k] + 1
        end = model.first_node[k + 1]
        if state.active[model.cell_of[e]] == 0:
            return
        loaded = int(0)
        while e < end:
            if may_be_loaded(contacts_in, e, end):
                loaded += 1
            e += 1
        flow.loaded[k] = loaded

    @wp.kernel(module=module)
    def arrange(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        # Out:
        flow: Flow,
    ):
        own = wp.tid()
        e = model.first_node[own] + 1
        end = model.first_node[own + 1]
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        first = model.first_flagellum[c]
        loaded = model.first_node[first]
        unloaded = loaded
        k = first
        while k < model.first_flagellum[c + 1]:
            unloaded += flow.loaded[k]
            if k < own:
                loaded += flow.loaded[k]
                unloaded += model.first_node[k + 1] - model.first_node[k] - 1 - flow.loaded[k]
            k += 1
        flow.start[own] = loaded
        flow.first_other[own] = unloaded
        if wp.static(flows.body):
            axes = axes_of(state, c)
        while e < end:
            slot = loaded
            if may_be_loaded(contacts_in, e, end):
                loaded += 1
            else:
                slot = unloaded
                unloaded += 1
            flow.node[slot] = e
            flow.slot[e] = slot
            x = state.pose.position[e]
            flow.sum.x[slot] = real(x[0])
            flow.sum.y[slot] = real(x[1])
            flow.sum.z[slot] = real(x[2])
            if wp.static(flows.unequal):
                flow.sum.radius[slot] = real(model.pairs.radius[own])
            if wp.static(flows.body):
                place(state, flow.shell, e, axes)
                if wp.static(by_cells):
                    find(model, flow.shell, e, own, c)
            e += 1

    tensor = rotne_prager.tensor_code(p.single, flows.unequal, "s.sum")

    @wp.func_native(native(__file__, "store_row", p.single, TENSOR=tensor))
    def store_row(s: Flow, row: wp.int32, i: wp.int32, begin: wp.int32, a: wp.float32): ...

    @wp.kernel(module=module)
    def store(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        flow: Flow,
    ):
        c = wp.tid()
        first = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        end -= model.first_flagellum[c + 1] - model.first_flagellum[c]
        i = first
        while i < end and state.active[c] != 0:
            store_row(flow, row_of(flow, first, c, i), i, first, real(model.pairs.radius[model.first_flagellum[c]]))
            i += 1

    return SimpleNamespace(count=count, arrange=arrange, store=store)


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `StepFlow`; none where forces cause no flows."""
    flow, device = struct(model.precision)(), model.device
    if model.switches.pairs == "none":
        return flow
    zeros = functools.partial(wp.zeros, device=device)
    flow.loaded, flow.start, flow.first_other = (zeros(model.flagellum_count, wp.int32) for _ in range(3))
    flow.node = zeros(model.element_count, wp.int32)
    flow.slot = wp.full(model.element_count, -1, dtype=wp.int32, device=device)
    step_pairs = model.plan.step_pairs
    results = () if step_pairs == "gathered" else ("ux", "uy", "uz")
    for name in ("x", "y", "z", "fx", "fy", "fz", *results):
        setattr(flow.sum, name, zeros(model.element_count, wp.float32))
    if model.switches.flows.unequal:
        flow.sum.radius = zeros(model.element_count, wp.float32)
    flow.shell = shell_stage.allocate(model, model.precision.single)
    if step_pairs == "stored":
        first_flagellum = model.data.first_flagellum.numpy()
        moving = np.diff(model.data.first_node.numpy()[first_flagellum]) - np.diff(first_flagellum)
        pairs = np.concatenate([[0], np.cumsum(moving * (moving - 1) // 2)])
        flow.first_pair = wp.array(pairs[:-1], dtype=wp.int32, device=device)
        for name in ("c", "qx", "qy", "qz"):
            setattr(flow, name, zeros(int(pairs[-1]), wp.float32))
    return flow


def build(model: DeviceModel, state: DeviceState, flow: Any, contacts_in: Any = None) -> None:
    """Slots, positions and pair coefficients of the nodes at the present pose.

    Args:
        model, state: of the batch.
        flow: struct `StepFlow`.
        contacts_in: the listed contacts, struct `Contacts`; None where nothing can touch.
    """
    kernels = _kernels(model.precision, contacts_in is not None, model.switches.flows, model.plan.by_cells)
    device = model.device
    listed = contact_list.struct(model.precision)() if contacts_in is None else contacts_in
    inputs = [model.data, state.data, listed, flow]
    wp.launch(kernels.count, model.flagellum_count, inputs=inputs, device=device)
    wp.launch(kernels.arrange, model.flagellum_count, inputs=inputs, device=device)
    if model.plan.step_pairs == "stored":
        wp.launch(kernels.store, model.cell_count, inputs=[model.data, state.data, flow], device=device)


@functools.cache
def _velocity_kernel(p: Precision, flows: Flows) -> Any:
    Model, State, Flow = structs(p).Model, structs(p).State, struct(p)
    sums = functions(p, flows, "stored")
    drag_velocity = node_velocity.local(p).drag_velocity
    load, spread, flow_at, slots_end = sums.load, sums.spread, sums.flow_at, sums.slots_end

    @wp.kernel(module=p.module("first_velocity", flows.variant))
    def cells(
        # Model:
        model: Model,
        # Out:
        flow: Flow,
        state: State,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        e = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        while e < end:
            if flow.slot[e] >= 0:
                load(flow, flow.slot[e], state.force[e])
            e += 1
        stop = slots_end(model, c)
        spread(model, flow, c, stop)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            e = model.first_node[k] + 1
            while e < model.first_node[k + 1]:
                flowing = flow_at(model, flow, e, k, c, stop, 0)
                state.velocity[e] = drag_velocity(model, state, e, k) + flowing
                e += 1
            k += 1

    return cells


def stores_pairs(model: DeviceModel) -> bool:
    """Whether the coefficients of pairs are stored."""
    return model.plan.step_pairs == "stored"


def single_velocities(model: DeviceModel, state: DeviceState, flow: Any) -> None:
    """Velocity of every node but r_0 in the lab [um/s], in single precision, into `velocity`.

    Args:
        model, state: of the batch, with the forces; with flow round the body, also its motion, found with `flow.shell`.
        flow: the struct `StepFlow`, built for this pose; its forces are overwritten.
    """
    flows = model.switches.flows
    kernel = _velocity_kernel(model.precision, flows.of_nodes)
    wp.launch(kernel, model.cell_count, inputs=[model.data, flow, state.data], device=model.device)
    if flows.body:
        body_flow.carry(model, state, flow.shell, model.precision.single)
