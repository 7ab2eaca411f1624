"""What a check tells of scenes that are too large to be tried themselves: from two parts of them."""

from __future__ import annotations

import pytest

from tests.runs import small
from warpflag.run.check import large, report
from warpflag.run.check.time_needed import MOVIE, Needed
from warpflag.run.simulation import Simulation
from warpflag.scene import with_values


@pytest.mark.parametrize(("p", "q"), [(2.0, 0.0), (0.0, 3e-3), (2.0, 3e-3)])
def test_times_of_parts_grow_to_that_of_the_whole(p, q):
    nodes = [500, 1500]
    assert large.grown(nodes, [p * n + q * n * n for n in nodes], 9000) == pytest.approx(9000 * p + 8.1e7 * q)


def test_times_of_parts_are_never_negative_far_out():
    assert large.grown([500, 1500], [1.0, 1.5], 10**6) == pytest.approx(1.5 / 1500 * 10**6)
    assert large.grown([500, 1500], [1.0, 30.0], 10**6) == pytest.approx(30.0 / 1500**2 * 10**12)


def test_a_part_has_the_first_flagella_of_a_scene():
    scene = small({"flagella.count": 40, "flagella.length": 2.0, "body.length": 20.0, "body.width": 10.0})
    own = with_values(scene, {"flagellum.1.torque": 1.0, "flagellum.39.length": 3.0})
    few = large.part(own, 66)
    assert [spec.segment_count for spec in few.resolved_flagella()] == [10] * 6
    assert few.resolved_flagella()[1].torque == 1.0 and few.fluid == own.fluid and few.numerics == own.numerics
    # Two flagella at least; where they are long, shorter ones of the same segments.
    short = large.part(small({"flagella.length": 90.0, "flagella.opening_angle": 120.0}), 200)
    assert [spec.segment_count for spec in short.resolved_flagella()] == [100, 100]
    assert short.resolved_flagella()[0].segment_length == pytest.approx(0.2, rel=0.01)
    explicit = large.part(small({"flagellum.0.segments": 400, "flagellum.0.length": 40.0}), 82)
    assert explicit.resolved_flagella()[0].segment_count == pytest.approx(80, abs=3)
    assert explicit.resolved_flagella()[0].segment_length == pytest.approx(0.1, rel=0.05)


def test_the_check_of_a_large_scene_advances_parts_of_it_alone(monkeypatch):
    monkeypatch.setattr(large, "LARGEST", 100)
    monkeypatch.setattr(large, "PARTS", (30, 60))
    advanced = []
    monkeypatch.setattr(Simulation, "advance", lambda own, until, watch=None: advanced.append(int(own.first_node[-1])))
    said = report(small({"flagella.count": 12, "flagella.length": 2.0}))
    assert "12 flagella, 120 segments, 132 nodes" in said
    assert "# which is a guess: from parts of it with 22 and 55 nodes" in said
    assert set(advanced) == {22, 55}


def test_the_time_of_a_large_scene_is_grown_from_its_parts(monkeypatch):
    """Stepping in n nodes taken as 2e-3 n + 3e-5 n^2 s, frames as 1e-3 n s beside a movie of its own time."""
    monkeypatch.setattr(large, "PARTS", (30, 60))

    def taken(simulation, seconds):
        n = int(simulation.first_node[-1])
        stepping = 2e-3 * n + 3e-5 * n**2
        return Needed(0.5, 2.0, 0.25 * stepping, 0.75 * stepping, MOVIE + 1e-3 * n, 1.0 + 1e-2 * n)

    monkeypatch.setattr(large, "needed", taken)
    found, nodes = large.needed_by_parts(small({"flagella.count": 12, "flagella.length": 2.0}), 0.25, "cpu")
    assert nodes == [22, 55]
    assert found.stepping == pytest.approx(2e-3 * 132 + 3e-5 * 132**2)
    assert found.output == pytest.approx(MOVIE + 1e-3 * 132)
    assert (found.startup, found.compiling, found.crowd) == pytest.approx((0.75, 4.0, 1.55))
