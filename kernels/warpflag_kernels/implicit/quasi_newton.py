"""A multisecant quasi-Newton model of the Delassus operator W, from the products made with it.

`learn` stores a secant pair: a vector that W has been applied to, made orthonormal to the earlier ones in the metric of
the diagonal compliance d, and W - d applied to it. `combine` solves the contact law linearised at the present gaps,

    wanted = -residual - (W - d) (stiffness_ratio/d) wanted,      W - d = sum of (response)(d load)^T over the pairs,

in the span of the pairs: a system of as many unknowns as there are pairs, which costs no product. There
stiffness_ratio = d k/(1 + d k), k the stiffness of a contact.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.native import native
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel
from warpflag_kernels.implicit import delassus
from warpflag_kernels.implicit.delassus import meet

SECANTS_KEPT = 16  # secant pairs at most; then each new one replaces the oldest. A step makes five to ten products
SYSTEM_ENTRIES = SECANTS_KEPT * (SECANTS_KEPT + 1)  # entries of the linear system in their span
# A pair is kept if at least this fraction of its vector is orthogonal to the earlier ones: the round-off of float32
# flows is 1e-6 of a product, so the part of W that is learnt from a smaller fraction has few digits.
INDEPENDENT = 0.1


@functools.cache
def functions(p: Precision, threads: int) -> SimpleNamespace:
    """Device functions of one block of so many threads: `learn` and `combine`."""
    real, Law = p.real, delassus.struct(p)
    block_sum = delassus.reductions(p, threads).block_sum
    Reals = wp.array(dtype=real)
    kept, system_entries, independent = (
        wp.constant(SECANTS_KEPT),
        wp.constant(SYSTEM_ENTRIES),
        wp.constant(real(INDEPENDENT)),
    )
    module = p.module("quasi_newton", str(threads))

    @wp.func_native(native(__file__, "weighted_dot", p, THREADS=threads))
    def dot(
        a: Reals, i: wp.int32, b: Reals, j: wp.int32, weight: Reals, k: wp.int32, count: wp.int32, thread: wp.int32
    ) -> real: ...  # fmt: skip

    @wp.func_native(native(__file__, "remove_load", p, THREADS=threads))
    def remove(law: Law, i: wp.int32, j: wp.int32, projection: real, count: wp.int32, thread: wp.int32): ...

    @wp.func_native(native(__file__, "fill_system", p, THREADS=threads))
    def fill_system(
        law: Law, first: wp.int32, n: wp.int32, own: wp.int32, capacity: wp.int32,
        begin: wp.int32, count: wp.int32, thread: wp.int32,
    ): ...  # fmt: skip

    @wp.func_native(native(__file__, "solve_system", p))
    def solve_system(law: Law, first: wp.int32, n: wp.int32): ...

    @wp.func_native(native(__file__, "add_responses", p, THREADS=threads))
    def add_responses(
        law: Law, first: wp.int32, n: wp.int32, own: wp.int32, capacity: wp.int32,
        begin: wp.int32, count: wp.int32, thread: wp.int32,
    ): ...  # fmt: skip

    @wp.func(module=module)
    def learn(law: Law, c: wp.int32, begin: wp.int32, count: wp.int32, capacity: wp.int32, thread: wp.int32):
        """Stores the secant pair of `load` and `change` = W load.

        Args:
            begin, count: where the cell's contacts lie; capacity: how many it has room for.
        """
        known = law.known[c]
        slot = known % kept
        own = kept * begin
        at = own + slot * capacity
        i = int(thread)
        while i < count:
            load = law.load[begin + i]
            law.loads[at + i] = load
            law.responses[at + i] = law.change[begin + i] - law.diagonal[begin + i] * load
            i += threads
        size = block_sum(law, dot(law.loads, at, law.loads, at, law.diagonal, begin, count, thread), c, thread)
        m = int(0)
        while m < wp.min(known, kept):
            if m != slot:
                other = own + m * capacity
                projection = dot(law.loads, at, law.loads, other, law.diagonal, begin, count, thread)
                remove(law, at, other, block_sum(law, projection, c, thread), count, thread)
            m += 1
        left = block_sum(law, dot(law.loads, at, law.loads, at, law.diagonal, begin, count, thread), c, thread)
        scale = real(0.0)
        if left > independent * independent * size:
            scale = real(1.0) / wp.sqrt(left)
        i = int(thread)
        while i < count:
            law.loads[at + i] = scale * law.loads[at + i]
            law.responses[at + i] = scale * law.responses[at + i]
            i += threads
        # A dependent vector is stored as zero; the next pair overwrites it.
        if thread == 0 and scale > real(0.0):
            law.known[c] = known + 1
        meet()

    @wp.func(module=module)
    def combine(law: Law, c: wp.int32, begin: wp.int32, count: wp.int32, capacity: wp.int32, thread: wp.int32):
        """The change of gap - d F(gap) that the linearised law asks for, into `wanted`; from `residual`."""
        n = wp.min(law.known[c], kept)
        own = kept * begin
        first = c * system_entries
        meet()
        fill_system(law, first, n, own, capacity, begin, count, thread)
        meet()
        if thread == 0:
            solve_system(law, first, n)
        meet()
        add_responses(law, first, n, own, capacity, begin, count, thread)

    return SimpleNamespace(learn=learn, combine=combine)


def allocate(model: DeviceModel, contacts: Any, law: Any) -> None:
    """Allocates the arrays of the struct `ContactLaw` that the method needs, for as many contacts as there is room."""
    real, device, room = model.precision.real, model.device, len(contacts.gap)
    law.loads, law.responses = (wp.zeros(SECANTS_KEPT * room, dtype=real, device=device) for _ in range(2))
    law.wanted = wp.zeros(room, dtype=real, device=device)
    law.small = wp.zeros(SYSTEM_ENTRIES * model.cell_count, dtype=real, device=device)
    law.known = wp.zeros(model.cell_count, dtype=wp.int32, device=device)
