"""Which members of a sweep advance together: groups of one structure, cut into batches for the workers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from warpflag.model.build import switches_of
from warpflag.run.run import begun_at_checkpoint
from warpflag.run.sweep.table import status_of
from warpflag.scene import Scene

__all__ = ["Batch", "cut", "groups", "share"]


@dataclass(frozen=True)
class Batch:
    """Members that one simulation advances.

    Attributes:
        members: their numbers.
        directories: of their runs.
        scenes: theirs.
    """

    members: Sequence[int]
    directories: Sequence[Path]
    scenes: Sequence[Scene]


def groups(scenes: Sequence[Scene], directories: Sequence[Path], pending: Sequence[int]) -> list[list[int]]:
    """Members that one simulation can advance: the same terms, precision and stepper, all begun or none.

    Args:
        scenes: of all members.
        directories: of all members.
        pending: numbers of those to run.
    """
    found: dict[object, list[int]] = {}
    for k in pending:
        scene, numerics = scenes[k], scenes[k].numerics
        begun = status_of(directories[k]) != "missing"
        at_checkpoint = begun and begun_at_checkpoint(directories[k])
        key = (switches_of(scene), numerics.precision, numerics.stepper, begun, at_checkpoint)
        found.setdefault(key, []).append(k)
    return list(found.values())


def cut(group: Sequence[int], size: int) -> list[list[int]]:
    """A group in batches of at most so many members, as equal as they can be.

    Members along an axis take more and more time, or every second takes more. So each batch takes one of every few
    neighbours, and their order is reversed from round to round: 0, 1, 2, 2, 1, 0, 0, 1, ...
    """
    count = math.ceil(len(group) / size)
    turns = [*range(count), *reversed(range(count))]
    own: list[list[int]] = [[] for _ in range(count)]
    for k, member in enumerate(group):
        own[turns[k % len(turns)]].append(member)
    return own


def share(count: int, workers: int, largest: int) -> int:
    """Members of a batch where every worker takes equal shares of a group, as few and as large as may be.

    What starts and ends with a batch is spread over its members, and none takes longer beside others. Shares end
    together, since `cut` deals out long and short members alike; smaller batches cost more than they even out.

    Args:
        count: members of the group.
        workers: processes that take batches.
        largest: most members of a batch.
    """
    rounds = math.ceil(count / (workers * largest))
    return math.ceil(count / (workers * rounds))
