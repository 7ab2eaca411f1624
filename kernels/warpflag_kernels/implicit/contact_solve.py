"""The contact law of an implicit step: forces at the contacts that agree with the gaps they lead to.

With W the compliance (see `delassus`), the gaps obey

    gap = free + W (F(gap) - acting),

F the steric force, free the gaps that the forces already acting lead to. `warm_start` sets those to begin with: the law at
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

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import contact_list, steric
from warpflag_kernels.implicit import block_band, contact_loops, delassus, quasi_newton
from warpflag_kernels.implicit import step_flow as flow_stage
from warpflag_kernels.implicit.delassus import meet, struct
from warpflag_kernels.rod import chain_chart

ITERATIONS = 60
FINEST = 1.0e-6  # gaps are not solved for any finer [sigma]
STIFFENING = 0.25  # of a contact's compliance from local drag, for what else holds it
DEEP = 0.75  # a solution begins where such a contact would settle alone [sigma]
DEEPEST = 0.9  # predicted gaps count for no less: what overlaps deeply will have moved apart [sigma]


@functools.cache
def _kernels(p: Precision, pairs: str, form: str, chains: str, threads: int) -> SimpleNamespace:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Band, Contacts, Law = block_band.types(p).Band, contact_list.struct(p), struct(p)
    Flow, Increment = flow_stage.struct(p), chain_chart.types(p).Increment
    steric_force = steric.functions(p).steric_force
    gap_change = contact_list.functions(p).gap_change
    product = delassus.functions(p, pairs, form, chains, threads).product
    block_sum, block_max = delassus.reductions(p, threads).block_sum, delassus.reductions(p, threads).block_max
    loops = contact_loops.functions(p, threads)
    load_all, take, leave, settle_all = loops.load_all, loops.take, loops.leave, loops.settle_all
    secants = quasi_newton.functions(p, threads)
    learn, combine = secants.learn, secants.combine
    iterations, deep = wp.constant(ITERATIONS), wp.constant(real(DEEP))
    deepest, stiffening = wp.constant(real(DEEPEST)), wp.constant(real(STIFFENING))
    infinite = wp.constant(real(3.0e38))
    module = p.module("contact_solve", f"{pairs}_{form}_{chains}_{threads}")

    @wp.kernel(module=module)
    def warm_start(
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
        c, thread = wp.tid()
        if state.active[c] == 0:
            return
        i = contacts_out.first[c] + thread
        while i < contacts_out.first[c] + contacts_out.count[c]:
            gap = contacts_out.gap[i]
            if share[c] > wp.float64(0.0):
                gap += real(share[c]) * gap_change(model, state, contacts_out, i, predicted)
            counted = wp.max(gap, deepest * model.steric.diameter[c])
            law.force[i] = steric_force(counted, model.steric.strength[c], model.steric.diameter[c])
            law.solved_gap[i] = gap
            i += threads

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
        return time * weights * model.drag.mobility_across[e]

    @wp.func(module=module)
    def evaluate(
        model: Model,
        state: State,
        contacts_in: Contacts,
        band: Band,
        flow: Flow,
        law: Law,
        c: wp.int32,
        thread: wp.int32,
        x: Increment,
    ):
        """Residuals at the solved gaps, the largest, and whether forces beyond those that act cause them."""
        begin = contacts_in.first[c]
        stop = begin + contacts_in.count[c]
        loaded = load_all(law, begin, stop, model.steric.strength[c], model.steric.diameter[c], thread)
        loaded = block_sum(law, loaded, c, thread)
        if loaded != real(0.0):
            product(model, state, contacts_in, band, flow, law, c, thread)
            first = model.first_node[model.first_flagellum[c]]
            end = model.first_node[model.first_flagellum[c + 1]]
            take(law, x, begin, stop, first, end, thread)
            if thread == 0:
                x.body[c] = x.body[c] + law.answer.body[c]
        worst = leave(law, begin, stop, thread)
        return block_max(law, worst, c, thread), loaded

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
        c, thread = wp.tid()
        if state.active[c] == 0:
            return
        strength = model.steric.strength[c]
        diameter = model.steric.diameter[c]
        begin = contacts_in.first[c]
        stop = begin + contacts_in.count[c]
        capacity = contacts_in.first[c + 1] - begin
        tolerance = coarse * law.tolerance[c]
        i = begin + thread
        while i < stop:
            law.diagonal[i] = own_compliance(
                model, contacts_in, i, stiffening * real(law.gain[c] * band.step[c])
            )
            law.free_gap[i] = contacts_in.gap[i] + gap_change(model, state, contacts_in, i, start)
            law.applied[i] = real(0.0)
            law.answered[i] = real(0.0)
            i += threads
        e = model.first_node[model.first_flagellum[c]] + thread
        while e < model.first_node[model.first_flagellum[c + 1]]:
            x.node[e] = start.node[e]
            e += threads
        if thread == 0:
            x.body[c] = start.body[c]
            if anew:
                law.known[c] = 0
        worst = real(0.0)
        loaded = real(0.0)
        iteration = int(0)
        if anew:
            # What overlaps deeply begins where it would settle alone: huge forces would leave their round-off behind.
            any_deep = real(0.0)
            i = begin + thread
            while i < stop:
                any_deep = wp.max(any_deep, deep * diameter - law.solved_gap[i])
                i += threads
            if block_max(law, any_deep, c, thread) > real(0.0):
                load_all(law, begin, stop, strength, diameter, thread)
                i = begin + thread
                while i < stop:
                    law.wanted[i] = -law.diagonal[i] * law.load[i]
                    if law.solved_gap[i] < deep * diameter:
                        law.wanted[i] = law.free_gap[i] - law.solved_gap[i]
                    i += threads
                settle_all(law, begin, stop, strength, diameter, thread)
        going = wp.where(stop > begin, 1, 0)
        while going != 0:
            worst, loaded = evaluate(model, state, contacts_in, band, flow, law, c, thread, x)
            if worst <= tolerance or iteration == iterations or not (worst < infinite):
                going = 0
            else:
                iteration += 1
                if loaded > real(0.0):
                    learn(law, c, begin, stop - begin, capacity, thread)
                combine(law, c, begin, stop - begin, capacity, thread)
                settle_all(law, begin, stop, strength, diameter, thread)
        if thread == 0 and not (worst <= tolerance):
            law.failed[c] = 1
        meet()
        i = begin + thread
        while i < stop:
            law.force[i] = steric_force(law.solved_gap[i], strength, diameter)
            contacts_in.gap[i] = law.solved_gap[i] - law.residual[i]  # where the increment leads
            i += threads

    return SimpleNamespace(warm_start=warm_start, solve=solve)


def warm_start(model: DeviceModel, state: DeviceState, share: Any, predicted: Any, contacts_out: Any, law: Any) -> None:
    """Forces at the predicted gaps of the listed contacts, into `force`: where the solution begins.

    Args:
        share, predicted: share * predicted is what the gaps are still expected to move by. share: per cell, shape
            [cell_count].
    """
    inputs = [model.data, state.data, share, predicted, contacts_out, law]
    dim = (model.cell_count, model.plan.contact_block)
    wp.launch(_kernels_of(model).warm_start, dim, inputs=inputs, device=model.device)


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
    threads = model.plan.contact_block
    inputs = [model.data, state.data, contacts_in, band, flow, start, coarse, anew, law, out]
    kernel = _kernels_of(model).solve
    wp.launch(kernel, (model.cell_count, threads), inputs=inputs, device=model.device, block_dim=threads)


def _kernels_of(model: DeviceModel) -> SimpleNamespace:
    plan = model.plan
    return _kernels(model.precision, model.switches.pairs, plan.step_pairs, plan.chains, plan.contact_block)
