"""The whole right-hand side in one launch, a cell per thread: for a CPU.

Its threads take turns, and every launch costs it what some ten nodes do, every thread of it another look at all the
arguments. The terms are the device functions of the stages, called in the same order: so the numbers are the same.
"""

import functools

import warp as wp

from warpflag_kernels.base.types import DeviceModel, DeviceState, Precision, Switches, structs
from warpflag_kernels.contact import neighbours, steric
from warpflag_kernels.fluid import body, node_velocity
from warpflag_kernels.rod import elastic, forces


@functools.cache
def _kernel(p: Precision, pair: Precision, switches: Switches):
    Model, State = structs(p).Model, structs(p).State
    PairSum, Neighbours = structs(pair).PairSum, structs(p).Neighbours
    with_steric, with_body, pairs = switches.steric, switches.body_contact, switches.pairs
    joint, refresh_cell = elastic.functions(p).joint, neighbours.lists(p).refresh_cell
    pairs_of_cell, body_force = steric.gathers(p).pairs_of_cell, steric.gathers(p).body_force
    gather = forces.functions(p, with_steric, with_body).gather
    motion = body.functions(p, with_body, switches.bearing_torque)
    sum_flagellum, move = motion.sum_flagellum, motion.move
    move_cell = node_velocity.functions(p, pair, pairs, "thread" if pairs == "none" else "halves").move_cell
    words = {pairs: True, "short": pair != p, "steric": with_steric, "body": with_body}
    words["bearing"] = switches.bearing_torque

    @wp.kernel(module=p.module("whole_cell", "_".join(word for word, on in words.items() if on)))
    def right_hand_side(
        # Model:
        model: Model,
        # State:
        state: State,
        s: PairSum,
        near: Neighbours,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        if wp.static(with_steric):
            refresh_cell(model, state, near, c)
            pairs_of_cell(model, state, near, c)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            begin = model.first_node[k]
            end = model.first_node[k + 1]
            e = begin
            while e + 1 < end:
                joint(model, state, e, k)
                e += 1
            if wp.static(with_body):
                e = begin + 1
                while e < end:
                    state.body_contact[e] = body_force(model, state, e, c)
                    e += 1
            e = begin
            while e < end:
                gather(model, state, e, k)
                e += 1
            sum_flagellum(model, state, k)
            k += 1
        move(model, state, c)
        move_cell(model, state, s, c)

    return right_hand_side


def right_hand_side(model: DeviceModel, state: DeviceState) -> None:
    """From positions and directors to forces, torques and velocities of every active cell."""
    inputs = [model.data, state.data, state.pairs, state.neighbours]
    kernel = _kernel(model.precision, model.pair_precision, model.switches)
    wp.launch(kernel, model.cell_count, inputs=inputs, device=model.device)
