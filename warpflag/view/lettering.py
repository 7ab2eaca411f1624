"""Lines and letters on a picture, drawn as strokes with soft edges: a small font of its own."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = ["draw_strokes", "draw_text", "text_width"]

Array = NDArray[np.floating]

# A glyph is its width and its strokes. A stroke is a run of points xy on a grid whose baseline is y = 2; small letters
# reach y = 6, digits and capitals y = 8. Corners are rounded off, but for points that stand twice.
_GLYPHS = {
    " ": "2",
    ".": "0 0202",
    "-": "4 0545",
    "/": "3 0138",
    "0": "4 280805022242454828",
    "1": "2 06282822",
    "2": "4 0708284846020242",
    "3": "4 070828484525 254542220203",
    "4": "4 38040444 3832",
    "5": "4 4808080505264642220203",
    "6": "4 4748280805022242462605",
    "7": "4 08484812",
    "8": "4 25050828484525 25050222424525",
    "9": "4 0302224245482808042445",
    "a": "4 444626060402224244 4642",
    "b": "4 0902 040626464442220204",
    "c": "4 454626060402224243",
    "d": "4 444626060402224244 4942",
    "e": "4 0444 444626060402224243",
    "f": "3 39191812 0636",
    "g": "4 444626060402224244 464140200001",
    "h": "4 0902 040626464442",
    "i": "0 0602 0808",
    "j": "2 26202000 2828",
    "k": "4 0902 4604 2542",
    "l": "0 0902",
    "m": "6 0602 0406363432 3436666462",
    "n": "4 0602 040626464442",
    "o": "4 260604022242444626",
    "p": "4 0600 040626464442220204",
    "q": "4 4640 444626060402224244",
    "r": "3 0602 04062636",
    "s": "4 4546260605244342220203",
    "t": "3 181232 0636",
    "u": "4 060402224244 4642",
    "v": "4 06222246",
    "w": "6 0612123636525266",
    "x": "4 0642 4602",
    "y": "4 0622 4610",
    "z": "4 064646020242",
    "µ": "4 0600 040302224244 4642",
    "N": "4 020808424248",
    "P": "4 0208 082848452505",
}
_CAP_HEIGHT = 6.0
_SPACING = 2.2
_WEIGHT = 0.95  # thickness of a stroke; all three in units of the grid


def text_width(text: str, size: float) -> float:
    """Width of a line of text [pixels]; `size` is the height of its digits."""
    return (sum(int(_GLYPHS[letter][0]) + _SPACING for letter in text) - _SPACING) * size / _CAP_HEIGHT


def draw_text(picture: NDArray[np.uint8], text: str, place: tuple[float, float], size: float, color: ArrayLike) -> None:
    """Draws a line of text into a picture.

    place: the left end of its baseline [pixels], from the upper left corner. size: height of its digits [pixels].
    color: sRGB, 0 to 255.
    """
    unit = size / _CAP_HEIGHT
    x = place[0]
    for letter in text:
        width, *runs = _GLYPHS[letter].split()
        grid = [np.array([[int(a), int(b)] for a, b in zip(run[::2], run[1::2], strict=True)], float) for run in runs]
        strokes = [np.array([x, place[1]]) + (_rounded(points) - [0, 2]) * [unit, -unit] for points in grid]
        draw_strokes(picture, strokes, _WEIGHT * unit, color)
        x += (int(width) + _SPACING) * unit


def draw_strokes(picture: NDArray[np.uint8], strokes: list[Array], thickness: float, color: ArrayLike) -> None:
    """Draws lines through points [pixels], shape [point, 2] each, with round ends and soft edges."""
    ends = [ends for points in strokes for ends in pairwise(points)]
    if not ends:
        return
    margin = 0.5 * thickness + 1.0
    corners = np.array(ends).reshape(-1, 2)
    left, top = np.maximum(np.floor(corners.min(axis=0) - margin), 0).astype(int)
    right, bottom = np.ceil(corners.max(axis=0) + margin).astype(int) + 1
    part = picture[top:bottom, left:right]
    y, x = np.mgrid[top : top + part.shape[0], left : left + part.shape[1]] + 0.5
    distance = np.full(part.shape[:2], np.inf)
    for (ax, ay), (bx, by) in ends:
        dx, dy = bx - ax, by - ay
        s = np.clip(((x - ax) * dx + (y - ay) * dy) / max(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
        np.minimum(distance, np.hypot(x - ax - s * dx, y - ay - s * dy), out=distance)
    covered = np.clip(0.5 * thickness + 0.5 - distance, 0.0, 1.0)[..., None]
    part[:] = np.rint(part + covered * (np.asarray(color, float) - part)).astype(np.uint8)


def _rounded(points: Array) -> Array:
    """Corners cut off twice (Chaikin): a smooth curve within the polygon, its ends where they were."""
    for _ in range(2):
        before, after = points[:-1], points[1:]
        cut = np.stack([0.75 * before + 0.25 * after, 0.25 * before + 0.75 * after], axis=1).reshape(-1, 2)
        points = np.concatenate([points[:1], cut[1:-1], points[-1:]])
    return points
