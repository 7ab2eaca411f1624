"""The linearised equations of a step in full, with the pair sum that the matrix leaves out: D^-1 (1/dt + g M H) x.

The forces are the first variation of those terms that have one. The stability of a step is measured with it, see
`stability`.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body
from warpflag_kernels.implicit import block_band
from warpflag_kernels.implicit import step_flow as flow_stage
from warpflag_kernels.rod import chain_chart, forces


@functools.cache
def _kernels(p: Precision, pairs: str, form: str, threads: int) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State = structs(p).Model, structs(p).State
    Increment, Band, vec6 = chain_chart.types(p).Increment, block_band.types(p).Band, block_band.types(p).vec6
    drag = block_band.functions(p).drag
    Flow, flows = flow_stage.struct(p), flow_stage.functions(p, pairs, form, threads)
    load, spread, flow_at, slots_end = flows.load, flows.spread, flows.flow_at, flows.slots_end
    module = p.module("linearised", f"{pairs}_{form}_{threads}")

    @wp.kernel(module=module)
    def load_nodes(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        flow: Flow,
    ):
        e = wp.tid()
        if flow.slot[e] >= 0 and state.active[model.cell_of[e]] != 0:
            load(flow, flow.slot[e], state.force[e])

    @wp.kernel(module=module)
    def add_flows(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        flow: Flow,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            spread(model, flow, c, slots_end(model, c))

    @wp.kernel(module=module)
    def complete(
        # Model:
        model: Model,
        # State:
        state: State,
        flow: Flow,
        band: Band,
        gain: wp.array(dtype=wp.float64),
        x: Increment,
        # Out:
        out: Increment,
    ):
        e, thread = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        g = real(gain[c])
        inv_dt = real(wp.float64(1.0) / band.step[c])
        y = inv_dt * x.node[e]
        v = vec3(real(0.0))
        if e > model.first_node[k]:
            v = vec3(y[0], y[1], y[2])
            if wp.static(pairs != "none"):
                v -= g * flow_at(model, flow, e, k, c, slots_end(model, c), thread)
            v = drag(band, e, v) - g * state.force[e]
        elif thread == 0 and k == model.first_flagellum[c]:
            u = state.body_velocity[c]
            w = state.body_spin[c]
            out.body[c] = inv_dt * x.body[c] - g * vec6(u[0], u[1], u[2], w[0], w[1], w[2])
        if thread == 0:
            out.node[e] = vec4(v[0], v[1], v[2], y[3] / model.drag.spin_mobility[k] - g * state.spin_torque[e])

    return SimpleNamespace(load_nodes=load_nodes, add_flows=add_flows, complete=complete)


def allocate(model: DeviceModel, state: DeviceState) -> None:
    """What the state needs for the first variation of forces beside what forces themselves need."""
    state.data.stretch_change = wp.zeros(model.element_count, dtype=model.precision.vec3, device=model.device)


def linearised_terms(model: DeviceModel) -> tuple[Term, ...]:
    """First variations of the model's terms, in their order."""
    return tuple(term.linearised for term in model.terms if term.linearised is not None)


def force_changes(model: DeviceModel, state: DeviceState, stiffness: Any, x: Any) -> None:
    """-H x: changes of the forces on nodes, of spin torques and of what flagella put on the body.

    Args:
        model, state: of the batch; the forces of `state` are replaced by their changes.
        stiffness: second derivatives at the state's pose, struct `Stiffness`.
        x: the increment, struct `Increment`.
    """
    terms = linearised_terms(model)
    for term in terms:
        if term.launch is not None:
            term.launch(model, state, stiffness, x)
    forces.total_forces(model, state, terms)
    body.sum_flagella(model, state, terms)


def apply(
    model: DeviceModel, state: DeviceState, stiffness: Any, band: Any, flow: Any, gain: wp.array, x: Any, out: Any
) -> None:
    """D^-1 (1/dt + g M H) x (of the bodies: without D^-1) into out; the forces of `state` are overwritten.

    Args:
        model, state: of the batch.
        stiffness, band, flow: at the state's pose.
        gain: g, shape [cell_count].
        x: increment, struct `Increment`.
        out: where the product goes, struct `Increment`.
    """
    plan, device = model.plan, model.device
    kernels = _kernels(plan.precision, model.switches.pairs, plan.step_pairs, plan.gathering_threads)
    force_changes(model, state, stiffness, x)
    body.move_bodies(model, state)
    if model.switches.pairs != "none":
        inputs = [model.data, state.data, flow]
        wp.launch(kernels.load_nodes, model.element_count, inputs=inputs, device=device)
        if plan.step_pairs != "gathered":
            wp.launch(kernels.add_flows, model.cell_count, inputs=inputs, device=device)
    inputs = [model.data, state.data, flow, band, gain, x, out]
    wp.launch(kernels.complete, (model.element_count, plan.gathering_threads), inputs=inputs, device=device)
