"""What the line of a violated guard says."""

from __future__ import annotations

import pytest
from warpflag_kernels.stepping.health import Fault

from tests.helpers import cell
from warpflag.run.faults import NumericalError

FIXED = {"numerics.time_step": 1e-6}


def test_it_says_when_and_where():
    line = str(NumericalError(Fault.TWIST, 1.25e-3, 3, 1, 7, cell()))
    assert line.startswith("stopped at 1.25 ms: flagellum 1, segment 7: a joint is twisted")
    assert str(NumericalError(Fault.UNSOLVED, 1.25e-3, 3, 1, 7, cell())).startswith("stopped at 1.25 ms: no step")


@pytest.mark.parametrize(
    ("kind", "values", "count"), [(Fault.TWIST, {}, 0), (Fault.TWIST, FIXED, 1), (Fault.UNSTABLE, FIXED, 1)]
)
def test_a_shorter_step_is_advised_once_where_it_is_fixed(kind, values, count):
    assert str(NumericalError(kind, 1e-3, 0, 0, 0, cell(values))).count("take a shorter numerics.time_step") == count
