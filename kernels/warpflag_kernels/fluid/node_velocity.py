"""Node velocities: local anisotropic drag plus the Rotne-Prager pair sum, plus the flow of the body's surface.

Local drag (mu_t of the paper's equation 1): [t t/gamma_par + (I - t t)/gamma_perp]/h per node (h/2 at the free end), t
the normalised sum of the adjacent tangents, at the last node the last segment's.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.plan import Flows
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body_flow, rotne_prager


@functools.cache
def local(p: Precision) -> SimpleNamespace:
    """Device function of the local drag alone."""
    Model, State = structs(p).Model, structs(p).State

    @wp.func(module=p.module("mobility_local"))
    def drag_velocity(model: Model, state: State, e: wp.int32, k: wp.int32):
        """Velocity of node e of flagellum k, not r_0, that its own force causes [um/s]."""
        t = state.pose.tangent[e]
        square = p.real(1.0)
        if e + 1 < model.first_node[k + 1]:
            t += state.pose.tangent[e + 1]
            square = wp.dot(t, t)
        force = state.force[e]
        along = (wp.dot(t, force) / square) * t
        return model.drag.mobility_along[e] * along + model.drag.mobility_across[e] * (force - along)

    return SimpleNamespace(drag_velocity=drag_velocity)


@functools.cache
def functions(p: Precision, pair: Precision, flows: Flows, pair_sum: str) -> SimpleNamespace:
    """Device functions: velocities of one node, and of all nodes of a cell."""
    Model, State, PairSum = structs(p).Model, structs(p).State, rotne_prager.struct(pair)
    module = p.module("mobility_functions", _variant(p, pair, flows, pair_sum))
    sums = rotne_prager.functions(p, pair, flows, pair_sum)
    add_cell, flow_at = sums.add_cell, sums.flow_at

    drag_velocity = local(p).drag_velocity

    @wp.func(module=module)
    def move_node(model: Model, state: State, s: PairSum, e: wp.int32, k: wp.int32, c: wp.int32, thread: wp.int32):
        """Velocity of node e of flagellum k of cell c; the threads of a warp share its pairs."""
        if wp.static(flows.pairs != "free") and e == model.first_node[k]:
            state.velocity[e] = state.body_velocity[c] + wp.cross(state.body_spin[c], state.pose.position[e])
            return
        v = drag_velocity(model, state, e, k)
        if wp.static(flows.pairs == "free") and e == model.first_node[k]:
            v = state.body_velocity[c]  # a free end: what its local mobility gives
        if wp.static(flows.pairs != "none"):
            v += model.pairs.mobility[c] * flow_at(model, s, e, k, c, thread)
        if thread == 0:
            state.velocity[e] = v
            if wp.static(flows.pairs == "free") and e == model.first_node[k]:
                state.body_velocity[c] = v

    @wp.func(module=module)
    def move_cell(model: Model, state: State, s: PairSum, c: wp.int32):
        """Velocities of all nodes of cell c."""
        if wp.static(pair_sum == "symmetric"):
            add_cell(model, state, s, c)
        e = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        while e < end:
            move_node(model, state, s, e, model.flagellum_of[e], c, 0)
            e += 1

    return SimpleNamespace(move_node=move_node, move_cell=move_cell)


@functools.cache
def _kernels(p: Precision, pair: Precision, flows: Flows, pair_sum: str) -> SimpleNamespace:
    vec3, real = p.vec3, pair.real
    Model, State, PairSum = structs(p).Model, structs(p).State, rotne_prager.struct(pair)
    f = functions(p, pair, flows, pair_sum)
    move_node, move_cell = f.move_node, f.move_cell
    module = p.module("mobility", _variant(p, pair, flows, pair_sum))

    @wp.kernel(module=module)
    def pack(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        s: PairSum,
    ):
        e = wp.tid()
        x = state.pose.position[e]
        force = state.force[e]
        if wp.static(flows.pairs != "free") and e == model.first_node[model.flagellum_of[e]]:
            force = vec3(p.real(0.0))
        s.x[e] = real(x[0])
        s.y[e] = real(x[1])
        s.z[e] = real(x[2])
        s.fx[e] = real(force[0])
        s.fy[e] = real(force[1])
        s.fz[e] = real(force[2])

    @wp.kernel(module=module)
    def velocities(
        # Model:
        model: Model,
        # State:
        s: PairSum,
        # Out:
        state: State,
    ):
        e, thread = wp.tid()
        c = model.cell_of[e]
        if state.active[c] != 0:
            move_node(model, state, s, e, model.flagellum_of[e], c, thread)

    kernels = SimpleNamespace(pack=pack, velocities=velocities)
    if pair_sum == "symmetric":  # elsewhere it need not be compiled

        @wp.kernel(module=module)
        def by_cells(
            # Model:
            model: Model,
            # Out:
            state: State,
            s: PairSum,
        ):
            c = wp.tid()
            if state.active[c] != 0:
                move_cell(model, state, s, c)

        kernels.by_cells = by_cells
    return kernels


def _variant(p: Precision, pair: Precision, flows: Flows, pair_sum: str) -> str:
    return "_".join([flows.variant, pair_sum, *["short"] * (pair != p)])


def node_velocities(model: DeviceModel, state: DeviceState) -> None:
    """Velocity of every node in the lab [um/s], into `velocity`.

    Args:
        model, state: of the batch, with the forces, the bodies' motion and, with flow round the body, the held loads.
    """
    plan, device = model.plan, model.device
    flows = model.switches.flows
    kernels = _kernels(model.precision, plan.pair_precision, flows.of_nodes, plan.pair_sum)
    inputs = [model.data, state.data, state.pairs]
    if plan.pair_sum == "symmetric":
        wp.launch(kernels.by_cells, model.cell_count, inputs=inputs, device=device)
    else:
        _gather(model, state, kernels)
    if flows.body:
        body_flow.carry(model, state, state.shell, plan.pair_precision)


def _gather(model: DeviceModel, state: DeviceState, kernels: SimpleNamespace) -> None:
    plan, device = model.plan, model.device
    inputs = [model.data, state.data, state.pairs]
    if plan.pair_sum != "none":
        wp.launch(kernels.pack, model.element_count, inputs=inputs, device=device)
    shape = model.element_count, plan.gathering_threads
    inputs = [model.data, state.pairs, state.data]
    wp.launch(kernels.velocities, shape, inputs=inputs, device=device, block_dim=plan.gathering_block)
