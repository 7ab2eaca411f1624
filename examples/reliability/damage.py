"""Damage done to files, each kind by a seed: flipped bits, changed bytes, zeroed blocks, lost ends."""

from __future__ import annotations

import random

__all__ = ["damaged"]


def damaged(content: bytes, seed: int) -> tuple[str, bytes]:
    """One piece of damage to the content of a file.

    Args:
        content: the bytes of the sound file, at least one.
        seed: which damage; the same seed and content give the same damage.

    Returns:
        What was done, in words, and the damaged bytes. Half of the flips and changes fall on bytes that are not zero,
        which in a sparse file are few and matter most.
    """
    chance = random.Random(seed)
    changed = bytearray(content)
    place = chance.randrange(len(changed))
    if chance.random() < 0.5:
        place = next((i for i in range(place, len(changed)) if changed[i]), place)
    kind = chance.choice(["flip", "flip", "byte", "zero", "random", "truncate", "repeat"])
    size = chance.choice([1, 8, 64, 512, 4096])
    end = min(place + size, len(changed))
    if kind == "flip":
        changed[place] ^= 1 << chance.randrange(8)
    elif kind == "byte":
        changed[place] = chance.choice([0x00, 0x7F, 0x80, 0xFF])
    elif kind == "zero":
        changed[place:end] = bytes(end - place)
    elif kind == "random":
        changed[place:end] = chance.randbytes(end - place)
    elif kind == "truncate":
        del changed[place:]
    else:  # a block that lies where another should
        source = chance.randrange(len(changed))
        changed[place:end] = content[source : source + end - place].ljust(end - place, b"\0")
    return f"{kind} at byte {place} of {len(content)}, {size} bytes", bytes(changed)
