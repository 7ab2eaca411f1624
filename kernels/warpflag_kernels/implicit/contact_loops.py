"""Loops over the contacts of a cell in its contact solve, in C++ so that a CPU's compiler makes vector code of them.

On a GPU the threads of a block share each loop.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.native import native
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.contact import steric
from warpflag_kernels.contact.constants import CUTOFF, LINEAR_BELOW
from warpflag_kernels.implicit import delassus
from warpflag_kernels.rod import chain_chart

NEWTON_STEPS = 4  # Newton iterations of a contact's scalar equation; what they leave enters the next residual


@functools.cache
def functions(p: Precision, threads: int) -> SimpleNamespace:
    """Device functions over the contacts [begin, stop) of one cell, for one thread of so many."""
    real, Law, Increment = p.real, delassus.struct(p), chain_chart.types(p).Increment

    law, bits = steric.law_code(p), {"float64": "long long", "float32": "int"}[p.name]

    @wp.func_native(native(__file__, "load_contacts", p, LAW=law, THREADS=threads))
    def load_all(
        law_in: Law, begin: wp.int32, stop: wp.int32, strength: real, diameter: real, thread: wp.int32
    ) -> real: ...

    @wp.func_native(native(__file__, "add_product", p, THREADS=threads))
    def take(
        law_in: Law, x: Increment, begin: wp.int32, stop: wp.int32, first: wp.int32, end: wp.int32, thread: wp.int32
    ): ...

    @wp.func_native(native(__file__, "residuals", p, THREADS=threads, BITS=bits))
    def leave(law_in: Law, begin: wp.int32, stop: wp.int32, thread: wp.int32) -> real: ...

    words = {"NEWTON_STEPS": NEWTON_STEPS, "CUTOFF": CUTOFF, "LINEAR": LINEAR_BELOW}

    @wp.func_native(native(__file__, "solve_single_contacts", p, LAW=law, THREADS=threads, **words))
    def solve_single(
        law_in: Law, begin: wp.int32, stop: wp.int32, strength: real, diameter: real, thread: wp.int32
    ): ...

    return SimpleNamespace(load_all=load_all, take=take, leave=leave, solve_single=solve_single)
