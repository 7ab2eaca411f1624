"""The movie holds what the record holds, in a file that validates and plays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdShade  # noqa: TID253 (no command line starts here)

from tests.films import FIRST_NODE, FRAME_INTERVAL, THREE, made_record, motor_axes
from tests.view.usd.stages import at, faults
from warpflag.scene import load, paper_scene, with_values
from warpflag.view.coloring import QUANTITIES, Coloring
from warpflag.view.node_quantities import curvature
from warpflag.view.usd import Shot, movie_stage, write_movie

EXAMPLES = sorted((Path(__file__).parents[3] / "examples").glob("*.toml"))


@pytest.fixture(scope="module")
def movie(tmp_path_factory):
    directory = tmp_path_factory.mktemp("movie")
    record = made_record(directory)
    path = directory / "movie.usdc"
    write_movie(record, path)
    assert sorted(p.name for p in directory.iterdir()) == ["movie.usdc", "run.h5"]
    return record, Usd.Stage.Open(str(path))


@pytest.mark.parametrize("color_by", QUANTITIES)
@pytest.mark.parametrize("follow", [False, True])
def test_validators_find_nothing(tmp_path, color_by, follow):
    record = made_record(tmp_path, 4)
    write_movie(record, tmp_path / "movie.usdc", Shot(color_by=color_by, follow=follow))
    assert faults(Usd.Stage.Open(str(tmp_path / "movie.usdc"))) == []


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_validators_find_nothing_in_the_examples(tmp_path, path):
    record = made_record(tmp_path, 3, scene=load(path))
    assert faults(movie_stage(record)) == []


@pytest.mark.parametrize("color_by", QUANTITIES)
def test_nvidia_s_validator_finds_no_fault(tmp_path, color_by):
    validation = pytest.importorskip("usd_validation_nvidia")
    write_movie(made_record(tmp_path, 4), tmp_path / "movie.usdc", Shot(color_by=color_by))
    issues = list(validation.ValidationEngine().validate(str(tmp_path / "movie.usdc")).issues())
    # It warns that equal colours could be indexed: that would cost more than it saves in what changes each frame.
    assert [str(issue) for issue in issues if issue.severity.name != "WARNING"] == []


def test_stage_says_its_units_times_and_origin(movie):
    record, stage = movie
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1e-6
    assert stage.GetRootLayer().HasTimeCodesPerSecond() and stage.GetRootLayer().HasFramesPerSecond()
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 50.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 11.0)
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert Usd.ModelAPI(at(stage, "/World")).GetKind() == "assembly"
    assert Usd.ModelAPI(at(stage, "/World/Cell")).GetKind() == "component"
    data = stage.GetRootLayer().customLayerData["warpflag"]
    assert data["version"] == "9.8"
    assert data["sceneSha256"] == record.scene_sha256
    assert data["frameInterval"] == pytest.approx(FRAME_INTERVAL)
    assert data["slowDown"] == pytest.approx(400.0)  # 0.05 ms of the cell in 20 ms of film
    time = at(stage, "/World/Cell").GetAttribute("warpflag:time")
    assert time.IsCustom()
    np.testing.assert_allclose([time.Get(frame) for frame in range(12)], record.times)


def test_film_rates(movie):
    record, _ = movie
    stage = movie_stage(record, Shot(slow_down=500.0, frames_per_second=24.0))
    assert stage.GetTimeCodesPerSecond() == pytest.approx(40.0)  # 1 ms of the cell, 20 frames, in 0.5 s
    assert stage.GetFramesPerSecond() == 24.0
    assert stage.GetRootLayer().customLayerData["warpflag"]["slowDown"] == pytest.approx(500.0)
    assert stage.GetEndTimeCode() == 11.0


def test_points_are_the_record_s(movie):
    record, stage = movie
    curves = UsdGeom.BasisCurves(at(stage, "/World/Cell/Flagella"))
    assert (curves.GetTypeAttr().Get(), curves.GetBasisAttr().Get()) == ("cubic", "catmullRom")
    assert curves.GetWrapAttr().Get() == "pinned"
    assert list(curves.GetCurveVertexCountsAttr().Get()) == [31, 21, 31]
    assert list(curves.GetWidthsAttr().Get()) == [pytest.approx(0.02)]
    assert curves.GetWidthsInterpolation() == "constant"
    assert curves.GetPointsAttr().GetTimeSamples() == list(range(12))
    for frame in range(12):
        points = np.array(curves.GetPointsAttr().Get(frame))
        np.testing.assert_array_equal(points, record.positions[frame].astype(np.float32))
        extent = curves.GetExtentAttr().Get(frame)
        np.testing.assert_array_equal(extent, UsdGeom.Boundable.ComputeExtentFromPlugins(curves, frame))
    between, before, after = (np.array(curves.GetPointsAttr().Get(code)) for code in (4.5, 4, 5))
    assert np.abs(after - before).max() > 0.1
    np.testing.assert_allclose(between, (before + after) / 2, atol=1e-6)


def test_body_is_the_record_s_spherocylinder_in_its_pose(movie):
    record, stage = movie
    body = UsdGeom.Capsule(at(stage, "/World/Cell/Body"))
    assert body.GetAxisAttr().Get() == "Z"
    assert body.GetRadiusAttr().Get() == pytest.approx(0.4)
    assert body.GetHeightAttr().Get() == pytest.approx(1.7)
    np.testing.assert_array_equal(body.GetExtentAttr().Get(), UsdGeom.Boundable.ComputeExtentFromPlugins(body, 0))
    for frame in range(12):
        matrix = body.ComputeLocalToWorldTransform(frame)
        np.testing.assert_allclose(matrix.ExtractTranslation(), record.body_position[frame], atol=1e-12)
        x, y, z, w = record.body_orientation[frame]
        turn = Gf.Rotation(Gf.Quatd(w, x, y, z))
        for axis in np.eye(3):
            np.testing.assert_allclose(
                matrix.TransformDir(Gf.Vec3d(*axis)), turn.TransformDir(Gf.Vec3d(*axis)), atol=1e-12
            )
    # The axis of the capsule is e_b3, by the formula rather than by USD's own quaternions.
    x, y, z, w = record.body_orientation[7]
    axis = body.ComputeLocalToWorldTransform(7).TransformDir(Gf.Vec3d(0, 0, 1))
    expected = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    np.testing.assert_allclose(axis, expected, atol=1e-12)


def test_markers_stand_on_the_anchors_and_turn_with_the_tripods(movie):
    record, stage = movie
    to_lab = UsdGeom.Xformable(at(stage, "/World/Cell/Body"))
    for k, m in enumerate(motor_axes(THREE)):
        motor = UsdGeom.BasisCurves(at(stage, f"/World/Cell/Motors/Motor_{k}"))
        for frame in range(12):
            matrix = motor.ComputeLocalToWorldTransform(frame)
            np.testing.assert_allclose(matrix.ExtractTranslation(), record.positions[frame][FIRST_NODE[k]], atol=1e-6)
            e1, e2, e3 = np.array(matrix)[:3, :3]
            np.testing.assert_allclose(e1, record.directors[frame][FIRST_NODE[k]], atol=1e-6)
            np.testing.assert_allclose(
                e3, to_lab.ComputeLocalToWorldTransform(frame).TransformDir(Gf.Vec3d(*m.tolist())), atol=1e-6
            )
            np.testing.assert_allclose(e2, np.cross(e3, e1), atol=1e-6)
        # Half-way between two frames it has turned half as far, however fast the motor is.
        middle = [np.array(motor.GetLocalTransformation(code))[0, :3] for code in (4, 4.5, 5)]
        angle = 0.9 * (k + 1)
        turned = np.cos(angle / 2) * middle[0] + np.sin(angle / 2) * np.cross(m, middle[0])
        np.testing.assert_allclose(middle[1], turned, atol=1e-6)


@pytest.mark.parametrize("prim", ["Body", "Flagella", "Motors/Motor_1"])
def test_materials_show_the_display_colour(movie, prim):
    _, stage = movie
    prim = at(stage, f"/World/Cell/{prim}")
    assert prim.HasAPI(UsdShade.MaterialBindingAPI)
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource()
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    reader = UsdShade.Shader(surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source)
    assert reader.GetIdAttr().Get() == "UsdPrimvarReader_float3"
    assert reader.GetInput("varname").Get() == "displayColor"


def test_flagella_have_a_colour_each(movie):
    _, stage = movie
    curves = UsdGeom.BasisCurves(at(stage, "/World/Cell/Flagella"))
    assert curves.GetDisplayColorPrimvar().GetInterpolation() == "vertex"
    colors = np.array(curves.GetDisplayColorAttr().Get())
    number = np.array(UsdGeom.PrimvarsAPI(curves).GetPrimvar("flagellum").Get())
    np.testing.assert_array_equal(number, np.repeat([0, 1, 2], [31, 21, 31]))
    assert len({tuple(color) for color in colors.tolist()}) == 3
    for k in range(3):
        assert (colors[number == k] == colors[FIRST_NODE[k]]).all()


@pytest.mark.parametrize("color_by", ["phase_difference", "curvature", "steric_force"])
def test_colours_and_raw_values_of_a_quantity(movie, color_by):
    record, _ = movie
    stage = movie_stage(record, Shot(color_by=color_by))
    coloring = Coloring(color_by, record, THREE)
    curves = UsdGeom.BasisCurves(at(stage, "/World/Cell/Flagella"))
    primvar = UsdGeom.PrimvarsAPI(curves).GetPrimvar(coloring.primvar)
    assert primvar.GetInterpolation() == curves.GetDisplayColorPrimvar().GetInterpolation() == "vertex"
    for frame in (0, 5, 11):
        block = slice(frame, frame + 1)
        expected = coloring.values(record.positions[block], block)[0]
        np.testing.assert_allclose(primvar.Get(frame), np.nan_to_num(expected, nan=-1.0), rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(curves.GetDisplayColorAttr().Get(frame), coloring.colors(expected), atol=1e-6)
    assert stage.GetRootLayer().customLayerData["warpflag"]["colorBy"] == color_by


def test_colours_follow_the_values(movie):
    record, _ = movie
    coloring = Coloring("curvature", record, THREE)
    assert coloring.highest == pytest.approx(2.6)  # twice the intrinsic 1.3 / um
    shades = coloring.colors([-1.0, 0.0, 1.3, 2.6, 9.0, np.nan])
    assert (shades[0] == shades[1]).all() and (shades[3] == shades[4]).all()
    brightness = shades[[1, 2, 3]].sum(axis=1)
    assert brightness[0] < brightness[1] < brightness[2]
    assert np.ptp(shades[5]) < 1e-6 < np.ptp(shades[1])  # grey where undefined
    assert curvature(record.positions[:1], record.first_node).max() < 2.6


@pytest.mark.parametrize("count", [1, 9])
def test_any_number_of_flagella(tmp_path, count):
    record = made_record(tmp_path, 3, scene=with_values(paper_scene(name="n"), {"flagella.count": count}))
    for color_by in QUANTITIES:
        assert faults(movie_stage(record, Shot(color_by=color_by))) == []
