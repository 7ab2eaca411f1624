"""How a step answers to forces at the contacts: columns of the implicit system, one per contact.

Column c is the increment Y_c = P(g M B_c) that a unit force at contact c causes: B_c acts on the nodes of both sides
(on the body where a node is r_0), M is the full mobility with its pair sum, P the factorised system. Eight columns
travel together as one group, which is what fills a vector register. With W = B^T Y the gaps obey

    gap = r + B^T e_0 + W F(gap),

r the gaps of the extrapolated pose (see `gaps`). The pose that this leads to has gaps of its own, since directions
turn; `refine` measures them and solves once more with the same W.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import banded, chain, contacts, gaps, mobility
from warpflag_kernels.gaps import GROUP
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

NEAR_FIELD = 0.6  # of a contact's pair of forces in the columns [um]
# Of a gap, in units of sigma: where it only leads to the pose at which the gaps are measured again, and there.
ROUGH, FINE = 1.0e-3, 1.0e-5


@functools.cache
def _kernels(p: Precision, pairs: str) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    t, b = gaps.types(p), banded.types(p)
    mat4g, mat6g, Response = t.mat4g, t.mat6g, t.Response
    Band = b.Band
    vecg = wp.types.vector(GROUP, real)
    Model, State = structs(p).Model, structs(p).State
    Contacts, Increment = contacts.struct(p), chain.types(p).Increment
    rotne_prager, body_mobility = mobility.pair_flow(p), banded.functions(p).body_mobility
    lever = contacts.functions(p)
    extended, body_lever, gap_change = lever.extended, lever.body_lever, lever.gap_change
    within, between = pairs in ("within", "all"), pairs in ("between", "all")
    module = p.module("response", pairs)
    group = wp.constant(GROUP)
    near_field = wp.constant(real(NEAR_FIELD))

    @wp.func(module=module)
    def column_of(model: Model, response: Response, c: wp.int32, g: wp.int32, e: wp.int32):
        """Where element e of group g of a cell lies in `columns`."""
        begin = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        return response.first_column[c] + g * (end - begin) + e - begin

    @wp.func(module=module)
    def flow(model: Model, state: State, c: wp.int32, e: wp.int32, source: wp.int32, force: vec3):
        """Pair-sum velocity of node e from a force on node `source`."""
        k = model.flagellum_of[e]
        own = model.flagellum_of[source]
        if source == model.first_node[own] or source == e:
            return vec3(real(0.0))
        if wp.static(not within) and own == k:
            return vec3(real(0.0))
        if wp.static(not between) and own != k:
            return vec3(real(0.0))
        d = state.position[e] - state.position[source]
        return model.pair_mobility[c] * rotne_prager(d, force, model.pair_radius[c])

    @wp.func(module=module)
    def right_hand_sides_of_group(
        model: Model, state: State, contacts_in: Contacts, response: Response, e: wp.int32, g: wp.int32
    ):
        c = model.cell_of[e]
        count = contacts_in.count[c]
        gain = real(response.gain[c])
        k = model.flagellum_of[e]
        block = mat4g(real(0.0))
        if e > model.first_node[k]:
            tangent = state.tangent[e]
            if e + 1 < model.first_node[k + 1]:
                tangent = wp.normalize(tangent + state.tangent[e + 1])
            q = int(0)
            while q < group:
                if g * group + q < count:
                    i = contacts_in.first[c] + g * group + q
                    n = contacts_in.normal[i]
                    s = contacts_in.at[i]
                    seg = contacts_in.segment[i]
                    oth = contacts_in.other[i]
                    own = vec3(real(0.0))
                    if seg == e:
                        own = s * n
                    elif oth == e:
                        own = -contacts_in.at_other[i] * n
                    if oth >= 0:
                        if seg - 1 == e:
                            own += (real(1.0) - s) * n
                        elif oth - 1 == e:
                            own -= (real(1.0) - contacts_in.at_other[i]) * n
                    if wp.static(pairs != "none"):
                        v = vec3(real(0.0))
                        # The two sides' opposite forces cancel at a distance; the defect correction adds what is left.
                        away = state.position[e] - state.position[seg]
                        near = oth < 0 or wp.dot(away, away) < near_field * near_field
                        if near:
                            v = flow(model, state, c, e, seg, s * n)
                        if near and oth >= 0:
                            r = contacts_in.at_other[i]
                            v += flow(model, state, c, e, seg - 1, (real(1.0) - s) * n)
                            v -= flow(model, state, c, e, oth, r * n)
                            v -= flow(model, state, c, e, oth - 1, (real(1.0) - r) * n)
                        along = wp.dot(tangent, v) * tangent
                        own += along / model.mobility_along[e] + (v - along) / model.mobility_across[e]
                    block[0, q] = gain * own[0]
                    block[1, q] = gain * own[1]
                    block[2, q] = gain * own[2]
                q += 1
        response.columns[column_of(model, response, c, g, e)] = block

    @wp.kernel(module=module)
    def right_hand_sides(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        lanes: wp.int32,
        # Out:
        response: Response,
    ):
        e, lane = wp.tid()
        c = model.cell_of[e]
        g = int(lane)
        while state.active[c] != 0 and g * group < contacts_in.count[c]:
            right_hand_sides_of_group(model, state, contacts_in, response, e, g)
            g += lanes

    @wp.func(module=module)
    def solve_flagella_of_group(
        model: Model, state: State, contacts_in: Contacts, band: Band, response: Response, k: wp.int32, g: wp.int32
    ):
        first = model.first_node[k]
        c = model.cell_of[first]
        start = column_of(model, response, c, g, first)
        size = model.first_node[k + 1] - first
        y1 = mat4g(real(0.0))
        y2 = mat4g(real(0.0))
        i = int(0)
        while i < size:
            y = response.columns[start + i]
            if i > 0:
                y -= band.lower1[first + i] * y1
            if i > 1:
                y -= band.lower2[first + i] * y2
            y = band.diagonal[first + i] * y
            response.columns[start + i] = y
            y2 = y1
            y1 = y
            i += 1
        y1 = mat4g(real(0.0))
        y2 = mat4g(real(0.0))
        i = size - 1
        while i >= 0:
            y = response.columns[start + i]
            if i + 1 < size:
                y -= wp.transpose(band.lower1[first + i + 1]) * y1
            if i + 2 < size:
                y -= wp.transpose(band.lower2[first + i + 2]) * y2
            y = wp.transpose(band.diagonal[first + i]) * y
            response.columns[start + i] = y
            y2 = y1
            y1 = y
            i -= 1

    @wp.kernel(module=module)
    def solve_flagella(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        band: Band,
        lanes: wp.int32,
        # Out:
        response: Response,
    ):
        k, lane = wp.tid()
        c = model.cell_of[model.first_node[k]]
        g = int(lane)
        while state.active[c] != 0 and g * group < contacts_in.count[c]:
            solve_flagella_of_group(model, state, contacts_in, band, response, k, g)
            g += lanes

    @wp.func(module=module)
    def solve_bodies_of_group(
        model: Model, state: State, contacts_in: Contacts, band: Band, response: Response, c: wp.int32, g: wp.int32
    ):
        count = contacts_in.count[c]
        back = mat6g(real(0.0))
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            first = model.first_node[k]
            for j in range(3):
                column = column_of(model, response, c, g, first + j)
                back += wp.transpose(band.from_body[3 * k + j]) * response.columns[column]
            k += 1
        weight = real(band.weight[c])
        rates = mat6g(real(0.0))
        q = int(0)
        while q < group:
            if g * group + q < count:
                i = contacts_in.first[c] + g * group + q
                f = real(response.gain[c]) * body_lever(model, state, i, contacts_in)
                force = vec3(f[0], f[1], f[2]) - weight * vec3(back[0, q], back[1, q], back[2, q])
                torque = vec3(f[3], f[4], f[5]) - weight * vec3(back[3, q], back[4, q], back[5, q])
                v = body_mobility(model, state, c, force, torque)
                j = int(0)
                while j < 6:
                    rates[j, q] = v[j]
                    j += 1
            q += 1
        response.body_columns[contacts_in.first[c] / group + g] = real(band.step[c]) * (band.body_inverse[c] * rates)

    @wp.kernel(module=module)
    def solve_bodies(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        band: Band,
        lanes: wp.int32,
        # Out:
        response: Response,
    ):
        c, lane = wp.tid()
        g = int(lane)
        while state.active[c] != 0 and g * group < contacts_in.count[c]:
            solve_bodies_of_group(model, state, contacts_in, band, response, c, g)
            g += lanes

    @wp.func(module=module)
    def follow_bodies_of_group(
        model: Model, state: State, contacts_in: Contacts, band: Band, response: Response, e: wp.int32, g: wp.int32
    ):
        c = model.cell_of[e]
        column = column_of(model, response, c, g, e)
        body = response.body_columns[contacts_in.first[c] / group + g]
        response.columns[column] = response.columns[column] - band.body_columns[e] * body

    @wp.kernel(module=module)
    def follow_bodies(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        band: Band,
        lanes: wp.int32,
        # Out:
        response: Response,
    ):
        e, lane = wp.tid()
        c = model.cell_of[e]
        g = int(lane)
        while state.active[c] != 0 and g * group < contacts_in.count[c]:
            follow_bodies_of_group(model, state, contacts_in, band, response, e, g)
            g += lanes

    @wp.func(module=module)
    def group_forces(response: Response, contacts_in: Contacts, c: wp.int32, g: wp.int32):
        """Solved contact forces of one group, zero beyond the list's end."""
        forces = vecg(real(0.0))
        q = int(0)
        while q < group:
            if g * group + q < contacts_in.count[c]:
                forces[q] = response.force[contacts_in.first[c] + g * group + q]
            q += 1
        return forces

    @wp.kernel(module=module)
    def project(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        start: Increment,
        # Out:
        response: Response,
    ):
        c, index = wp.tid()
        count = contacts_in.count[c]
        if state.active[c] == 0 or index >= count:
            return
        i = contacts_in.first[c] + index
        response.free_gap[i] = contacts_in.gap[i] + gap_change(model, state, contacts_in, i, start)
        if index == 0:
            response.closed_count[c] = -1
        n = extended(contacts_in.normal[i])
        s = contacts_in.at[i]
        r = contacts_in.at_other[i]
        e = contacts_in.segment[i]
        j = contacts_in.other[i]
        lever = body_lever(model, state, i, contacts_in)
        has_before = j >= 0 and e - 1 != model.first_node[model.flagellum_of[e]]
        has_other_before = False
        if j >= 0:
            has_other_before = j - 1 != model.first_node[model.flagellum_of[j]]
        row = response.first_entry[c] + index * count
        g = int(0)
        while g * group < count:
            w = (s * n) * response.columns[column_of(model, response, c, g, e)]
            w += lever * response.body_columns[contacts_in.first[c] / group + g]
            if has_before:
                w += ((real(1.0) - s) * n) * response.columns[column_of(model, response, c, g, e - 1)]
            if j >= 0:
                w -= (r * n) * response.columns[column_of(model, response, c, g, j)]
            if has_other_before:
                w -= ((real(1.0) - r) * n) * response.columns[column_of(model, response, c, g, j - 1)]
            q = int(0)
            while q < group:
                if g * group + q < count:
                    response.compliance[row + g * group + q] = w[q]
                q += 1
            g += 1

    @wp.kernel(module=module)
    def apply_nodes(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        response: Response,
        start: Increment,
        # Out:
        x: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        value = start.node[e]
        g = int(0)
        while g * group < contacts_in.count[c]:
            forces = group_forces(response, contacts_in, c, g)
            value += response.columns[column_of(model, response, c, g, e)] * forces
            g += 1
        x.node[e] = value

    @wp.kernel(module=module)
    def apply_bodies(
        # State:
        state: State,
        contacts_in: Contacts,
        response: Response,
        start: Increment,
        # Out:
        x: Increment,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        value = start.body[c]
        g = int(0)
        while g * group < contacts_in.count[c]:
            forces = group_forces(response, contacts_in, c, g)
            value += response.body_columns[contacts_in.first[c] / group + g] * forces
            g += 1
        x.body[c] = value

    return SimpleNamespace(
        right_hand_sides=right_hand_sides,
        solve_flagella=solve_flagella,
        solve_bodies=solve_bodies,
        follow_bodies=follow_bodies,
        project=project,
        apply_nodes=apply_nodes,
        apply_bodies=apply_bodies,
    )


def respond(
    model: DeviceModel,
    state: DeviceState,
    contacts_in: Any,
    band: Any,
    response: Any,
    groups: int,
    start: Any,
    out: Any,
) -> None:
    """The increment with contact forces, from the one without.

    Args:
        groups: launch size, groups of columns per cell at most.
        start: increment e_0 without contact forces.
        out: e_0 + Y F.
    """
    kernels, device = _kernels(model.precision, model.switches.pairs), model.device
    cells, flagella, elements = model.cell_count, model.flagellum_count, model.element_count
    inputs = [model.data, state.data, contacts_in]
    # Groups beyond a cell's list cost their launch: a serial device takes them one after another in each thread.
    lanes = 1 if device.is_cpu else groups
    wp.launch(kernels.right_hand_sides, (elements, lanes), inputs=[*inputs, lanes, response], device=device)
    wp.launch(kernels.solve_flagella, (flagella, lanes), inputs=[*inputs, band, lanes, response], device=device)
    wp.launch(kernels.solve_bodies, (cells, lanes), inputs=[*inputs, band, lanes, response], device=device)
    wp.launch(kernels.follow_bodies, (elements, lanes), inputs=[*inputs, band, lanes, response], device=device)
    wp.launch(kernels.project, (cells, groups * GROUP), inputs=[*inputs, start, response], device=device)
    gaps.solve_gaps(model, state, contacts_in, response, ROUGH)
    wp.launch(kernels.apply_nodes, elements, inputs=[*inputs, response, start, out], device=device)
    inputs = [state.data, contacts_in, response, start, out]
    wp.launch(kernels.apply_bodies, cells, inputs=inputs, device=device)


def yield_contacts(
    model: DeviceModel, state: DeviceState, contacts_in: Any, response: Any, change: Any, out: Any
) -> None:
    """A small change of the increment, after the closed contacts have answered to it linearly.

    Args:
        change: increment z without the contacts' answer.
        out: z + Y dF; not `change` itself.
    """
    kernels, device = _kernels(model.precision, model.switches.pairs), model.device
    gaps.yield_closed(model, state, contacts_in, response, change)
    inputs = [model.data, state.data, contacts_in, response, change, out]
    wp.launch(kernels.apply_nodes, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.apply_bodies, model.cell_count, inputs=inputs[1:], device=device)


def refine(
    model: DeviceModel, state: DeviceState, contacts_in: Any, response: Any, groups: int, start: Any, out: Any
) -> None:
    """Solves the contact law again after the gaps have been measured at the pose that it led to."""
    kernels, device = _kernels(model.precision, model.switches.pairs), model.device
    gaps.free_gaps(model, state, contacts_in, response, groups * GROUP)
    gaps.solve_gaps(model, state, contacts_in, response, FINE)
    inputs = [model.data, state.data, contacts_in, response, start, out]
    wp.launch(kernels.apply_nodes, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.apply_bodies, model.cell_count, inputs=inputs[1:], device=device)
