"""Whether a motion magnifies disturbances, and where a run says so."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from tests.runs import small, summary
from warpflag.run import execute, run
from warpflag.run.growth import States, growth, growth_words
from warpflag.run.simulation import Simulation


def test_states_are_spread_over_a_run():
    for count, expected in ((1, [0]), (2, [0, 1]), (9, [0, 4, 8]), (40, [0, 16, 32])):
        states = States()
        for k in range(count):
            state: Any = SimpleNamespace(time=float(k))
            states.add(state)
        chosen = [state.time for state in states.chosen()]
        assert chosen[0] == 0.0 and chosen[-1] <= count - 1
        assert chosen == pytest.approx(expected, abs=max(1, count // 5)), count
    assert States().chosen() == []


def test_a_steady_motion_magnifies_little_and_an_unstable_one_is_told():
    scene = small({"duration": 2e-4})
    simulation = Simulation(scene, device="cpu")
    simulation.advance(2e-5)
    factor, time = growth(scene, [simulation.cell_state()], simulation.first_node, "cpu")
    assert 0.01 < factor < 20.0 and time == simulation.times[0]
    assert growth_words((factor, time)) == "" == growth_words(None)
    assert "grows 4.2e+03 times in 0.1 ms from 0.3 ms on" in growth_words((4200.0, 3e-4))


def test_a_run_is_followed_where_its_estimate_is_high(tmp_path, monkeypatch):
    asked = []

    def found(scene, states, first_node, device):
        asked.append((scene.name, len(states), list(first_node), device))
        return 5e3, 1e-5

    monkeypatch.setattr(execute, "growth", found)
    for share, name in ((1e-9, "sound"), (1.0, "high")):
        started = run.start(small({"numerics.on_accuracy": "warn"}), str(tmp_path / name), "cpu")
        achieved = started.simulation.stepper.steps.achieved
        achieved.total.fill_(share)  # [s], of some ten microseconds
        message = started.execute(quiet=True).message
        assert ("unstable motion: a disturbance grows 5e+03 times" in message) == (name == "high")
        expected = {"factor": 5e3, "from": 1e-5} if name == "high" else None
        assert summary(tmp_path / name)["growth"] == expected
    assert [(name, nodes, device) for name, _, nodes, device in asked] == [("small", [0, 11, 22], "cpu")]
    assert asked[0][1] >= 1
