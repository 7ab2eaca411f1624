"""The contact solve of an implicit step: contact forces that obey the steric law at the gaps to which they lead.

With W the Delassus operator (see `delassus`), the gaps obey the nonlinear system

    gap = free + W (F(gap) - acting),

F the steric force, acting the contact forces that velocities were evaluated with, free the gaps that those lead to.
`warm_start` takes for acting the law at the predicted gaps, so that only the difference has to go through W.

Products with W dominate the cost. A multisecant quasi-Newton method (`quasi_newton`) approximates W by its diagonal d,
which is estimated, and a correction of low rank from the products made so far; secant pairs found in the first
iteration of a step are used again in the second. The stiff law enters through scalar equations gap - d F(gap) = c, one
for each contact, solved exactly. Over one step d times the stiffness of a contact is 0.1 to 8, so a few products are
enough, however many contacts there are.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.native import native
from warpflag_kernels.base.plan import Flows
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import contact_list, steric
from warpflag_kernels.contact.constants import CUTOFF, LINEAR_BELOW
from warpflag_kernels.implicit import block_band, delassus, quasi_newton
from warpflag_kernels.implicit import step_flow as flow_stage
from warpflag_kernels.implicit.delassus import meet, struct
from warpflag_kernels.rod import chain_chart

NEWTON_STEPS = 4  # Newton iterations of a contact's scalar equation; what they leave enters the next residual
CONTACT_ITERATIONS = 60  # products with W at most; crowds take some ten
FINEST = 1.0e-6  # least tolerance of a gap [sigma]; below, the residual is round-off of the float32 flows
FINEST_SINGLE = 1.0e-5  # the same in float32, whose sums leave residuals of up to 4e-6 sigma
# Diagonal compliance over that of the nodes' local drag alone: elasticity and neighbours hold a node as well.
DIAGONAL_PER_DRAG = 0.25
DEEP = 0.75  # below this gap a solution starts from the contact's own scalar equation [sigma]
DEEPEST = 0.9  # predicted gaps are taken to be at least this [sigma]: forces of deeper ones would overshoot


@functools.cache
def _loops(p: Precision, threads: int) -> SimpleNamespace:
    """Device functions over the contacts [begin, stop) of one cell, for one thread of so many.

    They are in C++ so that a CPU's compiler makes vector code of them; on a GPU the threads of a block share each loop.
    """
    real, Law, Increment = p.real, struct(p), chain_chart.types(p).Increment

    law, bits = steric.law_code(p), {"float64": "long long", "float32": "int"}[p.name]

    @wp.func_native(native(__file__, "load_contacts", p, LAW=law, THREADS=threads))
    def load_contacts(
        law_in: Law, begin: wp.int32, stop: wp.int32, strength: real, diameter: real, thread: wp.int32
    ) -> real: ...

    @wp.func_native(native(__file__, "add_product", p, THREADS=threads))
    def add_product(
        law_in: Law, x: Increment, begin: wp.int32, stop: wp.int32, first: wp.int32, end: wp.int32, thread: wp.int32
    ): ...

    @wp.func_native(native(__file__, "residuals", p, THREADS=threads, BITS=bits))
    def residuals(law_in: Law, begin: wp.int32, stop: wp.int32, thread: wp.int32) -> real: ...

    words = {"NEWTON_STEPS": NEWTON_STEPS, "CUTOFF": CUTOFF, "LINEAR": LINEAR_BELOW}

    @wp.func_native(native(__file__, "solve_single_contacts", p, LAW=law, THREADS=threads, **words))
    def solve_single(
        law_in: Law, begin: wp.int32, stop: wp.int32, strength: real, diameter: real, thread: wp.int32
    ): ...

    return SimpleNamespace(
        load_contacts=load_contacts, add_product=add_product, residuals=residuals, solve_single=solve_single
    )


@functools.cache
def _kernels(p: Precision, flows: Flows, step_pairs: str, chains: str, threads: int) -> SimpleNamespace:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Band, Contacts, Law = block_band.types(p).Band, contact_list.struct(p), struct(p)
    Flow, Increment = flow_stage.struct(p), chain_chart.types(p).Increment
    steric_force = steric.functions(p).steric_force
    gap_change = contact_list.functions(p).gap_change
    product = delassus.functions(p, flows, step_pairs, chains, threads).product
    block_sum, block_max = delassus.reductions(p, threads).block_sum, delassus.reductions(p, threads).block_max
    loops = _loops(p, threads)
    load_contacts, add_product = loops.load_contacts, loops.add_product
    residuals, solve_single = loops.residuals, loops.solve_single
    secants = quasi_newton.functions(p, threads)
    learn, combine = secants.learn, secants.combine
    iterations, deep = wp.constant(CONTACT_ITERATIONS), wp.constant(real(DEEP))
    deepest, per_drag = wp.constant(real(DEEPEST)), wp.constant(real(DIAGONAL_PER_DRAG))
    infinite = wp.constant(real(3.0e38))
    module = p.module("contact_solve", f"{flows.variant}_{step_pairs}_{chains}_{threads}")

    @wp.kernel(module=module)
    def warm_start(
        # Model:
        model: Model,
        # State:
        state: State,
        trust: wp.array(dtype=wp.float64),
        predicted: Increment,
        contacts_in: Contacts,
        # Out:
        law: Law,
    ):
        c, thread = wp.tid()
        if state.active[c] == 0:
            return
        i = contacts_in.first[c] + thread
        while i < contacts_in.first[c] + contacts_in.count[c]:
            gap = contacts_in.gap[i]
            if trust[c] > wp.float64(0.0):
                gap += real(trust[c]) * gap_change(model, state, contacts_in, i, predicted)
            counted = wp.max(gap, deepest * model.steric.diameter[c])
            law.force[i] = steric_force(counted, model.steric.strength[c], model.steric.diameter[c])
            law.solved_gap[i] = gap
            i += threads

    @wp.func(module=module)
    def own_compliance(model: Model, contacts_in: Contacts, i: wp.int32, time: real):
        """Compliance of a contact from the local drag of its nodes alone, over a time [um/pN]."""
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
        """Applies W to the forces at the solved gaps less those applied so far.

        Returns the largest residual [um], and the sum of the squares of that difference [pN^2].
        """
        begin = contacts_in.first[c]
        stop = begin + contacts_in.count[c]
        loaded = load_contacts(law, begin, stop, model.steric.strength[c], model.steric.diameter[c], thread)
        loaded = block_sum(law, loaded, c, thread)
        if loaded != real(0.0):
            product(model, state, contacts_in, band, flow, law, c, thread)
            first = model.first_node[model.first_flagellum[c]]
            end = model.first_node[model.first_flagellum[c + 1]]
            add_product(law, x, begin, stop, first, end, thread)
            if thread == 0:
                x.body[c] = x.body[c] + law.response.body[c]
        worst = residuals(law, begin, stop, thread)
        return block_max(law, worst, c, thread), loaded

    @wp.kernel(module=module)
    def solve(
        # Model:
        model: Model,
        # State:
        state: State,
        start: Increment,
        coarse: real,
        anew: wp.bool,
        # Out:
        contacts: Contacts,
        band: Band,
        flow: Flow,
        law: Law,
        x: Increment,
    ):
        c, thread = wp.tid()
        if state.active[c] == 0:
            return
        strength = model.steric.strength[c]
        diameter = model.steric.diameter[c]
        begin = contacts.first[c]
        stop = begin + contacts.count[c]
        capacity = contacts.first[c + 1] - begin
        tolerance = coarse * law.gap_tolerance[c]
        i = begin + thread
        while i < stop:
            law.diagonal[i] = own_compliance(model, contacts, i, per_drag * real(law.gain[c] * band.step[c]))
            law.free_gap[i] = contacts.gap[i] + gap_change(model, state, contacts, i, start)
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
            # Deep overlaps start from their own scalar equations: the round-off of huge forces would stay in the sums.
            any_deep = real(0.0)
            i = begin + thread
            while i < stop:
                any_deep = wp.max(any_deep, deep * diameter - law.solved_gap[i])
                i += threads
            if block_max(law, any_deep, c, thread) > real(0.0):
                load_contacts(law, begin, stop, strength, diameter, thread)
                i = begin + thread
                while i < stop:
                    law.wanted[i] = -law.diagonal[i] * law.load[i]
                    if law.solved_gap[i] < deep * diameter:
                        law.wanted[i] = law.free_gap[i] - law.solved_gap[i]
                    i += threads
                solve_single(law, begin, stop, strength, diameter, thread)
        going = wp.where(stop > begin, 1, 0)
        while going != 0:
            worst, loaded = evaluate(model, state, contacts, band, flow, law, c, thread, x)
            if worst <= tolerance or iteration == iterations or not (worst < infinite):
                going = 0
            else:
                iteration += 1
                if loaded > real(0.0):
                    learn(law, c, begin, stop - begin, capacity, thread)
                combine(law, c, begin, stop - begin, capacity, thread)
                solve_single(law, begin, stop, strength, diameter, thread)
        if thread == 0 and not (worst <= tolerance):
            law.failed[c] = 1
        meet()
        i = begin + thread
        while i < stop:
            law.force[i] = steric_force(law.solved_gap[i], strength, diameter)
            contacts.gap[i] = law.solved_gap[i] - law.residual[i]  # at the end of the increment found
            i += threads

    return SimpleNamespace(warm_start=warm_start, solve=solve)


def warm_start(model: DeviceModel, state: DeviceState, trust: Any, predicted: Any, contacts_out: Any, law: Any) -> None:
    """Warm start of the contact solve: forces at the predicted gaps of the listed contacts, into `force`.

    Args:
        model, state: of the batch.
        trust: share of the predicted increment that counts, 0 to 1, shape [cell_count].
        predicted: struct `Increment`.
        contacts_out: the listed contacts, struct `Contacts`.
        law: struct `ContactLaw`.
    """
    inputs = [model.data, state.data, trust, predicted, contacts_out, law]
    dim = (model.cell_count, model.plan.contact_block)
    wp.launch(_kernels_of(model).warm_start, dim, inputs=inputs, device=model.device)


def solve(
    model: DeviceModel,
    state: DeviceState,
    contacts: Any,
    band: Any,
    flow: Any,
    start: Any,
    law: Any,
    out: Any,
    coarse: float = 1.0,
    anew: bool = True,
) -> None:
    """Forces and gaps of the contacts, and the increment with them; `failed` tells of a cell without a solution.

    The iteration starts at the gaps found last.

    Args:
        model, state: of the batch.
        contacts, band, flow: listed contacts, factors and pair sum of this pose.
        start: increment with the contact forces `law.force`, struct `Increment`.
        law: struct `ContactLaw`.
        out: where the increment with the contact forces found goes, `start` + Y (F - acting).
        coarse: factor on the tolerance.
        anew: whether secant pairs found before are dropped.
    """
    threads = model.plan.contact_block
    inputs = [model.data, state.data, start, coarse, anew, contacts, band, flow, law, out]
    kernel = _kernels_of(model).solve
    wp.launch(kernel, (model.cell_count, threads), inputs=inputs, device=model.device, block_dim=threads)


def _kernels_of(model: DeviceModel) -> SimpleNamespace:
    plan = model.plan
    return _kernels(model.precision, model.switches.flows, plan.step_pairs, plan.chains, plan.contact_block)
