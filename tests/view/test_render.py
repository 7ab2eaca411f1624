"""Pictures show what is there: rods where the camera has them, in their colours, lit, with scale and time."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom  # noqa: TID253 (no command line starts here)

from tests.films import FIRST_NODE
from tests.view.pictures import ink, pixels_of
from warpflag import cli
from warpflag.base.output import OutputError
from warpflag.record import RecordError
from warpflag.view.render import Renderer, render
from warpflag.view.usd import Shot
from warpflag.view.usd.read import Film


def test_flagella_are_where_the_movie_s_camera_has_them_in_their_colours(run):
    film = Film(run / "movie.usdc")
    picture = Renderer(film, (640, 360)).picture(5.0)
    stage = Usd.Stage.Open(str(run / "movie.usdc"))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera(5)
    frustum = camera.frustum
    window = frustum.window  # widened to 16:9 as the picture is
    aspect = (window.max[0] - window.min[0]) / (window.max[1] - window.min[1])
    project = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    widen = np.array([min(1.0, aspect / (16 / 9)), min(1.0, (16 / 9) / aspect)])
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/Cell/Flagella"))
    colors = np.array(curves.GetDisplayColorAttr().Get(5))
    hits = total = 0
    for node, point in enumerate(curves.GetPointsAttr().Get(5)):
        x, y, _ = project.Transform(Gf.Vec3d(point))
        u, v = np.array([x, -y]) * widen
        pixel = picture[int((v + 1) / 2 * 360), int((u + 1) / 2 * 640)].astype(float)
        shades = np.stack([colors[first] for first in FIRST_NODE[:3]])
        hue = (pixel - pixel.min()) / max(np.ptp(pixel), 1.0)
        hues = (shades - shades.min(axis=1, keepdims=True)) / np.ptp(shades, axis=1, keepdims=True)
        if np.ptp(pixel) > 40:
            total += 1
            hits += np.abs(hues - hue).sum(axis=1).argmin() == np.searchsorted(FIRST_NODE, node, side="right") - 1
    assert total > 50  # nodes that nothing hides
    assert hits > 0.9 * total


def test_no_picture_is_empty_and_the_cell_moves(run):
    film = Film(run / "movie.usdc")
    pictures = [Renderer(film, (320, 180)).picture(code).astype(float) for code in (0, 4.5, 11)]
    for picture in pictures:
        vivid = np.ptp(picture, axis=2) > 50
        assert 0.003 < vivid.mean() < 0.2  # flagella
        assert ((picture[..., 0] - picture[..., 2]) > 20).mean() > 0.01  # the body is warm
    left = [np.nonzero((p[..., 0] - p[..., 2] > 20).any(axis=0))[0].min() for p in pictures]
    assert left[0] > left[1] > left[2]  # it swims to the left


def test_flagella_can_be_seen_at_thumbnail_size(run):
    film = Film(run / "movie.usdc")
    picture = Renderer(film, (128, 72)).picture(0).astype(float)
    assert (np.ptp(picture, axis=2) > 60).mean() > 0.01
    # And thinner ones are drawn as thin as asked for, where the picture is fine enough.
    shares = [
        (np.ptp(Renderer(film, (640, 360), radius).picture(0).astype(float), axis=2) > 50).mean()
        for radius in (0.05, 0.1)
    ]
    assert 1.5 < shares[1] / shares[0] < 2.5


def test_a_directory_is_drawn_by_its_movie_or_filmed_anew(run, tmp_path):
    render(run, tmp_path / "last.png", size=(160, 90))
    expected = Renderer(Film(run / "movie.usdc"), (160, 90)).picture(11)
    np.testing.assert_array_equal(pixels_of(tmp_path / "last.png"), expected)
    render(run / "movie.usdc", tmp_path / "same.png", size=(160, 90))
    assert (tmp_path / "same.png").read_bytes() == (tmp_path / "last.png").read_bytes()
    render(run, tmp_path / "early.png", size=(160, 90), times=[2.25e-4])
    np.testing.assert_array_equal(
        pixels_of(tmp_path / "early.png"), Renderer(Film(run / "movie.usdc"), (160, 90)).picture(4.5)
    )
    shutil.copy(run / "run.h5", tmp_path)
    render(tmp_path, tmp_path / "unfilmed.png", size=(160, 90))
    assert (tmp_path / "unfilmed.png").read_bytes() == (tmp_path / "last.png").read_bytes()
    render(run, tmp_path / "curved.png", size=(160, 90), shot=Shot(color_by="curvature", follow=True))
    assert (tmp_path / "curved.png").read_bytes() != (tmp_path / "last.png").read_bytes()


@pytest.mark.parametrize("count, size", [(6, (320, 180)), (2, (320, 80)), (5, (100, 300))])
def test_a_sheet_has_every_snapshot(run, tmp_path, count, size):
    render(run, tmp_path / "sheet.png", size=size, snapshots=count)
    sheet = pixels_of(tmp_path / "sheet.png").astype(float)
    assert sheet.shape == (size[1], size[0], 3)
    columns = {6: 3, 2: 2, 5: 1}[count]
    rows = -(-count // columns)
    times, barred = set(), []
    for i in range(count):
        row, column = divmod(i, columns)
        panel = sheet[row * size[1] // rows :, column * size[0] // columns :][: size[1] // rows, : size[0] // columns]
        assert (np.ptp(panel, axis=2) > 50).sum() > 20, i
        dark = ink(panel.astype(np.uint8))
        times.add(dark[:30, :60].tobytes())
        barred.append(bool((dark[-20:, -40:].sum(axis=1) > 5).any()))
    assert len(times) == count
    assert barred == [False] * (count - 1) + [True]  # all have one scale


@pytest.mark.parametrize(("rate", "count"), [(None, 12), (100.0, 23), (25.0, 6)])
def test_a_film_has_pictures_from_the_first_frame_to_the_last(rate, count, run, tmp_path):
    """At the movie's own 50 a second one of each of its twelve frames, at other rates those in between, or fewer."""
    image = pytest.importorskip("PIL.Image")
    render(run, tmp_path / "film.webp", size=(64, 36), frames_per_second=rate)
    with image.open(tmp_path / "film.webp") as film:
        assert film.n_frames == count
        film.seek(count - 1)
        last = np.array(film.convert("RGB")).astype(float)
    if count != 6:  # eleven intervals have no half
        render(run, tmp_path / "last.png", size=(64, 36))
        assert np.abs(last - pixels_of(tmp_path / "last.png")).mean() < 6.0


def test_bad_input_is_one_line_and_leaves_nothing(run, tmp_path):
    (tmp_path / "junk.usdc").write_text("junk")
    Usd.Stage.CreateNew(str(tmp_path / "bare.usda")).Save()
    wrong = [
        (run, "p.bmp", {}, "must end in"),
        (run, "p.png", {"size": (5, 5)}, "5x5"),
        (run, "p.png", {"radius": -1.0}, "radius"),
        (run, "p.gif", {"frames_per_second": 0.0}, "frames per second"),
        (run, "p.gif", {"snapshots": 3}, "for pictures"),
        (run, "p.png", {"snapshots": 0}, "snapshots 0"),
        *((run, "p.png", {"times": [1e-4, t]}, "the movie has 0 to 0.55 ms") for t in (math.nan, math.inf, -1e-6, 1e6)),
        (run, "p.png", {"times": [0.1]}, "times 100: the movie has 0 to 0.55 ms"),
        (run, "p.png", {"snapshots": 900, "size": (64, 64)}, "do not fit"),
        (run / "movie.usdc", "p.png", {"shot": Shot()}, "movie.usdc"),
        (tmp_path / "junk.usdc", "p.png", {}, "junk.usdc"),
        (tmp_path / "bare.usda", "p.png", {}, "no movie of warpflag"),
    ]
    for source, name, options, words in wrong:
        with pytest.raises(OutputError) as raised:
            render(source, tmp_path / name, **options)
        assert words in str(raised.value) and "\n" not in str(raised.value)
    with pytest.raises(RecordError, match="no such record"):
        render(tmp_path / "nowhere", tmp_path / "p.png")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bare.usda", "junk.usdc"]


def test_the_command_draws(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ["--size", "160x90"]
    assert cli.main(["render", str(run), "-o", "last.png", *small]) == 0
    assert capsys.readouterr().out == "last.png\n"
    render(run, "expected.png", size=(160, 90))
    assert Path("last.png").read_bytes() == Path("expected.png").read_bytes()
    options = ["--times", "0.1", "0.4", "--color", "curvature", "--follow", "--radius", "0.08", "--quiet", *small]
    assert cli.main(["render", str(run), "-o", "two.png", *options]) == 0
    render(
        run,
        "expected.png",
        size=(160, 90),
        times=[1e-4, 4e-4],
        shot=Shot(color_by="curvature", follow=True),
        radius=0.08,
    )
    assert Path("two.png").read_bytes() == Path("expected.png").read_bytes()
    assert capsys.readouterr() == ("", "")
    assert cli.main(["render", str(run), "-o", "sheet.png", "--snapshots", "3", "--quiet", *small]) == 0
    render(run, "expected.png", size=(160, 90), snapshots=3)
    assert Path("sheet.png").read_bytes() == Path("expected.png").read_bytes()
    film = ["--fps", "10", "--slow-down", "4000", "--quiet", "--size", "64x36"]
    assert cli.main(["render", str(run), "-o", "film.gif", *film]) == 0
    render(run, "expected.gif", size=(64, 36), frames_per_second=10.0, shot=Shot(slow_down=4000.0))
    assert Path("film.gif").read_bytes() == Path("expected.gif").read_bytes()
    for wrong, word in (
        (["-o", "p.tiff"], ".png"),
        (["-o", "p.png", "--device", "tpu"], "tpu"),
        (["-o", "p.png", "--color", "mood"], "curvature"),
        (["-o", "p.png", "--slow-down", "0"], "slow down"),
        (["-o", "p.png", "--times", "nan"], "times nan"),
    ):
        assert cli.main(["render", str(run), *wrong]) == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.count("\n") == 1 and word in said.err
