"""The movie holds what the record holds, in a file that validates and plays."""

from __future__ import annotations

import os

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade, UsdValidation  # noqa: TID253 (no command line starts here)

from warpflag.record import Frame, Record, RecordError
from warpflag.recorder import Recorder
from warpflag.usd import write_movie

FIRST_NODE = np.array([0, 31, 52, 83])  # three flagella of unequal length
FRAME_INTERVAL = 5e-5


def quaternion(axis, angle):
    axis = np.asarray(axis, float) / np.linalg.norm(axis)
    return np.array([*(np.sin(angle / 2) * axis), np.cos(angle / 2)])


def made_record(directory, frame_count=12, *, offset=(0.0, 0.0, 0.0)) -> Record:
    """A body that spins, tumbles and swims along -z, with helices behind it that turn."""
    directory.mkdir(exist_ok=True)
    recorder = Recorder(directory / "run.h5")
    recorder.start(
        "scene", FIRST_NODE, filament_radius=0.01, body_length=2.5, body_width=0.8, versions={"warpflag": "9.8"}
    )
    s = 0.2 * np.concatenate([np.arange(n) for n in np.diff(FIRST_NODE)])
    azimuth = np.repeat(2 * np.pi * np.arange(3) / 3, np.diff(FIRST_NODE))
    for i in range(frame_count):
        angle = -2.5 * s + 0.3 * i
        centre = np.array([0.0, 0.1 * np.sin(i), -0.5 * i]) + offset
        nodes = np.stack([np.cos(azimuth) * s + 0.2 * np.cos(angle), np.sin(azimuth) * s + 0.2 * np.sin(angle), s], -1)
        recorder.write(
            Frame(
                time=i * FRAME_INTERVAL,
                step=i,
                positions=nodes + centre,
                directors=np.zeros_like(nodes),
                motor_angle=np.zeros(3),
                body_position=centre,
                body_orientation=quaternion([0.1, 0.2, 1.0], -0.4 * i),
            )
        )
    recorder.close()
    return Record(directory)


@pytest.fixture(scope="module")
def movie(tmp_path_factory):
    directory = tmp_path_factory.mktemp("movie")
    record = made_record(directory)
    path = directory / "movie.usdc"
    write_movie(record, path)
    assert sorted(p.name for p in directory.iterdir()) == ["movie.usdc", "run.h5"]
    return record, Usd.Stage.Open(str(path))


def test_validators_find_nothing(movie):
    _, stage = movie
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    findings = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [f"{finding.GetName()}: {finding.GetMessage()}" for finding in findings] == []


def test_stage_says_its_units_times_and_origin(movie):
    record, stage = movie
    assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1e-6
    assert stage.GetRootLayer().HasTimeCodesPerSecond() and stage.GetRootLayer().HasFramesPerSecond()
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == 50.0
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 11.0)
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert Usd.ModelAPI(stage.GetPrimAtPath("/World")).GetKind() == "assembly"
    assert Usd.ModelAPI(stage.GetPrimAtPath("/World/Cell")).GetKind() == "component"
    data = stage.GetRootLayer().customLayerData["warpflag"]
    assert data["version"] == "9.8"
    assert data["sceneSha256"] == record.scene_sha256
    assert data["frameInterval"] == pytest.approx(FRAME_INTERVAL)
    assert data["slowDown"] == pytest.approx(400.0)  # 0.05 ms of the cell in 20 ms of film
    time = stage.GetPrimAtPath("/World/Cell").GetAttribute("warpflag:time")
    assert time.IsCustom()
    np.testing.assert_allclose([time.Get(frame) for frame in range(12)], record.times)


def test_points_are_the_record_s(movie):
    record, stage = movie
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/Cell/Flagella"))
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
    np.testing.assert_allclose(between, (before + after) / 2, atol=1e-6)
    colors = np.array(curves.GetDisplayColorAttr().Get())
    assert curves.GetDisplayColorPrimvar().GetInterpolation() == "uniform"
    assert colors.shape == (3, 3) and len(np.unique(colors, axis=0)) == 3


def test_body_is_the_record_s_spherocylinder_in_its_pose(movie):
    record, stage = movie
    body = UsdGeom.Capsule(stage.GetPrimAtPath("/World/Cell/Body"))
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


@pytest.mark.parametrize("prim", ["Body", "Flagella"])
def test_materials_show_the_display_colour(movie, prim):
    _, stage = movie
    prim = stage.GetPrimAtPath(f"/World/Cell/{prim}")
    assert prim.HasAPI(UsdShade.MaterialBindingAPI)
    material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource()
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    reader = UsdShade.Shader(surface.GetInput("diffuseColor").GetConnectedSources()[0][0].source)
    assert reader.GetIdAttr().Get() == "UsdPrimvarReader_float3"
    assert reader.GetInput("varname").Get() == "displayColor"


def assert_camera_sees_all(record, stage):
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera(0)
    project = camera.frustum.ComputeViewMatrix() * camera.frustum.ComputeProjectionMatrix()
    nodes = np.asarray(record.positions).reshape(-1, 3)
    x, y, z, w = record.body_orientation.T
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    ends = [record.body_position + side * 0.85 * axis for side in (-1, 1)]
    shown = [ball + 0.4 * direction for ball in ends for direction in np.vstack([np.eye(3), -np.eye(3)])]
    picture = np.array([project.Transform(Gf.Vec3d(*map(float, p))) for p in np.concatenate([nodes, *shown])])
    assert np.abs(picture).max() < 1.0
    # And they fill it: the scene is not a dot in a corner.
    reach = picture[:, :2].max(axis=0) - picture[:, :2].min(axis=0)
    assert reach.max() > 1.3
    np.testing.assert_allclose(picture[:, :2].max(axis=0) + picture[:, :2].min(axis=0), 0.0, atol=0.35)


def test_camera_frames_the_whole_path(movie):
    assert_camera_sees_all(*movie)


def test_cell_swims_to_the_left_of_the_picture(movie):
    record, stage = movie
    view = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera(0).frustum.ComputeViewMatrix()
    first, last = (view.Transform(Gf.Vec3d(*map(float, record.body_position[i]))) for i in (0, -1))
    assert last[0] < first[0] - 5.0
    assert abs(last[1] - first[1]) < 2.0


def test_there_is_light_from_the_camera_s_side(movie):
    _, stage = movie
    assert stage.GetPrimAtPath("/World/Lights/Dome").IsA(UsdLux.DomeLight)
    key = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Lights/Key"))
    assert key.GetPrim().IsA(UsdLux.DistantLight)
    shines = key.ComputeLocalToWorldTransform(0).TransformDir(Gf.Vec3d(0, 0, -1))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera"))
    looks = camera.ComputeLocalToWorldTransform(0).TransformDir(Gf.Vec3d(0, 0, -1))
    up = camera.ComputeLocalToWorldTransform(0).TransformDir(Gf.Vec3d(0, 1, 0))
    assert Gf.Dot(shines, looks) > 0.3 and Gf.Dot(shines, up) < -0.3


@pytest.mark.parametrize("frame_count", [1, 2, 61])
def test_any_number_of_frames_anywhere(tmp_path, frame_count):
    record = made_record(tmp_path, frame_count, offset=(900.0, -300.0, 50.0))
    write_movie(record, tmp_path / "movie.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "movie.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, frame_count - 1.0)
    assert_camera_sees_all(record, stage)
    slow_down = stage.GetRootLayer().customLayerData["warpflag"]["slowDown"]
    assert slow_down == pytest.approx(400.0 if frame_count > 1 else 0.0)


def test_no_frames_no_movie(tmp_path):
    record = made_record(tmp_path, 1)
    empty = Recorder(tmp_path / "run.h5", resume_step=-1)
    empty.start("scene", FIRST_NODE, filament_radius=0.01, body_length=2.5, body_width=0.8)
    empty.close()
    with pytest.raises(RecordError, match="no frames"):
        write_movie(record, tmp_path / "movie.usdc")
    assert not (tmp_path / "movie.usdc").exists()


def test_a_movie_that_could_not_be_finished_leaves_the_old_one(tmp_path, monkeypatch):
    record = made_record(tmp_path, 2)
    path = tmp_path / "movie.usdc"
    write_movie(record, path)
    before = path.read_bytes()

    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write_movie(record, path)
    assert path.read_bytes() == before
