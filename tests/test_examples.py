"""Every shipped example runs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from warpflag.record import Record
from warpflag.run import run, sweep
from warpflag.scene import load, with_values

EXAMPLES = Path(__file__).parent.parent / "examples"
SCENES = sorted(EXAMPLES.glob("*.toml"))
SWEEPS = sorted([*EXAMPLES.glob("sweeps/*.toml"), *EXAMPLES.glob("behaviour/*.toml")])


def few_steps(path: Path, directory: Path) -> Path:
    """The run directory of an example's first four steps."""
    scene = with_values(load(path), {"duration": 4e-5, "frames": 2})
    outcome = run.start(scene, str(directory / path.stem), "cpu").execute(quiet=True)
    assert outcome.status == "done", outcome.message
    return directory / path.stem


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_scene_runs(path, tmp_path):
    directory = few_steps(path, tmp_path)
    flagella = load(path).resolved_flagella()
    with Record(directory) as record:
        assert record.frame_count == 3
        assert record.positions.shape[1] == sum(spec.segment_count + 1 for spec in flagella)
        assert np.isfinite(record.positions[:]).all()
        # Motors turn the way that their torque points, whatever the cell.
        assert (record.motor_angle[-1] * [spec.torque for spec in flagella] > 0).all()
        moved = np.linalg.norm(record.body_position[-1] - record.body_position[0])
        assert (moved == 0) == load(path).body.anchored


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_sweep_runs(path, tmp_path):
    """Its first and last members, for a moment."""
    plan = sweep.read(path, ["duration=2e-5", "frames=2"])
    members = plan.members()
    assert len(members) >= 8
    for member in (members[0], members[-1]):
        outcome = run.start(member.scene, str(tmp_path / member.scene.name), "cpu", movies=False).execute(quiet=True)
        assert outcome.status == "done", outcome.message


def script(name: str, *arguments: str, cwd: Path) -> str:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    root = EXAMPLES.parent
    paths = os.pathsep.join([str(root), str(root / "kernels")])
    return subprocess.run(
        command, cwd=cwd, check=True, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": paths}
    ).stdout


def test_swim_reads_what_it_recorded(tmp_path):
    said = script("swim.py", "4e-5", cwd=tmp_path)
    with Record(tmp_path / "run.h5") as record:
        assert record.frame_count == 41
        assert f"phase difference {record.observables['phase_difference'][0]:.3f}" in said
    with pytest.raises(subprocess.CalledProcessError) as refused:
        script("swim.py", "4e-5", cwd=tmp_path)
    assert "run.h5: exists already" in refused.value.stderr and "Traceback" not in refused.value.stderr
