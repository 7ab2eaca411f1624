"""What surrounds the cells of a movie: where the camera stands, and the lights."""

# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# (pxr comes without type stubs)

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.view.poses import body_axes

__all__ = ["Extent", "add_camera", "add_lights", "arranged", "steady_path", "view_axes"]

Array = NDArray[np.float64]

_FOCAL_LENGTH = 60.0  # in tenths of a scene unit as the apertures; only their ratio counts
_ASPECT = 16 / 9  # width over height of a picture: that of screens and films
_TANGENTS = np.array([0.3, 0.3 / _ASPECT])  # of half the angles of view across and up
_FRAMING_MARGIN = 1.06  # distance of the camera over that at which all just fits in: 3 % free on each side
# Weights of (x, y, z) in the reach to right, left, up, down, front and back, see `Extent`.
_SIDES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
_SIDES[:4, 2] = np.repeat(_TANGENTS, 2)
_ELEVATION = np.radians(12.0)  # the camera looks down a little, so that coils read as coils


def view_axes(orientation: Array) -> Array:
    """The camera's right, up and back axes as rows, shape [3, 3].

    e_b3 points to the right, so the cell swims to the left; flagella at azimuth 0 and 180 open up and down, seen
    from 12 degrees above e_b2.

    Args:
        orientation: of the body, quaternion (x, y, z, w) from body to lab axes.
    """
    e1, _, e3 = body_axes(orientation)
    e2 = np.cross(e3, e1)
    sine, cosine = np.sin(_ELEVATION), np.cos(_ELEVATION)
    return np.stack([e3, cosine * e1 - sine * e2, cosine * e2 + sine * e1])


def steady_path(centres: Array) -> Array:
    """The moving average of a path over a quarter of its frames, which takes the wobble out, shape [frame, 3].

    Both ends are continued by their mirror image through the end point, which keeps a straight path as it is.

    Args:
        centres: points of the path [um], shape [frame, 3].
    """
    centres = np.asarray(centres, float)
    half = len(centres) // 8
    if half == 0:
        return centres
    before = 2.0 * centres[0] - centres[half:0:-1]
    after = 2.0 * centres[-1] - centres[-2 : -half - 2 : -1]
    sums = np.cumsum(np.concatenate([np.zeros((1, 3)), before, centres, after]), axis=0)
    return (sums[2 * half + 1 :] - sums[: -2 * half - 1]) / (2 * half + 1)


class Extent:
    """How far everything a cell shows reaches toward the four sides of the picture, the camera and away from it.

    Args:
        view: the camera's axes as rows, shape [3, 3].
        path: the camera's aim in lab axes [um], shape [frame, 3].

    Attributes:
        reach: relative to the path [um], shape [6]. For right, left, up, down: the greatest x + t z, x to that side, z
            toward the camera, t the tangent of half the angle of view; a camera at (ex, ey, ez) has everything in view
            when x + t z <= ex + t ez and so on. Then the greatest z and -z.
    """

    def __init__(self, view: Array, path: Array):
        self._view, self._path = view, path
        self.reach = np.full(6, -np.inf)

    def add(self, frames: slice, positions: Array, margin: float) -> None:
        """Extends the reach so that it holds spheres.

        Args:
            frames: in which they are seen.
            positions: their centres [um], shape [frame, point, 3].
            margin: their radius [um].
        """
        points = (positions - self._path[frames, None]).reshape(-1, 3)
        # Coordinate first: NumPy's reductions are quick along rows.
        reach = (_SIDES @ self._view @ points.T).max(axis=1) + margin * np.linalg.norm(_SIDES, axis=1)
        self.reach = np.maximum(self.reach, reach)


def arranged(reaches: Sequence[Array]) -> tuple[Array, Array]:
    """Where cells stand so that their rows fill a picture; a single cell stays where it is.

    Args:
        reaches: of each cell's `Extent`.

    Returns:
        Shifts in the camera's axes [um], shape [cell, 3], and the reach of all shifted cells, shape [6].
    """
    count = len(reaches)
    if count == 1:
        return np.zeros((1, 3)), reaches[0]
    right, left, up, down, *_ = sides = np.stack(reaches, axis=1)
    middles = np.stack([right - left, up - down, np.zeros(count)], axis=1) / 2
    width, height = 1.05 * (right + left).max(), 1.05 * (up + down).max()
    columns = min(range(1, count + 1), key=lambda n: max(n * width, -(-count // n) * height * _ASPECT))
    row, column = np.divmod(np.arange(count), columns)
    shifts = np.stack([column * width, -row * height, np.zeros(count)], axis=1) - middles
    return shifts, (sides + _SIDES @ shifts.T).max(axis=1)


def add_camera(stage: Any, view: Array, reach: Array, path: Array | None = None) -> None:
    """Adds a camera at /World/Camera, as near as it has everything in view.

    Its picture is 16:9, or narrower where what it shows is.

    Args:
        stage: where it is defined.
        view: its axes as rows, shape [3, 3].
        reach: of everything it shows, see `Extent`.
        path: where its aim goes in lab axes [um], shape [frame, 3]; None for a camera that stands still.
    """
    from pxr import Gf, UsdGeom

    right, left, up, down, toward, away = reach
    distances = 0.5 * np.array([right + left, up + down]) / _TANGENTS
    distance = distances.max()
    place = np.array([0.5 * (right - left), 0.5 * (up - down), distance])
    # Seen from farther than one direction needs, everything takes no more than this share of that direction.
    share = np.maximum((distances + away) / (distance + away), 9 / 16)
    width, height = 2.0 * _FOCAL_LENGTH * _TANGENTS * _FRAMING_MARGIN * share
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.CreateFocalLengthAttr(_FOCAL_LENGTH)
    camera.CreateHorizontalApertureAttr(width)
    camera.CreateVerticalApertureAttr(height)
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.5 * (distance - toward), 2.0 * (distance + away)))
    camera.CreateFocusDistanceAttr(distance - 0.5 * (toward - away))
    transform = camera.AddTransformOp()
    if path is None:
        transform.Set(_placed(view, place @ view))
    else:
        for frame, aim in enumerate(path):
            transform.Set(_placed(view, place @ view + aim), frame)


def add_lights(stage: Any, view: Array) -> None:
    """Adds soft light from everywhere and a broad key light over the camera's left shoulder.

    Args:
        stage: where they are defined.
        view: the camera's axes as rows, shape [3, 3].
    """
    from pxr import Gf, UsdGeom, UsdLux

    lights = UsdGeom.Xform.Define(stage, "/World/Lights")
    lights.AddTransformOp().Set(_placed(view, np.zeros(3)))
    UsdLux.DomeLight.Define(stage, "/World/Lights/Dome").CreateIntensityAttr(0.5)
    key = UsdLux.DistantLight.Define(stage, "/World/Lights/Key")
    key.CreateIntensityAttr(2.0)
    key.CreateAngleAttr(12.0)
    key.AddRotateXYZOp().Set(Gf.Vec3f(-38.0, -28.0, 0.0))


def _placed(axes: Array, origin: Array) -> Any:
    """USD's matrix, for row vectors, of a frame with these axes as rows at this origin."""
    from pxr import Gf

    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = axes, origin
    return Gf.Matrix4d(matrix.tolist())
