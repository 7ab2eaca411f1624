"""The rows of one dataset of an open record: one frame each, written and cut through HDF5's plain interface.

h5py's own indexing takes three times as long, which counts where a batch writes a thousand records.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.record.layout import dataset_path

__all__ = ["Rows"]


class Rows:
    """The frames of one entry.

    Args:
        file: of h5py, open for writing.
        name: of the entry.

    Attributes:
        shape: of one frame.
        dtype: of its numbers.
        chunk: frames of a chunk.

    Raises:
        OSError, RuntimeError, KeyError: HDF5 can't open it.
    """

    def __init__(self, file: Any, name: str) -> None:
        from h5py import h5d  # pyright: ignore[reportAttributeAccessIssue]

        self._id = h5d.open(file.id, dataset_path(name).encode())
        self.shape: tuple[int, ...] = self._id.shape[1:]
        self.dtype: np.dtype[Any] = self._id.dtype
        self.chunk: int = self._id.get_create_plist().get_chunk()[0]

    def cut(self, count: int) -> None:
        """Cuts to so many frames, or adds frames of zeros up to them."""
        self._id.set_extent((count, *self.shape))

    def write(self, first: int, frames: NDArray[Any]) -> None:
        """Writes frames from number `first` on; the dataset ends with the last of them."""
        from h5py import h5s  # pyright: ignore[reportAttributeAccessIssue]

        frames = np.ascontiguousarray(frames, dtype=self.dtype)
        self.cut(first + len(frames))
        space = self._id.get_space()
        space.select_hyperslab((first, *(0 for _ in self.shape)), frames.shape)
        self._id.write(h5s.create_simple(frames.shape), space, frames)
