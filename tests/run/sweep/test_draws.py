"""What is drawn at random in a sweep, where one drawn value has to do with another, and how many members that makes."""

from __future__ import annotations

import pytest

from tests.runs import small
from warpflag.run.sweep import Sweep
from warpflag.scene import SceneError, with_values


def test_anchors_keep_their_distances_on_the_body_that_was_drawn():
    """They are where they are on a body that has the drawn width from the start."""
    crowd = small({"flagella.count": 5, "flagella.length": 1.0, "steric.enabled": False})
    anchors = {"placement": "random", "least_distance": 0.8, "clearance": 0.0, "from": -0.3, "to": 0.3}

    def placed(scene, drawn):
        (member,) = Sweep(scene, random={"seed": 3, "anchors": anchors, **drawn}).members()
        return [(spec.azimuth, spec.anchor_offset) for spec in member.scene.resolved_flagella()]

    wide = {"body.width": {"low": 2.0, "high": 2.0}}
    assert placed(crowd, wide) == placed(with_values(crowd, {"body.width": 2.0}), {})


def test_the_most_members_are_counted_with_draws_and_repeats(monkeypatch):
    random = {"draws": 2, "flagellum.torque": {"mean": 3.0, "deviation": 0.1}}
    sweep = Sweep(small(), {"motor.axis_angle": [40.0, 55.0]}, random, repeats=3)
    monkeypatch.setattr("warpflag.run.sweep.axes.MOST_MEMBERS", 12)
    assert len(sweep.members()) == 12
    monkeypatch.setattr("warpflag.run.sweep.axes.MOST_MEMBERS", 11)
    with pytest.raises(SceneError, match="make 12 members; at most 11 are allowed"):
        sweep.members()
