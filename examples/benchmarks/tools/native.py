"""The C++ pair sum of pair_sum.cpp, compiled on the spot and called through ctypes."""

from __future__ import annotations

import ctypes
import functools
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

FLAGS = ("-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512", "-shared", "-fPIC")
SOURCE = Path(__file__).with_name("pair_sum.cpp")
_NUMBER = {"float64": ctypes.c_double, "float32": ctypes.c_float}


def compiler() -> str | None:
    """The C++ compiler at hand."""
    return shutil.which("g++") or shutil.which("clang++")


@functools.cache
def _library() -> ctypes.CDLL:
    # The folder may go once the library is loaded; a library kept for another day could be of another machine.
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "pair_sum.so"
        subprocess.run([compiler() or "g++", *FLAGS, str(SOURCE), "-o", str(library)], check=True)
        return ctypes.CDLL(str(library))


class NativePairSum:
    """The pair sum of given nodes in C++; `velocities` holds the result, in units of 1/(8 pi eta).

    Args:
        positions, forces: shape [node_count, 3].
        radius: of the Rotne-Prager tensor.
        symmetric: every unordered pair once, instead of both orders.
    """

    def __init__(self, positions: Any, forces: Any, radius: float, precision: str, symmetric: bool = False) -> None:
        self._function = getattr(_library(), f"pair_sum_{precision}")
        self._function.argtypes = [ctypes.c_int] * 3 + [ctypes.c_void_p] * 3 + [_NUMBER[precision]]
        self._x, self._f = (np.ascontiguousarray(np.transpose(a), dtype=precision) for a in (positions, forces))
        self._v = np.zeros_like(self._x)
        self._radius, self._symmetric = radius, int(symmetric)

    def __call__(self, repeats: int) -> None:
        """Sums so many times over."""
        arrays = [a.ctypes.data for a in (self._x, self._f, self._v)]
        self._function(self._symmetric, repeats, self._x.shape[1], *arrays, self._radius)

    @property
    def velocities(self) -> np.ndarray:
        return self._v.T.astype(np.float64)
