"""Flagella side by side, as a CPU takes them, against flagella one by one."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from warpflag_kernels.base import simd
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.implicit import linearised
from warpflag_kernels.rod import chain_chart

from tests.bench import Bench, bench, close
from tests.plans import by_elements

UNEQUAL = {"flagellum.1.length": 1.2, "flagellum.1.segments": 5, "flagellum.2.length": 0.8}
# Of ten flagella in float64: a register of eight lanes, and one of two.
CELLS = {
    "one": {"flagella.count": 1},
    "a lane over": {"flagella.count": 3, **UNEQUAL},
    "two groups": {"flagella.count": 10, **UNEQUAL},
}
ROUND_OFF = {"float64": 1e-11, "float32": 1e-3}


@pytest.fixture(params=CELLS)
def crowd(request: pytest.FixtureRequest, device: str, precision: str) -> Bench:
    return bench(CELLS[request.param], precision, device)


def in_both_forms(b: Bench, results: Any) -> None:
    """What `results` gives is the same to round-off, flagella side by side and one by one."""
    if b.model.plan.chains != "simd":
        pytest.skip("vector lanes are a CPU's")
    found, side_by_side = [], b.model
    for model in (dataclasses.replace(side_by_side, plan=by_elements(side_by_side.plan)), side_by_side):
        b.model = model
        found.append([a.numpy().copy() for a in results()])
    for one_by_one, together in zip(*found, strict=True):
        assert np.abs(one_by_one).max() > 0
        assert close(together, one_by_one, b.model.precision.name, tolerance=ROUND_OFF)


def test_solutions_are_the_same(crowd):
    right = np.random.default_rng(5).uniform(-1, 1, (crowd.count, 4))

    def results():
        band, y = crowd.factorise(1e-5, 0.9), crowd.increment(1.0, right)
        linearised.solve(crowd.model, crowd.state, band, y)
        return band.body_columns, band.body_block, band.body_inverse, y.body, y.node

    in_both_forms(crowd, results)


@pytest.mark.parametrize("angle", [0.1, 1.5])
@pytest.mark.parametrize("in_place", [False, True])
def test_retractions_are_the_same(angle, in_place, crowd):
    """Turns for which the series of sine and cosine hold, and others."""
    b, own, random = crowd, crowd.stepper, np.random.default_rng(6)
    nodes = random.uniform(-1, 1, (b.count, 4)) * [0.05, 0.05, 0.05, angle]
    x, carried = (b.increment(random.uniform(-0.1, 0.1, 6), n) for n in (nodes, random.uniform(-1, 1, (b.count, 4))))

    def results():
        a_out, b_out = b.increment(), b.increment()
        b.retract(b.increment())
        d = b.data.pose
        start = d if in_place else b.sim.system.chart.base
        chain_chart.retract(b.model, b.state, start, own.data.one, x, d, (carried, x, a_out, b_out))
        return (d.position, d.tangent, d.director, d.length, a_out.node, a_out.body, b_out.node, b_out.body)

    in_both_forms(crowd, results)


@pytest.mark.parametrize("step", [-1e-9, np.nan])
@pytest.mark.parametrize("one_by_one", [False, True])
def test_a_pivot_that_is_not_positive_is_told(one_by_one, step, crowd):
    if one_by_one:
        crowd.model = dataclasses.replace(crowd.model, plan=by_elements(crowd.model.plan))
    assert crowd.factorise(1e-5, 0.9).singular.numpy()[0] == 0
    assert crowd.factorise(step, 0.9).singular.numpy()[0] == 1


def test_groups_are_of_one_cell_each_and_as_wide_as_they_must_be(device):
    flagella, nodes = [1, 11, 3], np.array([5] * 9 + [7] * 6)
    first_flagellum, first_node = (np.concatenate([[0], np.cumsum(x)]) for x in (flagella, nodes))
    groups = simd.build(Precision("float64"), first_flagellum, first_node, device)
    found = {
        name: getattr(groups, name).numpy().tolist() for name in ("first_group", "first", "count", "width", "rows")
    }
    assert found == {
        "first_group": [0, 1, 3, 4],
        "first": [0, 1, 9, 12],
        "count": [1, 8, 3, 3],
        "width": [1, 8, 4, 4],
        "rows": [5, 5, 7, 7],
    }
    assert groups.start.numpy().tolist() == [0, 8, 48, 80, 112]
