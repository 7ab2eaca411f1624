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
from warpflag_kernels.compliance import DIRECTIONS, LANES, SMALL, meet, struct
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

ITERATIONS = 60
HALVINGS = 3
FINEST = 1.0e-5  # gaps are not solved for any finer [sigma]
SETTLED = 1.0e-3  # change at which a contact's own Newton iteration has converged, the next would be its square [sigma]
STIFFENING = 0.15  # of a contact's compliance from local drag, for what else holds it
DEEPEST = 0.9  # predicted gaps count for no less: what overlaps deeply will have moved apart [sigma]


SAME = 1.0e-3  # share of a load that must be new for it to be learnt from

# Sums over contacts are a vector loop only where the compiler is told that what they run over does not overlap.
_DOT = """
    const REAL* __restrict__ A = a.data + i; const REAL* __restrict__ B = b.data + j;
    const REAL* __restrict__ C = weight.data + k;
    REAL total = 0;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int n = lane; n < count; n += lanes) total += A[n] * B[n] * C[n];
    return total;
"""
_REMOVE = """
    REAL* __restrict__ A = a.data + i; const REAL* __restrict__ B = a.data + j;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int n = lane; n < count; n += lanes) A[n] -= share * B[n];
"""


@functools.cache
def _kernels(p: Precision, pairs: str, form: str, lanes: int) -> SimpleNamespace:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Band, Contacts, Law = banded.types(p).Band, contacts.struct(p), struct(p)
    Flow, Increment = flow_stage.struct(p), chain.types(p).Increment
    Reals = wp.array(dtype=real)
    steric_force, steric_law = steric.functions(p).steric_force, steric.functions(p).steric_law
    gap_change = contacts.functions(p).gap_change
    f = compliance.functions(p, pairs, form, lanes)
    block_sum, block_max, product = f.block_sum, f.block_max, f.product
    directions, iterations, halvings = wp.constant(DIRECTIONS), wp.constant(ITERATIONS), wp.constant(HALVINGS)
    same, small_size = wp.constant(real(SAME)), wp.constant(SMALL)
    deepest, stiffening = wp.constant(real(DEEPEST)), wp.constant(real(STIFFENING))
    cutoff, linear_below = wp.constant(real(steric.CUTOFF)), wp.constant(real(steric.LINEAR_BELOW))
    settled = wp.constant(real(SETTLED))
    infinite = wp.constant(real(3.0e38))
    module = p.module("contact_law", f"{pairs}_{form}_{lanes}")

    def native(code: str) -> str:
        return code.replace("REAL", {"float64": "double", "float32": "float"}[p.name])

    @wp.func_native(native(_DOT))
    def dot(
        a: Reals, i: wp.int32, b: Reals, j: wp.int32, weight: Reals, k: wp.int32,
        count: wp.int32, lane: wp.int32, lanes: wp.int32,
    ) -> real: ...  # fmt: skip

    @wp.func_native(native(_REMOVE))
    def remove(a: Reals, i: wp.int32, j: wp.int32, share: real, count: wp.int32, lane: wp.int32, lanes: wp.int32): ...

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

    @wp.func(module=module)
    def learn(law: Law, c: wp.int32, begin: wp.int32, count: wp.int32, capacity: wp.int32, lane: wp.int32):
        """Takes the load and its answer into what is known of W: what is new of the load, of unit length, and what W
        makes of it beyond the contacts' own compliance."""
        known = law.known[c]
        slot = known % directions
        own = directions * begin
        at = own + slot * capacity
        i = lane
        while i < count:
            load = law.load[begin + i]
            law.loads[at + i] = load
            law.answers[at + i] = law.change[begin + i] - law.yielding[begin + i] * load
            i += lanes
        size = dot(law.loads, at, law.loads, at, law.yielding, begin, count, lane, lanes)
        size = block_sum(law, size, c, lane)
        m = int(0)
        while m < wp.min(known, directions):
            if m != slot:
                other = own + m * capacity
                share = dot(law.loads, at, law.loads, other, law.yielding, begin, count, lane, lanes)
                share = block_sum(law, share, c, lane)
                remove(law.loads, at, other, share, count, lane, lanes)
                remove(law.answers, at, other, share, count, lane, lanes)
            m += 1
        left = dot(law.loads, at, law.loads, at, law.yielding, begin, count, lane, lanes)
        left = block_sum(law, left, c, lane)
        scale = real(0.0)
        if left > same * same * size:
            scale = real(1.0) / wp.sqrt(left)
        i = lane
        while i < count:
            law.loads[at + i] = scale * law.loads[at + i]
            law.answers[at + i] = scale * law.answers[at + i]
            i += lanes
        if lane == 0 and (scale > real(0.0) or known > slot):
            law.known[c] = known + 1
        meet()

    @wp.func(module=module)
    def solve_small(small: Reals, first: wp.int32, n: wp.int32):
        """Solves the system of n unknowns that lies at `first`, row after row with its right-hand side, in place."""
        width = n + 1
        col = int(0)
        while col < n:
            best = int(col)
            r = int(col) + 1
            while r < n:
                if wp.abs(small[first + r * width + col]) > wp.abs(small[first + best * width + col]):
                    best = r
                r += 1
            j = int(col)
            while j < width:
                swap = small[first + col * width + j]
                small[first + col * width + j] = small[first + best * width + j]
                small[first + best * width + j] = swap
                j += 1
            scale = real(1.0) / small[first + col * width + col]
            r = int(col) + 1
            while r < n:
                f = scale * small[first + r * width + col]
                j = int(col) + 1
                while j < width:
                    small[first + r * width + j] = small[first + r * width + j] - f * small[first + col * width + j]
                    j += 1
                r += 1
            col += 1
        col = n - 1
        while col >= 0:
            value = small[first + col * width + n]
            j = int(col) + 1
            while j < n:
                value -= small[first + col * width + j] * small[first + j * width + n]
                j += 1
            small[first + col * width + n] = value / small[first + col * width + col]
            col -= 1

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
        forget: wp.bool,
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
        own = directions * begin
        tolerance = coarse * law.tolerance[c]
        i = begin + lane
        while i < stop:
            law.yielding[i] = own_compliance(model, contacts_in, i, stiffening * real(law.gain[c] * band.step[c]))
            law.free_gap[i] = contacts_in.gap[i] + gap_change(model, state, contacts_in, i, start)
            i += lanes
        if forget and lane == 0:
            law.known[c] = 0
        worst = real(0.0)
        loaded = real(0.0)
        before = infinite
        shortened = real(1.0)
        iteration = int(0)
        halving = int(0)
        going = wp.where(stop > begin, 1, 0)
        while going != 0:
            worst, loaded = evaluate(model, state, contacts_in, band, flow, law, c, lane)
            if worst <= tolerance or iteration == iterations or not (worst < infinite):
                going = 0
            else:
                iteration += 1
                if loaded > real(0.0):
                    learn(law, c, begin, stop - begin, capacity, lane)
                if not (worst < before) and halving < halvings:
                    shortened = real(0.5) * shortened
                    halving += 1
                    i = begin + lane
                    while i < stop:
                        law.solved_gap[i] = law.solved_gap[i] - shortened * law.taken[i]
                        i += lanes
                else:
                    i = begin + lane
                    while i < stop:
                        _force, k = steric_law(law.solved_gap[i], strength, diameter)
                        compliance = law.yielding[i]
                        w = compliance * k / (real(1.0) + compliance * k)
                        law.share[i] = w
                        i += lanes
                    meet()
                    n = wp.min(law.known[c], directions)
                    first = c * small_size
                    entry = int(lane)
                    while entry < n * (n + 1):
                        row = own + (entry / (n + 1)) * capacity
                        column = entry % (n + 1)
                        value = real(0.0)
                        if column < n:
                            value = dot(
                                law.loads, row, law.answers, own + column * capacity, law.share, begin,
                                stop - begin, 0, 1,
                            )  # fmt: skip
                            if column == entry / (n + 1):
                                value += real(1.0)
                        else:
                            value = dot(law.loads, row, law.residual, begin, law.share, begin, stop - begin, 0, 1)
                        law.small[first + entry] = value
                        entry += lanes
                    meet()
                    if lane == 0:
                        solve_small(law.small, first, n)
                    meet()
                    i = begin + lane
                    while i < stop:
                        change = -law.residual[i]
                        m = int(0)
                        while m < n:
                            change += law.small[first + m * (n + 1) + n] * law.answers[own + m * capacity + i - begin]
                            m += 1
                        gap = law.solved_gap[i]
                        compliance = law.yielding[i]
                        force, k = steric_law(gap, strength, diameter)
                        guess = gap + change / (real(1.0) + compliance * k)
                        change = settle(gap - compliance * force + change, compliance, strength, diameter, guess) - gap
                        law.taken[i] = change  # should it have to be shortened
                        law.solved_gap[i] = gap + change
                        i += lanes
                    before = worst
                    shortened = real(1.0)
                    halving = 0
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
    forget: bool = True,
) -> None:
    """Forces and gaps of the contacts, and the increment with them; `failed` tells of a cell without a solution.

    Newton's method starts at the gaps found last.

    Args:
        start: increment with the forces that act, before the contacts answer to it.
        out: increment with their answer, `start` + Y (F - acting).
        coarse: how many times the tolerance is enough.
        forget: whether what is known of W is of other contacts.
    """
    lanes = _lanes(model)
    inputs = [model.data, state.data, contacts_in, band, flow, start, coarse, forget, law, out]
    kernel = _kernels_of(model).solve
    wp.launch(kernel, (model.cell_count, lanes), inputs=inputs, device=model.device, block_dim=lanes)


def _lanes(model: DeviceModel) -> int:
    return LANES if model.threads_cooperate else 1


def _kernels_of(model: DeviceModel) -> SimpleNamespace:
    return _kernels(model.precision, model.switches.pairs, flow_stage.form_of(model), _lanes(model))
