"""Behaviour of a recorded cell, and in the summary where the scene asks for it."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.runs import executed, small, summary
from tests.shapes import Zipping
from warpflag.observables.behaviour import load, of_record
from warpflag.record import Record
from warpflag.run import sweep
from warpflag.run.summary import plain


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return Zipping(tmp_path_factory.mktemp("zipping"))


def test_a_made_up_record(made):
    """Two flagella that zip, from 40 % of their length on at 1 ms, on a body that swims along its axis at 150 um/s."""
    with Record(made.directory) as record:
        membership = record.bundle_membership()
        together = made.front(record.times) >= 0.4
        assert (membership[together] == 0).all() and (membership[record.times < 1e-3] == -1).all()
        points = record.motor_loads(0.0, 5e-3)
        assert [p.rate for p in points] == pytest.approx([400.0, 400.0])
        assert [p.torque for p in points] == pytest.approx([3.4, 3.4])
        assert record.wobble().angle == pytest.approx(0.0, abs=1e-7)
        bundle = record.wobble("bundle")
        assert bundle.angle < 0.05
        with pytest.raises(ValueError, match="8 ms is too short"):
            record.runs_and_tumbles()
        found = record.runs_and_tumbles(smoothing=1e-3, shortest_run=0.0)
        assert found.run_speed == pytest.approx(150.0) and len(found.tumbles) == 0
        numbers = of_record.digest(record)
    assert numbers["runs"] is None
    assert numbers["bundles"] == {"count": 1.0, "members": 1.0}
    assert numbers["wrapped"] == {"flagella": 0.0, "along_body": pytest.approx(8 / 31)}  # they begin beside it
    assert numbers["motor_drag"] == pytest.approx([3.4 / (2 * np.pi * 400.0)] * 2)
    json.dumps(plain(numbers), allow_nan=False)


def test_motor_loads_of_a_law_lie_on_its_curve(tmp_path):
    law = {"motor.law": "torque_speed", "motor.torque": 1.26, "motor.knee": 50.0, "motor.no_load": 200.0}
    directory = executed(small({**law, "duration": 4e-3, "frames": 80}), tmp_path / "law")
    with Record(directory) as record:
        for point in record.motor_loads():
            assert 0.0 < point.torque < 1.2
            assert point.torque == pytest.approx(load.torque_at(point.rate, 1.26, 50.0, 200.0), rel=0.02)


def test_the_summary_and_a_sweeps_table_hold_it_where_the_scene_asks(tmp_path):
    asked = executed(small({"behaviour": True}), tmp_path / "asked")
    found = summary(asked)
    assert set(found["behaviour"]) == {"runs", "bundles", "wrapped", "wobble", "motor_drag"}
    assert found["behaviour"]["motor_drag"][0] > 0
    plan = sweep.Sweep(small({"behaviour": True}), {"motor.torque": [2.0]}, {})
    started = sweep.start(plan, tmp_path / "sweep")
    started.execute(workers=1)
    header, row = (tmp_path / "sweep" / "table.csv").read_text().splitlines()
    cells = dict(zip(header.split(","), row.split(","), strict=True))
    assert float(cells["behaviour.bundles.count"]) >= 0 and float(cells["behaviour.motor_drag.0"]) > 0
    assert "behaviour" not in summary(executed(small(), tmp_path / "plain"))


def test_direction_of_swimming_is_needed(made, monkeypatch):
    with Record(made.directory) as record:
        monkeypatch.setattr(type(record), "body_position", np.zeros((161, 3)))
        with pytest.raises(ValueError, match="does not move"):
            record.wobble()
        assert of_record.digest(record)["wobble"] is None
