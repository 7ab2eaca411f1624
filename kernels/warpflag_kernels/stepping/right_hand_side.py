"""The right-hand side: from positions and directors to forces, torques and velocities, built from the list of terms.

Stage by stage, a launch or more for each, or all forces of a cell and what they do to its body in one launch by one
thread: a CPU works through the threads of a launch one after the other, and every launch costs it what some ten nodes
do. Both call the same device functions in the same order, so the numbers are the same.

In an implicit step contact forces are given, and not evaluated (`launch_with_contacts`).
"""

import functools
from collections.abc import Callable
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term, acting, combined, variant
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import contact_list, neighbours
from warpflag_kernels.fluid import body, node_velocity
from warpflag_kernels.rod import forces


@functools.cache
def _evaluators(p: Precision, terms: tuple[Term, ...]) -> tuple[Any, Any]:
    """Device functions: what all terms evaluate before forces are summed, for one cell and for one flagellum."""
    Model, State, Neighbours = structs(p).Model, structs(p).State, neighbours.struct(p)
    parts = combined(p, terms)
    module = p.module("right_hand_side_functions", variant(terms))

    def of_cell(functions: list[Any]) -> Any:
        if not functions:

            @wp.func(module=module)
            def nothing(model: Model, state: State, near: Neighbours, c: wp.int32):
                return

            return nothing
        earlier, last = of_cell(functions[:-1]), functions[-1]

        @wp.func(module=module)
        def cell(model: Model, state: State, near: Neighbours, c: wp.int32):
            earlier(model, state, near, c)
            last(model, state, near, c)

        return cell

    def of_flagellum(functions: list[Any]) -> Any:
        if not functions:

            @wp.func(module=module)
            def nothing(model: Model, state: State, k: wp.int32, c: wp.int32):
                return

            return nothing
        earlier, last = of_flagellum(functions[:-1]), functions[-1]

        @wp.func(module=module)
        def flagellum(model: Model, state: State, k: wp.int32, c: wp.int32):
            earlier(model, state, k, c)
            last(model, state, k, c)

        return flagellum

    return of_cell(parts.in_cell), of_flagellum(parts.in_flagellum)


@functools.cache
def _of_cell(p: Precision, terms: tuple[Term, ...], moves: bool) -> Any:
    Model, State, Neighbours = structs(p).Model, structs(p).State, neighbours.struct(p)
    evaluate_cell, evaluate_flagellum = _evaluators(p, terms)
    gather, motion = forces.functions(p, terms).gather, body.functions(p, terms, False)
    sum_flagellum, move, settle = motion.sum_flagellum, motion.move, combined(p, terms).settle
    settles = settle is not None

    @wp.kernel(module=p.module("whole_cell", variant(terms) + "_held" * (not moves)))
    def forces_of_cell(
        # Model:
        model: Model,
        # Out:
        state: State,
        near: Neighbours,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        evaluate_cell(model, state, near, c)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            evaluate_flagellum(model, state, k, c)
            e = model.first_node[k]
            while e < model.first_node[k + 1]:
                gather(model, state, e, k)
                e += 1
            sum_flagellum(model, state, k)
            k += 1
        if wp.static(moves and settles):
            settle(model, state, c)
        if wp.static(moves):
            move(model, state, c)

    return forces_of_cell


@functools.cache
def _with_contacts(
    p: Precision, smooth: tuple[Term, ...], terms: tuple[Term, ...], touching: bool, body_contact: bool
) -> Any:
    Model, State, Contacts = structs(p).Model, structs(p).State, contact_list.struct(p)
    evaluate_flagellum, act_on_cell = _evaluators(p, smooth)[1], contact_list.acting(p, body_contact)
    gather, motion = forces.functions(p, smooth).gather, body.functions(p, terms, False)
    sum_flagellum, move, settle = motion.sum_flagellum, motion.move, combined(p, terms).settle
    settles = settle is not None

    @wp.kernel(module=p.module("whole_cell_in_step", variant(terms) + "_contacts" * touching))
    def with_contacts(
        # Model:
        model: Model,
        # State:
        contacts: Contacts,
        magnitude: wp.array(dtype=p.real),
        # Out:
        state: State,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            evaluate_flagellum(model, state, k, c)
            e = model.first_node[k]
            while e < model.first_node[k + 1]:
                gather(model, state, e, k)
                e += 1
            k += 1
        if wp.static(touching):
            act_on_cell(model, contacts, magnitude, state, c)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            sum_flagellum(model, state, k)
            k += 1
        if wp.static(settles):
            settle(model, state, c)
        move(model, state, c)

    return with_contacts


def launch_with_contacts(
    model: DeviceModel, state: DeviceState, terms: tuple[Term, ...], contacts: Any, magnitude: wp.array, single: Any
) -> None:
    """Forces, torques and the motion of the bodies at the pose of `state`, where the contact forces are given.

    Args:
        model, state: of the batch.
        terms: those that count; of contacts only what they put on the body.
        contacts: the listed contacts, struct `Contacts`.
        magnitude: their forces [pN].
        single: as in `body.body_motion`.
    """
    smooth = tuple(term for term in terms if not term.contact)
    in_one = model.plan.by_cells and not combined(model.precision, smooth).in_cell and not model.switches.flows.body
    if in_one:
        p, body_contact = model.precision, model.switches.has("body contact")
        own = tuple(term for term in terms if term in smooth or acting(p, [term], "on_body", "settle"))
        kernel = _with_contacts(p, smooth, own, model.touching, body_contact)
        inputs = [model.data, contacts, magnitude, state.data]
        wp.launch(kernel, model.cell_count, inputs=inputs, device=model.device)
        return
    for term in smooth:
        if term.launch is not None:
            term.launch(model, state)
    forces.total_forces(model, state, smooth)
    if model.touching:
        contact_list.act(model, state, contacts, magnitude)
    body.body_motion(model, state, terms, single=single)


def stages(model: DeviceModel) -> list[tuple[str, Callable[[DeviceModel, DeviceState], None]]]:
    """The stages of the right-hand side in order: a name for people, and the function that launches the kernels."""
    listed = [(term.name, term.launch) for term in model.terms if term.launch is not None]
    listed += [("forces", forces.total_forces), ("body", body.body_motion)]
    short = ", terms in float32" if model.switches.short_pairs else ""
    pairs = "local drag"
    if model.switches.pairs != "none":
        pairs += f" and pair sum ({model.switches.pairs.replace('_', ' ')} pairs{short})"
    if model.switches.flows.body:
        pairs += " and flow round the body"
    return [*listed, (pairs, node_velocity.node_velocities)]


def launch_right_hand_side(model: DeviceModel, state: DeviceState) -> None:
    """Forces, torques and velocities at the pose of `state`: forces by whole cells or stage by stage, as planned."""
    if not model.plan.by_cells:
        for _name, launch in stages(model):
            launch(model, state)
        return
    held = model.switches.flows.body  # the flow round it comes between its forces and its motion
    kernel = _of_cell(model.precision, model.terms, not held)
    wp.launch(kernel, model.cell_count, inputs=[model.data, state.data, state.neighbours], device=model.device)
    if held:
        body.motion_of_sums(model, state)
    node_velocity.node_velocities(model, state)
