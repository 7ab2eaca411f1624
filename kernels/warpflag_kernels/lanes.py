"""The block band on a CPU: the flagella of a cell side by side, one per lane of a vector register.

Along one flagellum every row waits for the one before; the same rows of several flagella do not wait for each other. A
group is what fills a register: flagella of one cell, whose blocks are interleaved when they are factorised. A lane
that is left over repeats the last flagellum of its group, and a flagellum shorter than its group goes on with unit
rows, whose solution is zero. Whatever these find is overwritten by, or equal to, what the lane is to find.

Clang's vector types are what makes vector code of this, hence C++. The mathematics is that of `cholesky`.
"""

import functools
import itertools
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels.types import Precision

REGISTER = 64  # bytes of the widest vector register
BLOCKS = 42  # numbers of a factorised row: C_ii^-1, lower triangle, and two whole blocks


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Lanes`: groups of flagella and their factors."""
    real = p.real

    @wp.struct
    class Lanes:
        first_group: wp.array(dtype=wp.int32)  # [C + 1]
        # Per group [G].
        first: wp.array(dtype=wp.int32)  # its first flagellum
        count: wp.array(dtype=wp.int32)  # of flagella
        width: wp.array(dtype=wp.int32)  # lanes: a power of two
        rows: wp.array(dtype=wp.int32)  # of its longest flagellum
        start: wp.array(dtype=wp.int32)  # of its rows, in numbers, where a row has one number per lane
        # Row after row of a group, number after number, lane after lane.
        factors: wp.array(dtype=real)  # BLOCKS per row
        solution: wp.array(dtype=real)  # 4 per row
        columns: wp.array(dtype=real)  # 4 x 6 per row

    return Lanes


def build(p: Precision, first_flagellum: np.ndarray, first_node: np.ndarray, device: Any) -> Any:
    """Groups of a batch.

    Args:
        first_flagellum: first flagellum of every cell and their number, shape [cell_count + 1].
        first_node: first node of every flagellum and their number, shape [flagellum_count + 1].
    """
    widest, length = REGISTER // wp.types.type_size_in_bytes(p.real), np.diff(first_node)
    first_group, groups, total = [0], [], 0
    for begin, end in itertools.pairwise(first_flagellum.tolist()):
        for first in range(begin, end, widest):
            count = min(widest, end - first)
            width, rows = 1 << (count - 1).bit_length(), int(length[first : first + count].max())
            groups.append((first, count, width, rows, total))
            total += -(-rows * width // widest) * widest  # every group begins with a whole register
        first_group.append(len(groups))
    lanes = struct(p)()
    lanes.first_group = wp.array(first_group, dtype=wp.int32, device=device)
    for name, values in zip(("first", "count", "width", "rows", "start"), zip(*groups, strict=True), strict=True):
        setattr(lanes, name, wp.array(values, dtype=wp.int32, device=device))
    for name, numbers in (("factors", BLOCKS), ("solution", 4), ("columns", 24)):
        setattr(lanes, name, wp.zeros(numbers * total, dtype=p.real, device=device))
    return lanes


# V is a vector of a group's lanes. Nothing of this is for CUDA, but a kernel that could call it must compile there.
_GROUP = """
#ifndef __CUDACC__
    using R = REAL;
    const int first = lanes.first.data[g], count = lanes.count.data[g], rows = lanes.rows.data[g];
    const size_t start = lanes.start.data[g];
    auto run = [&](auto zero) {
        using V = decltype(zero);
        constexpr int W = sizeof(V) / sizeof(R);
        int node[W], last[W], shortest = rows;
        for (int l = 0; l < W; ++l) {
            const int k = first + (l < count ? l : count - 1);
            node[l] = first_node.data[k];
            last[l] = first_node.data[k + 1] - node[l] - 1;
            shortest = last[l] + 1 < shortest ? last[l] + 1 : shortest;
        }
        auto element = [&](int l, int i) { return node[l] + (i < last[l] ? i : last[l]); };
        auto get = [](const R* from) { V v; __builtin_memcpy(&v, from, sizeof(V)); return v; };
        auto put = [](R* to, V v) { __builtin_memcpy(to, &v, sizeof(V)); };
        BODY
    };
    switch (lanes.width.data[g]) { CASES }
#endif
"""

# Right-hand sides are taken MANY at a time, which share the loads of the blocks.
_SOLVE = """
    for (int column = 0; column < COLUMNS; column += MANY) {
        R* F = lanes.factors.data + BLOCKS * start;
        R* S = lanes.ROOM.data + 4 * COLUMNS * start + 4 * column * W;
        V p[4][MANY], q[4][MANY];  // solutions of the last two rows
        for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) p[r][m] = q[r][m] = zero;
        for (int i = 0; i < rows; ++i, F += BLOCKS * W, S += 4 * COLUMNS * W) {
            V b[4][MANY];
            LOAD
            for (int c = 0; c < 4; ++c) for (int r = 0; r < 4; ++r) {
                const V f1 = get(F + (10 + 4 * r + c) * W), f2 = get(F + (26 + 4 * r + c) * W);
                for (int m = 0; m < MANY; ++m) b[r][m] -= f1 * p[c][m] + f2 * q[c][m];
            }
            for (int r = 0, t = 0; r < 4; ++r) {
                for (int m = 0; m < MANY; ++m) { q[r][m] = p[r][m]; p[r][m] = zero; }
                for (int c = 0; c <= r; ++c, ++t)
                    for (int m = 0; m < MANY; ++m) p[r][m] += get(F + t * W) * b[c][m];
            }
            for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) put(S + (r * MANY + m) * W, p[r][m]);
        }
        for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) p[r][m] = q[r][m] = zero;
        // Here they are what the rows already solved take away from the next one, and from the one after.
        for (int i = rows - 1; i >= 0; --i) {
            F -= BLOCKS * W;
            S -= 4 * COLUMNS * W;
            V y[4][MANY];
            for (int c = 0; c < 4; ++c) for (int m = 0; m < MANY; ++m) y[c][m] = zero;
            for (int r = 0, t = 0; r < 4; ++r) {
                V b[MANY];
                for (int m = 0; m < MANY; ++m) b[m] = get(S + (r * MANY + m) * W) - p[r][m];
                for (int c = 0; c <= r; ++c, ++t)
                    for (int m = 0; m < MANY; ++m) y[c][m] += get(F + t * W) * b[m];
            }
            for (int c = 0; c < 4; ++c) for (int m = 0; m < MANY; ++m) { p[c][m] = q[c][m]; q[c][m] = zero; }
            for (int c = 0; c < 4; ++c) for (int r = 0; r < 4; ++r) {
                const V f1 = get(F + (10 + 4 * r + c) * W), f2 = get(F + (26 + 4 * r + c) * W);
                for (int m = 0; m < MANY; ++m) { p[c][m] += f1 * y[r][m]; q[c][m] += f2 * y[r][m]; }
            }
            STORE
        }
    }
"""

_NODES = {
    "LOAD": """
        for (int l = 0; l < W; ++l) {
            const R* from = (const R*)x.data + 4 * element(l, i);
            for (int r = 0; r < 4; ++r) b[r][0][l] = from[r];
        }""",
    "STORE": """
        for (int l = 0; l < W; ++l) {
            R* to = (R*)x.data + 4 * element(l, i);
            for (int r = 0; r < 4; ++r) to[r] = y[r][0][l];
        }""",
    "ROOM": "solution",
    "COLUMNS": "1",
    "MANY": "1",
}

_BODY = {
    "LOAD": """
        for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) b[r][m] = zero;
        if (i < 3) for (int l = 0; l < W; ++l) {
            const int k = first + (l < count ? l : count - 1);
            const R* from = (const R*)to_body.data + 24 * (3 * k + i) + column;
            for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) b[r][m][l] = weight * from[6 * r + m];
        }""",
    "STORE": """
        for (int l = 0; l < W; ++l) {
            R* to = (R*)x.data + 24 * element(l, i) + column;
            for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) to[6 * r + m] = y[r][m][l];
        }""",
    "ROOM": "columns",
    "COLUMNS": "6",
    "MANY": "3",
}

_FACTORISE = """
    V c1_before[4][4], inverse1[4][4], inverse2[4][4];  // C_(i-1,i-2); C^-1 of the last two rows
    for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) c1_before[r][c] = inverse1[r][c] = inverse2[r][c] = zero;
    auto positive = zero == zero;
    R* F = lanes.factors.data + BLOCKS * start;
    for (int i = 0; i < rows; ++i, F += BLOCKS * W) {
        V d[4][4], c1[4][4], c2[4][4];
        for (int l = 0; l < W; ++l) {
            const int at = 16 * element(l, i);
            const R *from = (const R*)diagonal.data + at, *from1 = (const R*)lower1.data + at;
            const R* from2 = (const R*)lower2.data + at;
            for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) {
                if (c <= r) d[r][c][l] = from[4 * r + c];
                c1[r][c][l] = from1[4 * r + c];
                c2[r][c][l] = from2[4 * r + c];
            }
        }
        if (i >= shortest) for (int l = 0; l < W; ++l) if (i > last[l])
            for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) {
                if (c <= r) d[r][c][l] = r == c;
                c1[r][c][l] = c2[r][c][l] = 0;
            }
        for (int r = 0; r < 4; ++r) {  // every row of c1 and c2 from its end: what is still needed stands before
            for (int c = 3; c >= 0; --c) {
                V sum = c2[r][c] * inverse2[c][c];
                for (int m = 0; m < c; ++m) sum += c2[r][m] * inverse2[c][m];
                c2[r][c] = sum;
            }
            for (int c = 0; c < 4; ++c) for (int m = 0; m < 4; ++m) c1[r][c] -= c2[r][m] * c1_before[c][m];
            for (int c = 3; c >= 0; --c) {
                V sum = c1[r][c] * inverse1[c][c];
                for (int m = 0; m < c; ++m) sum += c1[r][m] * inverse1[c][m];
                c1[r][c] = sum;
            }
            for (int c = 0; c <= r; ++c)
                for (int m = 0; m < 4; ++m) d[r][c] -= c1[r][m] * c1[c][m] + c2[r][m] * c2[c][m];
        }
        for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) {
            put(F + (10 + 4 * r + c) * W, c1[r][c]);
            put(F + (26 + 4 * r + c) * W, c2[r][c]);
            c1_before[r][c] = c1[r][c];
            inverse2[r][c] = inverse1[r][c];
        }
        auto valid = zero == zero;
        for (int c = 0; c < 4; ++c) {  // Cholesky factor of d, in place; its diagonal inverted
            valid = valid & (d[c][c] > zero);  // NaN fails this, too
            d[c][c] = R(1) / __builtin_elementwise_sqrt(d[c][c]);
            for (int r = c + 1; r < 4; ++r) {
                d[r][c] *= d[c][c];
                for (int m = c + 1; m <= r; ++m) d[r][m] -= d[r][c] * (m < r ? d[m][c] : d[r][c]);
            }
        }
        positive = positive & valid;
        for (int c = 0; c < 4; ++c) for (int r = c; r < 4; ++r) {
            V sum = zero;
            for (int m = c; m < r; ++m) sum -= d[r][m] * inverse1[m][c];
            inverse1[r][c] = r == c ? d[c][c] : sum * d[r][r];
        }
        for (int r = 0, t = 0; r < 4; ++r) for (int c = 0; c <= r; ++c, ++t) {
            inverse1[r][c] = valid ? inverse1[r][c] : zero;
            put(F + t * W, inverse1[r][c]);
        }
    }
    for (int l = 0; l < W; ++l) if (!positive[l]) singular.data[cell] = 1;
"""


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of one group: `factorise`, `solve`, and `columns`, the solution for the body's six columns."""
    real, vec4 = p.real, p.vec4
    mat44, mat46 = wp.types.matrix((4, 4), real), wp.types.matrix((4, 6), real)
    Lanes = struct(p)
    name = {"float64": "double", "float32": "float"}[p.name]
    widest = REGISTER // wp.types.type_size_in_bytes(real)
    widths = [1 << i for i in range(widest.bit_length())]

    def code(body: str, words: dict[str, str]) -> str:
        case = "case {0}: {{ typedef R V __attribute__((ext_vector_type({0}))); run(V(R(0))); break; }}"
        text = _GROUP.replace("CASES", " ".join(case.format(w) for w in widths)).replace("BODY", body)
        for word, value in {**words, "BLOCKS": str(BLOCKS), "REAL": name}.items():
            text = text.replace(word, value)
        return re.sub(r"for \(int [rcml] ", r'_Pragma("clang loop unroll(full)") \g<0>', text)

    @wp.func_native(code(_FACTORISE, {}))
    def factorise(
        lanes: Lanes,
        g: wp.int32,
        cell: wp.int32,
        first_node: wp.array(dtype=wp.int32),
        diagonal: wp.array(dtype=mat44),
        lower1: wp.array(dtype=mat44),
        lower2: wp.array(dtype=mat44),
        singular: wp.array(dtype=wp.int32),
    ): ...

    @wp.func_native(code(_SOLVE, _NODES))
    def solve(lanes: Lanes, g: wp.int32, first_node: wp.array(dtype=wp.int32), x: wp.array(dtype=vec4)): ...

    @wp.func_native(code(_SOLVE, _BODY))
    def columns(
        lanes: Lanes,
        g: wp.int32,
        first_node: wp.array(dtype=wp.int32),
        weight: real,
        to_body: wp.array(dtype=mat46),
        x: wp.array(dtype=mat46),
    ): ...

    return SimpleNamespace(factorise=factorise, solve=solve, columns=columns)
