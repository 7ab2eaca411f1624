"""Pictures and films of a movie, without a screen: `warpflag render`.

A picture shows what the movie's own camera sees, with its colours, body and motors, a scale bar and the simulated
time. Flagella 20 nm thick would vanish, so they are drawn with a radius of 0.05 um, and never thinner than 3 pixels;
the picture says by how much. The scale bar holds at the distance of the middle of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from warpflag.base.device import find_device
from warpflag.base.output import OutputError
from warpflag.base.progress import Progress
from warpflag.record import Record
from warpflag.view.coloring import DISPLAY_RADIUS, map_color
from warpflag.view.images import check_writable, write_animation, write_png
from warpflag.view.lettering import draw_strokes, draw_text, text_width
from warpflag.view.raycaster import draw, seen
from warpflag.view.usd import Shot, movie_stage
from warpflag.view.usd.read import Film

__all__ = ["Renderer", "render"]

MOVIE_NAME = "movie.usdc"

_THINNEST = 1.5  # pixels, least radius of a flagellum in a picture
_INK = (38, 50, 63)
_FAINT = (112, 124, 138)
_LENGTHS = [base * 10.0**power for power in range(-3, 4) for base in (1, 2, 5)]  # um, of scale bars
_LEGEND_ROOM = 30  # heights of a letter: a narrower picture has the scale bar only
_GUTTER = 3  # pixels between the snapshots of a sheet


@dataclass(frozen=True)
class _Notes:
    """What is written on a picture."""

    time: bool = True
    scale: bool = True


class Renderer:
    """Draws pictures of a film.

    size: width and height [pixels]. radius: least radius of curves [um], but never below 1.5 pixels. device: that
    draws, None for Warp's preferred one.
    """

    def __init__(
        self, film: Film, size: tuple[int, int] = (1280, 720), radius: float = DISPLAY_RADIUS, device: str | None = None
    ):
        self.film, self.size = film, size
        self._radius = radius
        self._device = find_device(device)

    def picture(
        self, code: float, notes: _Notes | None = None, size: tuple[int, int] | None = None
    ) -> NDArray[np.uint8]:
        """The picture at a time code, sRGB, shape [height, width, 3]."""
        notes, size = notes or _Notes(), size or self.size
        camera = self.film.camera(code)
        pixel = 2.0 * camera.focus * seen(camera, size)[0] / size[0]  # um
        radius = max(self._radius, _THINNEST * pixel)
        picture = draw(self.film.rods(code, radius), camera, self.film.light(code), size, self._device)
        letter = max(8.0, 0.024 * min(size))
        if notes.time:
            _write_time(picture, self.film.time(code), letter)
        if notes.scale:
            _draw_scale(picture, pixel, letter)
            if size[0] > _LEGEND_ROOM * letter:
                _draw_legend(picture, self.film, radius, letter)
        return picture

    def sheet(self, codes: Sequence[float], progress: Progress) -> NDArray[np.uint8]:
        """Snapshots at time codes in rows, all at one scale; the last one has the scale bar."""
        columns, rows = _grid(len(codes), self.film.camera(codes[0]).tangents, self.size)
        width, height = ((whole - (n - 1) * _GUTTER) // n for whole, n in zip(self.size, (columns, rows), strict=True))
        if min(width, height) < 32:
            raise OutputError(f"{len(codes)} snapshots do not fit into {self.size[0]}x{self.size[1]} pixels")
        picture = np.full((self.size[1], self.size[0], 3), 255, dtype=np.uint8)
        for i, code in enumerate(codes):
            progress.update(self.film.time(code))
            row, column = divmod(i, columns)
            y, x = row * (height + _GUTTER), column * (width + _GUTTER)
            notes = _Notes(scale=i == len(codes) - 1)
            picture[y : y + height, x : x + width] = self.picture(code, notes, (width, height))
        return picture

    def pictures(self, codes: Sequence[float], progress: Progress) -> Iterator[NDArray[np.uint8]]:
        """The pictures at time codes, drawn as they are asked for."""
        for code in codes:
            progress.update(self.film.time(code))
            yield self.picture(code)


def render(
    source: str | Path,
    output: str | Path,
    *,
    shot: Shot | None = None,
    times: Sequence[float] = (),
    snapshots: int | None = None,
    frames_per_second: float | None = None,
    size: tuple[int, int] = (1280, 720),
    radius: float = DISPLAY_RADIUS,
    device: str | None = None,
    quiet: bool = True,
) -> None:
    """Draws a run or a movie into a picture (.png) or a film (.webp, .gif, .mp4); the file is whole or absent.

    source: a run directory or a movie file. A directory's movie.usdc is drawn as it is, or filmed anew where there is
    none or a `shot` is given. times: of a picture [s]; several, or `snapshots` spread evenly over the movie, make a
    sheet; none is the last frame. frames_per_second: of a film; None: the movie's own. The other arguments: see
    `Renderer`. quiet: without a progress bar.

    Raises OutputError for what can't be drawn, RecordError for a directory without a record, OSError where the file
    can't be written.
    """
    output = Path(output)
    check_writable(output)
    for name, value in (("radius", radius), ("frames per second", frames_per_second)):
        if value is not None and not 0 < value < np.inf:
            raise OutputError(f"{name} {value:g}: must be positive and finite")
    if min(size) < 32 or max(size) > 16384:
        raise OutputError(f"size {size[0]}x{size[1]}: 32 to 16384 pixels a side are allowed")
    is_film = output.suffix != ".png"
    if is_film and (times or snapshots is not None):
        raise OutputError(f"{output}: times and snapshots are for pictures, .png")
    film = _film(Path(source), shot)
    renderer = Renderer(film, size, radius, device)
    rate = frames_per_second or film.frames_per_second
    if is_film:
        codes = np.arange(film.start, film.end + 1e-6, film.codes_per_second / rate).tolist()
    else:
        codes = _snapshot_codes(film, times, snapshots)
    progress = Progress(film.time(codes[-1]), quiet=quiet or len(codes) == 1)
    try:
        if is_film:
            write_animation(output, renderer.pictures(codes, progress), len(codes), 1.0 / rate)
        elif len(codes) > 1:
            write_png(output, renderer.sheet(codes, progress))
        else:
            write_png(output, renderer.picture(codes[0]))
    finally:
        progress.close()


def _snapshot_codes(film: Film, times: Sequence[float], snapshots: int | None) -> list[float]:
    if snapshots is None:
        return [film.code_at(time) for time in times] or [film.end]
    if snapshots < 1 or times:
        raise OutputError(f"snapshots {snapshots}: must be positive, and given without times")
    return np.linspace(film.start, film.end, snapshots).tolist()


def _film(source: Path, shot: Shot | None) -> Film:
    if source.suffix.startswith(".usd"):
        if shot is not None:
            raise OutputError(f"{source}: has its own colours and camera; name the run directory to film it anew")
        return Film(source)
    if shot is None and (source / MOVIE_NAME).is_file():
        return Film(source / MOVIE_NAME)
    with Record(source) as record:
        return Film(movie_stage(record, shot))


def _grid(count: int, tangents: tuple[float, float], size: tuple[int, int]) -> tuple[int, int]:
    """Columns and rows in which snapshots are largest."""

    def scale(columns: int) -> float:
        rows = -(-count // columns)
        return min(size[0] / columns / tangents[0], size[1] / rows / tangents[1])

    columns = max(range(1, count + 1), key=scale)
    return columns, -(-count // columns)


def _write_time(picture: NDArray[np.uint8], time: float, letter: float) -> None:
    draw_text(picture, f"{1e3 * time:.2f} ms", (1.4 * letter, 2.6 * letter), 1.2 * letter, _INK)


def _draw_scale(picture: NDArray[np.uint8], pixel: float, letter: float) -> None:
    """A bar of 1, 2 or 5 um or powers of ten of them, about an eighth of the picture wide, in the lower right corner.

    pixel: width of one [um].
    """
    height, width = picture.shape[:2]
    length = min(_LENGTHS, key=lambda length: abs(np.log(length / (0.125 * width * pixel))))
    right, bottom = width - 1.6 * letter, height - 1.6 * letter
    left = right - length / pixel
    draw_strokes(picture, [np.array([[left, bottom], [right, bottom]])], 0.32 * letter, _INK)
    text = f"{length:g} µm"
    place = (0.5 * (left + right - text_width(text, letter)), bottom - 0.8 * letter)
    draw_text(picture, text, place, letter, _INK)


def _draw_legend(picture: NDArray[np.uint8], film: Film, radius: float, letter: float) -> None:
    """By how much the flagella are thickened, and what the colours mean, in the lower left corner."""
    x, y, small = 1.4 * letter, picture.shape[0] - 1.6 * letter, 0.75 * letter
    factor = radius / film.thinnest()
    if factor > 1.05:
        draw_text(picture, f"flagella drawn {_short(factor)}x thicker", (x, y), small, _FAINT)
        y -= 2.2 * letter
    label, highest = film.facts.get("colorLabel"), film.facts.get("colorHighest")
    if label and highest:
        ticks, width, height = ("0", _short(highest)), round(9 * letter), round(0.7 * letter)
        x += text_width(ticks[0], small) + 0.6 * letter
        row, column = round(y - 0.7 * letter), round(x)
        picture[row : row + height, column : column + width] = map_color(np.linspace(0.0, 1.0, width))
        draw_text(picture, ticks[0], (1.4 * letter, y), small, _INK)
        draw_text(picture, ticks[1], (x + width + 0.6 * letter, y), small, _INK)
        draw_text(picture, label, (1.4 * letter, y - 1.5 * letter), small, _INK)


def _short(value: float) -> str:
    """A positive number to two digits, in the letters there are."""
    return np.format_float_positional(float(f"{value:.2g}"), trim="-")
