"""Whether a motion magnifies disturbances, and where a run says so."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tests.runs import small, summary
from warpflag.run import execute, run
from warpflag.run.growth import FOLLOWED, FOLLOWED_IN_CROWDS, PATIENCE, Growth, chosen, growth, growth_words, wanted
from warpflag.run.simulation import Simulation
from warpflag.run.stop import Ended
from warpflag.scene import paper_scene, with_values


def test_a_run_is_followed_from_frames_spread_over_it():
    record: Any = SimpleNamespace(times=np.linspace(0.0, 4e-3, 41), frame_count=41, frame=lambda index: index)
    assert list(chosen(record, None, FOLLOWED, 3)) == [0, 40, 20]
    many = list(chosen(record, 3.31e-3, FOLLOWED, 10))
    assert many[:4] == [32, 40, 0, 20]  # first the one before the window of 0.1 ms
    assert len(set(many)) == 10 and np.diff(sorted(many)).max() <= 9  # the rest is between
    record.times, record.frame_count = np.zeros(1), 1
    assert list(chosen(record, 1e-3, FOLLOWED, 10)) == [0]


def test_a_steady_motion_magnifies_little_and_an_unstable_one_is_told():
    scene = small({"duration": 2e-4})
    simulation = Simulation(scene, device="cpu")
    simulation.advance(2e-5)
    found = growth(scene, [simulation.cell_state()], simulation.first_node, "cpu", 1e-6)
    assert found is not None and 0.01 < found.factor < 20.0 and found.start == simulation.times[0]
    assert 1e-5 <= found.within <= FOLLOWED and not found.unstable
    assert growth_words(found) == "" == growth_words(None)
    assert "grows 4.2e+03 times in 0.05 ms from 0.3 ms on" in growth_words(Growth(4200.0, 3e-4, 5e-5))
    assert growth(scene, [simulation.cell_state()], simulation.first_node, "cpu", 1e-6, patience=0.0) is None


PRESSED = {
    "flagella.count": 2,
    "flagella.segment_length": 0.1,
    "flagella.phase_difference": None,
    "body.contact": False,
    "body.length": 2.585,
    "body.width": 1.066,
    "motor.torque": -2.639,
    "motor.axis_angle": 26.43,
    "fluid.viscosity": 4.37e-4,
    "flagella.bending_rigidity": 2.558,
    "flagella.twist_rigidity": 1.423,
    "flagella.opening_angle": 125.2,
    "flagellum.0.azimuth": 4.03,
    "flagellum.0.anchor_offset": 0.318,
    "flagellum.0.length": 5.767,
    "flagellum.0.torque": 0.385,
    "flagellum.1.azimuth": 182.75,
    "flagellum.1.anchor_offset": -0.305,
    "flagellum.1.length": 2.97,
    "flagellum.1.torque": -5.438,
    "flagellum.1.tilt": 44.2,
    "flagellum.1.phase": -24.74,
}
"""A flagellum is wound up by a motor that is too strong for it: it loops and falls over."""


def test_errors_of_steps_are_no_growth():
    """With steps under control the pair would differ by hundreds of times the disturbance, the errors of its steps."""
    scene = with_values(paper_scene("pressed"), {**PRESSED, "duration": 1.0e-4})
    simulation = Simulation(scene, device="cpu")
    simulation.advance(5e-5)
    found = growth(scene, [simulation.cell_state()], simulation.first_node, "cpu", 5e-8)
    assert found is not None and 0.1 < found.factor < 5.0


def parting(monkeypatch, scale):
    """Pairs of cells are as far apart as `scale` says, of the time; returns the scenes they were made of."""
    made = []

    class Parting:
        def __init__(self, scenes, device, starts, **_options):
            made.append(scenes)
            self.one, self.two = (np.concatenate(start.positions) for start in starts)

        def advance(self, until, watch):
            watch()
            self.scale = scale(until)

        def cells(self):
            return SimpleNamespace(positions=np.concatenate([self.one, self.one + self.scale * (self.two - self.one)]))

    monkeypatch.setattr("warpflag.run.growth.Simulation", Parting)
    return made


def still(time):
    nodes = np.zeros((22, 3))
    return SimpleNamespace(time=time, positions=nodes, directors=nodes, body_position=nodes[0], body_orientation=None)


def test_the_largest_growth_is_told_of_all_looks_and_starts(monkeypatch):
    """Pairs that part and meet again, farthest in the middle of `FOLLOWED`."""
    parting(monkeypatch, lambda until: 1.0 + 10.0 * np.sin(np.pi * until / FOLLOWED))
    found = growth(small(), [still(1e-4), still(2e-4)], np.array([0, 11, 22]), "cpu", 2e-7)
    largest = np.linalg.norm(np.random.default_rng(0).standard_normal((10, 3)), axis=1).max() / 3**0.5
    assert found is not None and not found.unstable
    assert found.within == pytest.approx(FOLLOWED / 2) and found.factor >= 11.0 * largest * (1 - 1e-9)
    assert found.start == 1e-4


def test_growth_at_a_known_rate_is_found(monkeypatch):
    """Two cells whose distance doubles ten times in `FOLLOWED`; looks are a tenth of it apart."""
    made = parting(monkeypatch, lambda until: 2.0 ** (10.0 * until / FOLLOWED))
    scene, state = small({"numerics.accuracy": 1e-3}), still(3e-4)
    found = growth(scene, [state], np.array([0, 11, 22]), "cpu", 2e-7)
    largest = np.linalg.norm(np.random.default_rng(0).standard_normal((10, 3)), axis=1).max() / 3**0.5
    assert found is not None and found.unstable and found.start == 3e-4
    assert found.factor > largest * 2.0 ** (10.0 * found.within / FOLLOWED) * (1 - 1e-9)
    assert found.within == pytest.approx(FOLLOWED * 0.6) or found.within == pytest.approx(FOLLOWED * 0.7)
    assert all(own.numerics.time_step == 2e-7 and own.numerics.accuracy is None for own in made[0])

    def stop():
        raise Ended("interrupted", "")

    assert growth(scene, [state], np.array([0, 11, 22]), "cpu", 2e-7, check=stop) is None


def test_a_run_is_followed_where_its_estimate_is_high(tmp_path, monkeypatch):
    asked = []

    def found(scene, states, first_node, device, step, patience, followed, check):
        assert 1e-9 < step < 1e-5
        asked.append((scene.name, [state.time for state in states], list(first_node), device))
        return Growth(5e3, 1e-5, 2e-5)

    monkeypatch.setattr(execute, "growth", found)
    for share, name in ((1e-9, "sound"), (1.0, "high")):
        started = run.start(small({"numerics.on_accuracy": "warn"}), str(tmp_path / name), "cpu")
        achieved = started.simulation.stepper.steps.achieved
        achieved.window_time.fill_(-1.0)  # no window of the run itself comes to an end
        achieved.worst.fill_(1e3 * share)
        message = started.execute(quiet=True).message
        assert ("unstable motion: a disturbance grows 5e+03 times" in message) == (name == "high")
        expected = {"factor": 5e3, "from": 1e-5, "within": 2e-5, "between": 1.0} if name == "high" else None
        assert summary(tmp_path / name)["growth"] == expected
    assert [(name, nodes, device) for name, _, nodes, device in asked] == [("small", [0, 11, 22], "cpu")]
    assert asked[0][1][-1] > 0.0 in asked[0][1]


def test_what_grows_after_the_disturbance_has_relaxed_is_lively(monkeypatch):
    """A distance that at first falls to a tenth, and then grows from look to look."""
    scales = {1: 1.0, 2: 0.4, 3: 0.1, 4: 0.1, 5: 0.2, 6: 0.4, 7: 0.8, 8: 0.75, 9: 0.7, 10: 0.6}
    parting(monkeypatch, lambda until: scales[round(10 * until / FOLLOWED_IN_CROWDS)])
    nodes, step = np.array([0, 11, 22]), 2e-7
    found = growth(small(), [still(1e-3)], nodes, "cpu", step, followed=FOLLOWED_IN_CROWDS)
    assert found is not None and not found.unstable and found.lively and found.between == pytest.approx(8.0)
    assert "lively motion: a disturbance grows 8 times in 0.175 ms from 1 ms on" in growth_words(found)
    # One that falls for good, or grows in the disturbance's own relaxation alone, is not.
    parting(monkeypatch, lambda until: 9.0 - until / FOLLOWED)
    relaxing = growth(small(), [still(1e-3)], nodes, "cpu", step)
    assert relaxing is not None and not relaxing.lively and growth_words(relaxing) == ""


@pytest.mark.parametrize(("count", "share", "expected"), [(3, 3.0, 0), (4, 3.0, 1), (4, 1.5, 0), (3, 6.0, 5)])
def test_a_crowd_is_followed_sooner_but_from_one_frame(count, share, expected, tmp_path, monkeypatch):
    asked = []

    def found(scene, states, first_node, device, step, patience, followed, check):
        asked.extend([followed] * len(list(states)))

    monkeypatch.setattr(execute, "growth", found)
    values = {"numerics.on_accuracy": "warn", "flagella.count": count, "duration": 4e-5, "frames": 4}
    started = run.start(small(values), str(tmp_path / "made"), "cpu", movies=False)
    achieved = started.simulation.stepper.steps.achieved
    achieved.window_time.fill_(-1.0)
    achieved.worst.fill_(share)
    achieved.worst_end.fill_(1.3e-4)
    started.execute(quiet=True)
    assert asked == [FOLLOWED_IN_CROWDS if expected == 1 else FOLLOWED] * expected


@pytest.mark.parametrize(("shortest", "expected"), [(59, False), (61, True)])
def test_a_run_whose_steps_are_as_short_as_they_may_be_is_followed_for_as_long_as_it_has_taken(
    shortest, expected, monkeypatch
):
    monkeypatch.setattr("warpflag.run.growth.time", SimpleNamespace(process_time=lambda: 7.0))
    kept = {"asked": 5e-3, "worst_window": 1e-3, "steps_at_shortest": shortest}
    found = wanted(kept, 1000, 2, stopped=False)
    assert (found is not None) == expected
    if found is not None:
        assert found.within == FOLLOWED and found.frames > 1 and found.patience == 7.0
    stopped = wanted(kept, 1000, 2, stopped=True)
    assert stopped is not None and stopped.patience == PATIENCE


@pytest.mark.parametrize(("precision", "size"), [("float64", 1e-6), ("float32", 1e-4)])
def test_the_disturbance_is_far_above_round_off(precision, size, monkeypatch):
    """Root mean square over the free nodes; nodes at anchors stay."""
    given = []

    class Looked:
        def __init__(self, scenes, device, starts, **_options):
            given.extend(starts)

        def advance(self, until, watch):
            raise Ended("late", "")

    monkeypatch.setattr("warpflag.run.growth.Simulation", Looked)
    growth(small({"numerics.precision": precision}), [still(0.0)], np.array([0, 11, 22]), "cpu", 2e-7)
    apart = np.array(given[1].positions) - np.array(given[0].positions)
    assert (apart[:, 0] == 0.0).all()
    assert np.sqrt((apart[:, 1:] ** 2).sum(axis=2).mean()) == pytest.approx(size, rel=0.3)


def test_members_of_a_batch_share_the_time_for_following(tmp_path, monkeypatch):
    clock, given = [0.0], []

    def found(scene, states, first_node, device, step, patience, followed, check):
        given.append(patience)
        clock[0] += 15.0

    monkeypatch.setattr(execute, "growth", found)
    monkeypatch.setattr(execute, "process_time", lambda: clock[0])
    scenes = [small({"numerics.on_accuracy": "warn", "duration": 4e-5, "frames": 4})] * 3
    started = run.start_batch(scenes, [tmp_path / name for name in "abc"], "cpu", movies=False)
    achieved = started.simulation.stepper.steps.achieved
    achieved.window_time.fill_(-1.0)
    achieved.worst.fill_(1e3)
    started.execute_all(quiet=True)
    assert given == [PATIENCE, PATIENCE - 15.0]


def test_a_cell_is_followed_with_its_motors_and_forms_as_they_stand(monkeypatch):
    given = []

    class Taken:
        def __init__(self, scenes, device, starts, **_options):
            given.extend(starts)

        def advance(self, until, watch):
            given.append(until)
            raise Ended("late", "")

    monkeypatch.setattr("warpflag.run.growth.Simulation", Taken)
    state = still(3e-3)
    state.forms = np.ones(22, np.int32)
    switching = small({"motor.switching": "schedule", "motor.switch_times": [1e-3]})
    growth(switching, [state], np.array([0, 11, 22]), "cpu", 2e-7)
    assert given[0].time == given[1].time == 3e-3 < given[2] and given[0].forms is given[1].forms is state.forms
    given.clear()
    growth(small(), [state], np.array([0, 11, 22]), "cpu", 2e-7)
    assert given[0].time == 0.0 < given[2] <= FOLLOWED
