"""The contact law of an implicit step: forces at the contacts that agree with the gaps they lead to.

A load lambda on the contacts changes the increment by Y lambda and the gaps by W lambda = B^T Y lambda: B puts it on
the nodes, the near field of the pair sum carries it on, the factorised system answers. The gaps obey

    gap = free + W (F(gap) - acting),

F the steric force, free the gaps that the forces already acting lead to. `press` sets those to begin with: the law at
the extrapolated gaps, so that only changes have to go through W. Newton's method solves it, and GMRES its linear
systems (1 + k^1/2 W k^1/2) u = -k^1/2 residual with the stiffness k = -dF/dgap: nothing but products with W is needed,
each in time proportional to the nodes and contacts. Contacts are soft against what they rest on over one step, so a
few products are enough, however many contacts there are. An estimate w of a contact's own compliance scales the
systems, and takes the steepness of F out of them: Newton's steps are straight in gap - w F(gap), not in the gap.

One block of threads takes one cell: on CUDA its lanes share every loop and wait for each other between them, on a CPU
a single lane does it all.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import banded, chain, contacts, near_field, steric
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

LANES = 128  # threads of a block on CUDA
DIRECTIONS = 8  # of GMRES at most
LEAST_REDUCTION, MOST_REDUCTION = 0.05, 0.003  # of the linear residual, at which GMRES stops
ITERATIONS = 40  # of Newton's method
HALVINGS = 8
FINEST = 1.0e-5  # gaps are not solved for any finer [sigma]
STIFFENING = 0.15  # of a contact's compliance from local drag, for what else holds it
DEEPEST = 0.9  # extrapolated gaps count for no less: what overlaps deeply will have moved apart [sigma]


@wp.func_native("WP_TILE_SYNC();")
def meet():
    """Lanes of a block wait for each other; what one has written the others read."""
    ...


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Law`: unknowns, work space and settings."""
    real, vec3 = p.real, p.vec3
    Increment, vec6 = chain.types(p).Increment, chain.types(p).vec6

    @wp.struct
    class Law:
        # Per contact [capacity].
        free_gap: wp.array(dtype=real)
        solved_gap: wp.array(dtype=real)
        residual: wp.array(dtype=real)
        pressed: wp.array(dtype=real)  # force at the extrapolated pose [pN]
        force: wp.array(dtype=real)  # what acts [pN]
        load: wp.array(dtype=real)  # what W is applied to; between solutions: force - pressed [pN]
        change: wp.array(dtype=real)  # W load [um]
        yielding: wp.array(dtype=real)  # estimate of the contact's own compliance, a diagonal entry of W [um/pN]
        root: wp.array(dtype=real)  # square root of the stiffness that a contact shows against it
        basis: wp.array(dtype=real)  # [(DIRECTIONS + 1) * capacity], orthonormal
        moved: wp.array(dtype=real)  # [DIRECTIONS * capacity], W k^1/2 basis
        # Per element [E], flagellum [K], lane [C * LANES].
        on_first: wp.array(dtype=vec3)  # of segment i [pN]
        on_second: wp.array(dtype=vec3)
        on_node: wp.array(dtype=vec3)
        on_body: wp.array(dtype=vec6)  # [K]
        answer: Increment  # Y load
        partial: wp.array(dtype=real)  # of sums and maxima
        # Per cell [C].
        gain: wp.array(dtype=wp.float64)  # g
        tolerance: wp.array(dtype=real)  # of a gap [um]
        products: wp.array(dtype=wp.int32)  # with W, so far
        failed: wp.array(dtype=wp.int32)  # 1: not solved

    return Law


@functools.cache
def _kernels(p: Precision, pairs: str) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State = structs(p).Model, structs(p).State
    Band, Contacts, Law = banded.types(p).Band, contacts.struct(p), struct(p)
    NearField, Increment, vec6 = near_field.struct(p), chain.types(p).Increment, chain.types(p).vec6
    vecd = wp.types.vector(DIRECTIONS, real)
    hessenberg = wp.types.matrix((DIRECTIONS + 1, DIRECTIONS), real)
    rotations = wp.types.vector(DIRECTIONS + 1, real)
    steric_force, steric_stiffness = steric.functions(p).steric_force, steric.functions(p).steric_stiffness
    near_flow = near_field.functions(p).near_flow
    body_mobility, solve_flagellum = banded.functions(p).body_mobility, banded.functions(p).solve_flagellum
    lever = contacts.functions(p)
    gap_change, segment_loads, body_load = lever.gap_change, lever.segment_loads, lever.body_load
    directions, iterations, halvings = wp.constant(DIRECTIONS), wp.constant(ITERATIONS), wp.constant(HALVINGS)
    deepest, stiffening = wp.constant(real(DEEPEST)), wp.constant(real(STIFFENING))
    cutoff, linear_below = wp.constant(real(steric.CUTOFF)), wp.constant(real(steric.LINEAR_BELOW))
    settled = wp.constant(real(0.1 * FINEST))
    infinite = wp.constant(real(3.0e38))
    least_reduction, most_reduction = wp.constant(real(LEAST_REDUCTION)), wp.constant(real(MOST_REDUCTION))
    module = p.module("contact_law", pairs)

    @wp.kernel(module=module)
    def press(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        lanes: wp.int32,
        # Out:
        law: Law,
    ):
        c, lane = wp.tid()
        if state.active[c] == 0:
            return
        i = contacts_in.first[c] + lane
        while i < contacts_in.first[c] + contacts_in.count[c]:
            gap = wp.max(contacts_in.gap[i], deepest * model.steric_diameter[c])
            law.pressed[i] = steric_force(gap, model.steric_strength[c], model.steric_diameter[c])
            law.force[i] = law.pressed[i]
            law.solved_gap[i] = contacts_in.gap[i]
            i += lanes

    @wp.func(module=module)
    def own_compliance(model: Model, contacts_in: Contacts, i: wp.int32, time: real):
        """What the local drag of its nodes alone would let a contact yield in a time."""
        e = contacts_in.segment[i]
        s = contacts_in.at[i]
        u = real(1.0) - s
        weights = s * s + u * u
        if contacts_in.other[i] >= 0:
            s = contacts_in.at_other[i]
            u = real(1.0) - s
            weights += s * s + u * u
        return time * weights * model.mobility_across[e]

    @wp.func(module=module)
    def settle(s: real, compliance: real, strength: real, diameter: real):
        """The gap of a contact that yields alone: gap - compliance F(gap) = s."""
        edge = cutoff * diameter
        if s >= edge:
            return s
        # The left side is concave: from below, Newton's method rises to the solution without overshooting.
        gap = wp.max(s, linear_below * diameter)
        if gap - compliance * steric_force(gap, strength, diameter) > s:
            gap = s  # the solution lies where the law is linear, and is found at once
        i = int(0)
        while i < 20:
            f = gap - compliance * steric_force(gap, strength, diameter) - s
            step = -f / (real(1.0) + compliance * steric_stiffness(gap, strength, diameter))
            gap += step
            if wp.abs(step) < settled * diameter:
                i = 20
            i += 1
        return gap

    @wp.func(module=module)
    def block_sum(law: Law, value: real, c: wp.int32, lane: wp.int32, lanes: wp.int32):
        law.partial[c * lanes + lane] = value
        meet()
        total = real(0.0)
        i = int(0)
        while i < lanes:
            total += law.partial[c * lanes + i]
            i += 1
        meet()
        return total

    @wp.func(module=module)
    def block_max(law: Law, value: real, c: wp.int32, lane: wp.int32, lanes: wp.int32):
        law.partial[c * lanes + lane] = value
        meet()
        largest = real(0.0)
        i = int(0)
        while i < lanes:
            largest = wp.max(largest, law.partial[c * lanes + i])
            i += 1
        meet()
        return largest

    @wp.func(module=module)
    def product(
        model: Model,
        state: State,
        contacts_in: Contacts,
        band: Band,
        near: NearField,
        law: Law,
        c: wp.int32,
        lane: wp.int32,
        lanes: wp.int32,
    ):
        """W load into `change`, Y load into `answer`."""
        meet()
        k_begin = model.first_flagellum[c]
        k_end = model.first_flagellum[c + 1]
        begin = model.first_node[k_begin]
        end = model.first_node[k_end]
        e = begin + lane
        while e < end:
            on_first, on_second = segment_loads(contacts_in, law.load, e)
            law.on_first[e] = on_first
            law.on_second[e] = on_second
            e += lanes
        meet()
        e = begin + lane
        while e < end:
            f = law.on_second[e]
            if e + 1 < end:
                f += law.on_first[e + 1]  # zero where the next element is a tripod
            law.on_node[e] = f
            e += lanes
        meet()
        gain = real(law.gain[c])
        e = begin + lane
        while e < end:
            k = model.flagellum_of[e]
            f = vec3(real(0.0))
            if e > model.first_node[k]:
                f = law.on_node[e]
                if wp.static(pairs != "none"):
                    t = state.tangent[e]
                    if e + 1 < model.first_node[k + 1]:
                        t = wp.normalize(t + state.tangent[e + 1])
                    v = near_flow(near, law.on_node, e)
                    along = wp.dot(t, v) * t
                    f += along / model.mobility_along[e] + (v - along) / model.mobility_across[e]
                f = gain * f
            law.answer.node[e] = vec4(f[0], f[1], f[2], real(0.0))
            e += lanes
        meet()
        weight = real(band.weight[c])
        k = k_begin + lane
        while k < k_end:
            first = model.first_node[k]
            solve_flagellum(model, band, k, law.answer)
            back = vec6(real(0.0))
            for j in range(3):
                back += wp.transpose(band.from_body[3 * k + j]) * law.answer.node[first + j]
            on_body = body_load(model, state, contacts_in, law.load, k, law.on_node[first])
            law.on_body[k] = gain * on_body - weight * back
            k += lanes
        meet()
        if lane == 0:
            total = vec6(real(0.0))
            k = k_begin
            while k < k_end:
                total += law.on_body[k]
                k += 1
            force = vec3(total[0], total[1], total[2])
            torque = vec3(total[3], total[4], total[5])
            rate = body_mobility(model, state, c, force, torque)
            law.answer.body[c] = real(band.step[c]) * (band.body_inverse[c] * rate)
            law.products[c] += 1
        meet()
        body = law.answer.body[c]
        e = begin + lane
        while e < end:
            law.answer.node[e] = law.answer.node[e] - band.body_columns[e] * body
            e += lanes
        meet()
        i = contacts_in.first[c] + lane
        stop = contacts_in.first[c] + contacts_in.count[c]
        while i < stop:
            law.change[i] = gap_change(model, state, contacts_in, i, law.answer)
            i += lanes

    @wp.func(module=module)
    def evaluate(
        model: Model,
        state: State,
        contacts_in: Contacts,
        band: Band,
        near: NearField,
        law: Law,
        c: wp.int32,
        lane: wp.int32,
        lanes: wp.int32,
    ):
        """Residuals at the solved gaps; the largest."""
        strength = model.steric_strength[c]
        diameter = model.steric_diameter[c]
        begin = contacts_in.first[c]
        stop = begin + contacts_in.count[c]
        loaded = real(0.0)
        i = begin + lane
        while i < stop:
            load = steric_force(law.solved_gap[i], strength, diameter) - law.force[i]
            law.load[i] = load
            if load != real(0.0):
                loaded = real(1.0)
            i += lanes
        loaded = block_max(law, loaded, c, lane, lanes)
        if loaded > real(0.0):
            product(model, state, contacts_in, band, near, law, c, lane, lanes)
        worst = real(0.0)
        i = begin + lane
        while i < stop:
            r = law.solved_gap[i] - law.free_gap[i]
            if loaded > real(0.0):
                r -= law.change[i]
            law.residual[i] = r
            if not wp.isfinite(r):
                r = infinite  # a maximum would pass over what is not a number
            worst = wp.max(worst, wp.abs(r))
            i += lanes
        return block_max(law, worst, c, lane, lanes), loaded

    @wp.kernel(module=module)
    def solve(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        band: Band,
        near: NearField,
        start: Increment,
        coarse: real,
        lanes: wp.int32,
        # Out:
        law: Law,
        x: Increment,
    ):
        c, lane = wp.tid()
        if state.active[c] == 0:
            return
        strength = model.steric_strength[c]
        diameter = model.steric_diameter[c]
        begin = contacts_in.first[c]
        stop = begin + contacts_in.count[c]
        capacity = contacts_in.first[c + 1] - begin
        own_basis = (directions + 1) * begin
        own_moved = directions * begin
        tolerance = coarse * law.tolerance[c]
        i = begin + lane
        while i < stop:
            law.yielding[i] = own_compliance(model, contacts_in, i, stiffening * real(law.gain[c] * band.step[c]))
            law.free_gap[i] = contacts_in.gap[i] + gap_change(model, state, contacts_in, i, start)
            i += lanes
        worst = real(0.0)
        loaded = real(0.0)
        before = infinite
        shortened = real(1.0)
        iteration = int(0)
        halving = int(0)
        going = wp.where(stop > begin, 1, 0)
        while going != 0:
            worst, loaded = evaluate(model, state, contacts_in, band, near, law, c, lane, lanes)
            if worst <= tolerance:
                going = 0
            elif iteration > 0 and not (worst < before) and halving < halvings:
                shortened = real(0.5) * shortened
                halving += 1
                i = lane
                while i < stop - begin:
                    law.solved_gap[begin + i] = law.solved_gap[begin + i] - shortened * law.basis[own_basis + i]
                    i += lanes
            elif iteration == iterations:
                going = 0
            else:
                # GMRES for u, from zero.
                norm = real(0.0)
                i = begin + lane
                while i < stop:
                    k = steric_stiffness(law.solved_gap[i], strength, diameter)
                    root = wp.sqrt(k / (real(1.0) + k * law.yielding[i]))
                    law.root[i] = root
                    b = -root * law.residual[i]
                    law.basis[own_basis + i - begin] = b
                    norm += b * b
                    i += lanes
                norm = wp.sqrt(block_sum(law, norm, c, lane, lanes))
                enough = wp.clamp(real(0.5) * tolerance / worst, most_reduction, least_reduction)
                h = hessenberg()
                cosine = rotations()
                sine = rotations()
                right = rotations()
                right[0] = norm
                left = norm
                n = int(0)
                while n < directions and left > enough * norm:
                    # The direction's length, then its product.
                    at = own_basis + n * capacity
                    size = norm
                    if n > 0:
                        size = h[n, n - 1]  # kept below the triangle
                    scale = real(1.0) / size
                    i = lane
                    while i < stop - begin:
                        v = scale * law.basis[at + i]
                        law.basis[at + i] = v
                        law.load[begin + i] = law.root[begin + i] * v
                        i += lanes
                    product(model, state, contacts_in, band, near, law, c, lane, lanes)
                    i = lane
                    while i < stop - begin:
                        change = law.change[begin + i]
                        law.moved[own_moved + n * capacity + i] = change
                        root = law.root[begin + i]
                        scaled = real(1.0) - root * root * law.yielding[begin + i]
                        law.basis[at + capacity + i] = scaled * law.basis[at + i] + root * change
                        i += lanes
                    m = int(0)
                    while m <= n:
                        other = own_basis + m * capacity
                        dot = real(0.0)
                        i = lane
                        while i < stop - begin:
                            dot += law.basis[other + i] * law.basis[at + capacity + i]
                            i += lanes
                        dot = block_sum(law, dot, c, lane, lanes)
                        i = lane
                        while i < stop - begin:
                            law.basis[at + capacity + i] = law.basis[at + capacity + i] - dot * law.basis[other + i]
                            i += lanes
                        h[m, n] = dot
                        m += 1
                    size = real(0.0)
                    i = lane
                    while i < stop - begin:
                        size += law.basis[at + capacity + i] * law.basis[at + capacity + i]
                        i += lanes
                    size = wp.sqrt(block_sum(law, size, c, lane, lanes))
                    h[n + 1, n] = size
                    # Givens rotations turn the Hessenberg matrix into a triangle.
                    m = int(0)
                    while m < n:
                        a = h[m, n]
                        b = h[m + 1, n]
                        h[m, n] = cosine[m] * a + sine[m] * b
                        h[m + 1, n] = cosine[m] * b - sine[m] * a
                        m += 1
                    a = h[n, n]
                    length = wp.sqrt(a * a + size * size)
                    cosine[n] = a / length
                    sine[n] = size / length
                    h[n, n] = length
                    right[n + 1] = -sine[n] * right[n]
                    right[n] = cosine[n] * right[n]
                    left = wp.abs(right[n + 1])
                    n += 1
                y = vecd()
                m = n - 1
                while m >= 0:
                    value = right[m]
                    j = m + 1
                    while j < n:
                        value -= h[m, j] * y[j]
                        j += 1
                    y[m] = value / h[m, m]
                    m -= 1
                i = lane
                while i < stop - begin:
                    change = -law.residual[begin + i]
                    m = int(0)
                    while m < n:
                        change -= y[m] * law.moved[own_moved + m * capacity + i]
                        m += 1
                    gap = law.solved_gap[begin + i]
                    compliance = law.yielding[begin + i]
                    k = steric_stiffness(gap, strength, diameter)
                    alone = gap - compliance * steric_force(gap, strength, diameter)
                    alone += (real(1.0) + compliance * k) * change
                    change = settle(alone, compliance, strength, diameter) - gap
                    # Kept, should the step have to be shortened.
                    law.basis[own_basis + i] = change
                    law.solved_gap[begin + i] = gap + change
                    i += lanes
                before = worst
                shortened = real(1.0)
                halving = 0
                iteration += 1
        if lane == 0 and not (worst <= tolerance):
            law.failed[c] = 1
        meet()
        i = begin + lane
        while i < stop:
            law.force[i] = steric_force(law.solved_gap[i], strength, diameter)
            law.load[i] = law.force[i] - law.pressed[i]
            contacts_in.gap[i] = law.solved_gap[i]
            i += lanes
        e = model.first_node[model.first_flagellum[c]] + lane
        end = model.first_node[model.first_flagellum[c + 1]]
        while e < end:
            moved = start.node[e]
            if loaded > real(0.0):
                moved += law.answer.node[e]
            x.node[e] = moved
            e += lanes
        if lane == 0:
            body_moved = start.body[c]
            if loaded > real(0.0):
                body_moved += law.answer.body[c]
            x.body[c] = body_moved

    return SimpleNamespace(press=press, solve=solve)


def press(model: DeviceModel, state: DeviceState, contacts_in: Any, law: Any) -> None:
    """Forces at the listed gaps, into `force` and `pressed`: where the solution begins."""
    kernel, lanes = _kernels(model.precision, model.switches.pairs).press, _lanes(model)
    inputs = [model.data, state.data, contacts_in, lanes, law]
    wp.launch(kernel, (model.cell_count, lanes), inputs=inputs, device=model.device)


def solve(
    model: DeviceModel,
    state: DeviceState,
    contacts_in: Any,
    band: Any,
    near: Any,
    start: Any,
    law: Any,
    out: Any,
    coarse: float = 1.0,
) -> None:
    """Forces and gaps of the contacts, and the increment with them; `failed` tells of a cell without a solution.

    Newton's method starts at the gaps found last.

    Args:
        start: increment with the forces that act, before the contacts answer to it.
        out: increment with their answer, `start` + Y (F - acting).
        coarse: how many times the tolerance is enough.
    """
    kernel, lanes = _kernels(model.precision, model.switches.pairs).solve, _lanes(model)
    inputs = [model.data, state.data, contacts_in, band, near, start, coarse, lanes, law, out]
    wp.launch(kernel, (model.cell_count, lanes), inputs=inputs, device=model.device, block_dim=lanes)


def _lanes(model: DeviceModel) -> int:
    return 1 if model.device.is_cpu else LANES
