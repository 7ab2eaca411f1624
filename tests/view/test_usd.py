"""The movie holds what the record holds, in a file that validates and plays."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade, UsdValidation  # noqa: TID253 (no command line starts here)

from tests.films import FIRST_NODE, FRAME_INTERVAL, THREE, made_record, motor_axes
from warpflag.base.output import OutputError
from warpflag.record import RecordError
from warpflag.record.recorder import Recorder
from warpflag.scene import Scene, dumps, load, with_values
from warpflag.view.coloring import QUANTITIES, Coloring
from warpflag.view.node_quantities import curvature
from warpflag.view.usd import Shot, movie_stage, write_movie
from warpflag.view.usd import movie as usd
from warpflag.view.usd.camera import steady_path
from warpflag.view.usd.check import problems

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.toml"))


@pytest.fixture(scope="module")
def movie(tmp_path_factory):
    directory = tmp_path_factory.mktemp("movie")
    record = made_record(directory)
    path = directory / "movie.usdc"
    write_movie(record, path)
    assert sorted(p.name for p in directory.iterdir()) == ["movie.usdc", "run.h5"]
    return record, Usd.Stage.Open(str(path))


def faults(stage) -> list[str]:
    """What the validators that come with USD and the project's own checks find."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    findings = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{finding.GetName()}: {finding.GetMessage()}" for finding in findings] + problems(stage)


def at(stage, path):
    prim = stage.GetPrimAtPath(path)
    assert prim, path
    return prim


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
    stage = movie_stage(record, Shot(slow_down=1000.0, frames_per_second=24.0))
    assert stage.GetTimeCodesPerSecond() == pytest.approx(20.0)  # 1 ms of the cell, 20 frames, in 1 s
    assert stage.GetFramesPerSecond() == 24.0
    assert stage.GetRootLayer().customLayerData["warpflag"]["slowDown"] == pytest.approx(1000.0)
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


def assert_camera_sees_all(record, stage, frame_by_frame=False):
    nodes = np.asarray(record.positions)
    x, y, z, w = record.body_orientation.T
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=-1)
    balls = record.body_position[:, None] + 0.85 * axis[:, None] * np.array([[-1.0], [1.0]])
    surface = balls[:, :, None] + 0.4 * np.vstack([np.eye(3), -np.eye(3)])
    shown = np.concatenate([nodes, surface.reshape(len(nodes), -1, 3)], axis=1)
    picture = []
    for frame in range(len(nodes)):
        camera = UsdGeom.Camera(at(stage, "/World/Camera")).GetCamera(frame)
        project = camera.frustum.ComputeViewMatrix() * camera.frustum.ComputeProjectionMatrix()
        picture.append([project.Transform(Gf.Vec3d(*map(float, p))) for p in shown[frame]])
    picture = np.array(picture)
    assert np.abs(picture).max() < 1.0
    # And they fill it: the scene is neither a dot nor off to one side.
    low, high = picture[..., :2].min(axis=(0, 1)), picture[..., :2].max(axis=(0, 1))
    assert (high - low).max() > 1.8
    np.testing.assert_allclose(high + low, 0.0, atol=0.15)


def test_camera_frames_the_whole_path(movie):
    record, stage = movie
    assert_camera_sees_all(record, stage)
    assert UsdGeom.Xformable(at(stage, "/World/Camera")).GetTimeSamples() == []


def test_camera_follows_the_cell(tmp_path):
    record = made_record(tmp_path, 60, speed=1.0)
    stage = movie_stage(record, Shot(follow=True))
    assert_camera_sees_all(record, stage)
    camera = UsdGeom.Xformable(at(stage, "/World/Camera"))
    places = np.array([camera.ComputeLocalToWorldTransform(f).ExtractTranslation() for f in range(60)])
    # It goes at the cell's pace and leaves out its wobble.
    np.testing.assert_allclose(np.diff(places, axis=0)[:, 2], -1.0, atol=1e-9)
    assert np.ptp(places[8:-8, 0]) < 0.2 * np.ptp(record.body_position[:, 0])
    # So it may be much nearer than one that holds 60 um in view.
    fixed = movie_stage(record)
    distances = [UsdGeom.Camera(at(s, "/World/Camera")).GetFocusDistanceAttr().Get() for s in (stage, fixed)]
    assert distances[0] < 0.5 * distances[1]


def test_a_straight_path_is_steady_already():
    line = np.outer(np.arange(50.0), [1.0, -2.0, 0.5])
    np.testing.assert_allclose(steady_path(line), line, atol=1e-12)
    np.testing.assert_array_equal(steady_path(line[:3]), line[:3])
    wobbling = line + 0.1 * np.random.default_rng(0).standard_normal(line.shape)
    assert np.std(steady_path(wobbling) - line) < 0.6 * np.std(wobbling - line)


def test_cell_swims_to_the_left_of_the_picture(movie):
    record, stage = movie
    view = UsdGeom.Camera(at(stage, "/World/Camera")).GetCamera(0).frustum.ComputeViewMatrix()
    first, last = (view.Transform(Gf.Vec3d(*map(float, record.body_position[i]))) for i in (0, -1))
    assert last[0] < first[0] - 2.0
    assert abs(last[1] - first[1]) < 1.0


def test_there_is_light_from_the_camera_s_side(movie):
    _, stage = movie
    assert at(stage, "/World/Lights/Dome").IsA(UsdLux.DomeLight)
    key = UsdGeom.Xformable(at(stage, "/World/Lights/Key"))
    assert key.GetPrim().IsA(UsdLux.DistantLight)
    shines = key.ComputeLocalToWorldTransform(0).TransformDir(Gf.Vec3d(0, 0, -1))
    camera = UsdGeom.Camera(at(stage, "/World/Camera"))
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


@pytest.mark.parametrize("count", [1, 9])
def test_any_number_of_flagella(tmp_path, count):
    record = made_record(tmp_path, 3, scene=with_values(Scene(name="n"), {"flagella.count": count}))
    for color_by in QUANTITIES:
        assert faults(movie_stage(record, Shot(color_by=color_by))) == []


def test_several_cells_stand_side_by_side(tmp_path):
    two = with_values(Scene(name="two"), {"flagella.length": 4.0})
    records = [
        made_record(tmp_path / "a", 12),
        made_record(tmp_path / "b", 5, scene=two),
        made_record(tmp_path / "c", 12),
    ]
    stage = movie_stage(records)
    assert faults(stage) == []
    assert stage.GetEndTimeCode() == 11.0
    boxes = []
    for k, record in enumerate(records):
        curves = UsdGeom.BasisCurves(at(stage, f"/World/Cell_{k}/Flagella"))
        np.testing.assert_array_equal(curves.GetPointsAttr().Get(4), record.positions[4].astype(np.float32))
        view = UsdGeom.Camera(at(stage, "/World/Camera")).GetCamera(0).frustum.ComputeViewMatrix()
        place = curves.ComputeLocalToWorldTransform(0) * view
        seen = np.array([place.Transform(Gf.Vec3d(*p)) for p in np.asarray(record.positions).reshape(-1, 3).tolist()])
        boxes.append((seen.min(axis=0)[:2], seen.max(axis=0)[:2]))
    for a, b in ((0, 1), (0, 2), (1, 2)):
        apart = np.maximum(boxes[a][0] - boxes[b][1], boxes[b][0] - boxes[a][1])
        assert apart.max() > 0.0, (a, b)
    # The shorter record stays at its last frame.
    last = UsdGeom.BasisCurves(at(stage, "/World/Cell_1/Flagella")).GetPointsAttr()
    np.testing.assert_array_equal(last.Get(11), last.Get(4))


def test_value_clips_play_as_one_file_does(tmp_path, monkeypatch):
    record = made_record(tmp_path / "run", 12)
    path, shot = tmp_path / "movie.usdc", Shot(color_by="curvature")
    whole = movie_stage(record, shot)
    monkeypatch.setattr(usd, "_CLIP_BYTES", 5 * 28 * FIRST_NODE[-1])  # what outgrows this is divided
    for _ in range(2):  # the second time over the first one's files
        write_movie(record, path, shot)
    clips = sorted(tmp_path.glob("movie.usdc.clips/*.usdc"))
    assert len(clips) == 4 and "manifest" in clips[-1].name  # 5 + 5 + 2 frames
    stage = Usd.Stage.Open(str(path))
    assert problems(stage) == []
    for prim in whole.Traverse():
        for attribute in prim.GetAttributes():
            other = stage.GetAttributeAtPath(attribute.GetPath())
            for code in (0, 4, 4.5, 5, 8.25, 9.5, 11):
                expected = attribute.Get(code)
                assert expected == other.Get(code), (attribute.GetPath(), code)
    clips[1].rename(tmp_path / "taken.usdc")
    assert any(clips[1].name in line for line in problems(Usd.Stage.Open(str(path))))
    # Written whole again, nothing is left of them.
    monkeypatch.undo()
    write_movie(record, path, shot)
    assert not (tmp_path / "movie.usdc.clips").exists()


def test_packed_and_text_files(tmp_path):
    record = made_record(tmp_path / "run", 3)
    for name in ("movie.usdz", "movie.usda"):
        write_movie(record, tmp_path / name)
        stage = Usd.Stage.Open(str(tmp_path / name))
        assert faults(stage) == []
        points = UsdGeom.BasisCurves(at(stage, "/World/Cell/Flagella")).GetPointsAttr().Get(2)
        np.testing.assert_array_equal(points, record.positions[2].astype(np.float32))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["movie.usda", "movie.usdz", "run"]


def test_what_can_t_be_filmed_is_told(tmp_path):
    record = made_record(tmp_path, 2)
    with pytest.raises(OutputError, match=r"must end in \.usdc"):
        write_movie(record, tmp_path / "movie.mp4")
    for wrong in ({"color_by": "mood"}, {"slow_down": 0.0}, {"frames_per_second": np.inf}, {"clip_frames": -1}):
        with pytest.raises(OutputError):
            Shot(**wrong)
    empty = Recorder(tmp_path / "run.h5", resume_step=-1)
    empty.start(dumps(THREE), FIRST_NODE, filament_radius=0.01, body_length=2.5, body_width=0.8)
    empty.close()
    with pytest.raises(RecordError, match="no frames"):
        write_movie(record, tmp_path / "movie.usdc")
    assert os.listdir(tmp_path) == ["run.h5"]


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
