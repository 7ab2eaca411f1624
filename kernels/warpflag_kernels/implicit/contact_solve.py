"""The contact law of an implicit step: forces at the contacts that agree with the gaps they lead to.

With W the compliance (see `delassus`), the gaps obey

    gap = free + W (F(gap) - acting),

F the steric force, free the gaps that the forces already acting lead to. `press` sets those to begin with: the law at
the predicted gaps, so that only changes have to go through W. Products with W are dear and all else is cheap, so every
product is made the most of. A quasi-Newton method learns from it what W does to a load (`quasi_newton`) and, for the
rest, takes each contact to yield by an estimate w of its own compliance; that takes the steepness of F out of the
systems, since a contact that yields alone can be solved for as it is: gap - w F(gap). What has been learnt in the
first iteration of a step serves the second. Contacts are soft against what they rest on over one step, so a few
products are enough, however many contacts there are.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.types import DeviceModel, DeviceState, Precision, structs
from warpflag_kernels.contact import contact_list, steric
from warpflag_kernels.implicit import block_band, contact_loops, delassus, quasi_newton
from warpflag_kernels.implicit import frozen_flow as flow_stage
from warpflag_kernels.implicit.delassus import LANES, meet, struct
from warpflag_kernels.rod import chain_chart

ITERATIONS = 60
FINEST = 1.0e-6  # gaps are not solved for any finer [sigma]
STIFFENING = 0.25  # of a contact's compliance from local drag, for what else holds it
DEEP = 0.75  # a solution begins where such a contact would settle alone [sigma]
DEEPEST = 0.9  # predicted gaps count for no less: what overlaps deeply will have moved apart [sigma]


@functools.cache
def _kernels(p: Precision, pairs: str, form: str, lanes: int) -> SimpleNamespace:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Band, Contacts, Law = block_band.types(p).Band, contact_list.struct(p), struct(p)
    Flow, Increment = flow_stage.struct(p), chain_chart.types(p).Increment
    steric_force = steric.functions(p).steric_force
    gap_change = contact_list.functions(p).gap_change
    f = delassus.functions(p, pairs, form, lanes)
    block_sum, block_max, product = f.block_sum, f.block_max, f.product
    loops = contact_loops.functions(p, lanes)
    load_all, take, leave, settle_all = loops.load_all, loops.take, loops.leave, loops.settle_all
    learn, combine = (
        quasi_newton.functions(p, pairs, form, lanes).learn,
        quasi_newton.functions(p, pairs, form, lanes).combine,
    )
    iterations, deep = wp.constant(ITERATIONS), wp.constant(real(DEEP))
    deepest, stiffening = wp.constant(real(DEEPEST)), wp.constant(real(STIFFENING))
    infinite = wp.constant(real(3.0e38))
    module = p.module("contact_law", f"{pairs}_{form}_{lanes}")

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
            gap = contacts_out.gap[i]
            if share[c] > wp.float64(0.0):
                gap += real(share[c]) * gap_change(model, state, contacts_out, i, predicted)
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
    def evaluate(
        model: Model,
        state: State,
        contacts_in: Contacts,
        band: Band,
        flow: Flow,
        law: Law,
        c: wp.int32,
        lane: wp.int32,
        x: Increment,
    ):
        """Residuals at the solved gaps, the largest, and whether forces beyond those that act cause them."""
        begin = contacts_in.first[c]
        stop = begin + contacts_in.count[c]
        loaded = load_all(law, begin, stop, model.steric_strength[c], model.steric_diameter[c], lane)
        loaded = block_sum(law, loaded, c, lane)
        if loaded != real(0.0):
            product(model, state, contacts_in, band, flow, law, c, lane)
            first = model.first_node[model.first_flagellum[c]]
            end = model.first_node[model.first_flagellum[c + 1]]
            take(law, x, begin, stop, first, end, lane)
            if lane == 0:
                x.body[c] = x.body[c] + law.answer.body[c]
        worst = leave(law, begin, stop, lane)
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
        anew: wp.bool,
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
        tolerance = coarse * law.tolerance[c]
        i = begin + lane
        while i < stop:
            law.yielding[i] = own_compliance(model, contacts_in, i, stiffening * real(law.gain[c] * band.step[c]))
            law.free_gap[i] = contacts_in.gap[i] + gap_change(model, state, contacts_in, i, start)
            law.applied[i] = real(0.0)
            law.answered[i] = real(0.0)
            i += lanes
        e = model.first_node[model.first_flagellum[c]] + lane
        while e < model.first_node[model.first_flagellum[c + 1]]:
            x.node[e] = start.node[e]
            e += lanes
        if lane == 0:
            x.body[c] = start.body[c]
            if anew:
                law.known[c] = 0
        worst = real(0.0)
        loaded = real(0.0)
        iteration = int(0)
        if anew:
            # What overlaps deeply begins where it would settle alone: huge forces would leave their round-off behind.
            any_deep = real(0.0)
            i = begin + lane
            while i < stop:
                any_deep = wp.max(any_deep, deep * diameter - law.solved_gap[i])
                i += lanes
            if block_max(law, any_deep, c, lane) > real(0.0):
                load_all(law, begin, stop, strength, diameter, lane)
                i = begin + lane
                while i < stop:
                    law.wanted[i] = -law.yielding[i] * law.load[i]
                    if law.solved_gap[i] < deep * diameter:
                        law.wanted[i] = law.free_gap[i] - law.solved_gap[i]
                    i += lanes
                settle_all(law, begin, stop, strength, diameter, lane)
        going = wp.where(stop > begin, 1, 0)
        while going != 0:
            worst, loaded = evaluate(model, state, contacts_in, band, flow, law, c, lane, x)
            if worst <= tolerance or iteration == iterations or not (worst < infinite):
                going = 0
            else:
                iteration += 1
                if loaded > real(0.0):
                    learn(law, c, begin, stop - begin, capacity, lane)
                combine(law, c, begin, stop - begin, capacity, lane)
                settle_all(law, begin, stop, strength, diameter, lane)
        if lane == 0 and not (worst <= tolerance):
            law.failed[c] = 1
        meet()
        i = begin + lane
        while i < stop:
            law.force[i] = steric_force(law.solved_gap[i], strength, diameter)
            contacts_in.gap[i] = law.solved_gap[i] - law.residual[i]  # where the increment leads
            i += lanes

    return SimpleNamespace(press=press, solve=solve)


def press(model: DeviceModel, state: DeviceState, share: Any, predicted: Any, contacts_out: Any, law: Any) -> None:
    """Forces at the predicted gaps of the listed contacts, into `force`: where the solution begins.

    Args:
        share, predicted: share * predicted is what the gaps are still expected to move by. share: per cell, shape
            [cell_count].
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
    anew: bool = True,
) -> None:
    """Forces and gaps of the contacts, and the increment with them; `failed` tells of a cell without a solution.

    It starts at the gaps found last.

    Args:
        start: increment with the forces that act, before the contacts answer to it.
        out: increment with their answer, `start` + Y (F - acting).
        coarse: how many times the tolerance is enough.
        anew: whether these contacts are solved for the first time; else with what the last solution told of W.
    """
    lanes = _lanes(model)
    inputs = [model.data, state.data, contacts_in, band, flow, start, coarse, anew, law, out]
    kernel = _kernels_of(model).solve
    wp.launch(kernel, (model.cell_count, lanes), inputs=inputs, device=model.device, block_dim=lanes)


def _lanes(model: DeviceModel) -> int:
    return LANES if model.threads_cooperate else 1


def _kernels_of(model: DeviceModel) -> SimpleNamespace:
    return _kernels(model.precision, model.switches.pairs, flow_stage.form_of(model), _lanes(model))
