"""How a step answers to forces at the contacts: columns of the implicit system, and the exact contact law among them.

Column c is the increment Y_c = P(g M B_c) that a unit force at contact c causes: B_c acts on the nodes of both sides
(on the body where a node is r_0), M is the full mobility with its pair sum, P the factorised system. Eight columns
travel together as one group, which is what fills a vector register. With W = B^T Y the gaps obey

    gap = r + B^T e_0 + W F(gap),

r the gaps of the extrapolated pose and F the steric force law: solved by Newton, in which only closed contacts need
a factorisation. The pose that this leads to has gaps of its own, since directions turn; `refine` measures them and
solves once more with the same W.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import banded, chain, contacts, mobility, steric
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

GROUP = 8
NEWTON_ITERATIONS = 60
HALVINGS = 8
NEAR_FIELD = 0.6  # of a contact's pair of forces in the columns [um]
# Of a gap, in units of sigma: where it only leads to the pose at which the gaps are measured again, and there.
ROUGH, FINE = 1.0e-3, 1.0e-5


@functools.cache
def types(p: Precision) -> SimpleNamespace:
    """Block types of a group of columns, and the struct `Response`."""
    real = p.real
    mat4g = wp.types.matrix((4, GROUP), real)
    mat6g = wp.types.matrix((6, GROUP), real)

    @wp.struct
    class Response:
        first_column: wp.array(dtype=wp.int32)  # [C + 1], of a cell's groups in `columns`
        columns: wp.array(dtype=mat4g)  # [sum of groups * elements per cell]
        body_columns: wp.array(dtype=mat6g)  # [groups]
        first_entry: wp.array(dtype=wp.int32)  # [C], of a cell's matrices
        compliance: wp.array(dtype=real)  # W [um/pN]
        factor: wp.array(dtype=real)  # of the closed contacts
        closed: wp.array(dtype=wp.int32)  # [capacity], their indices
        free_gap: wp.array(dtype=real)  # [capacity], gap without contact forces
        solved_gap: wp.array(dtype=real)  # [capacity]
        residual: wp.array(dtype=real)  # [capacity]
        change: wp.array(dtype=real)  # [capacity]
        force: wp.array(dtype=real)  # [capacity] [pN]
        total_force: wp.array(dtype=real)  # [capacity], corrections included [pN]
        closed_count: wp.array(dtype=wp.int32)  # [C], rows of `factor`
        gain: wp.array(dtype=wp.float64)  # [C], g
        failed: wp.array(dtype=wp.int32)  # [C], 1: the contact law was not solved

    return SimpleNamespace(mat4g=mat4g, mat6g=mat6g, Response=Response)


@functools.cache
def _kernels(p: Precision, pairs: str) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    t, b = types(p), banded.types(p)
    mat4g, mat6g, Response = t.mat4g, t.mat6g, t.Response
    vec6, Band = b.vec6, b.Band
    vecg = wp.types.vector(GROUP, real)
    Model, State = structs(p).Model, structs(p).State
    Contacts, Increment = contacts.struct(p), chain.types(p).Increment
    rotne_prager, body_mobility = mobility.pair_flow(p), banded.functions(p).body_mobility
    steric_force, steric_stiffness = steric.functions(p).steric_force, steric.functions(p).steric_stiffness
    within, between = pairs in ("within", "all"), pairs in ("between", "all")
    module = p.module("response", pairs)
    group = wp.constant(GROUP)
    near_field = wp.constant(real(NEAR_FIELD))
    iterations, halvings = wp.constant(NEWTON_ITERATIONS), wp.constant(HALVINGS)
    infinite = wp.constant(real(3.0e38))

    @wp.func(module=module)
    def extended(f: vec3):
        return vec4(f[0], f[1], f[2], real(0.0))

    @wp.func(module=module)
    def column_of(model: Model, response: Response, c: wp.int32, g: wp.int32, e: wp.int32):
        """Where element e of group g of a cell lies in `columns`."""
        begin = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        return response.first_column[c] + g * (end - begin) + e - begin

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

    @wp.func(module=module)
    def row_product(a: wp.array(dtype=real), i: wp.int32, b: wp.array(dtype=real), j: wp.int32, count: wp.int32):
        """Sum of a[i + m] b[j + m] over m < count; flat arrays and a while loop, so that it vectorises."""
        total = real(0.0)
        m = int(0)
        while m < count:
            total += a[i + m] * b[j + m]
            m += 1
        return total

    @wp.func(module=module)
    def evaluate(response: Response, strength: real, diameter: real, first: wp.int32, entry: wp.int32, count: wp.int32):
        """Forces and residuals at the solved gaps; the largest residual."""
        i = int(0)
        while i < count:
            response.force[first + i] = steric_force(response.solved_gap[first + i], strength, diameter)
            i += 1
        worst = real(0.0)
        i = int(0)
        while i < count:
            r = response.solved_gap[first + i] - response.free_gap[first + i]
            r -= row_product(response.compliance, entry + i * count, response.force, first, count)
            response.residual[first + i] = r
            if not wp.isfinite(r):
                r = infinite  # a maximum would pass over what is not a number
            worst = wp.max(worst, wp.abs(r))
            i += 1
        return worst

    @wp.func(module=module)
    def factorise_closed(
        response: Response, strength: real, diameter: real, first: wp.int32, entry: wp.int32, count: wp.int32
    ):
        """Factors L U of (1/k + W) over the closed contacts, k the contact stiffness; how many they are.

        W lacks symmetry by as much as the flows of the pair sum, since the matrix behind P leaves them out: a
        Cholesky factor of one half of it fails in a crowd. Rows of L, then columns of U, one after another without
        gaps; L has a unit diagonal, U the inverses of its own.
        """
        closed = int(0)
        i = int(0)
        while i < count:
            if steric_stiffness(response.solved_gap[first + i], strength, diameter) > real(0.0):
                response.closed[first + closed] = i
                closed += 1
            i += 1
        upper = entry + closed * (closed - 1) / 2
        i = int(0)
        while i < closed:
            a = response.closed[first + i]
            row = entry + i * (i - 1) / 2
            column = upper + i * (i + 1) / 2
            j = int(0)
            while j < i:
                b = response.closed[first + j]
                before = row_product(response.factor, row, response.factor, upper + j * (j + 1) / 2, j)
                pivot = response.factor[upper + j * (j + 1) / 2 + j]
                response.factor[row + j] = (response.compliance[entry + a * count + b] - before) * pivot
                before = row_product(response.factor, entry + j * (j - 1) / 2, response.factor, column, j)
                response.factor[column + j] = response.compliance[entry + b * count + a] - before
                j += 1
            value = response.compliance[entry + a * count + a]
            value += real(1.0) / steric_stiffness(response.solved_gap[first + a], strength, diameter)
            value -= row_product(response.factor, row, response.factor, column, i)
            response.factor[column + i] = real(1.0) / value
            i += 1
        return closed

    @wp.func(module=module)
    def solve_closed(response: Response, first: wp.int32, entry: wp.int32, count: wp.int32, closed: wp.int32):
        """Solves with those factors; right-hand side and solution in `change`."""
        i = int(0)
        while i < closed:
            row = entry + i * (i - 1) / 2
            response.change[first + i] -= row_product(response.factor, row, response.change, first, i)
            i += 1
        i = closed - 1
        while i >= 0:
            column = entry + closed * (closed - 1) / 2 + i * (i + 1) / 2
            value = response.change[first + i] * response.factor[column + i]
            response.change[first + i] = value
            j = int(0)
            while j < i:
                response.change[first + j] -= response.factor[column + j] * value
                j += 1
            i -= 1

    @wp.kernel(module=module)
    def yield_closed(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        x: Increment,
        # Out:
        response: Response,
    ):
        c = wp.tid()
        count = contacts_in.count[c]
        if state.active[c] == 0 or count == 0:
            return
        first = contacts_in.first[c]
        entry = response.first_entry[c]
        closed = response.closed_count[c]
        i = int(0)
        while i < closed:
            a = first + response.closed[first + i]
            response.change[first + i] = -gap_change(model, state, contacts_in, a, x)
            i += 1
        solve_closed(response, first, entry, count, closed)
        i = int(0)
        while i < count:
            response.force[first + i] = real(0.0)
            i += 1
        i = int(0)
        while i < closed:
            a = first + response.closed[first + i]
            response.force[a] = response.change[first + i]
            response.total_force[a] += response.change[first + i]
            i += 1

    @wp.kernel(module=module)
    def free_gaps(
        # State:
        state: State,
        contacts_in: Contacts,
        # Out:
        response: Response,
    ):
        c, index = wp.tid()
        count = contacts_in.count[c]
        if state.active[c] == 0 or index >= count:
            return
        first = contacts_in.first[c]
        row = response.first_entry[c] + index * count
        caused = row_product(response.compliance, row, response.force, first, count)
        response.free_gap[first + index] = contacts_in.gap[first + index] - caused

    @wp.kernel(module=module)
    def solve_gaps(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        accuracy: real,
        # Out:
        response: Response,
    ):
        c = wp.tid()
        count = contacts_in.count[c]
        if state.active[c] == 0 or count == 0:
            return
        first = contacts_in.first[c]
        entry = response.first_entry[c]
        strength = model.steric_strength[c]
        diameter = model.steric_diameter[c]
        tolerance = accuracy * diameter
        i = int(0)
        while i < count:
            response.solved_gap[first + i] = contacts_in.gap[first + i]
            i += 1
        worst = evaluate(response, strength, diameter, first, entry, count)
        iteration = int(0)
        closed = response.closed_count[c]  # -1: no factor yet of these contacts
        stalled = closed < 0
        while worst > tolerance and iteration < iterations:
            # An old factor serves as long as it brings the residual down quickly.
            if stalled:
                closed = factorise_closed(response, strength, diameter, first, entry, count)
            i = int(0)
            while i < closed:
                response.change[first + i] = -response.residual[first + response.closed[first + i]]
                i += 1
            solve_closed(response, first, entry, count, closed)
            # Change of every gap: -residual - W lambda, lambda spread over all contacts.
            i = int(0)
            while i < count:
                response.force[first + i] = real(0.0)
                i += 1
            i = int(0)
            while i < closed:
                response.force[first + response.closed[first + i]] = response.change[first + i]
                i += 1
            i = int(0)
            while i < count:
                row = entry + i * count
                value = response.residual[first + i]
                value += row_product(response.compliance, row, response.force, first, count)
                response.change[first + i] = -value
                response.solved_gap[first + i] -= value
                i += 1
            before = worst
            worst = evaluate(response, strength, diameter, first, entry, count)
            halving = int(0)
            scale = real(1.0)
            while not (worst < before) and halving < halvings and worst > tolerance:
                scale = real(0.5) * scale
                i = int(0)
                while i < count:
                    response.solved_gap[first + i] -= scale * response.change[first + i]
                    i += 1
                worst = evaluate(response, strength, diameter, first, entry, count)
                halving += 1
            stalled = worst > real(0.3) * before
            iteration += 1
        if not (worst <= tolerance):
            response.failed[c] = 1
        if closed < 0:
            closed = factorise_closed(response, strength, diameter, first, entry, count)
        response.closed_count[c] = closed
        i = int(0)
        while i < count:
            response.total_force[first + i] = response.force[first + i]
            i += 1

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
        free_gaps=free_gaps,
        solve_gaps=solve_gaps,
        yield_closed=yield_closed,
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
    wp.launch(kernels.solve_gaps, cells, inputs=[*inputs, ROUGH, response], device=device)
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
    inputs = [model.data, state.data, contacts_in, change, response]
    wp.launch(kernels.yield_closed, model.cell_count, inputs=inputs, device=device)
    inputs = [model.data, state.data, contacts_in, response, change, out]
    wp.launch(kernels.apply_nodes, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.apply_bodies, model.cell_count, inputs=inputs[1:], device=device)


def refine(
    model: DeviceModel, state: DeviceState, contacts_in: Any, response: Any, groups: int, start: Any, out: Any
) -> None:
    """Solves the contact law again after the gaps have been measured at the pose that it led to."""
    kernels, device = _kernels(model.precision, model.switches.pairs), model.device
    inputs = [state.data, contacts_in, response]
    wp.launch(kernels.free_gaps, (model.cell_count, groups * GROUP), inputs=inputs, device=device)
    inputs = [model.data, state.data, contacts_in, FINE, response]
    wp.launch(kernels.solve_gaps, model.cell_count, inputs=inputs, device=device)
    inputs = [model.data, state.data, contacts_in, response, start, out]
    wp.launch(kernels.apply_nodes, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.apply_bodies, model.cell_count, inputs=inputs[1:], device=device)
