"""The contact law of an implicit step: forces at the contacts that agree with the gaps they lead to.

With W the compliance (see `compliance`), the gaps obey

    gap = free + W (F(gap) - acting),

F the steric force, free the gaps that the forces already acting lead to. `press` sets those to begin with: the law at
the gaps of the predicted pose, so that only changes have to go through W. Newton's method solves it, and GMRES its
linear systems (1 + k^1/2 W k^1/2) u = -k^1/2 residual with the stiffness k = -dF/dgap: nothing but products with W is
needed. Contacts are soft against what they rest on over one step, so a few are enough, however many contacts there
are. An estimate w of a contact's own compliance scales the systems, and takes the steepness of F out of them: Newton's
steps are straight in gap - w F(gap), not in the gap.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import banded, chain, compliance, contacts, steric
from warpflag_kernels import flow as flow_stage
from warpflag_kernels.compliance import DIRECTIONS, LANES, meet, struct
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

LEAST_REDUCTION, MOST_REDUCTION = 0.1, 0.001  # of the linear residual, at which GMRES stops
PATIENCE = 4  # iterations of Newton's method after which it does not stop early: contacts are very stiff
ITERATIONS = 60  # of Newton's method
HALVINGS = 3
FINEST = 1.0e-5  # gaps are not solved for any finer [sigma]
SETTLED = 1.0e-3  # change at which a contact's own Newton iteration has converged, the next would be its square [sigma]
STIFFENING = 0.15  # of a contact's compliance from local drag, for what else holds it
DEEPEST = 0.9  # predicted gaps count for no less: what overlaps deeply will have moved apart [sigma]


# Dot products with earlier directions, and their removal, are a vector loop only where the compiler is told that
# directions do not overlap.
_DOT = """
    const REAL* __restrict__ A = law.basis.data + a; const REAL* __restrict__ B = law.basis.data + b;
    REAL total = 0;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int i = lane; i < count; i += LANES) total += A[i] * B[i];
    return total;
"""
_REMOVE = """
    REAL* __restrict__ A = law.basis.data + a; const REAL* __restrict__ B = law.basis.data + b;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int i = lane; i < count; i += LANES) A[i] -= share * B[i];
"""


@functools.cache
def _kernels(p: Precision, pairs: str, form: str, lanes: int) -> SimpleNamespace:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Band, Contacts, Law = banded.types(p).Band, contacts.struct(p), struct(p)
    Flow, Increment = flow_stage.struct(p), chain.types(p).Increment
    vecd = wp.types.vector(DIRECTIONS, real)
    hessenberg = wp.types.matrix((DIRECTIONS + 1, DIRECTIONS), real)
    rotations = wp.types.vector(DIRECTIONS + 1, real)
    steric_force, steric_law = steric.functions(p).steric_force, steric.functions(p).steric_law
    gap_change = contacts.functions(p).gap_change
    f = compliance.functions(p, pairs, form, lanes)
    block_sum, block_max, product = f.block_sum, f.block_max, f.product
    directions, iterations, halvings = wp.constant(DIRECTIONS), wp.constant(ITERATIONS), wp.constant(HALVINGS)
    patience = wp.constant(PATIENCE)
    deepest, stiffening = wp.constant(real(DEEPEST)), wp.constant(real(STIFFENING))
    cutoff, linear_below = wp.constant(real(steric.CUTOFF)), wp.constant(real(steric.LINEAR_BELOW))
    settled = wp.constant(real(SETTLED))
    infinite = wp.constant(real(3.0e38))
    least_reduction, most_reduction = wp.constant(real(LEAST_REDUCTION)), wp.constant(real(MOST_REDUCTION))
    module = p.module("contact_law", f"{pairs}_{form}_{lanes}")

    def native(code: str) -> str:
        return code.replace("REAL", {"float64": "double", "float32": "float"}[p.name]).replace("LANES", str(lanes))

    @wp.func_native(native(_DOT))
    def dot_basis(law: Law, a: wp.int32, b: wp.int32, count: wp.int32, lane: wp.int32) -> real: ...

    @wp.func_native(native(_REMOVE))
    def remove(law: Law, a: wp.int32, b: wp.int32, count: wp.int32, lane: wp.int32, share: real): ...

    @wp.kernel(module=module)
    def press(
        # Model:
        model: Model,
        # State:
        state: State,
        share: wp.array(dtype=wp.float64),
        predicted: Increment,
        # Out:
        contacts_out: Contacts,
        law: Law,
    ):
        c, lane = wp.tid()
        if state.active[c] == 0:
            return
        i = contacts_out.first[c] + lane
        while i < contacts_out.first[c] + contacts_out.count[c]:
            gap = contacts_out.gap[i] + real(share[c]) * gap_change(model, state, contacts_out, i, predicted)
            counted = wp.max(gap, deepest * model.steric_diameter[c])
            law.force[i] = steric_force(counted, model.steric_strength[c], model.steric_diameter[c])
            law.solved_gap[i] = gap
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
    def settle(s: real, compliance: real, strength: real, diameter: real, gap: real):
        """The gap of a contact that yields alone, gap - compliance F(gap) = s, from an estimate of it."""
        if s >= cutoff * diameter:
            return s
        # The left side is concave: Newton's method overshoots from above once, from below it rises to the solution.
        gap = wp.clamp(gap, linear_below * diameter, cutoff * diameter)
        i = int(0)
        while i < 20:
            force, stiffness = steric_law(gap, strength, diameter)
            step = (s + compliance * force - gap) / (real(1.0) + compliance * stiffness)
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
        flow: Flow,
        law: Law,
        c: wp.int32,
        lane: wp.int32,
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
        loaded = block_max(law, loaded, c, lane)
        if loaded > real(0.0):
            product(model, state, contacts_in, band, flow, law, c, lane)
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
        return block_max(law, worst, c, lane), loaded

    @wp.kernel(module=module)
    def solve(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        band: Band,
        flow: Flow,
        start: Increment,
        coarse: real,
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
            worst, loaded = evaluate(model, state, contacts_in, band, flow, law, c, lane)
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
                    _force, k = steric_law(law.solved_gap[i], strength, diameter)
                    root = wp.sqrt(k / (real(1.0) + k * law.yielding[i]))
                    law.root[i] = root
                    b = -root * law.residual[i]
                    law.basis[own_basis + i - begin] = b
                    norm += b * b
                    i += lanes
                norm = wp.sqrt(block_sum(law, norm, c, lane))
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
                    product(model, state, contacts_in, band, flow, law, c, lane)
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
                        dot = block_sum(law, dot_basis(law, other, at + capacity, stop - begin, lane), c, lane)
                        remove(law, at + capacity, other, stop - begin, lane, dot)
                        h[m, n] = dot
                        m += 1
                    size = dot_basis(law, at + capacity, at + capacity, stop - begin, lane)
                    size = wp.sqrt(block_sum(law, size, c, lane))
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
                    force, k = steric_law(gap, strength, diameter)
                    alone = gap - compliance * force + (real(1.0) + compliance * k) * change
                    change = settle(alone, compliance, strength, diameter, gap + change) - gap
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
            contacts_in.gap[i] = law.solved_gap[i] - law.residual[i]  # where the increment leads
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


def press(model: DeviceModel, state: DeviceState, share: Any, predicted: Any, contacts_out: Any, law: Any) -> None:
    """Forces at the listed gaps, into `force` and `pressed`: where the solution begins.

    Args:
        share, predicted: share * predicted leads to the pose in which the contacts were found; gaps are taken back to
            the one it begins at. share: per cell, shape [cell_count].
    """
    inputs = [model.data, state.data, share, predicted, contacts_out, law]
    wp.launch(_kernels_of(model).press, (model.cell_count, _lanes(model)), inputs=inputs, device=model.device)


def solve(
    model: DeviceModel,
    state: DeviceState,
    contacts_in: Any,
    band: Any,
    flow: Any,
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
    lanes = _lanes(model)
    inputs = [model.data, state.data, contacts_in, band, flow, start, coarse, law, out]
    kernel = _kernels_of(model).solve
    wp.launch(kernel, (model.cell_count, lanes), inputs=inputs, device=model.device, block_dim=lanes)


def _lanes(model: DeviceModel) -> int:
    return LANES if model.threads_cooperate else 1


def _kernels_of(model: DeviceModel) -> SimpleNamespace:
    return _kernels(model.precision, model.switches.pairs, flow_stage.form_of(model), _lanes(model))
