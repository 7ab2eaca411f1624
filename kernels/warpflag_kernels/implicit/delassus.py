"""The Delassus operator of a step's contacts: changes of the gaps per contact force, as products without the matrix.

Contact forces lambda change the increment by Y lambda and the gaps by W lambda. With the contact Jacobian B

    Y = P g M B,      W = B^T Y :

B distributes contact forces to nodes and bodies, M is the mobility with the Rotne-Prager sum, P the inverse of the
step's matrix.

One block of threads takes one cell: on CUDA its threads share every loop and synchronise between them, on a CPU a
single thread does it all.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.plan import Flows
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, structs
from warpflag_kernels.contact import contact_list
from warpflag_kernels.fluid import shell_flow
from warpflag_kernels.implicit import block_band, body_coupling
from warpflag_kernels.implicit import step_flow as flow_stage
from warpflag_kernels.rod import chain_chart


@wp.func_native("WP_TILE_SYNC();")
def meet():
    """Threads of a block wait for each other; what one has written the others read."""
    ...


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `ContactLaw`: unknowns, work space and settings."""
    real, vec3 = p.real, p.vec3
    Increment, vec6 = chain_chart.types(p).Increment, chain_chart.types(p).vec6

    @wp.struct
    class ContactLaw:
        # Per contact [capacity].
        free_gap: wp.array(dtype=real)  # at the end of the step, if contact forces do not change [um]
        solved_gap: wp.array(dtype=real)  # the unknown [um]
        residual: wp.array(dtype=real)  # solved_gap - free_gap - W applied [um]
        force: wp.array(dtype=real)  # contact force that velocities are evaluated with [pN]
        load: wp.array(dtype=real)  # vector that the next product applies W to [pN]
        applied: wp.array(dtype=real)  # sum of all vectors that W has been applied to in this solution [pN]
        answered: wp.array(dtype=real)  # W applied [um]
        change: wp.array(dtype=real)  # W load [um]
        diagonal: wp.array(dtype=real)  # diagonal compliance, an estimate of W's diagonal [um/pN]
        # d k/(1 + d k), d the diagonal compliance, k the stiffness of the contact.
        stiffness_ratio: wp.array(dtype=real)
        wanted: wp.array(dtype=real)  # change of gap - d F(gap) that the linear model asks for [um]
        # Secant pairs, see `quasi_newton`: orthonormal vectors, and W less the diagonal applied to them.
        loads: wp.array(dtype=real)  # [SECANTS_KEPT * capacity]
        responses: wp.array(dtype=real)  # [SECANTS_KEPT * capacity]
        # Per element [E], flagellum [K], thread [C * threads of a block].
        on_first: wp.array(dtype=vec3)  # contact force of segment i on its first node [pN]
        on_second: wp.array(dtype=vec3)  # on its second node [pN]
        on_node: wp.array(dtype=vec3)  # on a node [pN]
        on_body: wp.array(dtype=vec6)  # [K], g times a flagellum's load on the body, less s H_bf of its solution
        response: Increment  # Y load
        partial: wp.array(dtype=real)  # every thread's part of a sum or maximum
        # Per cell [C].
        gain: wp.array(dtype=wp.float64)  # g
        gap_tolerance: wp.array(dtype=real)  # of a gap [um]
        small: wp.array(dtype=real)  # [C * SYSTEM_ENTRIES], the linear system in the span of the secant pairs
        known: wp.array(dtype=wp.int32)  # secant pairs found so far
        products: wp.array(dtype=wp.int32)  # with W, so far
        failed: wp.array(dtype=wp.int32)  # 1: the gaps were not found

    return ContactLaw


def allocate(model: DeviceModel, contacts_in: Any) -> Any:
    """Arrays of the struct `ContactLaw`, for as many contacts as there is room for."""
    p, cells, elements, total = model.precision, model.cell_count, model.element_count, len(contacts_in.gap)
    vec6 = chain_chart.types(p).vec6

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=model.device)

    law = struct(p)()
    gaps, forces = ("free_gap", "solved_gap", "residual", "answered", "change"), ("force", "load", "applied")
    for name in (*gaps, *forces, "diagonal", "stiffness_ratio"):
        setattr(law, name, zeros(total, p.real))
    law.on_node = zeros(elements, p.vec3)
    if model.plan.contact_block > 1:
        law.on_first, law.on_second = zeros(elements, p.vec3), zeros(elements, p.vec3)
    law.on_body = zeros(model.flagellum_count, vec6)
    law.response.node, law.response.body = zeros(elements, p.vec4), zeros(cells, vec6)
    law.partial = zeros(cells * model.plan.contact_block, p.real)
    law.gain, law.gap_tolerance = zeros(cells, wp.float64), zeros(cells, p.real)
    law.products, law.failed = zeros(cells, wp.int32), zeros(cells, wp.int32)
    return law


@functools.cache
def reductions(p: Precision, threads: int) -> SimpleNamespace:
    """Device functions of one block of so many threads: sums and maxima over them."""
    real, Law = p.real, struct(p)
    module = p.module("block_reductions", str(threads))

    @wp.func(module=module)
    def block_sum(law: Law, value: real, c: wp.int32, thread: wp.int32):
        if wp.static(threads == 1):
            return value
        law.partial[c * threads + thread] = value
        meet()
        total = real(0.0)
        i = int(0)
        while i < threads:
            total += law.partial[c * threads + i]
            i += 1
        meet()
        return total

    @wp.func(module=module)
    def block_max(law: Law, value: real, c: wp.int32, thread: wp.int32):
        if wp.static(threads == 1):
            return value
        law.partial[c * threads + thread] = value
        meet()
        largest = real(0.0)
        i = int(0)
        while i < threads:
            largest = wp.max(largest, law.partial[c * threads + i])
            i += 1
        meet()
        return largest

    return SimpleNamespace(block_sum=block_sum, block_max=block_max)


@functools.cache
def functions(p: Precision, flows: Flows, step_pairs: str, chains: str, threads: int) -> SimpleNamespace:
    """Device function `product` of one block of so many threads: W and Y applied to a load."""
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State = structs(p).Model, structs(p).State
    Band, Contacts, Law = block_band.types(p).Band, contact_list.struct(p), struct(p)
    Flow, vec6 = flow_stage.struct(p), chain_chart.types(p).vec6
    sums = flow_stage.functions(p, flows, step_pairs)
    load, spread, flow_at, loaded_end = sums.load, sums.spread, sums.flow_at, sums.loaded_end
    band_functions, body_rate = block_band.functions(p), body_coupling.functions(p, flows.body).body_rate
    drag, solve_flagellum = band_functions.drag, band_functions.solve_flagellum
    solve_cell, follow = band_functions.solve_cell, band_functions.follow
    jacobian = contact_list.functions(p)
    gap_change, body_load = jacobian.gap_change, jacobian.body_load
    segment_loads, node_loads = jacobian.segment_loads, jacobian.node_loads
    stored = step_pairs != "gathered"
    beads = shell_flow.functions(p, p.single, stored)
    axes_of, pull, answer, bead_flow = beads.axes_of, beads.pull, beads.answer, beads.flow_at_bead
    hold_row, sum_loads, load_rows, flow_at_node = beads.hold_row, beads.sum_loads, beads.load_rows, beads.flow_at_node
    module = p.module("delassus", f"{flows.variant}_{step_pairs}_{chains}_{threads}")

    @wp.func(module=module)
    def held(flow: Flow, c: wp.int32):
        """Force [pN] and torque [pN um] of the flow on the body of cell c when it is held."""
        f = flow.shell.force[c]
        t = flow.shell.torque[c]
        return vec6(real(f[0]), real(f[1]), real(f[2]), real(t[0]), real(t[1]), real(t[2]))

    @wp.func(module=module)
    def load_beads(
        model: Model, state: State, contacts_in: Contacts, flow: Flow, law: Law, c: wp.int32, thread: wp.int32
    ):  # fmt: skip
        """Loads on the beads of the body under the contact forces, and their resultant when it is held."""
        axes = axes_of(state, c)
        k = model.first_flagellum[c] + thread
        while k < model.first_flagellum[c + 1]:
            e = model.first_node[k] + 1
            while e < model.first_node[k + 1]:
                pull(flow.shell, e, axes, law.on_node[e])
                e += 1
            k += threads
        meet()
        rows = 3 * (flow.shell.first[c + 1] - flow.shell.first[c])
        if wp.static(stored):
            answer(model, flow.shell, c)
        else:
            i = int(thread)
            while i < rows / 3:
                bead_flow(model, flow.shell, c, i)
                i += threads
            meet()
            i = int(thread)
            while i < rows:
                hold_row(flow.shell, c, i)
                i += threads
            meet()
        if thread == 0:
            sum_loads(flow.shell, c, axes)
        meet()
        total = held(flow, c)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            total += body_load(model, state, contacts_in, law.load, k, law.on_node[model.first_node[k]])
            k += 1
        motion = body_rate(model, state, c, total)
        u = vec3(motion[0], motion[1], motion[2])
        w = vec3(motion[3], motion[4], motion[5])
        if wp.static(threads == 1):
            load_rows(model, flow.shell, c, axes, u, w, 0, rows)
        else:
            i = int(thread)
            while i < rows:
                load_rows(model, flow.shell, c, axes, u, w, i, i + 1)
                i += threads
            meet()

    @wp.func(module=module)
    def product(
        model: Model,
        state: State,
        contacts_in: Contacts,
        band: Band,
        flow: Flow,
        law: Law,
        c: wp.int32,
        thread: wp.int32,
    ):
        """W load into `change`, Y load into `response`."""
        meet()
        k_begin = model.first_flagellum[c]
        k_end = model.first_flagellum[c + 1]
        begin = model.first_node[k_begin]
        end = model.first_node[k_end]
        e = begin + thread
        if wp.static(threads == 1):
            while e < end:
                law.on_node[e] = vec3(real(0.0))
                e += 1
            node_loads(model, contacts_in, law.load, c, law.on_node)
        else:
            while e < end:
                on_first, on_second = segment_loads(contacts_in, law.load, e)
                law.on_first[e] = on_first
                law.on_second[e] = on_second
                e += threads
            meet()
            e = begin + thread
            while e < end:
                f = law.on_second[e]
                if e + 1 < end:
                    f += law.on_first[e + 1]  # zero where the next element is a tripod
                law.on_node[e] = f
                e += threads
        if wp.static(flows.pairs != "none"):
            e = begin + thread
            while e < end:
                if flow.slot[e] >= 0:
                    load(flow, flow.slot[e], law.on_node[e])
                e += threads
        meet()
        if wp.static(step_pairs != "gathered"):
            spread(model, flow, c, loaded_end(model, flow, c))
        if wp.static(flows.body):
            load_beads(model, state, contacts_in, flow, law, c, thread)
            axes = axes_of(state, c)
        gain = real(law.gain[c])
        e = begin + thread
        while e < end:
            k = model.flagellum_of[e]
            f = vec3(real(0.0))
            if e > model.first_node[k]:
                f = law.on_node[e]
                if wp.static(flows.pairs != "none"):
                    v = flow_at(model, flow, e, k, c, loaded_end(model, flow, c), 0)
                    if wp.static(flows.body):
                        v += flow_at_node(model, flow.shell, e, k, c, axes)
                    f += drag(band, e, v)
                f = gain * f
            law.response.node[e] = vec4(f[0], f[1], f[2], real(0.0))
            e += threads
        meet()
        weight = real(band.weight[c])
        if wp.static(chains == "simd"):
            solve_cell(model, band, c, law.response)
        k = k_begin + thread
        while k < k_end:
            first = model.first_node[k]
            if wp.static(chains == "serial"):
                solve_flagellum(model, band, k, law.response)
            back = vec6(real(0.0))
            for j in range(3):
                back += wp.transpose(band.from_body[3 * k + j]) * law.response.node[first + j]
            on_body = body_load(model, state, contacts_in, law.load, k, law.on_node[first])
            law.on_body[k] = gain * on_body - weight * back
            k += threads
        meet()
        if thread == 0:
            total = vec6(real(0.0))
            if wp.static(flows.body):
                total = gain * held(flow, c)
            k = k_begin
            while k < k_end:
                total += law.on_body[k]
                k += 1
            rate = body_rate(model, state, c, total)
            law.response.body[c] = real(band.step[c]) * (band.body_inverse[c] * rate)
            law.products[c] += 1
        meet()
        body = law.response.body[c]
        e = begin + thread
        while e < end:
            law.response.node[e] = follow(band, e, law.response.node[e], body)
            e += threads
        meet()
        i = contacts_in.first[c] + thread
        stop = contacts_in.first[c] + contacts_in.count[c]
        while i < stop:
            law.change[i] = gap_change(model, state, contacts_in, i, law.response)
            i += threads

    return SimpleNamespace(product=product)
