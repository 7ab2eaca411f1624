"""What the products with the compliance W have told of it: loads, and how they are answered.

Of a load that has been applied once the answer is known, and of whatever loads combine those applied. `learn` keeps
what is new of a load beside the earlier ones, orthogonal to them, and what W makes of it beyond `yielding`, the
estimate that stands in for W where nothing is known. `combine` solves the linear contact law

    wanted = -residual - (W - yielding) (share/yielding) wanted,    W - yielding = sum of answers x yielding loads

for the shares of the known loads: a system of as many unknowns as there are loads, which costs no product.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.types import Precision
from warpflag_kernels.implicit import delassus
from warpflag_kernels.implicit.delassus import meet

KEPT = 16  # loads at most; then each new one takes the place of the oldest
SMALL = KEPT * (KEPT + 1)  # entries of the system of their shares
SAME = 0.1  # share of a load that must be new for it to be kept: what round-off makes of less misleads

# Sums over contacts are a vector loop only where the compiler is told that what they run over does not overlap.
_DOT = """
    const REAL* __restrict__ A = a.data + i; const REAL* __restrict__ B = b.data + j;
    const REAL* __restrict__ W = weight.data + k;
    REAL total = 0;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int n = lane; n < count; n += LANES) total += A[n] * B[n] * W[n];
    return total;
"""
# a -= share b, at two places of two arrays.
_REMOVE = """
    REAL* __restrict__ A = law.loads.data + i; const REAL* __restrict__ B = law.loads.data + j;
    REAL* __restrict__ C = law.answers.data + i; const REAL* __restrict__ D = law.answers.data + j;
    #ifndef __CUDACC__
    #pragma clang loop vectorize(assume_safety)
    #endif
    for (int n = lane; n < count; n += LANES) { A[n] -= share * B[n]; C[n] -= share * D[n]; }
"""
# Row by row: 1 + loads . share answers, and loads . share residual. A lane of a GPU does single entries, a CPU four
# columns at once.
_SYSTEM = """
    const REAL* L = law.loads.data + own; const REAL* A = law.answers.data + own;
    const REAL* __restrict__ W = law.share.data + begin; const REAL* R = law.residual.data + begin;
    #ifdef __CUDACC__
    for (int entry = lane; entry < n * (n + 1); entry += LANES) {
        const int row = entry / (n + 1), column = entry % (n + 1);
        const REAL* X = L + row * capacity; const REAL* Y = column < n ? A + column * capacity : R;
        REAL total = row == column ? 1 : 0;
        for (int i = 0; i < count; ++i) total += X[i] * W[i] * Y[i];
        law.small.data[first + entry] = total;
    }
    #else
    for (int row = 0; row < n; ++row) {
        const REAL* __restrict__ X = L + row * capacity;
        REAL* out = law.small.data + first + row * (n + 1);
        for (int column = 0; column <= n; column += 4) {
            const REAL* Y[4];
            for (int j = 0; j < 4; ++j) Y[j] = column + j < n ? A + (column + j) * capacity : R;
            const REAL* __restrict__ Y0 = Y[0]; const REAL* __restrict__ Y1 = Y[1];
            const REAL* __restrict__ Y2 = Y[2]; const REAL* __restrict__ Y3 = Y[3];
            REAL s0 = 0, s1 = 0, s2 = 0, s3 = 0;
            #pragma clang loop vectorize(assume_safety)
            for (int i = 0; i < count; ++i) {
                const REAL x = X[i] * W[i];
                s0 += x * Y0[i]; s1 += x * Y1[i]; s2 += x * Y2[i]; s3 += x * Y3[i];
            }
            const REAL sum[4] = {s0, s1, s2, s3};
            for (int j = 0; j < 4 && column + j <= n; ++j) out[column + j] = sum[j] + (row == column + j ? 1 : 0);
        }
    }
    #endif
"""
# Gaussian elimination with row pivoting of a system that lies row by row, its right-hand side last, which becomes the
# solution.
_SOLVE = """
    REAL* a = law.small.data + first;
    const int width = n + 1;
    for (int k = 0; k < n; ++k) {
        int best = k;
        for (int r = k + 1; r < n; ++r)
            if (wp::abs(a[r * width + k]) > wp::abs(a[best * width + k])) best = r;
        for (int j = k; j < width; ++j) {
            const REAL swap = a[k * width + j];
            a[k * width + j] = a[best * width + j];
            a[best * width + j] = swap;
        }
        const REAL scale = (REAL)1 / a[k * width + k];
        for (int r = k + 1; r < n; ++r) {
            const REAL f = scale * a[r * width + k];
            for (int j = k + 1; j < width; ++j) a[r * width + j] -= f * a[k * width + j];
        }
    }
    for (int k = n - 1; k >= 0; --k) {
        REAL value = a[k * width + n];
        for (int j = k + 1; j < n; ++j) value -= a[k * width + j] * a[j * width + n];
        a[k * width + n] = value / a[k * width + k];
    }
"""
# What the known loads leave to be changed: -residual and their shares of the answers.
_CHANGE = """
    REAL* __restrict__ C = law.wanted.data + begin; const REAL* __restrict__ R = law.residual.data + begin;
    for (int i = lane; i < count; i += LANES) C[i] = -R[i];
    for (int m = 0; m < n; ++m) {
        const REAL* __restrict__ A = law.answers.data + own + m * capacity;
        const REAL share = law.small.data[first + m * (n + 1) + n];
        #ifndef __CUDACC__
        #pragma clang loop vectorize(assume_safety)
        #endif
        for (int i = lane; i < count; i += LANES) C[i] += share * A[i];
    }
"""


@functools.cache
def functions(p: Precision, pairs: str, form: str, lanes: int) -> SimpleNamespace:
    """Device functions of one block of so many lanes: `learn` and `combine`."""
    real, Law = p.real, delassus.struct(p)
    block_sum = delassus.functions(p, pairs, form, lanes).block_sum
    Reals = wp.array(dtype=real)
    kept, small_size, same = wp.constant(KEPT), wp.constant(SMALL), wp.constant(real(SAME))
    module = p.module("secant", f"{pairs}_{form}_{lanes}")

    def native(code: str) -> str:
        return code.replace("REAL", {"float64": "double", "float32": "float"}[p.name]).replace("LANES", str(lanes))

    @wp.func_native(native(_DOT))
    def dot(
        a: Reals, i: wp.int32, b: Reals, j: wp.int32, weight: Reals, k: wp.int32, count: wp.int32, lane: wp.int32
    ) -> real: ...  # fmt: skip

    @wp.func_native(native(_REMOVE))
    def remove(law: Law, i: wp.int32, j: wp.int32, share: real, count: wp.int32, lane: wp.int32): ...

    @wp.func_native(native(_SYSTEM))
    def fill_system(
        law: Law, first: wp.int32, n: wp.int32, own: wp.int32, capacity: wp.int32,
        begin: wp.int32, count: wp.int32, lane: wp.int32,
    ): ...  # fmt: skip

    @wp.func_native(native(_SOLVE))
    def solve_system(law: Law, first: wp.int32, n: wp.int32): ...

    @wp.func_native(native(_CHANGE))
    def add_answers(
        law: Law, first: wp.int32, n: wp.int32, own: wp.int32, capacity: wp.int32,
        begin: wp.int32, count: wp.int32, lane: wp.int32,
    ): ...  # fmt: skip

    @wp.func(module=module)
    def learn(law: Law, c: wp.int32, begin: wp.int32, count: wp.int32, capacity: wp.int32, lane: wp.int32):
        """Keeps what is new of `load`, and what `change`, its answer, says of it.

        Args:
            begin, count: where the cell's contacts lie; capacity: how many it has room for.
        """
        known = law.known[c]
        slot = known % kept
        own = kept * begin
        at = own + slot * capacity
        i = int(lane)
        while i < count:
            load = law.load[begin + i]
            law.loads[at + i] = load
            law.answers[at + i] = law.change[begin + i] - law.yielding[begin + i] * load
            i += lanes
        size = block_sum(law, dot(law.loads, at, law.loads, at, law.yielding, begin, count, lane), c, lane)
        m = int(0)
        while m < wp.min(known, kept):
            if m != slot:
                other = own + m * capacity
                share = dot(law.loads, at, law.loads, other, law.yielding, begin, count, lane)
                remove(law, at, other, block_sum(law, share, c, lane), count, lane)
            m += 1
        left = block_sum(law, dot(law.loads, at, law.loads, at, law.yielding, begin, count, lane), c, lane)
        scale = real(0.0)
        if left > same * same * size:
            scale = real(1.0) / wp.sqrt(left)
        i = int(lane)
        while i < count:
            law.loads[at + i] = scale * law.loads[at + i]
            law.answers[at + i] = scale * law.answers[at + i]
            i += lanes
        # A load without anything new stands as zero in its place, until the next one takes it.
        if lane == 0 and scale > real(0.0):
            law.known[c] = known + 1
        meet()

    @wp.func(module=module)
    def combine(law: Law, c: wp.int32, begin: wp.int32, count: wp.int32, capacity: wp.int32, lane: wp.int32):
        """What is to be added to a gap less what it yields to its own force, into `wanted`: from `residual` and
        `share`, of a change of a gap the part that its force takes back."""
        n = wp.min(law.known[c], kept)
        own = kept * begin
        first = c * small_size
        meet()
        fill_system(law, first, n, own, capacity, begin, count, lane)
        meet()
        if lane == 0:
            solve_system(law, first, n)
        meet()
        add_answers(law, first, n, own, capacity, begin, count, lane)

    return SimpleNamespace(learn=learn, combine=combine)


def allocate(p: Precision, cells: int, contacts: int, device: Any, law: Any) -> None:
    """The arrays of the struct `Law` that this needs."""
    law.loads, law.answers = (wp.zeros(KEPT * contacts, dtype=p.real, device=device) for _ in range(2))
    law.wanted = wp.zeros(contacts, dtype=p.real, device=device)
    law.small = wp.zeros(SMALL * cells, dtype=p.real, device=device)
    law.known = wp.zeros(cells, dtype=wp.int32, device=device)
