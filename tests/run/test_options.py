"""Options of commands that start long work reach it."""

from __future__ import annotations

import time

import pytest

from tests.runs import small
from warpflag import cli
from warpflag.run.member import Outcome
from warpflag.run.stop import Ended
from warpflag.run.sweep.sweep import SweepRun
from warpflag.run.tradeoff import Study
from warpflag.scene import dumps


@pytest.fixture
def scene(tmp_path, monkeypatch) -> str:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "small.toml").write_text(dumps(small({"flagella.length": 1.0})))
    return "small.toml"


def test_limits_of_a_sweep(scene, monkeypatch):
    found = {}

    def execute(self, workers, device, quiet, stop, **options):
        found.update(options, workers=workers, device=device, quiet=quiet)
        time.sleep(0.01)
        with pytest.raises(Ended, match="wall time"):
            stop.check()
        return Outcome("done", "")

    monkeypatch.setattr(SweepRun, "execute", execute)
    said = ["--workers", "3", "--device", "cpu", "--movies", "--share", "1/4", "--quiet"]
    limits = ["--checkpoint-interval", "70", "--max-wall", "0.001"]
    assert cli.main(["sweep", scene, "--grid", "motor.torque=1,2", *said, *limits]) == 0
    found.pop("starter")
    expected = {"workers": 3, "device": "cpu", "movies": True, "share": (1, 4), "quiet": True, "checkpoint_seconds": 70}
    assert found == expected


def test_budget_of_a_trade_off(scene, monkeypatch, capsys):
    found = []
    monkeypatch.setattr(Study, "execute", lambda self, budget, quiet, check: found.append((budget, quiet)) or "told")
    assert cli.main(["tradeoff", scene, "--budget", "7", "--quiet"]) == 0
    assert found == [(7.0, True)] and capsys.readouterr().out == "told\n"
