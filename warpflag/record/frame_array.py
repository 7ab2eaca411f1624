"""Frames of one quantity of a record, read as they are indexed and compared with their checksums."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from warpflag.record.layout import RecordError, checksums, one_line

__all__ = ["FrameArray", "reading"]


@contextmanager
def reading(path: Path, what: str) -> Iterator[None]:
    """Turns whatever HDF5 and h5py raise over a damaged file, which are errors of many kinds, into a RecordError.

    Args:
        path: the file.
        what: what is wrong with it, for the message.
    """
    try:
        yield
    except RecordError:
        raise
    except Exception as error:
        raise RecordError(f"{path}: {what}: {one_line(error)}") from error


class FrameArray:
    """Frames of one quantity, read as they are indexed: a[i], a[10:20, :3], or np.asarray(a) for all.

    Every frame that is read is compared with its checksum; where they differ, or the file can't be read, indexing
    raises RecordError.

    Args:
        read: gives the frames from one to before another, shape [last - first, ...].
        shape: of one frame.
        sums: checksums of the committed frames, shape [frame_count]; None for a record without.
        frame_count: number of committed frames; what the file holds beyond is left out.
        path: the file, for messages.
        name: of the quantity, for messages.

    Attributes:
        shape: [frame_count, ...].
    """

    def __init__(
        self,
        read: Callable[[int, int], NDArray[Any]],
        shape: tuple[int, ...],
        sums: NDArray[np.uint32] | None,
        frame_count: int,
        path: Path,
        name: str,
    ):
        self._read = read
        self._sums = sums
        self._path = path
        self._name = name
        self.shape: tuple[int, ...] = (frame_count, *shape)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> NDArray[np.float64]:
        first: Any
        first, *rest = key if isinstance(key, tuple) else (key,)
        if first is Ellipsis:
            first, rest = slice(None), [Ellipsis, *rest]
        if first is None or isinstance(first, bool | np.bool_):  # adds an axis before the frames
            return self[:][key]
        rows = np.arange(len(self))[first]  # IndexError and negative steps as in any array
        if rows.size == 0:
            return np.empty(self.shape)[key]
        low = int(rows.min())
        with reading(self._path, "frames can't be read"):
            block = np.asarray(self._read(low, int(rows.max()) + 1))
            if len(block) != int(rows.max()) + 1 - low:
                raise RecordError(f"{self._path}: is damaged: /{self._name} ends before frame {int(rows.max())}")
        self._verify(block, low)
        if isinstance(first, slice) or not rows.ndim:
            return block[rows - low][(slice(None),) * rows.ndim + tuple(rest)]
        return block[(rows - low, *rest)]  # frames by an array go together with other arrays, one by one

    if not TYPE_CHECKING:  # a type checker knows by itself that there is no such method

        def __getattr__(self, name: str) -> Any:
            raise AttributeError(f"frames are read as they are indexed and have no {name}; [:] reads all of them")

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[:], dtype=dtype)

    def _verify(self, block: NDArray[Any], low: int) -> None:
        if self._sums is None:
            return
        differ = np.flatnonzero(checksums(block) != self._sums[low : low + len(block)])
        if differ.size:
            problem = f"frame {low + differ[0]} of /{self._name} does not agree with its checksum"
            raise RecordError(f"{self._path}: is damaged: {problem}")
