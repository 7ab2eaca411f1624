"""Movie files: value clips, packed and text files, and what is refused or interrupted."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom  # noqa: TID253 (no command line starts here)

from tests.films import FIRST_NODE, THREE, made_record
from tests.view.usd.stages import at, faults
from warpflag.base.output import OutputError
from warpflag.record import RecordError
from warpflag.record.recorder import Recorder
from warpflag.scene import dumps
from warpflag.view.usd import Shot, movie_stage, write_movie
from warpflag.view.usd.check import problems
from warpflag.view.usd.read import Film


def test_value_clips_play_as_one_file_does(tmp_path):
    record = made_record(tmp_path / "run", 12)
    path, shot = tmp_path / "movie.usdc", Shot(color_by="curvature", clip_frames=5)
    whole = movie_stage(record, shot)
    for _ in range(2):  # the second time over the first one's files
        write_movie(record, path, shot)
    clips = sorted(tmp_path.glob("movie.usdc.clips/*.usdc"))
    assert len(clips) == 4 and "manifest" in clips[-1].name  # 5 + 5 + 2 frames
    samples = [Sdf.Layer.FindOrOpen(str(clip)).ListAllTimeSamples() for clip in clips]
    assert samples == [[*range(6)], [*range(5, 11)], [10, 11], []]  # with the first of the next one
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


DAMAGE = """
import resource
import sys
from pathlib import Path
from examples.reliability.damage import damaged
from warpflag.base.output import OutputError
from warpflag.view.usd.check import problems_of
from warpflag.view.usd.read import Film

resource.setrlimit(resource.RLIMIT_AS, (4 * 2**30,) * 2)
sound = Path(sys.argv[1])
for seed in range(100):
    path = sound.with_name(f"{seed}.usdc")  # USD keeps files by their names
    path.write_bytes(damaged(sound.read_bytes(), seed)[1])
    try:
        film = Film(path)
        film.code_at(1e-4), film.thinnest(), film.camera(film.end), film.light(film.end), film.rods(film.end)
    except OutputError as error:
        assert "\\n" not in str(error) and len(str(error)) < 400, str(error)
        print("refused", end=" ")
        if "is damaged" in str(error):
            print("late", end=" ")
            try:
                problems_of(str(path))
            except OutputError:
                pass
    path.unlink()
"""


def test_a_damaged_movie_is_drawn_or_refused_in_a_line(tmp_path):
    """One that another program has written anew, without a checksum; in a process of its own, which USD may crash."""
    write_movie(made_record(tmp_path / "run", 6), tmp_path / "movie.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "movie.usdc"))
    stage.GetRootLayer().Export(str(tmp_path / "other.usdc"))
    root = str(Path(__file__).parents[3])
    command = [sys.executable, "-c", DAMAGE, str(tmp_path / "other.usdc")]
    ended = subprocess.run(
        command, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": ":".join(sys.path)}, cwd=root
    )
    assert ended.returncode == 0, ended.stderr[-1000:]
    assert ended.stdout.count("refused") > 20 and "late" in ended.stdout


@pytest.mark.parametrize(("start", "end"), [(0, 1e12), (0, np.inf), (-1e12, 2), (2, 1)])
def test_time_codes_without_frames_are_refused(tmp_path, start, end):
    write_movie(made_record(tmp_path / "run", 3), tmp_path / "movie.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "movie.usdc"))
    stage.SetStartTimeCode(start)
    stage.SetEndTimeCode(end)
    stage.GetRootLayer().Export(str(tmp_path / "other.usdc"))
    with pytest.raises(OutputError, match=r"other\.usdc: its time codes, .* are not those of its frames"):
        Film(tmp_path / "other.usdc")


@pytest.mark.parametrize(("name", "clip_frames"), [("movie.usdc", None), ("movie.usdz", None), ("clips.usdc", 3)])
def test_changed_bits_of_a_movie_are_found(tmp_path, name, clip_frames):
    """Of numbers that USD would draw another picture from; as it was, and written anew by USD, the movie is read."""
    folder = tmp_path / "movie"
    folder.mkdir()
    write_movie(made_record(tmp_path / "run", 6), folder / name, Shot(clip_frames=clip_frames))
    parts = [folder / name, *sorted(folder.glob("*.clips/*.usdc"))]
    assert len(parts) == (4 if clip_frames else 1)
    for k, part in enumerate(parts):
        sound = part.read_bytes()
        for place in range(len(sound) // 8, len(sound) - 40, len(sound) // 8):
            copy = shutil.copytree(folder, tmp_path / f"{k}-{place}")  # USD keeps files that it has read open
            damaged = copy / part.relative_to(folder)
            damaged.write_bytes(sound[:place] + bytes([sound[place] ^ 4]) + sound[place + 1 :])
            with pytest.raises(OutputError, match=rf"{part.name}: is damaged: it does not agree with its checksum"):
                Film(copy / name)
    assert len(Film(folder / name).rods(5.0).start) > 80
    stage = Usd.Stage.Open(str(folder / name))
    stage.Export(str(tmp_path / "anew.usdc"))
    assert len(Film(tmp_path / "anew.usdc").rods(5.0).start) > 80
