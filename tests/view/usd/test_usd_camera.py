"""The camera of a movie holds the cells in view or goes with them, and light comes from its side."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdLux  # noqa: TID253 (no command line starts here)

from tests.films import made_record
from tests.view.usd.stages import at, faults
from warpflag.scene import paper_scene, with_values
from warpflag.view.usd import Shot, movie_stage, write_movie
from warpflag.view.usd.camera import Extent, add_camera, steady_path, view_axes


@pytest.fixture(scope="module")
def movie(tmp_path_factory):
    record = made_record(tmp_path_factory.mktemp("movie"))
    return record, movie_stage(record)


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


@pytest.mark.parametrize("toward, away", [(1.0, 1.0), (0.5, 90.0), (3.0, 0.1)])
def test_all_that_lies_before_the_camera_is_within_its_clipping_range(toward, away):
    """However deep the scene is; seen from where a breadth and a height of 10 um just fit in."""
    stage = Usd.Stage.CreateInMemory()
    add_camera(stage, np.eye(3), np.array([5.0, 5.0, 5.0, 5.0, toward, away]))
    camera = UsdGeom.Camera(at(stage, "/World/Camera"))
    distance = camera.GetCamera().transform.ExtractTranslation()[2]
    near, far = camera.GetClippingRangeAttr().Get()
    assert 0.0 < near < distance - toward and far > distance + away


def test_spheres_reach_as_far_as_their_surfaces():
    """Seen at half the angle of view, the edge of a sphere is beyond the one that faces that side."""
    directions = np.random.default_rng(1).standard_normal((1, 20000, 3))
    surface = directions / np.linalg.norm(directions, axis=2, keepdims=True)
    view = view_axes(np.array([0.0, 0.0, 0.0, 1.0]))
    ball, points = (Extent(view, np.zeros((1, 3))) for _ in range(2))
    ball.add(slice(0, 1), np.zeros((1, 1, 3)), 1.0)
    points.add(slice(0, 1), surface, 0.0)
    np.testing.assert_allclose(points.reach, ball.reach, rtol=2e-3)


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


def test_a_cell_whose_record_ends_earlier_stays_where_it_is(tmp_path):
    """The camera follows the mean of both, at half the pace from then on."""
    records = [made_record(tmp_path / str(count), count, speed=1.0, offset=(0.0, 0.0, 5.0)) for count in (24, 12)]
    stage = movie_stage(records, Shot(follow=True))
    camera = UsdGeom.Xformable(at(stage, "/World/Camera"))
    places = np.array([camera.ComputeLocalToWorldTransform(f).ExtractTranslation() for f in range(24)])
    np.testing.assert_allclose(np.diff(places[:, 2]), [-1.0] * 11 + [-0.5] * 12, atol=1e-9)


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


def test_several_cells_stand_side_by_side(tmp_path):
    two = with_values(paper_scene(name="two"), {"flagella.length": 4.0})
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
