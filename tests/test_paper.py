"""The scripts of examples/paper: their scenes are sound, their table and their mobility right."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from tests.helpers import touching_cell
from tests.oracles import dense_mobility
from tests.shapes import Zipping
from warpflag.model.geometry import initial_state
from warpflag.scene import with_values
from warpflag.scene.resistance import filament_mobility

pytest.importorskip("matplotlib")

sys.path.insert(0, str(Path(__file__).parent.parent / "examples" / "paper"))
import mobility
import scenes
import study
import table

sys.path.pop(0)


def test_scenes_of_the_figures():
    opening, ablations = scenes.figure_3(), scenes.figure_4()
    assert [run.flagella.opening_angle for run in opening.values()] == [23, 44, 60, 90] * 2
    assert {run.flagella.length for run in opening.values()} == {6.0, 8.0}
    assert len(ablations) == 18
    assert not ablations["T2-no-translation"].body.translation
    changed = with_values(ablations["T3.4-standard"], {"body.anchored": True, "name": "T3.4-anchored"})
    assert changed == ablations["T3.4-anchored"]
    groups = (
        opening,
        ablations,
        scenes.choices(),
        scenes.torques(),
        scenes.printed_mobility(),
        scenes.continued(Path()),
    )
    names = [name for group in groups for name in group]
    assert len(set(names)) == len(names)
    for group in groups:
        for run in group.values():
            # A motor turns by less than half a turn between two frames, at 400 Hz per pN um.
            assert run.duration / run.frames < 0.5 / (400 * run.motor.torque)


def test_points_of_the_study():
    points = study.points()
    crossed = [values for values, _ in points.values() if values.keys() == study.FACTORS.keys()]
    assert len(crossed) >= 2 * 2 * 3 * 2 * 2 * 2 * 6
    values = {**study.STANDARD, "flagella.length": 8.0}
    own = study.build(values, "consistent-within")
    whole = study.build(values, "consistent")
    assert (own.hydrodynamics.mode, whole.hydrodynamics.mode) == ("within", "consistent")
    assert filament_mobility(own, 0.2).along == pytest.approx(filament_mobility(whole, 0.2).along)
    assert filament_mobility(own, 0.2).across == pytest.approx(filament_mobility(whole, 0.2).across)
    # Flagella from one side of the body open by the same angle.
    tilts = [
        np.radians(spec.tilt) for spec in study.build({**study.STANDARD, "apart": 90.0}, "all").resolved_flagella()
    ]
    between = np.cos(tilts[0]) * np.cos(tilts[1])  # at a right angle the sines drop out
    assert np.degrees(np.arccos(between)) == pytest.approx(23.0)


def test_mobility_is_the_one_of_the_model():
    scene = touching_cell({"hydrodynamics.mode": "as_printed"})
    start = initial_state(scene)
    local = filament_mobility(scene, 0.2)
    for radius in (0.010, 0.0297):
        drag = local.along, local.across, 1e-3
        found = mobility.mobility(np.concatenate(start.positions), np.array([0, 11, 22]), 0.2, radius, drag)
        np.testing.assert_allclose(found, dense_mobility(scene, start, radius), rtol=1e-9, atol=1e-9 * found.max())
        assert (np.linalg.eigvalsh(found)[0] > 0.0) == (radius > 0.02)


def test_table_of_a_run(tmp_path):
    made = Zipping(tmp_path)
    (tmp_path / "summary.json").write_text('{"status": "stopped", "time": 0.0081}')
    row = dict(zip(table.COLUMNS, table.row(tmp_path), strict=True))
    assert row["run"] == f"{tmp_path.name} (stopped at 8.10 ms)"
    assert row["zip, held"] == "7.00"  # the front reaches the last node when 0.4 + 0.1 (t - 1 ms) = 1
    assert (row["motor"], row["body"], row["speed"]) == ("366", f"{made.body_rate:.1f}", f"{made.body_speed:.0f}")
    assert (row["f_c peak"], row["at"], row["contact"]) == ("1.01", "8.00", "0.00")
