"""The short form of the attack: a few attempts of each kind by the one command, and how attempts are judged."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from examples.reliability import attack, extremes, scenes
from examples.reliability.attempt import OUTCOMES, problem
from warpflag.scene import paper_scene, with_values

ROOT = Path(__file__).parent.parent.parent
COUNTS = {"kills": 3, "limits": 2, "damage": 5, "malformed": 30, "random": 2, "living": 1, "extremes": 3, "signals": 2}
SEED = 5


def test_the_attack_finds_nothing(tmp_path):
    """One command; the same command again has nothing left to try."""
    line = [
        sys.executable,
        str(ROOT / "examples/reliability/attack.py"),
        "-o",
        str(tmp_path),
        "--seed",
        str(SEED),
        "--cut-off",
        "3",
    ]
    line += ["--counts", *(f"{kind}={count}" for kind, count in COUNTS.items())]
    ended = subprocess.run(line, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    entries = [json.loads(entry) for entry in (tmp_path / f"attack-{SEED}.jsonl").read_text().splitlines()]
    assert len(entries) == sum(COUNTS.values()) == len({(e["kind"], e["number"]) for e in entries})
    assert {e["outcome"] for e in entries} <= set(OUTCOMES) - set(attack.BAD)
    assert "| kills | 3 | 3 |" in ended.stdout and "0 of 48 attempts" in ended.stdout
    again = subprocess.run(line, capture_output=True, text=True)
    assert again.stdout == ended.stdout and again.returncode == 0


@pytest.mark.parametrize(
    "status, said, words",
    [
        (0, "", ""),
        (2, "warpflag: one line\n", ""),
        (3, "  3 %  0.1 / 1 ms\nwarpflag: stopped\n", ""),
        (2, "", "status 2 with 0 lines"),
        (1, "warpflag: a\nwarpflag: b\n", "status 1 with 2 lines"),
        (1, "Traceback (most recent call last):\nKeyError: 3\n", "traceback: KeyError: 3"),
        (-11, "", "died of SIGSEGV"),
        (7, "", "status 7"),
    ],
)
def test_how_a_command_ends_is_judged(status, said, words):
    assert problem(subprocess.CompletedProcess([], status, "", said)).startswith(words)
    assert bool(problem(subprocess.CompletedProcess([], status, "", said))) == bool(words)


def test_every_row_and_form_of_the_extremes_is_tried_once():
    count = extremes.COUNT
    assert sorted(attack.scattered(k, count) for k in range(count)) == list(range(count))
    assert len(extremes.ROWS) >= 40 and len(extremes.FORMS) == 16
    left = list(attack.in_turn({"kills": 2, "random": 4}, {("random", 1)}))
    assert left == [("kills", 0), ("random", 0), ("kills", 1), ("random", 2), ("random", 3)]


def test_a_run_that_is_off_is_wrong(monkeypatch):
    """As if the finer run had ended elsewhere."""
    scene = with_values(paper_scene(name="short"), {"duration": 2e-5, "frames": 2, "flagella.length": 2.0})
    assert scenes.asked(scene, 1e-3) == 5e-3 and scenes.asked(scene, 1e-5) == pytest.approx(5e-4)
    assert scenes.against_finer(scene).outcome == "right"
    looks = scenes.looks

    def elsewhere(of, start, cut_off):
        seen, seconds, end, sim = looks(of, start, cut_off)
        if of.numerics.accuracy:
            for state in seen:
                state.positions[3] += np.array([0.0, 0.0, 0.01])
        return seen, seconds, end, sim

    monkeypatch.setattr(scenes, "looks", elsewhere)
    assert scenes.against_finer(scene).outcome == "wrong"
