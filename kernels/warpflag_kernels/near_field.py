"""Flows between nearby nodes: the part of the pair sum that decides how contacts answer to forces.

Two filaments that push each other apart drag the fluid between them along, which makes the gap several times harder
to open than local drag alone would. The opposite forces of two segments cancel at a distance, so only neighbours
matter:

    v_i = sum over loaded nodes j within the reach of  w_ij mu(r_ij) f_j,     w = (1 - d^2/reach^2)^2

d the distance of the midpoints of the segments that end at the nodes; the smooth weight keeps the cancellation exact
to first order. A node that is pressed against the body is felt everywhere. What is left out, the defect correction
adds.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import chain, contacts, mobility, neighbours
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

SLOTS = 48  # neighbours that a node keeps; more are left to the defect correction


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `NearField`: the tapered Rotne-Prager blocks of every node, row by row."""
    vec6 = chain.types(p).vec6

    @wp.struct
    class NearField:
        count: wp.array(dtype=wp.int32)  # [E]
        source: wp.array(dtype=wp.int32)  # [E * SLOTS]
        block: wp.array(dtype=vec6)  # [E * SLOTS], xx, xy, xz, yy, yz, zz [um/(s pN)]

    return NearField


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device function of the near field: the velocity that loads on the nodes cause."""
    real, vec3 = p.real, p.vec3
    NearField = struct(p)
    slots = wp.constant(SLOTS)

    @wp.func(module=p.module("near_field_functions"))
    def near_flow(near: NearField, load: wp.array(dtype=vec3), e: wp.int32):
        """Velocity of node e from the loads of its neighbours [um/s]."""
        v = vec3(real(0.0))
        i = e * slots
        end = i + near.count[e]
        while i < end:
            b = near.block[i]
            f = load[near.source[i]]
            v += vec3(
                b[0] * f[0] + b[1] * f[1] + b[2] * f[2],
                b[1] * f[0] + b[3] * f[1] + b[4] * f[2],
                b[2] * f[0] + b[4] * f[1] + b[5] * f[2],
            )
            i += 1
        return v

    return SimpleNamespace(near_flow=near_flow)


@functools.cache
def _kernels(p: Precision, pairs: str, steric: bool) -> SimpleNamespace:
    real, vec6 = p.real, chain.types(p).vec6
    Model, State = structs(p).Model, structs(p).State
    Contacts, NearField = contacts.struct(p), struct(p)
    rotne_prager = mobility.pair_coefficients(p)
    within, between = pairs in ("within", "all"), pairs in ("between", "all")
    slots, reach = wp.constant(SLOTS), wp.constant(real(neighbours.REACH))
    Neighbours, middle = structs(p).Neighbours, neighbours.functions(p).middle
    candidates, candidate = neighbours.functions(p).candidates, neighbours.functions(p).candidate
    module = p.module("near_field", pairs + ("_steric" if steric else ""))

    @wp.func(module=module)
    def loaded_by_segments(contacts_in: Contacts, e: wp.int32, end: wp.int32):
        """Whether other segments, but not the body, can load node e of a flagellum that ends before `end`."""
        last = contacts_in.stop[e] - 1  # a node's contact with the body is the last it lists
        if last >= contacts_in.start[e] and contacts_in.other[last] < 0:
            return False
        if last >= contacts_in.start[e] or contacts_in.head[e] >= 0:
            return True
        return e + 1 < end and (contacts_in.stop[e + 1] > contacts_in.start[e + 1] or contacts_in.head[e + 1] >= 0)

    @wp.func(module=module)
    def add(
        model: Model,
        state: State,
        near: NearField,
        c: wp.int32,
        e: wp.int32,
        j: wp.int32,
        weight: real,
    ):
        """The block of source j, times a weight, into the row of node e."""
        found = near.count[e]
        if found < slots:
            d = state.position[e] - state.position[j]
            plain, along = rotne_prager(wp.length(d), model.pair_radius[c])
            scale = weight * model.pair_mobility[c]
            plain = scale * plain
            s = (scale * along) * d
            near.source[e * slots + found] = j
            near.block[e * slots + found] = vec6(
                plain + s[0] * d[0], s[0] * d[1], s[0] * d[2], plain + s[1] * d[1], s[1] * d[2],
                plain + s[2] * d[2],
            )  # fmt: skip
            near.count[e] = found + 1

    @wp.func(module=module)
    def taper(state: State, e: wp.int32, j: wp.int32):
        """Weight of the flow between the nodes at the ends of two segments, by the distance of their midpoints."""
        d = middle(state, e) - middle(state, j)
        w = wp.max(real(1.0) - wp.dot(d, d) / (reach * reach), real(0.0))
        return w * w

    @wp.kernel(module=module)
    def build(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        others: Neighbours,
        # Out:
        near: NearField,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        near.count[e] = 0
        own = model.flagellum_of[e]
        first = model.first_node[own]
        end = model.first_node[own + 1]
        if e == first or contacts_in.count[c] == 0:
            return
        # Pressed against the body: a single force, which nothing cancels at a distance.
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            coupled = wp.where(k == own, wp.static(int(within)), wp.static(int(between)))
            i = contacts_in.body_head[k]
            while i >= 0 and coupled > 0:
                j = contacts_in.segment[i]
                if j != e:
                    add(model, state, near, c, e, j, real(1.0))
                i = contacts_in.next[i]
            k += 1
        if wp.static(within):
            span = int(reach / model.segment_length[own]) + 1
            j = wp.max(e - span, first + 1)
            while j <= e + span and j < end:
                weight = taper(state, e, j)
                if j != e and weight > real(0.0) and loaded_by_segments(contacts_in, j, end):
                    add(model, state, near, c, e, j, weight)
                j += 1
        if wp.static(between and steric):
            n = candidates(model, others, e)
            i = int(0)
            while i < n:
                j = candidate(model, others, e, i)
                i += 1
                if j >= 0:
                    weight = taper(state, e, j)
                    if weight > real(0.0) and loaded_by_segments(
                        contacts_in, j, model.first_node[model.flagellum_of[j] + 1]
                    ):
                        add(model, state, near, c, e, j, weight)

    return SimpleNamespace(build=build)


def build(model: DeviceModel, state: DeviceState, contacts_in: Any, near: Any) -> None:
    """The near field of the present positions, for loads on nodes that have contacts."""
    kernel = _kernels(model.precision, model.switches.pairs, model.switches.steric).build
    inputs = [model.data, state.data, contacts_in, state.neighbours, near]
    wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)
