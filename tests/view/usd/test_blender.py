"""Blender shows a movie of meshes in its colours, by the example script; skipped where Blender is not installed.

It is `blender` on the PATH, or a Python that has the package bpy, named in WARPFLAG_BLENDER_PYTHON: an environment of
its own, since bpy asks for another NumPy.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from tests.films import made_record
from tests.view.pictures import pixels_of
from warpflag.view.usd import Shot, write_movie

SCRIPT = Path(__file__).parents[3] / "examples" / "blender.py"

PYTHON = os.environ.get("WARPFLAG_BLENDER_PYTHON")
COMMAND = [PYTHON, str(SCRIPT)] if PYTHON else ["blender", "--background", "--python", str(SCRIPT), "--"]

pytestmark = pytest.mark.skipif(shutil.which(COMMAND[0]) is None, reason="needs Blender")


def drawn(directory: Path, color_by: str) -> np.ndarray:
    """The first frame as Blender draws it."""
    with made_record(directory / "run", 3) as record:
        write_movie(record, directory / "movie.usdc", Shot(color_by=color_by, mesh=True))
    arguments = ["movie.usdc", "frame.png", "0", "--width", "320"]
    subprocess.run([*COMMAND, *arguments], cwd=directory, check=True, capture_output=True)
    return pixels_of(directory / "frame.png").astype(int)


def test_flagella_have_their_colours(tmp_path):
    red, green, blue = drawn(tmp_path, "flagellum").transpose(2, 0, 1)
    vermilion, sea, leaf = (red > blue + 70), (blue > red + 50) & (blue > green + 20), (green > red + 40)
    assert all(20 < found.sum() < 3000 for found in (vermilion, sea, leaf))


def test_a_quantity_colours_them_too(tmp_path):
    red, green, blue = drawn(tmp_path, "curvature").transpose(2, 0, 1)
    # The ground state has half of the range: the middle of the map is red.
    assert ((red > blue + 50) & (red > green + 50)).sum() > 60
    assert (green > red + 40).sum() == 0
