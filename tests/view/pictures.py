"""What the tests of pictures share: pixels of files, and where something dark is written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest


def pixels_of(path: Path) -> np.ndarray:
    """sRGB of a picture file, shape [height, width, 3]."""
    image = pytest.importorskip("PIL.Image")
    with image.open(path) as picture:
        return np.array(picture.convert("RGB"))


def ink(picture: np.ndarray) -> np.ndarray:
    """Where text and bars are, shape [height, width]."""
    return (np.abs(picture.astype(int) - [38, 50, 63]).max(axis=2) < 12) & (picture.max(axis=2) < 90)
