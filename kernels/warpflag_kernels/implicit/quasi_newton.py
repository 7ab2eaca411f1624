"""What the products with the compliance W have told of it: loads, and how they are answered.

Of a load that has been applied once the answer is known, and of whatever loads combine those applied. `learn` keeps
what is new of a load beside the earlier ones, orthogonal to them, and what W makes of it beyond `diagonal`, the
estimate that stands in for W where nothing is known. `combine` solves the linear contact law

    wanted = -residual - (W - diagonal) (share/diagonal) wanted,    W - diagonal = sum of answers x diagonal loads

for the shares of the known loads: a system of as many unknowns as there are loads, which costs no product.
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

KEPT = 16  # loads at most; then each new one takes the place of the oldest
SMALL = KEPT * (KEPT + 1)  # entries of the system of their shares
SAME = 0.1  # share of a load that must be new for it to be kept: what round-off makes of less misleads


@functools.cache
def functions(p: Precision, threads: int) -> SimpleNamespace:
    """Device functions of one block of so many threads: `learn` and `combine`."""
    real, Law = p.real, delassus.struct(p)
    block_sum = delassus.reductions(p, threads).block_sum
    Reals = wp.array(dtype=real)
    kept, small_size, same = wp.constant(KEPT), wp.constant(SMALL), wp.constant(real(SAME))
    module = p.module("quasi_newton", str(threads))

    @wp.func_native(native(__file__, "weighted_dot", p, THREADS=threads))
    def dot(
        a: Reals, i: wp.int32, b: Reals, j: wp.int32, weight: Reals, k: wp.int32, count: wp.int32, thread: wp.int32
    ) -> real: ...  # fmt: skip

    @wp.func_native(native(__file__, "remove_load", p, THREADS=threads))
    def remove(law: Law, i: wp.int32, j: wp.int32, share: real, count: wp.int32, thread: wp.int32): ...

    @wp.func_native(native(__file__, "fill_system", p, THREADS=threads))
    def fill_system(
        law: Law, first: wp.int32, n: wp.int32, own: wp.int32, capacity: wp.int32,
        begin: wp.int32, count: wp.int32, thread: wp.int32,
    ): ...  # fmt: skip

    @wp.func_native(native(__file__, "solve_system", p))
    def solve_system(law: Law, first: wp.int32, n: wp.int32): ...

    @wp.func_native(native(__file__, "add_answers", p, THREADS=threads))
    def add_answers(
        law: Law, first: wp.int32, n: wp.int32, own: wp.int32, capacity: wp.int32,
        begin: wp.int32, count: wp.int32, thread: wp.int32,
    ): ...  # fmt: skip

    @wp.func(module=module)
    def learn(law: Law, c: wp.int32, begin: wp.int32, count: wp.int32, capacity: wp.int32, thread: wp.int32):
        """Keeps what is new of `load`, and what `change`, its answer, says of it.

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
            law.answers[at + i] = law.change[begin + i] - law.diagonal[begin + i] * load
            i += threads
        size = block_sum(
            law, dot(law.loads, at, law.loads, at, law.diagonal, begin, count, thread), c, thread
        )
        m = int(0)
        while m < wp.min(known, kept):
            if m != slot:
                other = own + m * capacity
                share = dot(law.loads, at, law.loads, other, law.diagonal, begin, count, thread)
                remove(law, at, other, block_sum(law, share, c, thread), count, thread)
            m += 1
        left = block_sum(
            law, dot(law.loads, at, law.loads, at, law.diagonal, begin, count, thread), c, thread
        )
        scale = real(0.0)
        if left > same * same * size:
            scale = real(1.0) / wp.sqrt(left)
        i = int(thread)
        while i < count:
            law.loads[at + i] = scale * law.loads[at + i]
            law.answers[at + i] = scale * law.answers[at + i]
            i += threads
        # A load without anything new stands as zero in its place, until the next one takes it.
        if thread == 0 and scale > real(0.0):
            law.known[c] = known + 1
        meet()

    @wp.func(module=module)
    def combine(law: Law, c: wp.int32, begin: wp.int32, count: wp.int32, capacity: wp.int32, thread: wp.int32):
        """What is to be added to a gap less what it yields to its own force, into `wanted`: from `residual` and
        `share`, of a change of a gap the part that its force takes back."""
        n = wp.min(law.known[c], kept)
        own = kept * begin
        first = c * small_size
        meet()
        fill_system(law, first, n, own, capacity, begin, count, thread)
        meet()
        if thread == 0:
            solve_system(law, first, n)
        meet()
        add_answers(law, first, n, own, capacity, begin, count, thread)

    return SimpleNamespace(learn=learn, combine=combine)


def allocate(model: DeviceModel, contacts: Any, law: Any) -> None:
    """The arrays of the struct `ContactLaw` that the method needs, in place, for as many contacts as there is room."""
    real, device, room = model.precision.real, model.device, len(contacts.gap)
    law.loads, law.answers = (wp.zeros(KEPT * room, dtype=real, device=device) for _ in range(2))
    law.wanted = wp.zeros(room, dtype=real, device=device)
    law.small = wp.zeros(SMALL * model.cell_count, dtype=real, device=device)
    law.known = wp.zeros(model.cell_count, dtype=wp.int32, device=device)
