"""Movie files: value clips, packed and text files, and what is refused or interrupted."""

from __future__ import annotations

import os

import numpy as np
import pytest
from pxr import Usd, UsdGeom  # noqa: TID253 (no command line starts here)

from tests.films import FIRST_NODE, THREE, made_record
from tests.view.usd.stages import at, faults
from warpflag.base.output import OutputError
from warpflag.record import RecordError
from warpflag.record.recorder import Recorder
from warpflag.scene import dumps
from warpflag.view.usd import Shot, movie_stage, write_movie
from warpflag.view.usd.check import problems


def test_value_clips_play_as_one_file_does(tmp_path):
    record = made_record(tmp_path / "run", 12)
    path, shot = tmp_path / "movie.usdc", Shot(color_by="curvature", clip_frames=5)
    whole = movie_stage(record, shot)
    for _ in range(2):  # the second time over the first one's files
        write_movie(record, path, shot)
    clips = sorted(tmp_path.glob("movie.usdc.clips/*.usdc"))
    assert len(clips) == 4 and "manifest" in clips[-1].name  # 5 + 5 + 2 frames
    stage = Usd.Stage.Open(str(path))
    assert problems(stage) == []
    for prim in whole.Traverse():
        for attribute in prim.GetAttributes():
            other = stage.GetAttributeAtPath(attribute.GetPath())
            for code in (0, 4, 4.5, 5, 8.25, 9.5, 11):
                expected = attribute.Get(code)
                assert expected == other.Get(code), (attribute.GetPath(), code)
    clips[1].rename(tmp_path / "taken.usdc")
    assert any(clips[1].name in line for line in problems(Usd.Stage.Open(str(path))))
    # Written whole again, nothing is left of them.
    write_movie(record, path)
    assert not (tmp_path / "movie.usdc.clips").exists()


def test_packed_and_text_files(tmp_path):
    record = made_record(tmp_path / "run", 3)
    for name in ("movie.usdz", "movie.usda"):
        write_movie(record, tmp_path / name)
        stage = Usd.Stage.Open(str(tmp_path / name))
        assert faults(stage) == []
        points = UsdGeom.BasisCurves(at(stage, "/World/Cell/Flagella")).GetPointsAttr().Get(2)
        np.testing.assert_array_equal(points, record.positions[2].astype(np.float32))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["movie.usda", "movie.usdz", "run"]


def test_what_can_t_be_filmed_is_told(tmp_path):
    record = made_record(tmp_path, 2)
    with pytest.raises(OutputError, match=r"must end in \.usdc"):
        write_movie(record, tmp_path / "movie.mp4")
    for wrong in ({"color_by": "mood"}, {"slow_down": 0.0}, {"frames_per_second": np.inf}, {"clip_frames": -1}):
        with pytest.raises(OutputError):
            Shot(**wrong)
    empty = Recorder(tmp_path / "run.h5", resume_step=-1)
    empty.start(dumps(THREE), FIRST_NODE, filament_radius=0.01, body_length=2.5, body_width=0.8)
    empty.close()
    with pytest.raises(RecordError, match="no frames"):
        write_movie(record, tmp_path / "movie.usdc")
    assert os.listdir(tmp_path) == ["run.h5"]


def test_a_movie_that_could_not_be_finished_leaves_the_old_one(tmp_path, monkeypatch):
    record = made_record(tmp_path, 2)
    path = tmp_path / "movie.usdc"
    write_movie(record, path)
    before = path.read_bytes()

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_movie(record, path)
    assert path.read_bytes() == before
