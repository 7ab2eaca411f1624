"""Which members of a sweep advance together: groups of one structure, cut into batches for the workers."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from warpflag.model.build import switches_of
from warpflag.run.run import begun_at_checkpoint
from warpflag.run.sweep.table import status_of
from warpflag.scene import Scene

__all__ = ["Batch", "best_size", "cut", "groups", "is_short", "share"]

_GOLDEN = (5.0**0.5 - 1.0) / 2.0  # golden ratio: its multiples modulo 1 lie most evenly
# Node seconds for each worker, a minute of computing of examples/zipping.toml. For 24 runs of 150 ms of it the
# measurement chose batches of two, which took a fifth longer than equal shares.
_SHORT = 1000.0


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

    Members along an axis take more and more time, or every second takes more, so that neighbours go to different
    batches: in the order of the multiples of the golden ratio modulo 1, a stretch holds members from everywhere.
    """
    count = math.ceil(len(group) / size)
    if size == 1:
        return [[k] for k in group]
    order = sorted(range(len(group)), key=lambda i: i * _GOLDEN % 1.0)
    ends = [len(group) * k // count for k in range(count + 1)]
    return [sorted(group[i] for i in order[first:last]) for first, last in itertools.pairwise(ends)]


def is_short(scenes: Sequence[Scene], workers: int) -> bool:
    """Whether members are so few, small and short that all will have ended before measuring them pays."""
    needed = sum(scene.duration * sum(spec.segment_count + 1 for spec in scene.resolved_flagella()) for scene in scenes)
    return needed <= _SHORT * workers


def share(count: int, workers: int, largest: int) -> int:
    """Members of a batch where each worker takes an equal share of a group, in as few batches as may be."""
    return min(math.ceil(count / workers), largest)


def best_size(count: int, workers: int, alone: float, together: float, sample: int, largest: int) -> tuple[int, float]:
    """Members of a batch with which the sweep is expected to end first, the fewest of those.

    A member of a batch of s takes a + b / s: what a batch shares is spread over its members. Members differ, and which
    are the long ones is not known, so the last batch is taken to keep one worker busy for half its length alone.

    Args:
        count: members to run.
        workers: processes that take batches.
        alone: time of a member by itself [s].
        together: time per member in a batch of `sample` [s].
        sample: members of the batch that was measured.
        largest: most members of a batch.

    Returns:
        Members of a batch, and the wall time that is expected [s].
    """
    shared = min(max(0.0, (alone - together) / (1.0 - 1.0 / sample)), alone)
    own = alone - shared

    def expected(size: int) -> float:
        rounds = math.ceil(math.ceil(count / size) / workers)
        even = min(rounds * size, count) if workers > 1 else count
        return (own + shared / size) * (even + (0.5 * size if workers > 1 else 0.0))

    size = min(range(1, min(count, largest) + 1), key=expected)
    return size, expected(size)
