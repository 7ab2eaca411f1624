"""Loops over the contacts of a cell that its law takes many times: what they need of the law is C++, as vector code.

A compiler makes them vector loops only where it is told that arrays do not overlap, and where nothing branches. On a
GPU the lanes of a block share each loop.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.types import Precision
from warpflag_kernels.contact import steric
from warpflag_kernels.implicit import delassus
from warpflag_kernels.rod import chain_chart

SETTLING = 4  # iterations of a contact's own equation

# What forces at the solved gaps differ by from those that W has been applied to, and how stiff they are; returns
# whether they differ at all.
_LOAD = """
    LAW
    const REAL* __restrict__ G = law_in.solved_gap.data; const REAL* __restrict__ F = law_in.force.data;
    const REAL* __restrict__ Y = law_in.yielding.data; const REAL* __restrict__ A = law_in.applied.data;
    REAL* __restrict__ L = law_in.load.data; REAL* __restrict__ S = law_in.share.data;
    REAL total = 0;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int i = begin + lane; i < stop; i += LANES) {
        REAL f, k;
        law(G[i], strength, diameter, f, k);
        L[i] = f - F[i] - A[i];
        S[i] = Y[i] * k / (1 + Y[i] * k);
        total += L[i] * L[i];
    }
    return total;
"""
# What a product has found, added to what was found before.
_TAKE = """
    REAL* __restrict__ A = law_in.applied.data; const REAL* __restrict__ L = law_in.load.data;
    REAL* __restrict__ N = law_in.answered.data; const REAL* __restrict__ C = law_in.change.data;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int i = begin + lane; i < stop; i += LANES) { A[i] += L[i]; N[i] += C[i]; }
    REAL* __restrict__ X = reinterpret_cast<REAL*>(x.node.data);
    const REAL* __restrict__ Y = reinterpret_cast<const REAL*>(law_in.answer.node.data);
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int i = 4 * first + lane; i < 4 * end; i += LANES) X[i] += Y[i];
"""
# Residuals, and the largest. Compared as integers, what is not a number is larger than all others.
_LEAVE = """
    const REAL* __restrict__ G = law_in.solved_gap.data; const REAL* __restrict__ F = law_in.free_gap.data;
    const REAL* __restrict__ N = law_in.answered.data; REAL* __restrict__ R = law_in.residual.data;
    BITS worst = 0;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int i = begin + lane; i < stop; i += LANES) {
        union { REAL value; BITS bits; } r;
        R[i] = G[i] - F[i] - N[i];
        r.value = wp::abs(R[i]);
        worst = r.bits > worst ? r.bits : worst;
    }
    union { BITS bits; REAL value; } r;
    r.bits = worst;
    return r.value < (REAL)3.0e38 ? r.value : (REAL)3.0e38;
"""
# New gaps, each of which settles against its own compliance alone. What is left of its equation is concave: Newton's
# method overshoots from above once, from below it rises to the solution.
_SETTLE = """
    LAW
    REAL* __restrict__ G = law_in.solved_gap.data;
    const REAL* __restrict__ A = law_in.applied.data; const REAL* __restrict__ F = law_in.force.data;
    const REAL* __restrict__ Y = law_in.yielding.data; const REAL* __restrict__ S = law_in.share.data;
    const REAL* __restrict__ C = law_in.wanted.data;
    const REAL most = (REAL)CUTOFF * diameter, least = (REAL)LINEAR * diameter;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int i = begin + lane; i < stop; i += LANES) {
        const REAL gap = G[i], y = Y[i], alone = gap - y * (A[i] + F[i]) + C[i];
        REAL g = gap + C[i] * (1 - S[i]), f, k;
        g = g < least ? least : (g > most ? most : g);
        for (int n = 0; n < SETTLING; ++n) {
            law(g, strength, diameter, f, k);
            g += (alone + y * f - g) / (1 + y * k);
        }
        G[i] = alone >= most ? alone : g;
    }
"""


@functools.cache
def functions(p: Precision, lanes: int) -> SimpleNamespace:
    """Device functions over the contacts [begin, stop) of one cell, for one lane of so many."""
    real, Law, Increment = p.real, delassus.struct(p), chain_chart.types(p).Increment

    def native(text: str) -> str:
        text = text.replace("BITS", {"float64": "long long", "float32": "int"}[p.name])
        return steric.code(p, text).replace("LANES", str(lanes)).replace("SETTLING", str(SETTLING))

    @wp.func_native(native(_LOAD))
    def load_all(
        law_in: Law, begin: wp.int32, stop: wp.int32, strength: real, diameter: real, lane: wp.int32
    ) -> real: ...

    @wp.func_native(native(_TAKE))
    def take(
        law_in: Law, x: Increment, begin: wp.int32, stop: wp.int32, first: wp.int32, end: wp.int32, lane: wp.int32
    ): ...

    @wp.func_native(native(_LEAVE))
    def leave(law_in: Law, begin: wp.int32, stop: wp.int32, lane: wp.int32) -> real: ...

    @wp.func_native(native(_SETTLE))
    def settle_all(law_in: Law, begin: wp.int32, stop: wp.int32, strength: real, diameter: real, lane: wp.int32): ...

    return SimpleNamespace(load_all=load_all, take=take, leave=leave, settle_all=settle_all)
