"""The contact law of an implicit step: forces at the contacts that agree with the gaps they lead to.

With W the compliance (see `compliance`), the gaps obey

    gap = free + W (F(gap) - acting),

F the steric force, free the gaps that the forces already acting lead to. `press` sets those to begin with: the law at
the extrapolated gaps, so that only changes have to go through W. Newton's method solves it, and GMRES its linear
systems (1 + k^1/2 W k^1/2) u = -k^1/2 residual with the stiffness k = -dF/dgap: nothing but products with W is needed,
each in time proportional to the nodes and contacts. Contacts are soft against what they rest on over one step, so a
few products are enough, however many contacts there are. An estimate w of a contact's own compliance scales the
systems, and takes the steepness of F out of them: Newton's steps are straight in gap - w F(gap), not in the gap.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import banded, chain, compliance, contacts, near_field, steric
from warpflag_kernels.compliance import LANES, meet, struct
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

DIRECTIONS = 10  # of GMRES at most
LEAST_REDUCTION, MOST_REDUCTION = 0.05, 0.001  # of the linear residual, at which GMRES stops
PATIENCE = 4  # iterations of Newton's method after which it does not stop early: contacts are very stiff
ITERATIONS = 60  # of Newton's method
HALVINGS = 3
FINEST = 1.0e-5  # gaps are not solved for any finer [sigma]
STIFFENING = 0.15  # of a contact's compliance from local drag, for what else holds it
DEEPEST = 0.9  # extrapolated gaps count for no less: what overlaps deeply will have moved apart [sigma]


@functools.cache
def _kernels(p: Precision, pairs: str) -> SimpleNamespace:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Band, Contacts, Law = banded.types(p).Band, contacts.struct(p), struct(p)
    NearField, Increment = near_field.struct(p), chain.types(p).Increment
    vecd = wp.types.vector(DIRECTIONS, real)
    hessenberg = wp.types.matrix((DIRECTIONS + 1, DIRECTIONS), real)
    rotations = wp.types.vector(DIRECTIONS + 1, real)
    steric_force, steric_stiffness = steric.functions(p).steric_force, steric.functions(p).steric_stiffness
    gap_change = contacts.functions(p).gap_change
    f = compliance.functions(p, pairs)
    block_sum, block_max, product = f.block_sum, f.block_max, f.product
    directions, iterations, halvings = wp.constant(DIRECTIONS), wp.constant(ITERATIONS), wp.constant(HALVINGS)
    patience = wp.constant(PATIENCE)
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
                enough = most_reduction
                if iteration < patience:
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
