"""The Rotne-Prager pair sum over the nodes of a cell, a the pair radius:

    r > 2a:   1/(8 pi eta r) [(1 + 2a^2/3r^2) I + (1 - 2a^2/r^2) rr]
    r <= 2a:  1/(6 pi eta a) [(1 - 9r/32a) I + (3r/32a) rr]

It runs over the distinct nodes of the same flagellum, of the others, or both, as the scene says. r_0 belongs to the
body: it moves with the body and its force enters the sum as zero.

On a GPU the threads of a warp gather the flows at one node together, an order of magnitude faster than a thread for
each node would, of which a cell has too few. A CPU, where one thread does a whole cell, takes every pair once for both
nodes instead, half the square roots for the same sum.

A float64 run may have its pairs in float32: `BLOCK` terms are then added up in float32, and such sums in float64.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.types import Precision, structs

WARP = 32  # threads of a warp
BLOCK = 64  # with fewer, float64 additions begin to show in the time; with more, float32 ones in the error

# Nodes [begin, end) laid out for the sum by halves, which begins at zero. That the components of a vector lie side by
# side is what a compiler needs to know to move many at once; in Warp, with a stride from the array, this takes
# several times as long.
_PACK = """
    using R = REAL;
    using S = RUN;
    const S* __restrict__ P = reinterpret_cast<const S*>(position.data);
    const S* __restrict__ Q = reinterpret_cast<const S*>(force.data);
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

# The sum of what the threads of a warp hold, in the first of them.
_WARP_SUM = """
    #ifdef __CUDA_ARCH__
    for (int distance = 16; distance > 0; distance /= 2)
        for (int axis = 0; axis < 3; ++axis) v[axis] += __shfl_down_sync(0xffffffffu, v[axis], distance);
    #endif
    return v;
"""

# Moves the float32 sums of nodes [begin, end) into the float64 ones.
_FLUSH = """
    float* __restrict__ U = s.ux.data; float* __restrict__ V = s.uy.data; float* __restrict__ W = s.uz.data;
    double* __restrict__ X = s.total_x.data; double* __restrict__ Y = s.total_y.data;
    double* __restrict__ Z = s.total_z.data;
    for (int j = begin; j < end; ++j) {
        X[j] += U[j]; Y[j] += V[j]; Z[j] += W[j];
        U[j] = 0; V[j] = 0; W[j] = 0;
    }
"""


def _in_cpp(source: str, pair: Precision, run: Precision) -> str:
    names = {"float64": "double", "float32": "float"}
    return source.replace("REAL", names[pair.name]).replace("RUN", names[run.name])


@functools.cache
def rows(p: Precision, lanes: int = 1) -> SimpleNamespace:
    """Device functions of one row of pairs: `add_row` counts them at both nodes, `gather_pairs` at one, every so many
    of them."""
    real, vec3, PairSum = p.real, p.vec3, structs(p).PairSum

    @wp.func_native(_in_cpp(_ROW, p, p))
    def add_row(s: PairSum, i: wp.int32, begin: wp.int32, end: wp.int32, a: real): ...

    @wp.func(module=p.module("pair_rows", str(lanes)))
    def gather_pairs(s: PairSum, i: wp.int32, begin: wp.int32, end: wp.int32, a: real):
        """Sum over nodes in [begin, end) of 8 pi eta times the Rotne-Prager tensor times the force."""
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
            j += wp.static(lanes)
        return vec3(ux, uy, uz)

    return SimpleNamespace(add_row=add_row, gather_pairs=gather_pairs)


@functools.cache
def over_warp(p: Precision) -> Any:
    """Device function: the sum of a vector over the threads of a warp, in the first of them."""
    vec3 = p.vec3

    @wp.func_native(_WARP_SUM)
    def warp_sum(v: vec3) -> vec3: ...

    return warp_sum


@functools.cache
def functions(p: Precision, pair: Precision, pairs: str, form: str) -> SimpleNamespace:
    """Device functions: the sum of a cell by halves, and the flow at a node in units of 1/(8 pi eta).

    Args:
        pair: precision of the terms.
        pairs: which nodes are coupled, one of `Switches.pairs`, but "none".
        form: "halves", "warp" or "thread": pairs once for both nodes, or for one, by a warp or by a thread.
    """
    vec3, real, short = p.vec3, pair.real, pair != p  # vectors of the run, numbers of its pairs
    Model, State, PairSum = structs(p).Model, structs(p).State, structs(pair).PairSum
    module = p.module("pair_sum", "_".join([pairs, form, *["short"] * short]))
    within, between = pairs in ("within", "all"), pairs in ("between", "all")
    halves, lanes = form == "halves", WARP if form == "warp" else 1
    add_row, gather_pairs, warp_sum = rows(pair, lanes).add_row, rows(pair, lanes).gather_pairs, over_warp(p)

    @wp.func_native(_in_cpp(_PACK, pair, p))
    def pack_cell(
        position: wp.array(dtype=vec3), force: wp.array(dtype=vec3), s: PairSum, begin: wp.int32, end: wp.int32
    ): ...

    @wp.func_native(_FLUSH)
    def flush(s: PairSum, begin: wp.int32, end: wp.int32): ...

    @wp.func(module=module)
    def add_cell(model: Model, state: State, s: PairSum, c: wp.int32):
        """Pair sum of cell c, every pair once for both nodes."""
        begin = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        a = real(model.pair_radius[c])
        pack_cell(state.position, state.force, s, begin, end)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            i = model.first_node[k]
            s.fx[i] = real(0.0)
            s.fy[i] = real(0.0)
            s.fz[i] = real(0.0)
            k += 1
        if wp.static(short):
            i = begin
            while i < end:
                s.total_x[i] = wp.float64(0.0)
                s.total_y[i] = wp.float64(0.0)
                s.total_z[i] = wp.float64(0.0)
                i += 1
        i = begin
        while i < end:
            own = model.first_node[model.flagellum_of[i]]
            if i > own:
                if wp.static(within and between):
                    add_row(s, i, begin, i, a)
                elif wp.static(within):
                    add_row(s, i, own, i, a)
                else:
                    add_row(s, i, begin, own, a)
            i += 1
            if wp.static(short):
                done = i - begin
                if done % wp.static(BLOCK) == 0 or i == end:
                    flush(s, begin, i)

    @wp.func(module=module)
    def gather_blocks(s: PairSum, i: wp.int32, begin: wp.int32, end: wp.int32, a: real):
        """As `gather_pairs`, in the run's precision."""
        total = vec3()
        j = begin
        while j < end:
            part = gather_pairs(s, i, j, wp.min(j + wp.static(BLOCK * lanes), end), a)
            total += vec3(p.real(part[0]), p.real(part[1]), p.real(part[2]))
            j += wp.static(BLOCK * lanes)
        return total

    gather = gather_blocks if short else gather_pairs

    @wp.func(module=module)
    def flow_at(model: Model, s: PairSum, e: wp.int32, k: wp.int32, c: wp.int32, lane: wp.int32):
        """Flow at node e of flagellum k of cell c: by halves what `add_cell` has found, in the first lane of a warp."""
        if wp.static(halves and short):
            return vec3(s.total_x[e], s.total_y[e], s.total_z[e])
        elif wp.static(halves):
            return vec3(s.ux[e], s.uy[e], s.uz[e])
        else:
            begin = model.first_node[k]
            end = model.first_node[k + 1]
            cell_begin = model.first_node[model.first_flagellum[c]]
            cell_end = model.first_node[model.first_flagellum[c + 1]]
            a = real(model.pair_radius[c])
            v = vec3()
            if wp.static(within and between):
                v = gather(s, e, cell_begin + lane, cell_end, a)
            elif wp.static(within):
                v = gather(s, e, begin + lane, end, a)
            else:
                v = gather(s, e, cell_begin + lane, begin, a) + gather(s, e, end + lane, cell_end, a)
            if wp.static(lanes > 1):
                v = warp_sum(v)
            return v

    return SimpleNamespace(add_cell=add_cell, flow_at=flow_at)
