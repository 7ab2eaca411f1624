"""What is written on pictures: scale bar, time and legend say what is so."""

from __future__ import annotations

import sys
from importlib.resources import files

import numpy as np
import pytest

from tests.films import made_record
from tests.view.pictures import ink
from warpflag import cli
from warpflag.view import notes
from warpflag.view.coloring import FORM_COLORS
from warpflag.view.notes import Pen
from warpflag.view.render import Renderer
from warpflag.view.usd import Shot, movie_stage
from warpflag.view.usd.read import Film

pytest.importorskip("PIL")

LETTER = 0.024 * 540


def written(text: str, size: float) -> np.ndarray:
    """Where a line of text has ink, by itself, cut to its bounds."""
    from PIL import Image, ImageDraw, ImageFont

    image = Image.new("RGB", (400, 60), (245, 245, 245))
    font = ImageFont.truetype(str(files("warpflag.view") / "font" / "DejaVuSans-subset.ttf"), size)
    ImageDraw.Draw(image).text((10, 40), text, (38, 50, 63), font, "ls")
    return cut(ink(np.array(image)))


def cut(found: np.ndarray) -> np.ndarray:
    rows, columns = found.any(axis=1).nonzero()[0], found.any(axis=0).nonzero()[0]
    return found[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]


def likeness(found: np.ndarray, text: str, size: float) -> float:
    """Share of the pixels on which a text and what was found agree, both laid on their upper left corners."""
    one, two = cut(found), written(text, size)
    shape = np.maximum(one.shape, two.shape)
    one, two = (np.pad(a, [(0, n - m) for n, m in zip(shape, a.shape, strict=True)]) for a in (one, two))
    return (one & two).sum() / (one | two).sum()


@pytest.mark.parametrize("pixel, length", [(0.0081, 1.0), (0.0167, 2.0), (0.04, 5.0), (0.0004, 0.05), (1.0, 100.0)])
def test_scale_bar_is_as_long_as_it_says(pixel, length):
    pen = Pen(np.full((540, 960, 3), 245, np.uint8), LETTER)
    assert pen.draw_scale(pixel) == pytest.approx(length)
    found = ink(pen.picture)
    row = found.sum(axis=1).argmax()
    assert found[row].sum() == pytest.approx(length / pixel, abs=1.5)
    texts = [f"{value:g} µm" for value in (0.05, 1, 2, 5, 100)]
    alike = [likeness(found[: row - 8], text, LETTER / 0.73) for text in texts]
    assert texts[int(np.argmax(alike))] == f"{length:g} µm" and max(alike) > 0.4


def test_a_picture_s_scale_is_that_of_the_middle_of_the_scene(run):
    film = Film(run / "movie.usdc")
    camera = film.camera(0)
    pixel = 2 * camera.focus * max(camera.tangents[0], camera.tangents[1] * 16 / 9) / 960
    found = ink(Renderer(film, (960, 540)).picture(0))[450:, 600:]
    length = found.sum(axis=1).max() * pixel
    assert length == pytest.approx(min((0.5, 1, 2, 5), key=lambda one: abs(np.log(one / length))), rel=0.02)


def test_the_time_is_in_the_picture(run):
    renderer = Renderer(Film(run / "movie.usdc"), (960, 540))
    texts = {0: "0.00 ms", 7: "0.35 ms", 11: "0.55 ms"}
    for code, text in texts.items():
        corner = ink(renderer.picture(code))[:60, :200]
        alike = {other: likeness(corner, other, 1.2 * LETTER / 0.73) for other in texts.values()}
        assert max(alike, key=alike.__getitem__) == text and alike[text] > 0.6


def test_the_legend_of_forms_has_each_name_beside_its_colour():
    """A long name, told by how far its row reaches, in turn at every colour."""
    for long in range(3):
        pen = Pen(np.full((540, 960, 3), 245, np.uint8), LETTER)
        pen.write_legend(1.0, "form", 2.0, ["a form of a long name" if k == long else "i" for k in range(3)])
        reach = []
        for color in FORM_COLORS:
            rgb = np.frombuffer(bytes.fromhex(color[1:]), dtype=np.uint8)
            rows = (pen.picture == rgb).all(axis=2).any(axis=1)
            assert rows.any()
            reach.append((pen.picture[rows] != 245).any(axis=(0, 2)).nonzero()[0].max())
        assert int(np.argmax(reach)) == long and sorted(reach)[-1] > sorted(reach)[-2] + 40


def test_a_legend_says_what_colours_mean(run, tmp_path):
    with made_record(tmp_path, 3) as record:
        film = Film(movie_stage(record, Shot(color_by="curvature")))
    plain = Film(run / "movie.usdc")
    corners = [Renderer(f, (640, 360)).picture(0)[250:330, :200].astype(float) for f in (film, plain)]
    assert (np.ptp(corners[0], axis=2) > 90).sum() > 100 and (np.ptp(corners[1], axis=2) > 90).sum() == 0


@pytest.mark.parametrize("highest", [1.0, 2.6, 8.0])
def test_a_legend_ends_with_the_value_of_the_last_colour(highest):
    pen = Pen(np.full((540, 960, 3), 245, np.uint8), LETTER)
    pen.write_legend(1.0, "curvature", highest)
    found = ink(pen.picture)[505:530, 150:]  # beyond the colours
    alike = {value: likeness(found, f"{value:g}", 0.75 * LETTER / 0.73) for value in (1.0, 2.6, 8.0)}
    assert max(alike, key=alike.__getitem__) == highest


def test_every_letter_that_is_written_is_in_the_font():
    shapes = {letter: written(letter, 30) for letter in "0123456789.-µmsxkpNceurvatd/fl"}
    assert len({(shape.shape, shape.tobytes()) for shape in shapes.values()}) == len(shapes)
    with pytest.raises(ValueError):
        written("\N{SNOWMAN}", 30)  # a letter that the font lacks leaves no ink


def test_without_pillow_nothing_is_written_and_that_is_told(run, tmp_path, monkeypatch, capsys):
    for name in ("PIL", "PIL.Image"):
        monkeypatch.setitem(sys.modules, name, None)
    notes.can_write.cache_clear()
    try:
        assert cli.main(["render", str(run), "-o", str(tmp_path / "bare.png"), "--size", "160x90"]) == 0
        said = capsys.readouterr()
        assert "Pillow" in said.err and said.err.count("\n") == 1
        bare = Renderer(Film(run / "movie.usdc"), (640, 360)).picture(0)
    finally:
        notes.can_write.cache_clear()
    assert not ink(bare).any()
    assert (tmp_path / "bare.png").is_file()
