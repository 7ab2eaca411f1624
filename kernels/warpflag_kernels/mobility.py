"""Node velocities: local anisotropic drag plus the Rotne-Prager pair sum.

Local (the paper's mu_t): [t t/gamma_par + (I - t t)/gamma_perp]/h per node (h/2 at the free end), t the normalised
sum of the adjacent tangents, at the last node the last segment's. Pair sum, a the pair radius:

    r > 2a:   1/(8 pi eta r) [(1 + 2a^2/3r^2) I + (1 - 2a^2/r^2) rr]
    r <= 2a:  1/(6 pi eta a) [(1 - 9r/32a) I + (3r/32a) rr]

It runs over the distinct nodes of the same flagellum, of the others, or both, as the scene says. r_0 belongs to the
body: it moves with the body and its force enters the sum as zero.

Every thread gathers the flows at its own node. A CPU, where one thread does a whole cell, takes every pair once for
both nodes instead, half the square roots for the same sum.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs


@functools.cache
def pair_coefficients(p: Precision):
    """Device function: 8 pi eta times the Rotne-Prager tensor as plain I + along d d, at distance r = |d|, radius a."""
    real = p.real

    @wp.func(module=p.module("mobility_functions"))
    def rotne_prager(r: real, a: real):
        if r > real(2.0) * a:
            q = a * a / (r * r)
            plain = (real(1.0) + real(2.0) / real(3.0) * q) / r
            return plain, (real(1.0) - real(2.0) * q) / (r * r * r)
        near = (real(4.0) / real(3.0) - real(0.375) * r / a) / a
        if r > real(0.0):
            return near, real(1.0) / (real(8.0) * a * a * r)
        return near, real(0.0)

    return rotne_prager


# Nodes [begin, end) laid out for the sum by halves, which begins at zero. That the components of a vector lie side by
# side is what a compiler needs to know to move many at once; in Warp, with a stride from the array, this takes
# several times as long.
_PACK = """
    using R = REAL;
    const R* __restrict__ P = reinterpret_cast<const R*>(position.data);
    const R* __restrict__ Q = reinterpret_cast<const R*>(force.data);
    R* __restrict__ X = s.x.data; R* __restrict__ Y = s.y.data; R* __restrict__ Z = s.z.data;
    R* __restrict__ F = s.fx.data; R* __restrict__ G = s.fy.data; R* __restrict__ H = s.fz.data;
    R* __restrict__ U = s.ux.data; R* __restrict__ V = s.uy.data; R* __restrict__ W = s.uz.data;
    for (int i = begin; i < end; ++i) {
        X[i] = P[3 * i]; Y[i] = P[3 * i + 1]; Z[i] = P[3 * i + 2];
        F[i] = Q[3 * i]; G[i] = Q[3 * i + 1]; H[i] = Q[3 * i + 2];
        U[i] = 0; V[i] = 0; W[i] = 0;
    }
"""

# One row of the sum by halves: pairs (i, j) for j in [begin, end), counted at both nodes. A loop that adds to what it
# reads is vectorised only if the compiler is told that no two rows overlap, which takes C++; the body is that of
# `gather_pairs`. Whole vectors first, then what is left in one masked vector: rows are short, one by one it would cost
# as much as the rest.
_ROW = """
    using R = REAL;
    const R* __restrict__ X = s.x.data; const R* __restrict__ Y = s.y.data; const R* __restrict__ Z = s.z.data;
    const R* __restrict__ F = s.fx.data; const R* __restrict__ G = s.fy.data; const R* __restrict__ H = s.fz.data;
    R* __restrict__ U = s.ux.data; R* __restrict__ V = s.uy.data; R* __restrict__ W = s.uz.data;
    const R a2 = a * a, near = 4 * a2, contact = R(4) / (R(3) * a), slope = R(0.375) / a2, slope_d = R(0.125) / a2;
    const R xi = X[i], yi = Y[i], zi = Z[i], fi = F[i], gi = G[i], hi = H[i];
    R ui = 0, vi = 0, wi = 0;
    const auto add_pair = [&](int j) {
        const R dx = xi - X[j], dy = yi - Y[j], dz = zi - Z[j];
        const R r2 = dx * dx + dy * dy + dz * dz;
        const R inv_r = R(1) / wp::sqrt(r2 > R(0) ? r2 : R(1));
        const R inv_r2 = inv_r * inv_r, q = a2 * inv_r2;
        const bool far = r2 > near;
        const R ci = far ? inv_r * (R(1) + R(2) / R(3) * q) : contact - slope * (r2 * inv_r);
        const R cd = far ? inv_r * inv_r2 * (R(1) - R(2) * q) : slope_d * inv_r;
        const R dj = cd * (dx * F[j] + dy * G[j] + dz * H[j]), di = cd * (dx * fi + dy * gi + dz * hi);
        ui += ci * F[j] + dj * dx; vi += ci * G[j] + dj * dy; wi += ci * H[j] + dj * dz;
        U[j] += ci * fi + di * dx; V[j] += ci * gi + di * dy; W[j] += ci * hi + di * dz;
    };
    const int lanes = 64 / static_cast<int>(sizeof(R)), whole = end - (end - begin) % lanes;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety) interleave(disable)
    #endif
    for (int j = begin; j < whole; ++j) add_pair(j);
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety) vectorize_predicate(enable) interleave(disable)
    #endif
    for (int j = whole; j < end; ++j) add_pair(j);
    U[i] += ui; V[i] += vi; W[i] += wi;
"""


@functools.cache
def functions(p: Precision, pairs: str, halves: bool) -> SimpleNamespace:
    """Device functions: velocities of one node, and of all nodes of a cell."""
    real, vec3 = p.real, p.vec3
    Model, State, PairSum = structs(p).Model, structs(p).State, structs(p).PairSum
    module = p.module("mobility_functions", _variant(pairs, halves))
    within, between = pairs in ("within", "all"), pairs in ("between", "all")

    def in_cpp(source: str) -> str:
        return source.replace("REAL", {"float64": "double", "float32": "float"}[p.name])

    @wp.func_native(in_cpp(_PACK))
    def pack_cell(
        position: wp.array(dtype=vec3), force: wp.array(dtype=vec3), s: PairSum, begin: wp.int32, end: wp.int32
    ): ...

    @wp.func_native(in_cpp(_ROW))
    def add_row(s: PairSum, i: wp.int32, begin: wp.int32, end: wp.int32, a: real): ...

    @wp.func(module=module)
    def add_rows(model: Model, state: State, s: PairSum, c: wp.int32):
        """Pair sum of cell c, every pair once for both nodes."""
        begin = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        pack_cell(state.position, state.force, s, begin, end)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            i = model.first_node[k]
            s.fx[i] = real(0.0)
            s.fy[i] = real(0.0)
            s.fz[i] = real(0.0)
            k += 1
        i = begin
        while i < end:
            own = model.first_node[model.flagellum_of[i]]
            if i > own:
                if wp.static(within and between):
                    add_row(s, i, begin, i, model.pair_radius[c])
                elif wp.static(within):
                    add_row(s, i, own, i, model.pair_radius[c])
                else:
                    add_row(s, i, begin, own, model.pair_radius[c])
            i += 1

    @wp.func(module=module)
    def gather_pairs(s: PairSum, i: wp.int32, begin: wp.int32, end: wp.int32, a: real):
        """Sum over nodes [begin, end) of 8 pi eta times the Rotne-Prager tensor times the force."""
        # Scalar loads, scalar accumulators and a while loop are what lets the compiler vectorise this.
        xi = s.x[i]
        yi = s.y[i]
        zi = s.z[i]
        a2 = a * a
        near = real(4.0) * a2
        # The overlapping form in the same units: 8/(6a) = 4/(3a).
        contact = real(4.0) / (real(3.0) * a)
        slope = real(0.375) / a2
        slope_d = real(0.125) / a2
        ux = real(0.0)
        uy = real(0.0)
        uz = real(0.0)
        j = begin
        while j < end:
            dx = xi - s.x[j]
            dy = yi - s.y[j]
            dz = zi - s.z[j]
            fx = s.fx[j]
            fy = s.fy[j]
            fz = s.fz[j]
            r2 = dx * dx + dy * dy + dz * dz
            inv_r = real(1.0) / wp.sqrt(wp.where(r2 > real(0.0), r2, real(1.0)))
            inv_r2 = inv_r * inv_r
            q = a2 * inv_r2
            far_i = inv_r * (real(1.0) + real(2.0) / real(3.0) * q)
            far_d = inv_r * inv_r2 * (real(1.0) - real(2.0) * q)
            ci = wp.where(r2 > near, far_i, contact - slope * (r2 * inv_r))
            cd = wp.where(r2 > near, far_d, slope_d * inv_r)
            other = wp.where(j == i, real(0.0), real(1.0))
            df = other * cd * (dx * fx + dy * fy + dz * fz)
            ci = other * ci
            ux += ci * fx + df * dx
            uy += ci * fy + df * dy
            uz += ci * fz + df * dz
            j += 1
        return vec3(ux, uy, uz)

    @wp.func(module=module)
    def move_node(model: Model, state: State, s: PairSum, e: wp.int32, k: wp.int32, c: wp.int32):
        """Velocity of node e of flagellum k of cell c."""
        begin = model.first_node[k]
        end = model.first_node[k + 1]
        if e == begin:
            state.velocity[e] = state.body_velocity[c] + wp.cross(state.body_spin[c], state.position[e])
            return
        t = state.tangent[e]
        square = real(1.0)
        if e + 1 < end:
            t += state.tangent[e + 1]
            square = wp.dot(t, t)
        force = state.force[e]
        along = (wp.dot(t, force) / square) * t
        v = model.mobility_along[e] * along + model.mobility_across[e] * (force - along)
        if wp.static(halves):
            v += model.pair_mobility[c] * vec3(s.ux[e], s.uy[e], s.uz[e])
        elif wp.static(pairs != "none"):
            a = model.pair_radius[c]
            pair = vec3(real(0.0))
            if wp.static(within and between):
                cell_begin = model.first_node[model.first_flagellum[c]]
                cell_end = model.first_node[model.first_flagellum[c + 1]]
                pair = gather_pairs(s, e, cell_begin, cell_end, a)
            elif wp.static(within):
                pair = gather_pairs(s, e, begin, end, a)
            else:
                cell_begin = model.first_node[model.first_flagellum[c]]
                cell_end = model.first_node[model.first_flagellum[c + 1]]
                pair = gather_pairs(s, e, cell_begin, begin, a)
                pair += gather_pairs(s, e, end, cell_end, a)
            v += model.pair_mobility[c] * pair
        state.velocity[e] = v

    @wp.func(module=module)
    def move_cell(model: Model, state: State, s: PairSum, c: wp.int32):
        """Velocities of all nodes of cell c."""
        if wp.static(halves):
            add_rows(model, state, s, c)
        e = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        while e < end:
            move_node(model, state, s, e, model.flagellum_of[e], c)
            e += 1

    return SimpleNamespace(move_node=move_node, move_cell=move_cell)


@functools.cache
def _kernels(p: Precision, pairs: str, halves: bool) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State, PairSum = structs(p).Model, structs(p).State, structs(p).PairSum
    move_node, move_cell = functions(p, pairs, halves).move_node, functions(p, pairs, halves).move_cell
    module = p.module("mobility", _variant(pairs, halves))

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
            force = vec3(real(0.0))
        s.x[e] = x[0]
        s.y[e] = x[1]
        s.z[e] = x[2]
        s.fx[e] = force[0]
        s.fy[e] = force[1]
        s.fz[e] = force[2]

    @wp.kernel(module=module)
    def velocities(
        # Model:
        model: Model,
        # State:
        state: State,
        s: PairSum,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] != 0:
            move_node(model, state, s, e, model.flagellum_of[e], c)

    kernels = SimpleNamespace(pack=pack, velocities=velocities)
    if halves:  # elsewhere it need not be compiled

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


def _variant(pairs: str, halves: bool) -> str:
    return pairs + ("_halves" if halves else "")


def sums_by_halves(model: DeviceModel) -> bool:
    """Whether the pair sum visits every pair once for both nodes: where one thread does a whole cell, it pays."""
    return model.one_thread_per_cell and model.switches.pairs != "none"


def node_velocities(model: DeviceModel, state: DeviceState) -> None:
    """Velocity of every node in the lab [um/s], into `velocity`; needs the forces and the body's motion."""
    halves = sums_by_halves(model)
    kernels, device = _kernels(model.precision, model.switches.pairs, halves), model.device
    inputs = [model.data, state.data, state.pairs]
    if halves:
        wp.launch(kernels.by_cells, model.cell_count, inputs=inputs, device=device)
        return
    if model.switches.pairs != "none":
        wp.launch(kernels.pack, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.velocities, model.element_count, inputs=inputs, device=device)
