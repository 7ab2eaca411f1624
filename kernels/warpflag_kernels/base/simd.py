"""SIMD over flagella: recursions along a chain, for several flagella of a cell in the lanes of a vector register.

Along one flagellum every row of a recursion depends on the one before; the same rows of several flagella are
independent. A group is as many flagella of one cell as fill a register. A lane without a flagellum of its own repeats
the last one of its group, with the same result; what a lane computes beyond the end of its flagellum is not stored.

Clang's vector types express this, hence C++. A strict build takes flagella one by one, as a GPU does.
"""

import functools
import itertools
import re
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels.base.native import native
from warpflag_kernels.base.precision import Precision

REGISTER = 64  # bytes of the widest vector register


@functools.cache
def struct() -> Any:
    """The struct `Groups`."""

    @wp.struct
    class Groups:
        """Flagella that are treated side by side in the lanes of a vector register; G groups."""

        first_group: wp.array(dtype=wp.int32)  # [C + 1]
        # Per group [G].
        first: wp.array(dtype=wp.int32)  # its first flagellum
        count: wp.array(dtype=wp.int32)  # of flagella
        width: wp.array(dtype=wp.int32)  # lanes: a power of two
        rows: wp.array(dtype=wp.int32)  # of its longest flagellum
        # Where its rows begin in arrays with one number per row and lane; last: how many numbers these have [G + 1].
        start: wp.array(dtype=wp.int32)

    return Groups


def build(p: Precision, first_flagellum: np.ndarray, first_node: np.ndarray, device: Any) -> Any:
    """The struct `Groups` of a batch.

    Args:
        p: precision, which sets the number of lanes.
        first_flagellum: first flagellum of every cell and their number, shape [cell_count + 1].
        first_node: first node of every flagellum and their number, shape [flagellum_count + 1].
        device: Warp's device.
    """
    widest, length = REGISTER // wp.types.type_size_in_bytes(p.real), np.diff(first_node)
    first_group, start, groups = [0], [0], []
    for begin, end in itertools.pairwise(first_flagellum.tolist()):
        for first in range(begin, end, widest):
            count = min(widest, end - first)
            width, rows = 1 << (count - 1).bit_length(), int(length[first : first + count].max())
            groups.append((first, count, width, rows))
            start.append(start[-1] + -(-rows * width // widest) * widest)  # every group begins with a whole register
        first_group.append(len(groups))
    found = struct()()
    found.first_group, found.start = (wp.array(x, dtype=wp.int32, device=device) for x in (first_group, start))
    for name, values in zip(("first", "count", "width", "rows"), zip(*groups, strict=True), strict=True):
        setattr(found, name, wp.array(values, dtype=wp.int32, device=device))
    return found


def code(p: Precision, body: str) -> str:
    """C++ of a function with arguments `groups`, `g` and `first_node`, which does `body` for group g.

    Loops over r, c, m (rows, columns and right-hand sides of small blocks) and l (lanes) are unrolled, so that the
    blocks that they index stay in registers.

    Args:
        p: precision of the lanes.
        body: C++ in which V is a vector of W lanes.
    """
    case = "case {0}: {{ typedef Real V __attribute__((ext_vector_type({0}))); run(V(Real(0))); break; }}"
    widest = REGISTER // wp.types.type_size_in_bytes(p.real)
    cases = " ".join(case.format(1 << i) for i in range(widest.bit_length()))
    text = native(__file__, "simd_group", p, BODY=body, CASES=cases)
    return re.sub(r"for \(int [rcml] ", r'_Pragma("clang loop unroll(full)") \g<0>', text)
