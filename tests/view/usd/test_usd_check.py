"""The check of a movie finds what the usual validators of USD files leave unsaid."""

from __future__ import annotations

import pytest
from pxr import Gf, Usd  # noqa: TID253 (no command line starts here)

from tests.films import made_record
from tests.view.usd.stages import at
from warpflag.view.usd import Shot, write_movie
from warpflag.view.usd.check import problems

FLAGELLA = "/World/Cell/Flagella"


def cut(name, frame):
    """Takes the last value away from an array attribute of the flagella."""

    def broken(stage):
        attribute = at(stage, FLAGELLA).GetAttribute(name)
        attribute.Set(attribute.Get(frame)[:-1], frame)

    return broken


def setting(path, name, value, frame=None):
    def broken(stage):
        attribute = at(stage, path).GetAttribute(name)
        attribute.Set(value(attribute.Get(frame)) if callable(value) else value, *([] if frame is None else [frame]))

    return broken


def not_a_number(points):
    points[3] = Gf.Vec3f(0, float("nan"), 0)
    return points


# What neither the validators of USD nor those of NVIDIA find, and what only the latter do.
BREAKAGES = {
    "start after end": (lambda stage: stage.SetStartTimeCode(99), "time codes"),
    "no time codes per second": (lambda stage: stage.GetRootLayer().ClearTimeCodesPerSecond(), "timeCodesPerSecond"),
    "no frames per second": (lambda stage: stage.GetRootLayer().ClearFramesPerSecond(), "framesPerSecond"),
    "no time code in a second": (lambda stage: stage.SetTimeCodesPerSecond(0), "timeCodesPerSecond"),
    "no frame in a second": (lambda stage: stage.SetFramesPerSecond(0), "framesPerSecond"),
    "no unit": (lambda stage: stage.ClearMetadata("metersPerUnit"), "unit"),
    "no default prim": (lambda stage: stage.ClearDefaultPrim(), "default prim"),
    "no camera": (lambda stage: stage.RemovePrim("/World/Camera"), "camera"),
    "a point too few in one frame": (cut("points", 7), "curveVertexCounts"),
    "a count too many": (setting(FLAGELLA, "curveVertexCounts", [31, 21, 32]), "curveVertexCounts"),
    "a colour too few in one frame": (cut("primvars:displayColor", 7), "primvars:displayColor"),
    "a raw value too few in one frame": (cut("primvars:curvature", 7), "primvars:curvature"),
    "an unknown basis": (setting(FLAGELLA, "basis", "catmulRom"), "catmulRom"),
    "an unknown axis": (setting("/World/Cell/Body", "axis", "W"), "W is none of"),
    "a misspelt type": (lambda stage: at(stage, FLAGELLA).SetTypeName("BasisCurve"), "BasisCurve"),
    "a point that is no number": (setting(FLAGELLA, "points", not_a_number, 7), "not finite"),
    "a wrong extent in one frame": (setting(FLAGELLA, "extent", [(-1, -1, -1), (1, 1, 1)], 7), "extent"),
    "a sample after the end": (setting(FLAGELLA, "extent", [(-9, -9, -9), (9, 9, 9)], 99), "time codes of the stage"),
    "a missing file": (lambda stage: at(stage, "/World").GetReferences().AddReference("./gone.usdc"), "gone.usdc"),
}


@pytest.mark.parametrize("name", BREAKAGES)
def test_a_broken_movie_is_found_out(tmp_path, name):
    path = tmp_path / "movie.usdc"
    write_movie(made_record(tmp_path / "run", 12), path, Shot(color_by="curvature"))
    stage = Usd.Stage.Open(str(path))
    assert problems(stage) == []
    breakage, words = BREAKAGES[name]
    breakage(stage)
    stage.GetRootLayer().Save()
    found = problems(Usd.Stage.Open(str(path)))
    assert any(words in line for line in found), found
