"""The chain chart on a CPU: the segments of flagella side by side, each turned and stretched as in `chain_chart`."""

import functools
import math
from typing import Any

import warp as wp

from warpflag_kernels.base import simd
from warpflag_kernels.base.native import native
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import structs

# Square of half the angle of a turn up to which eight terms of the series hold to round-off [rad^2]: the next one is
# 0.35^16/17! = 1e-22.
SMALL_ANGLE_SQUARED = 0.35**2


def _series(first: int) -> str:
    """Eight terms of sin(x)/x (first: 1) or cos(x) (first: 0), in y2 = x^2."""
    text = "REAL(0)"
    for k in range(7, -1, -1):
        text = f"(REAL({(-1) ** k / math.factorial(2 * k + first)!r}) + y2 * {text})"
    return text


@functools.cache
def rows(p: Precision, transporting: bool, Increment: Any) -> Any:
    """Device function: all rows but the first of one group of a cell, with the increment s x; transports a and b."""
    Model, Pose = structs(p).Model, structs(p).Pose
    words = {
        "COSINE": _series(0),
        "SINE": _series(1),
        "SMALL_ANGLE_SQUARED": SMALL_ANGLE_SQUARED,
        "MANY": 2 if transporting else 0,
    }

    @wp.func_native(simd.code(p, native(__file__, "chain_rows", p, **words)))
    def chain_rows(
        groups: simd.struct(),
        g: wp.int32,
        first_node: wp.array(dtype=wp.int32),
        cell: wp.int32,
        model: Model,
        start: Pose,
        s: p.real,
        x: Increment,
        a: Increment,
        b: Increment,
        end: Pose,
        a_out: Increment,
        b_out: Increment,
    ): ...

    return chain_rows
