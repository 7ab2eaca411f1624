"""Pictures and films of a movie, without a screen: `warpflag render`.

A picture shows what the movie's own camera sees, with its colours, body and motors, a scale bar and the simulated
time. Flagella 20 nm thick would vanish, so they are drawn with a radius of 0.05 um, and never thinner than 3 pixels;
the picture says by how much. The scale bar holds at the distance of the middle of the scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

import numpy as np
from numpy.typing import NDArray

from warpflag.base.device import find_device
from warpflag.base.output import OutputError
from warpflag.base.progress import Progress
from warpflag.base.streams import tell
from warpflag.record import Record
from warpflag.view.coloring import DISPLAY_RADIUS
from warpflag.view.images import PICTURES, check_rate, check_writable, write_animation, write_picture
from warpflag.view.notes import Pen, can_write
from warpflag.view.raycaster import draw, seen
from warpflag.view.usd import Shot, movie_stage
from warpflag.view.usd.read import Film

__all__ = ["Renderer", "render"]

MOVIE_NAME = "movie.usdc"

_THINNEST = 1.5  # pixels, least radius of a flagellum in a picture
_LEGEND_ROOM = 30  # heights of a letter: a narrower picture has the scale bar only
_GUTTER = 3  # pixels between the snapshots of a sheet
_ROUNDING = 1e-6  # of a movie's time: a picture's may be this far outside


@dataclass(frozen=True)
class _Notes:
    """Which notes are written on a picture: the simulated time; scale bar and legend."""

    time: bool = True
    scale: bool = True


class Renderer:
    """Draws pictures of a film.

    Args:
        film: to be drawn.
        size: width and height [pixels].
        radius: least radius of flagella and spokes [um]; they are never thinner than 3 pixels.
        device: Warp's device that draws; None for Warp's preferred one.
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
        """The picture at a time code, sRGB, shape [height, width, 3]; without notes where Pillow is missing."""
        notes, size = notes or _Notes(), size or self.size
        camera = self.film.camera(code)
        pixel = 2.0 * camera.focus * seen(camera, size)[0] / size[0]  # um
        radius = max(self._radius, _THINNEST * pixel)
        picture = draw(self.film.rods(code, radius), camera, self.film.light(code), size, self._device)
        if not can_write():
            return picture
        letter = max(8.0, 0.024 * min(size))
        pen = Pen(picture, letter)
        if notes.time:
            pen.write_time(self.film.time(code))
        if notes.scale:
            pen.draw_scale(pixel)
            if size[0] > _LEGEND_ROOM * letter:
                facts = self.film.facts
                factor = radius / self.film.thinnest()
                names = [name for name in facts.get("colorNames", "").split(", ") if name]
                pen.write_legend(factor, facts.get("colorLabel", ""), facts.get("colorHighest", 0.0), names)
        return pen.picture

    def sheet(self, codes: Sequence[float], progress: Progress) -> NDArray[np.uint8]:
        """Snapshots at time codes in rows, all at one scale; the last one has the scale bar.

        Raises:
            OutputError: they do not fit into the picture.
        """
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
    """Draws a run or a movie into a picture (.png, .jpg) or a film (.webp, .gif, .mp4); the file is whole or absent.

    Args:
        source: a run directory or a movie file. A directory's movie.usdc is drawn as it is, or filmed anew where there
            is none or a `shot` is given.
        output: the file; its ending says the format.
        shot: how a directory is filmed anew.
        times: of a picture [s]; several make a sheet, none is the last frame.
        snapshots: a sheet of so many pictures spread evenly over the movie.
        frames_per_second: of a film; None for the movie's own.
        size: width and height [pixels].
        radius: least radius of flagella and spokes [um]; they are never thinner than 3 pixels.
        device: Warp's device that draws; None for Warp's preferred one.
        quiet: say nothing of how long the film will be, and show no progress.

    Raises:
        OutputError: what can't be drawn.
        RecordError: a directory without a record.
        OSError: the file can't be written.
    """
    output = Path(output)
    check_writable(output)
    for name, value in (("radius", radius), ("frames per second", frames_per_second)):
        if value is not None and not 0 < value < np.inf:
            raise OutputError(f"{name} {value:g}: must be positive and finite")
    if min(size) < 32 or max(size) > 16384:
        raise OutputError(f"size {size[0]}x{size[1]}: 32 to 16384 pixels a side are allowed")
    is_film = output.suffix not in PICTURES
    if is_film and (times or snapshots is not None):
        raise OutputError(f"{output}: times and snapshots are for pictures, {', '.join(PICTURES)}")
    film = _film(Path(source), shot)
    renderer = Renderer(film, size, radius, device)
    rate = frames_per_second or film.frames_per_second
    if is_film:
        check_rate(output, rate)
        codes = np.arange(film.start, film.end + 1e-6, film.codes_per_second / rate).tolist()
    else:
        codes = _snapshot_codes(film, times, snapshots)
    if is_film and not quiet:
        seconds = len(codes) * _seconds_per_picture(renderer, codes)
        film_length = f"{len(codes)} pictures of {size[0]}x{size[1]}, a film of {len(codes) / rate:.1f} s"
        tell(f"{output}: {film_length}; drawing it takes about {seconds:.0f} s")
    progress = Progress(film.time(codes[-1]), quiet=quiet or len(codes) == 1)
    try:
        if is_film:
            write_animation(output, renderer.pictures(codes, progress), len(codes), rate)
        elif len(codes) > 1:
            write_picture(output, renderer.sheet(codes, progress))
        else:
            write_picture(output, renderer.picture(codes[0]))
    finally:
        progress.close()


def _seconds_per_picture(renderer: Renderer, codes: Sequence[float]) -> float:
    """Time that a picture takes [s], measured on the last one after the first, which may compile kernels."""
    renderer.picture(codes[0])
    start = monotonic()
    renderer.picture(codes[-1])
    return monotonic() - start


def _snapshot_codes(film: Film, times: Sequence[float], snapshots: int | None) -> list[float]:
    """Time codes of the pictures that are asked for."""
    first, last = film.time(film.start), film.time(film.end)
    slack = _ROUNDING * (last - first)
    for time in times:
        if not first - slack <= time <= last + slack:
            raise OutputError(f"times {1e3 * time:g}: the movie has {1e3 * first:g} to {1e3 * last:g} ms")
    if snapshots is None:
        return [film.code_at(time) for time in times] or [film.end]
    if snapshots < 1 or times:
        raise OutputError(f"snapshots {snapshots}: must be positive, and given without times")
    return np.linspace(film.start, film.end, snapshots).tolist()


def _film(source: Path, shot: Shot | None) -> Film:
    """The movie of a file, of a directory, or one filmed anew from its record."""
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
