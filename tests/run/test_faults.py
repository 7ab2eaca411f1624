"""What the line of a violated guard says."""

from __future__ import annotations

import numpy as np
import pytest
from warpflag_kernels.base import clock
from warpflag_kernels.stepping.health import Fault, encode

from tests.helpers import cell
from warpflag.run.faults import NumericalError, found_faults, likely_causes

FIXED = {"numerics.time_step": 1e-6}


def test_it_says_when_and_where():
    line = str(NumericalError(Fault.TWIST, 1.25e-3, 3, 1, 7, cell()))
    assert line.startswith("stopped at 1.25 ms: flagellum 1, segment 7: a joint is twisted")
    assert str(NumericalError(Fault.UNSOLVED, 1.25e-3, 3, 1, 7, cell())).startswith("stopped at 1.25 ms: no step")


@pytest.mark.parametrize(
    ("element", "place"), [(0, (0, 0, 0)), (10, (0, 0, 10)), (11, (0, 1, 0)), (22, (1, 0, 0)), (33, (1, 1, 0))]
)
def test_a_fault_belongs_to_the_flagellum_of_its_element(element, place):
    """Two cells of two flagella with 10 segments each; the tripod is number 0. The second cell has fixed steps."""
    codes = np.full(2, clock.NO_FAULT)
    codes[place[0]] = encode(Fault.TURN) + element
    first_node, first_flagellum = np.array([0, 11, 22, 33, 44]), np.array([0, 2, 4])
    found = found_faults(codes, np.array([1e-3, 2e-3]), first_node, first_flagellum, [cell(), cell(FIXED)])
    assert list(found) == [place[0]]
    error = found[place[0]]
    assert (error.cell, error.flagellum, error.segment) == place and error.time == 1e-3 * (1 + place[0])
    assert ("take a shorter numerics.time_step" in str(error)) == (place[0] == 1)


@pytest.mark.parametrize(
    ("kind", "values", "count"), [(Fault.TWIST, {}, 0), (Fault.TWIST, FIXED, 1), (Fault.UNSTABLE, FIXED, 1)]
)
def test_a_shorter_step_is_advised_once_where_it_is_fixed(kind, values, count):
    assert str(NumericalError(kind, 1e-3, 0, 0, 0, cell(values))).count("take a shorter numerics.time_step") == count


def test_the_value_that_is_farthest_from_its_default_is_named_first_whether_above_or_below_it():
    causes = likely_causes(cell({"motor.torque": 34.0, "fluid.viscosity": 1e-5, "steric.strength": 0.04}))
    assert [cause.partition(" = ")[0] for cause in causes] == ["fluid.viscosity", "steric.strength", "motor.torque"]
    assert causes[0].endswith("1/100 of the default") and causes[2].endswith("10 times the default")
