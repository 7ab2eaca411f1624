"""The Rotne-Prager pair sum over the nodes of a cell, a the pair radius:

    r > 2a:   1/(8 pi eta r) [(1 + 2a^2/3r^2) I + (1 - 2a^2/r^2) rr]
    r <= 2a:  1/(6 pi eta a) [(1 - 9r/32a) I + (3r/32a) rr]

It runs over the distinct nodes of the same flagellum, of the others, or both, as the scene says. r_0 belongs to the
body: it moves with the body and its force enters the sum as zero; only in a free filament it is a node like others.
Nodes of unequal radii have the tensor of two spheres of two radii (Zuk, Wajnryb, Mizerski & Szymczak, J. Fluid Mech.
741, R5 (2014)), which costs more and is compiled only where a scene has them.

On a GPU the threads of a warp gather the flows at one node together, an order of magnitude faster than a thread for
each node, of which a cell has too few. A CPU, where one thread does a whole cell, takes every pair once for both nodes
instead: half the square roots for the same sum.

A float64 run may have its pairs in float32: `FLOAT32_TERMS` of them are then added up in float32,
and such sums in float64.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.native import native
from warpflag_kernels.base.plan import WARP, Flows
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, structs

# Pairs added up in float32 before float64 takes over: with fewer, float64 additions begin to show in the time; with
# more, float32 ones in the error (examples/benchmarks/pair_precision.py).
FLOAT32_TERMS = 64


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `PairSum`: one array per component, which lets a compiler fill its vector registers; [E] each."""
    real = p.real

    @wp.struct
    class PairSum:
        x: wp.array(dtype=real)  # position [um]
        y: wp.array(dtype=real)
        z: wp.array(dtype=real)
        fx: wp.array(dtype=real)  # force, zero on r_0 [pN]
        fy: wp.array(dtype=real)
        fz: wp.array(dtype=real)
        radius: wp.array(dtype=real)  # a of the node [um]; only where radii are unequal
        ux: wp.array(dtype=real)  # 8 pi eta times the velocity [pN/um]; only of the symmetric sum
        uy: wp.array(dtype=real)
        uz: wp.array(dtype=real)
        # What a float64 run adds up of it; only where its pairs are float32 and the sum is symmetric.
        total_x: wp.array(dtype=wp.float64)
        total_y: wp.array(dtype=wp.float64)
        total_z: wp.array(dtype=wp.float64)

    return PairSum


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `PairSum` that the model's plan needs."""
    p = model.plan.pair_precision
    sums, names = struct(p)(), ["x", "y", "z", "fx", "fy", "fz"]
    if model.plan.pair_sum == "none":
        return sums
    if model.plan.pair_sum == "symmetric":
        names += ["ux", "uy", "uz"]
        if model.switches.short_pairs:
            for name in ("total_x", "total_y", "total_z"):
                setattr(sums, name, wp.zeros(model.element_count, dtype=wp.float64, device=model.device))
    for name in names:
        setattr(sums, name, wp.zeros(model.element_count, dtype=p.real, device=model.device))
    if model.switches.flows.unequal:
        radii = model.data.pairs.radius.numpy()[model.data.flagellum_of.numpy()]
        sums.radius = wp.array(radii, dtype=p.real, device=model.device)
    return sums


def tensor_code(p: Precision, unequal: bool, sums: str) -> str:
    """C++ that defines tensor(r2, j, c, d): c I + d dd^T, dd the vector between nodes i and j, r2 its square.

    Args:
        p: precision of the pairs.
        unequal: with the radii of the struct `PairSum`; else of two nodes of radius `a`.
        sums: the name of that struct there.
    """
    if unequal:
        return native(__file__, "unequal_row", p, UNEQUAL=native(__file__, "unequal_tensor", p), SUM=sums)
    return native(__file__, "rotne_prager_tensor", p)


@functools.cache
def rows(p: Precision, unequal: bool, threads: int = 1) -> SimpleNamespace:
    """Device functions of one row of pairs: `add_row` adds their flows at both nodes, `gather_pairs` at node i alone.

    Args:
        p: precision of the pairs.
        unequal: whether nodes have unequal pair radii.
        threads: that share the row in `gather_pairs`, each taking every so-many-th pair.
    """
    real, vec3, PairSum, tensor = p.real, p.vec3, struct(p), tensor_code(p, unequal, "s")

    @wp.func_native(native(__file__, "symmetric_row", p, TENSOR=tensor))
    def add_row(s: PairSum, i: wp.int32, begin: wp.int32, end: wp.int32, a: real): ...

    @wp.func_native(native(__file__, "gathered_row", p, TENSOR=tensor, THREADS=threads))
    def gather_pairs(s: PairSum, i: wp.int32, begin: wp.int32, end: wp.int32, a: real) -> vec3: ...

    return SimpleNamespace(add_row=add_row, gather_pairs=gather_pairs)


@functools.cache
def over_warp(p: Precision) -> Any:
    """Device function: the sum of a vector over the threads of a warp, in the first of them."""
    vec3 = p.vec3

    @wp.func_native(native(__file__, "warp_sum", p, WARP=WARP))
    def warp_sum(v: vec3, thread: wp.int32) -> vec3: ...

    return warp_sum


@functools.cache
def functions(p: Precision, pair: Precision, flows: Flows, pair_sum: str) -> SimpleNamespace:
    """Device functions: the symmetric sum of a cell, and the flow at a node in units of 1/(8 pi eta).

    Args:
        p: precision of the run.
        pair: precision of the terms.
        flows: which nodes are coupled, but not "none".
        pair_sum: `Plan.pair_sum`: "symmetric", "warp" or "thread".
    """
    vec3, real, short = p.vec3, pair.real, pair != p  # vectors of the run, numbers of its pairs
    Model, State, PairSum = structs(p).Model, structs(p).State, struct(pair)
    module = p.module("pair_sum", "_".join([flows.variant, pair_sum, *["short"] * short]))
    within, between = flows.within, flows.between
    symmetric, threads = pair_sum == "symmetric", WARP if pair_sum == "warp" else 1
    row = rows(pair, flows.unequal, threads)
    add_row, gather_pairs, warp_sum = row.add_row, row.gather_pairs, over_warp(p)

    @wp.func_native(native(__file__, "pack_cell", pair, RUN=p.c_name))
    def pack_cell(
        position: wp.array(dtype=vec3), force: wp.array(dtype=vec3), s: PairSum, begin: wp.int32, end: wp.int32
    ): ...

    @wp.func_native(native(__file__, "flush_totals", pair))
    def flush(s: PairSum, begin: wp.int32, end: wp.int32): ...

    @wp.func(module=module)
    def add_cell(model: Model, state: State, s: PairSum, c: wp.int32):
        """Pair sum of cell c, every pair once for both nodes."""
        begin = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        a = real(model.pairs.radius[model.first_flagellum[c]])
        pack_cell(state.pose.position, state.force, s, begin, end)
        k = model.first_flagellum[c]
        while wp.static(flows.pairs != "free") and k < model.first_flagellum[c + 1]:
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
                if done % wp.static(FLOAT32_TERMS) == 0 or i == end:
                    flush(s, begin, i)

    @wp.func(module=module)
    def gather_blocks(s: PairSum, i: wp.int32, begin: wp.int32, end: wp.int32, a: real):
        """As `gather_pairs`, in the run's precision."""
        total = vec3()
        j = begin
        while j < end:
            part = gather_pairs(s, i, j, wp.min(j + wp.static(FLOAT32_TERMS * threads), end), a)
            total += vec3(p.real(part[0]), p.real(part[1]), p.real(part[2]))
            j += wp.static(FLOAT32_TERMS * threads)
        return total

    gather = gather_blocks if short else gather_pairs

    @wp.func(module=module)
    def flow_at(model: Model, s: PairSum, e: wp.int32, k: wp.int32, c: wp.int32, thread: wp.int32):
        """Flow at node e of flagellum k of cell c: what `add_cell` has found, or gathered; valid in thread 0."""
        if wp.static(symmetric and short):
            return vec3(s.total_x[e], s.total_y[e], s.total_z[e])
        elif wp.static(symmetric):
            return vec3(s.ux[e], s.uy[e], s.uz[e])
        else:
            begin = model.first_node[k]
            end = model.first_node[k + 1]
            cell_begin = model.first_node[model.first_flagellum[c]]
            cell_end = model.first_node[model.first_flagellum[c + 1]]
            a = real(model.pairs.radius[model.first_flagellum[c]])
            v = vec3()
            if wp.static(within and between):
                v = gather(s, e, cell_begin + thread, cell_end, a)
            elif wp.static(within):
                v = gather(s, e, begin + thread, end, a)
            else:
                v = gather(s, e, cell_begin + thread, begin, a) + gather(s, e, end + thread, cell_end, a)
            if wp.static(threads > 1):
                v = warp_sum(v, thread)
            return v

    return SimpleNamespace(add_cell=add_cell, flow_at=flow_at)
