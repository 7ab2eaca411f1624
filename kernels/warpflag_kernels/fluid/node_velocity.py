"""Node velocities: local anisotropic drag plus the Rotne-Prager pair sum of `pair_sum`.

Local (the paper's mu_t): [t t/gamma_par + (I - t t)/gamma_perp]/h per node (h/2 at the free end), t the normalised
sum of the adjacent tangents, at the last node the last segment's.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.types import DeviceModel, DeviceState, Precision, structs
from warpflag_kernels.fluid import rotne_prager


@functools.cache
def local(p: Precision) -> SimpleNamespace:
    """Device function of the local drag alone."""
    Model, State = structs(p).Model, structs(p).State

    @wp.func(module=p.module("mobility_local"))
    def drag_velocity(model: Model, state: State, e: wp.int32, k: wp.int32):
        """Velocity of node e of flagellum k, not r_0, that its own force causes [um/s]."""
        t = state.tangent[e]
        square = p.real(1.0)
        if e + 1 < model.first_node[k + 1]:
            t += state.tangent[e + 1]
            square = wp.dot(t, t)
        force = state.force[e]
        along = (wp.dot(t, force) / square) * t
        return model.mobility_along[e] * along + model.mobility_across[e] * (force - along)

    return SimpleNamespace(drag_velocity=drag_velocity)


@functools.cache
def functions(p: Precision, pair: Precision, pairs: str, form: str) -> SimpleNamespace:
    """Device functions: velocities of one node, and of all nodes of a cell."""
    Model, State, PairSum = structs(p).Model, structs(p).State, structs(pair).PairSum
    module = p.module("mobility_functions", _variant(p, pair, pairs, form))
    sums = rotne_prager.functions(p, pair, pairs, form)
    add_cell, flow_at = sums.add_cell, sums.flow_at

    drag_velocity = local(p).drag_velocity

    @wp.func(module=module)
    def move_node(model: Model, state: State, s: PairSum, e: wp.int32, k: wp.int32, c: wp.int32, lane: wp.int32):
        """Velocity of node e of flagellum k of cell c; the lanes of a warp share its pairs."""
        if e == model.first_node[k]:
            state.velocity[e] = state.body_velocity[c] + wp.cross(state.body_spin[c], state.position[e])
            return
        v = drag_velocity(model, state, e, k)
        if wp.static(pairs != "none"):
            v += model.pair_mobility[c] * flow_at(model, s, e, k, c, lane)
        if lane == 0:
            state.velocity[e] = v

    @wp.func(module=module)
    def move_cell(model: Model, state: State, s: PairSum, c: wp.int32):
        """Velocities of all nodes of cell c."""
        if wp.static(form == "halves"):
            add_cell(model, state, s, c)
        e = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        while e < end:
            move_node(model, state, s, e, model.flagellum_of[e], c, 0)
            e += 1

    return SimpleNamespace(move_node=move_node, move_cell=move_cell)


@functools.cache
def _kernels(p: Precision, pair: Precision, pairs: str, form: str) -> SimpleNamespace:
    vec3, real = p.vec3, pair.real
    Model, State, PairSum = structs(p).Model, structs(p).State, structs(pair).PairSum
    f = functions(p, pair, pairs, form)
    move_node, move_cell = f.move_node, f.move_cell
    module = p.module("mobility", _variant(p, pair, pairs, form))

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
        x = state.position[e]
        force = state.force[e]
        if e == model.first_node[model.flagellum_of[e]]:
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
        state: State,
        s: PairSum,
    ):
        e, lane = wp.tid()
        c = model.cell_of[e]
        if state.active[c] != 0:
            move_node(model, state, s, e, model.flagellum_of[e], c, lane)

    kernels = SimpleNamespace(pack=pack, velocities=velocities)
    if form == "halves":  # elsewhere it need not be compiled

        @wp.kernel(module=module)
        def by_cells(
            # Model:
            model: Model,
            # State:
            state: State,
            s: PairSum,
        ):
            c = wp.tid()
            if state.active[c] != 0:
                move_cell(model, state, s, c)

        kernels.by_cells = by_cells
    return kernels


def _variant(p: Precision, pair: Precision, pairs: str, form: str) -> str:
    return "_".join([pairs, form, *["short"] * (pair != p)])


def form_of(model: DeviceModel) -> str:
    """How the pair sum is done, see `pair_sum.functions`."""
    if model.switches.pairs == "none":
        return "thread"
    if model.one_thread_per_cell:
        return "halves"
    return "warp" if model.threads_cooperate else "thread"


def sums_by_halves(model: DeviceModel) -> bool:
    """Whether a thread sums a whole cell and takes every pair once for both of its nodes."""
    return form_of(model) == "halves"


def node_velocities(model: DeviceModel, state: DeviceState) -> None:
    """Velocity of every node in the lab [um/s], into `velocity`; needs the forces and the body's motion."""
    form = form_of(model)
    kernels, device = _kernels(model.precision, model.pair_precision, model.switches.pairs, form), model.device
    inputs = [model.data, state.data, state.pairs]
    if form == "halves":
        wp.launch(kernels.by_cells, model.cell_count, inputs=inputs, device=device)
        return
    if model.switches.pairs != "none":
        wp.launch(kernels.pack, model.element_count, inputs=inputs, device=device)
    lanes = rotne_prager.WARP if form == "warp" else 1
    wp.launch(kernels.velocities, (model.element_count, lanes), inputs=inputs, device=device)
