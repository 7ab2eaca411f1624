"""Picture files hold the pixels, films play at their pace, and what a format needs is told."""

from __future__ import annotations

import shutil
import sys

import numpy as np
import pytest

from tests.view.pictures import pixels_of
from warpflag import cli
from warpflag.base.output import OutputError
from warpflag.view.images import check_writable, write_animation, write_picture
from warpflag.view.render import Renderer, render
from warpflag.view.usd.read import Film


def some_picture() -> np.ndarray:
    smooth = np.add.outer(np.arange(40), np.arange(30))[..., None] * [1, 2, 3] % 256
    noise = np.random.default_rng(1).integers(0, 256, (20, 30, 3))
    return np.concatenate([smooth, noise, np.repeat(noise[:1], 9, axis=0)]).astype(np.uint8)


def test_png_holds_the_pixels_with_pillow_and_without(tmp_path, monkeypatch):
    write_picture(tmp_path / "one.png", some_picture())
    with monkeypatch.context() as patched:
        patched.setitem(sys.modules, "PIL", None)
        write_picture(tmp_path / "two.png", some_picture())
        with pytest.raises(OutputError, match="--extra render"):
            write_picture(tmp_path / "three.jpg", some_picture())
    for name in ("one.png", "two.png"):
        np.testing.assert_array_equal(pixels_of(tmp_path / name), some_picture())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.png", "two.png"]


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg"])
def test_jpeg_is_close_to_the_picture(run, tmp_path, suffix):
    render(run, tmp_path / f"last{suffix}", size=(160, 90))
    expected = Renderer(Film(run / "movie.usdc"), (160, 90)).picture(11).astype(int)
    assert np.abs(pixels_of(tmp_path / f"last{suffix}") - expected).mean() < 4


@pytest.mark.parametrize("rate, delays", [(50.0, [20]), (25.0, [40]), (30.0, [30, 40, 30]), (12.0, [80, 90, 80])])
def test_a_gif_s_delays_are_hundredths_that_keep_its_length(tmp_path, rate, delays):
    image = pytest.importorskip("PIL.Image")
    pictures = [np.full((8, 8, 3), 20 * k, np.uint8) for k in range(12)]
    write_animation(tmp_path / "film.gif", iter(pictures), 12, rate)
    found = []
    with image.open(tmp_path / "film.gif") as film:
        for frame in range(film.n_frames):
            film.seek(frame)
            found.append(film.info["duration"])
    assert sorted(set(found)) == sorted(set(delays))
    assert sum(found) == pytest.approx(1e3 * 12 / rate, abs=5.0)


def test_a_gif_of_more_than_fifty_pictures_a_second_is_refused(run, tmp_path):
    with pytest.raises(OutputError, match="at most 50"):
        render(run, tmp_path / "film.gif", frames_per_second=60.0)
    assert list(tmp_path.iterdir()) == []


def test_the_length_of_a_film_is_told_before_it_is_drawn(run, tmp_path, capsys):
    pytest.importorskip("PIL")
    render(run, tmp_path / "film.gif", size=(64, 36), frames_per_second=25.0, quiet=False)
    assert "6 pictures of 64x36, a film of 0.2 s" in capsys.readouterr().err.splitlines()[0]


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_films_play_at_the_movie_s_pace(run, tmp_path, suffix):
    image = pytest.importorskip("PIL.Image")
    render(run, tmp_path / f"film{suffix}", size=(96, 54), frames_per_second=25.0)
    with image.open(tmp_path / f"film{suffix}") as film:
        assert film.size == (96, 54) and film.info["loop"] == 0
        assert film.n_frames == 6  # 0.22 s: time codes 0, 2, ... 10
        durations = []
        for frame in range(6):
            film.seek(frame)
            film.load()
            durations.append(film.info["duration"])
            shown = np.array(film.convert("RGB")).astype(float)
            expected = Renderer(Film(run / "movie.usdc"), (96, 54)).picture(2 * frame)
            assert np.abs(shown - expected).mean() < 6
        assert durations == [40] * 6


def test_a_film_needs_its_program_and_says_so(run, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    for package in ("PIL", "imageio_ffmpeg"):
        monkeypatch.setitem(sys.modules, package, None)
    for suffix in (".mp4", ".webp", ".gif"):
        with pytest.raises(OutputError, match="--extra render"):
            render(run, tmp_path / f"film{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_mp4_by_ffmpeg(run, tmp_path):
    try:
        check_writable(tmp_path / "film.mp4")
    except OutputError:
        pytest.skip("no ffmpeg here")
    render(run, tmp_path / "film.mp4", size=(97, 55))
    data = (tmp_path / "film.mp4").read_bytes()
    assert data[4:8] == b"ftyp" and len(data) > 1000


def test_a_film_s_pace_is_the_movie_s_whatever_its_pictures_per_second(run, tmp_path):
    image = pytest.importorskip("PIL.Image")
    for slow_down, seconds in ((None, 0.22), ("800", 0.44)):
        slower = ["--slow-down", slow_down] if slow_down else ["--follow"]
        options = ["--size", "64x36", "--fps", "25", "--quiet", *slower]
        assert cli.main(["render", str(run), "-o", str(tmp_path / "film.gif"), *options]) == 0
        with image.open(tmp_path / "film.gif") as film:
            assert 0.04 * film.n_frames == pytest.approx(seconds, abs=0.04)
