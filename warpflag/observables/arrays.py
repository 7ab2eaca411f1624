"""What the measures share: unit vectors, the flagella of a flat array, the duration of a window."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["Array", "elapsed", "flagella", "unit"]

Array = NDArray[np.floating]


def unit(vectors: ArrayLike) -> Array:
    """Vectors of length one along the given vectors, shape [..., 3] both."""
    vectors = np.asarray(vectors, float)
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def flagella(first_node: ArrayLike) -> Iterator[slice]:
    """The rows of each flagellum in a flat array, from its r_0 to its tip.

    Args:
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
    """
    for first, end in pairwise(np.asarray(first_node).tolist()):
        yield slice(first, end)


def elapsed(times: ArrayLike) -> float:
    """The time between the first and the last frame of a window [s].

    Args:
        times: of the frames [s], shape [frame_count].

    Raises:
        ValueError: fewer than two frames, or the last is not after the first.
    """
    times = np.asarray(times, float)
    if len(times) < 2 or not times[-1] > times[0]:
        raise ValueError("a rate needs at least two frames at increasing times")
    return float(times[-1] - times[0])
