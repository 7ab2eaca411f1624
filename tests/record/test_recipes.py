"""The recipes of docs/howto/lab.md: their scenes, and the scripts that need no long run."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from tests.runs import executed, small
from warpflag.scene import loads

PAGE = (Path(__file__).parents[2] / "docs" / "howto" / "lab.md").read_text(encoding="utf-8")
SCENES = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
RELATIVE = 1e-5  # of a speed from rounded differences of frames against that of the record


def script(word: str) -> str:
    (found,) = [block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if word in block]
    return found


@pytest.mark.parametrize("toml", SCENES, ids=[re.findall('name = "(.*)"', toml)[0] for toml in SCENES])
def test_scenes_can_be_simulated(toml):
    assert loads(toml).format == 1


def test_the_fit_of_a_motor_curve_prints_what_the_page_shows(capsys):
    exec(script("def fitted"), {})
    assert f"```\n{capsys.readouterr().out}```" in PAGE


def test_the_record_is_read_without_this_package(tmp_path, monkeypatch):
    executed(small({"duration": 2e-4, "frames": 40}), tmp_path / "runs" / "two")
    monkeypatch.chdir(tmp_path)
    found: dict = {}
    exec(script("import h5py"), found)
    assert found["tips"].shape == (41, 2, 3) and found["unit"] == "um s-1"
    np.testing.assert_allclose(found["ahead"], found["speed"][1:], rtol=RELATIVE)
