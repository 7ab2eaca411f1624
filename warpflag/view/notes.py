"""What is written on a picture: the time, a scale bar, what thickness and colours mean. Drawn by Pillow.

Without Pillow (extra `render`) pictures are drawn with nothing on them.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib.resources import as_file, files
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.view.coloring import FORM_COLORS, map_color

__all__ = ["Pen", "can_write"]

INK = (38, 50, 63)  # sRGB of letters and bars: a dark slate
FAINT = (112, 124, 138)  # sRGB of what stands back, half as dark
_LENGTHS = [base * 10.0**power for power in range(-3, 4) for base in (1, 2, 5)]  # um, of scale bars
_DIGIT_HEIGHT = 0.73  # of the font, in units of its size


@cache
def can_write() -> bool:
    """Whether Pillow is installed, with letters."""
    try:
        from PIL import features
    except ImportError:
        return False
    return bool(features.check("freetype2"))


class Pen:
    """Writes on a picture; `letter` is the height of a digit [pixels], which all sizes follow.

    Args:
        picture: sRGB, shape [height, width, 3]; it stays as it is.
        letter: height of a digit [pixels].
    """

    def __init__(self, picture: NDArray[np.uint8], letter: float):
        from PIL import Image, ImageDraw

        self._image = Image.fromarray(picture)
        self._draw = ImageDraw.Draw(self._image)
        self._letter = letter
        self._width, self._height = self._image.size

    @property
    def picture(self) -> NDArray[np.uint8]:
        """The picture with what was written on it, shape [height, width, 3]."""
        return np.array(self._image)

    def write_time(self, time: float) -> None:
        """Writes the simulated time [s] into the upper left corner."""
        self._text(f"{1e3 * time:.2f} ms", (1.4 * self._letter, 2.6 * self._letter), 1.2)

    def draw_scale(self, pixel: float) -> float:
        """Draws a bar about an eighth of the picture wide into the lower right corner, with its length.

        Args:
            pixel: width of one at the distance of the middle of the scene [um].

        Returns:
            The length: 1, 2 or 5 um or powers of ten of them.
        """
        length = min(_LENGTHS, key=lambda length: abs(np.log(length / (0.125 * self._width * pixel))))
        right, bottom = self._width - 1.6 * self._letter, self._height - 1.6 * self._letter
        self._box(right - length / pixel, bottom, right, bottom + 0.32 * self._letter)
        place = (right - 0.5 * length / pixel, bottom - 0.7 * self._letter)
        self._text(f"{length:g} µm", place, anchor="ms")
        return length

    def write_legend(self, factor: float, label: str, highest: float, names: Sequence[str] = ()) -> None:
        """Writes into the lower left corner how much flagella are thickened, and what their colours mean.

        Args:
            factor: how many times thicker than the record's they are drawn.
            label: of the quantity that colours them, with its unit; empty where colours only tell them apart.
            highest: value of the last colour; the first one's is 0.
            names: of the forms, for a quantity that has a colour each.
        """
        left, row = 1.4 * self._letter, self._height - 1.6 * self._letter
        if factor > 1.05:
            self._text(f"flagella drawn {_short(factor)}x thicker", (left, row), 0.75, FAINT)
            row -= 2.2 * self._letter
        for name, color in reversed(list(zip(names, FORM_COLORS, strict=False))):
            rgb = np.frombuffer(bytes.fromhex(color[1:]), dtype=np.uint8)
            self._paste(
                np.tile(rgb, (round(0.7 * self._letter), round(1.4 * self._letter), 1)),
                (round(left), round(row - 0.7 * self._letter)),
            )
            self._text(name, (left + 1.9 * self._letter, row), 0.75)
            row -= 1.4 * self._letter
        if label and not names:
            start = left + 1.2 * self._letter
            self._text("0", (left, row), 0.75)
            width, height = round(9 * self._letter), round(0.7 * self._letter)
            colors = np.rint(map_color(np.linspace(0.0, 1.0, width))).astype(np.uint8)
            self._paste(np.tile(colors, (height, 1, 1)), (round(start), round(row - 0.7 * self._letter)))
            self._text(_short(highest), (start + width + 0.5 * self._letter, row), 0.75)
            self._text(label, (left, row - 1.6 * self._letter), 0.75)

    def _text(
        self,
        text: str,
        place: tuple[float, float],
        size: float = 1.0,
        color: tuple[int, int, int] = INK,
        anchor: str = "ls",
    ) -> None:
        """Draws a line of text; `anchor` says what of it stands at the place, by default the left end of its base."""
        self._draw.text(place, text, color, _font(size * self._letter / _DIGIT_HEIGHT), anchor)

    def _box(self, left: float, top: float, right: float, bottom: float) -> None:
        self._draw.rectangle((round(left), round(top), round(right) - 1, max(round(bottom), round(top) + 2) - 1), INK)

    def _paste(self, pixels: NDArray[np.uint8], place: tuple[int, int]) -> None:
        from PIL import Image

        self._image.paste(Image.fromarray(pixels), place)


@cache
def _font(size: float) -> Any:
    """DejaVu Sans, which unlike Pillow's own font has a µ; size [pixels]."""
    from PIL import ImageFont

    with as_file(files("warpflag.view") / "font" / "DejaVuSans-subset.ttf") as path:
        return ImageFont.truetype(path, size)


def _short(value: float) -> str:
    """A positive number to two digits, without an exponent."""
    return np.format_float_positional(float(f"{value:.2g}"), trim="-")
