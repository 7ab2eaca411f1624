"""Device functions of rotations: short ways to the same numbers."""

# No postponed annotations here: a kernel needs its types.

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.rod import rotations


@pytest.mark.parametrize("strict", [False, True])
def test_an_angle_is_the_arctangent_of_its_sine_and_cosine(strict, precision, device):
    p = Precision(precision, strict)
    angle = rotations.functions(p).angle

    @wp.kernel(module=p.module("test_frames"))
    def angles(
        # Model:
        sine: wp.array(dtype=p.real),
        cosine: wp.array(dtype=p.real),
        # Out:
        out: wp.array(dtype=p.real),
    ):
        i = wp.tid()
        out[i] = angle(sine[i], cosine[i])

    around = np.concatenate([np.linspace(-np.pi, np.pi, 5001), np.logspace(-12, 0, 200), -np.logspace(-12, 0, 200)])
    length = np.random.default_rng(0).uniform(0.5, 2.0, len(around))  # need not be one
    sine, cosine = ((length * f(around)).astype(precision) for f in (np.sin, np.cos))
    arrays = [wp.array(values, dtype=p.real, device=device) for values in (sine, cosine)]
    out = wp.zeros(len(around), dtype=p.real, device=device)
    wp.launch(angles, len(around), inputs=[*arrays, out], device=device)
    expected = np.arctan2(sine.astype(np.float64), cosine.astype(np.float64))
    assert np.abs(out.numpy() - expected).max() <= 3 * float(np.finfo(precision).eps) * np.pi
    small = np.abs(expected) < 0.8
    assert (np.abs(out.numpy() - expected)[small] <= 3 * float(np.finfo(precision).eps) * np.abs(expected[small])).all()
