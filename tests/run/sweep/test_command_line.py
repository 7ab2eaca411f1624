"""Values and axes of the command line beside those of a sweep file."""

from __future__ import annotations

import pytest

from tests.runs import small
from warpflag.run.sweep import read
from warpflag.scene import SceneError, dumps


@pytest.fixture
def sweep(tmp_path):
    (tmp_path / "base.toml").write_text(dumps(small()))
    (tmp_path / "sweep.toml").write_text('base = "base.toml"\n[axes]\nmotor.torque = [1.0, 2.0]\n')
    return tmp_path / "sweep.toml"


@pytest.mark.parametrize(
    "file, key, grid",
    [
        ("sweep.toml", "motor.torque", ()),
        ("sweep.toml", "fluid.viscosity", ("fluid.viscosity=1e-3,2e-3",)),
        ("base.toml", "motor.torque", ("motor.torque=1:2:3",)),
    ],
)
def test_a_value_that_an_axis_would_replace_is_refused(file, key, grid, sweep):
    with pytest.raises(SceneError, match=rf"--set: {key} = 3\.0: is an axis .* --grid {key}=3\.0"):
        read(sweep.with_name(file), [f"{key}=3.0"], grid)


def test_a_grid_of_one_value_takes_the_place_of_an_axis(sweep):
    found = read(sweep, ["fluid.viscosity=2e-3"], ["motor.torque=3.0"]).members()
    assert [(m.scene.motor.torque, m.scene.fluid.viscosity) for m in found] == [(3.0, 2e-3)]
