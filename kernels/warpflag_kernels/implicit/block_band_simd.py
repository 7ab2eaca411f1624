"""The block band on a CPU: factors and solutions of flagella side by side. The mathematics is that of `cholesky`.

A flagellum shorter than its group goes on with unit rows, which are coupled to nothing.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import simd
from warpflag_kernels.base.types import Precision

NUMBERS = 42  # of a factorised row


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Factors`: row after row of a group, number after number, lane after lane."""
    real = p.real

    @wp.struct
    class Factors:
        blocks: wp.array(dtype=real)  # NUMBERS per row
        solution: wp.array(dtype=real)  # 4 per row; work space

    return Factors


def build(p: Precision, groups: Any) -> Any:
    """Room for the factors of these groups."""
    factors, size = struct(p)(), int(groups.start.numpy()[-1])
    for name, numbers in (("blocks", NUMBERS), ("solution", 4)):
        setattr(factors, name, wp.zeros(numbers * size, dtype=p.real, device=groups.start.device))
    return factors


# A row of factors is C_ii^-1, lower triangle, C_(i,i+1) and C_(i,i+2).
_PLACES = """
    R* F = factors.blocks.data + NUMBERS * (size_t)groups.start.data[g];
    auto get = [](const R* from) { V v; __builtin_memcpy(&v, from, sizeof(V)); return v; };
    auto put = [](R* to, V v) { __builtin_memcpy(to, &v, sizeof(V)); };
"""

# Right-hand sides are taken MANY at a time, which share the loads of the blocks; all are zero from row FILLED on.
_SOLVE = """
    for (int column = 0; column < COLUMNS; column += MANY) {
        ROOM
        V p[4][MANY], q[4][MANY];  // solutions of the last two rows
        for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) p[r][m] = q[r][m] = zero;
        for (int i = wp::min(FILLED, rows) - 1; i >= 0; --i) {
            const R* block = F + NUMBERS * W * i;
            V b[4][MANY];
            LOAD
            for (int c = 0; c < 4; ++c) for (int r = 0; r < 4; ++r) {
                const V f1 = get(block + (10 + 4 * r + c) * W), f2 = get(block + (26 + 4 * r + c) * W);
                for (int m = 0; m < MANY; ++m) b[r][m] -= f1 * p[c][m] + f2 * q[c][m];
            }
            for (int r = 0, t = 0; r < 4; ++r) {
                for (int m = 0; m < MANY; ++m) { q[r][m] = p[r][m]; p[r][m] = zero; }
                for (int c = 0; c <= r; ++c, ++t)
                    for (int m = 0; m < MANY; ++m) p[r][m] += get(block + t * W) * b[c][m];
            }
            for (int r = 0; r < 4; ++r)
                for (int m = 0; m < MANY; ++m) put(S + ((4 * i + r) * MANY + m) * W, p[r][m]);
        }
        for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) p[r][m] = q[r][m] = zero;
        // Here they are what the rows already solved take away from the next one, and from the one after.
        for (int i = 0; i < rows; ++i) {
            const R* block = F + NUMBERS * W * i;
            V y[4][MANY];
            for (int c = 0; c < 4; ++c) for (int m = 0; m < MANY; ++m) y[c][m] = zero;
            for (int r = 0, t = 0; r < 4; ++r) {
                V b[MANY];
                for (int m = 0; m < MANY; ++m)
                    b[m] = (i < FILLED ? get(S + ((4 * i + r) * MANY + m) * W) : zero) - p[r][m];
                for (int c = 0; c <= r; ++c, ++t)
                    for (int m = 0; m < MANY; ++m) y[c][m] += get(block + t * W) * b[m];
            }
            for (int c = 0; c < 4; ++c) for (int m = 0; m < MANY; ++m) { p[c][m] = q[c][m]; q[c][m] = zero; }
            for (int c = 0; c < 4; ++c) for (int r = 0; r < 4; ++r) {
                const V f1 = get(block + (10 + 4 * r + c) * W), f2 = get(block + (26 + 4 * r + c) * W);
                for (int m = 0; m < MANY; ++m) { p[c][m] += f1 * y[r][m]; q[c][m] += f2 * y[r][m]; }
            }
            for (int l = 0; l < W; ++l) if (i <= last[l]) {
                R* to = (R*)(x.data + COLUMNS * (node[l] + i) + column);
                for (int m = 0; m < MANY; ++m) for (int r = 0; r < 4; ++r) to[4 * m + r] = y[r][m][l];
            }
        }
    }
"""

_NODES = {
    "LOAD": """
        for (int l = 0; l < W; ++l) {
            const R* from = (const R*)x.data + 4 * element(l, i);
            for (int r = 0; r < 4; ++r) b[r][0][l] = from[r];
        }""",
    "FILLED": "rows",
    "ROOM": "R* S = factors.solution.data + 4 * (size_t)groups.start.data[g];",
    "COLUMNS": "1",
    "MANY": "1",
}

_BODY = {
    "LOAD": """
        for (int l = 0; l < W; ++l) {
            const R* from = (const R*)to_body.data + 24 * (3 * flagellum[l] + i) + column;
            for (int r = 0; r < 4; ++r) for (int m = 0; m < MANY; ++m) b[r][m][l] = weight * from[6 * r + m];
        }""",
    "FILLED": "3",
    "ROOM": "R S[3 * 4 * MANY * W];",
    "COLUMNS": "6",
    "MANY": "3",
}

_FACTORISE = """
    V c1_before[4][4], inverse1[4][4], inverse2[4][4];  // C_(i+1,i+2); C^-1 of the last two rows
    for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) c1_before[r][c] = inverse1[r][c] = inverse2[r][c] = zero;
    auto positive = zero == zero;
    for (int i = rows - 1; i >= 0; --i) {
        R* block = F + NUMBERS * W * i;
        V d[4][4], c1[4][4], c2[4][4];
        for (int l = 0; l < W; ++l) {
            const R* from = (const R*)diagonal.data + 16 * element(l, i);
            const R* from1 = (const R*)lower1.data + 16 * element(l, i + 1);
            const R* from2 = (const R*)lower2.data + 16 * element(l, i + 2);
            for (int r = 0; r < 4; ++r) for (int c = 0; c <= r; ++c) d[r][c][l] = from[4 * r + c];
            for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) c1[c][r][l] = from1[4 * r + c];
            for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) c2[c][r][l] = from2[4 * r + c];
        }
        if (i + 2 >= shortest) for (int l = 0; l < W; ++l)
            for (int r = 0; r < 4; ++r) for (int c = 0; c < 4; ++c) {
                if (c <= r && i > last[l]) d[r][c][l] = r == c;
                if (i + 1 > last[l]) c1[r][c][l] = 0;
                if (i + 2 > last[l]) c2[r][c][l] = 0;
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
            put(block + (10 + 4 * r + c) * W, c1[r][c]);
            put(block + (26 + 4 * r + c) * W, c2[r][c]);
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
            put(block + t * W, inverse1[r][c]);
        }
    }
    for (int l = 0; l < W; ++l) if (!positive[l]) singular.data[cell] = 1;
"""


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of one group: `factorise`, `solve`, and `columns`, the solution for the body's six columns."""
    real, vec4 = p.real, p.vec4
    mat44, mat46 = wp.types.matrix((4, 4), real), wp.types.matrix((4, 6), real)
    Groups, Factors, words = simd.struct(), struct(p), {"NUMBERS": str(NUMBERS)}

    @wp.func_native(simd.code(p, _PLACES + _FACTORISE, words))
    def factorise(
        groups: Groups,
        factors: Factors,
        g: wp.int32,
        first_node: wp.array(dtype=wp.int32),
        diagonal: wp.array(dtype=mat44),
        lower1: wp.array(dtype=mat44),
        lower2: wp.array(dtype=mat44),
        singular: wp.array(dtype=wp.int32),
        cell: wp.int32,
    ): ...

    @wp.func_native(simd.code(p, _PLACES + _SOLVE, {**_NODES, **words}))
    def solve(
        groups: Groups, factors: Factors, g: wp.int32, first_node: wp.array(dtype=wp.int32), x: wp.array(dtype=vec4)
    ): ...

    @wp.func_native(simd.code(p, _PLACES + _SOLVE, {**_BODY, **words}))
    def columns(
        groups: Groups,
        factors: Factors,
        g: wp.int32,
        first_node: wp.array(dtype=wp.int32),
        weight: real,
        to_body: wp.array(dtype=mat46),
        x: wp.array(dtype=vec4),
    ): ...

    return SimpleNamespace(factorise=factorise, solve=solve, columns=columns)
