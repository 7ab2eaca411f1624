"""Philox against the known answers of its authors, and the normal deviates made of it."""

import numpy as np
import warp as wp
from warpflag_kernels.base import random_numbers
from warpflag_kernels.base.precision import Precision

# Counter, key, answer, of Philox4x32 with ten rounds: the file kat_vectors of the Random123 library.
KNOWN = [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]
COUNT = 100_000


def test_philox_gives_the_known_answers(device):
    philox = random_numbers.counters().philox

    @wp.kernel(module="unique")
    def words(given: wp.array2d(dtype=wp.uint32), out: wp.array2d(dtype=wp.uint32)):
        i = wp.tid()
        a, b, c, d = philox(given[i, 0], given[i, 1], given[i, 2], given[i, 3], given[i, 4], given[i, 5])
        out[i, 0] = a
        out[i, 1] = b
        out[i, 2] = c
        out[i, 3] = d

    given = wp.array(np.array([counter + key for counter, key, _ in KNOWN], dtype=np.uint32), device=device)
    out = wp.zeros((len(KNOWN), 4), dtype=wp.uint32, device=device)
    wp.launch(words, len(KNOWN), inputs=[given, out], device=device)
    assert out.numpy().tolist() == [list(answer) for *_, answer in KNOWN]


def test_deviates_are_normal_and_independent(precision, device):
    p = Precision(precision)
    normals = random_numbers.functions(p).normals

    @wp.kernel(module="unique")
    def draw(seed: wp.uint64, step: wp.int32, out: wp.array(dtype=p.vec4)):
        i = wp.tid()
        out[i] = normals(seed, i, step, 1)

    def drawn(seed: int, step: int) -> np.ndarray:
        out = wp.zeros(COUNT, dtype=p.vec4, device=device)
        wp.launch(draw, COUNT, inputs=[wp.uint64(seed), step, out], device=device)
        return out.numpy().astype(np.float64)

    x, other_step, other_seed = drawn(7, 3), drawn(7, 4), drawn(7 + 2**40, 3)
    error = COUNT**-0.5
    assert np.all(abs(x.mean(axis=0)) < 4 * error)
    assert np.all(abs(np.cov(x.T) - np.eye(4)) < 5 * error)
    assert np.all(abs((x**4).mean(axis=0) - 3) < 5 * 96**0.5 * error)  # the variance of x^4 is 96
    for y in (other_step, other_seed, np.roll(x, 1, axis=0)):
        assert np.all(abs((x * y).mean(axis=0)) < 4 * error)
    assert np.array_equal(x, drawn(7, 3))
