"""The block band on a CPU: factors and solutions of several flagella in vector lanes, by the method of `cholesky`.

A flagellum shorter than the longest of its group is continued by unit rows without coupling.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import simd
from warpflag_kernels.base.native import native
from warpflag_kernels.base.precision import Precision

NUMBERS_PER_ROW = 42  # of a factorised row


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Factors`: row after row of a group, number after number, lane after lane."""
    real = p.real

    @wp.struct
    class Factors:
        blocks: wp.array(dtype=real)  # NUMBERS_PER_ROW per row
        solution: wp.array(dtype=real)  # 4 per row; work space

    return Factors


def build(p: Precision, groups: Any) -> Any:
    """Room for the factors of these groups."""
    factors, size = struct(p)(), int(groups.start.numpy()[-1])
    for name, numbers in (("blocks", NUMBERS_PER_ROW), ("solution", 4)):
        setattr(factors, name, wp.zeros(numbers * size, dtype=p.real, device=groups.start.device))
    return factors


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of one group: `factorise`, `solve`, and `columns`, the solution for the body's six columns."""
    real, vec4 = p.real, p.vec4
    mat44, mat46 = wp.types.matrix((4, 4), real), wp.types.matrix((4, 6), real)
    Groups, Factors = simd.struct(), struct(p)

    def in_file(name: str, **words: object) -> str:
        return native(__file__, name, p, **words)

    places = in_file("factor_places", NUMBERS=NUMBERS_PER_ROW)
    nodes = {
        "LOAD": in_file("load_nodes"),
        "FILLED": "rows",
        "ROOM": "Real* S = factors.solution.data + 4 * (size_t)groups.start.data[g];",
        "COLUMNS": 1,
        "MANY": 1,
    }
    body = {
        "LOAD": in_file("load_body_columns"),
        "FILLED": 3,
        "ROOM": "Real S[3 * 4 * MANY * W];",
        "COLUMNS": 6,
        "MANY": 3,
    }

    @wp.func_native(simd.code(p, in_file("factorise_group", PLACES=places, NUMBERS=NUMBERS_PER_ROW)))
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

    @wp.func_native(simd.code(p, in_file("solve_group", PLACES=places, NUMBERS=NUMBERS_PER_ROW, **nodes)))
    def solve(
        groups: Groups, factors: Factors, g: wp.int32, first_node: wp.array(dtype=wp.int32), x: wp.array(dtype=vec4)
    ): ...

    @wp.func_native(simd.code(p, in_file("solve_group", PLACES=places, NUMBERS=NUMBERS_PER_ROW, **body)))
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
