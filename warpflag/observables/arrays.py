"""What the measures share: unit vectors, the flagella of a flat array, the length of a window."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Array", "elapsed", "flagella", "unit"]

Array = NDArray[np.floating]


def unit(vectors: ArrayLike) -> Array:
    """The vectors over their lengths, shape [..., 3]."""
    vectors = np.asarray(vectors, float)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def flagella(first_node: ArrayLike) -> Iterator[slice]:
    """The rows of each flagellum, from its r_0 to its tip."""
    for first, end in pairwise(np.asarray(first_node).tolist()):
        yield slice(first, end)


def elapsed(times: ArrayLike) -> float:
    """The time passed over the window [s]; raises ValueError where there is none."""
    times = np.asarray(times, float)
    if len(times) < 2 or not times[-1] > times[0]:
        raise ValueError("a rate needs at least two frames at increasing times")
    return float(times[-1] - times[0])
