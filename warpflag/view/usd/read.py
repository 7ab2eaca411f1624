"""A movie read back for drawing: its curves and capsules as rods, its camera, light and times, at any time code."""

# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# (pxr comes without type stubs)

from __future__ import annotations

import contextlib
import functools
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.base.output import OutputError
from warpflag.view.usd.checksum import verify

__all__ = ["Camera", "Film", "Rods", "opened", "reading"]

Array = NDArray[np.float64]

_LONGEST_REASON = 160  # characters of what USD says of a damaged file: two lines of a terminal
_PIECES_PER_SPAN = 4  # straight pieces per span of a cubic curve
_T = np.linspace(0.0, 1.0, _PIECES_PER_SPAN + 1)[:, None]  # places along a span, its ends and between pieces
# Catmull-Rom weights of the four points about a span, at these places; a linear curve has one piece.
_CUBIC = 0.5 * np.hstack(
    [-_T + 2 * _T**2 - _T**3, 2 - 5 * _T**2 + 3 * _T**3, _T + 4 * _T**2 - 3 * _T**3, -(_T**2) + _T**3]
)
_LINEAR = np.array([[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])  # the same of a linear curve, its two ends


@dataclass(frozen=True)
class Rods:
    """Rods with round ends.

    Attributes:
        start: one end of each axis [um], shape [rod, 3].
        end: the other end [um], shape [rod, 3].
        radius: [um], shape [rod].
        color_start: linear RGB at the start, shape [rod, 3].
        color_end: linear RGB at the end, shape [rod, 3].
    """

    start: Array
    end: Array
    radius: Array
    color_start: Array
    color_end: Array


@dataclass(frozen=True)
class Camera:
    """Where a camera is and looks.

    Attributes:
        eye: its place [um], shape [3].
        right: unit vector to the right of its picture, shape [3].
        up: unit vector to the top of its picture, shape [3].
        back: unit vector against the direction in which it looks, shape [3].
        tangents: of half its angles of view across and up.
        focus: distance of the middle of the scene [um].
    """

    eye: Array
    right: Array
    up: Array
    back: Array
    tangents: tuple[float, float]
    focus: float


def opened(path: str | Path) -> Any:
    """The stage of a USD file.

    Raises:
        OutputError: it can't be read.
    """
    from pxr import Tf, Usd

    if Path(path).is_file():
        with contextlib.suppress(OSError):  # which USD finds as well
            verify(Path(path))
    try:
        return Usd.Stage.Open(str(path))
    except Tf.ErrorException:
        raise OutputError(f"{path}: not a readable USD file") from None


@contextlib.contextmanager
def reading(path: str | Path | None) -> Iterator[None]:
    """Turns what USD and NumPy raise over a damaged file, which is read as values are asked for, into an OutputError.

    Args:
        path: the file; None for a stage in memory, whose errors are those of the program.
    """
    try:
        yield
    except (OutputError, MemoryError):
        raise
    except Exception as error:
        if path is None:
            raise
        told = re.findall(r"' at line \d+ in file .*? : '(.*?)'\s*$", str(error), re.MULTILINE)
        line = " ".join((told[0] if told else str(error)).split())
        raise OutputError(f"{path}: is damaged: {line[:_LONGEST_REASON]}") from error


def _of_file(method: Callable[..., Any]) -> Any:
    """A method of a film that reads its file."""

    @functools.wraps(method)
    def read(film: Film, *values: Any) -> Any:
        with reading(film.path):
            return method(film, *values)

    return read


class Film:
    """The movie of a stage or of a .usd, .usda, .usdc or .usdz file.

    Args:
        source: the stage, or the path of the file.

    Attributes:
        path: of the file; None for a stage.
        start: first time code.
        end: last time code.
        codes_per_second: time codes per second of the film.
        frames_per_second: of the film.
        facts: the movie's own customLayerData: origin, slow-down, colours.

    Raises:
        OutputError: not readable, no movie of this program, or one of meshes; from every method: the file is damaged.
    """

    def __init__(self, source: Any):
        self.path = Path(source) if isinstance(source, str | Path) else None
        with reading(self.path):
            self._begin(source if self.path is None else opened(self.path))

    def _begin(self, stage: Any) -> None:
        from pxr import UsdGeom, UsdLux

        name = self.path or "the stage"
        prims = list(stage.Traverse())
        cameras, lights, cells = (
            [prim for prim in prims if belongs(prim)]
            for belongs in (
                lambda prim: prim.IsA(UsdGeom.Camera),
                lambda prim: prim.IsA(UsdLux.DistantLight),
                lambda prim: prim.HasAttribute("warpflag:time"),
            )
        )
        if not cameras or not lights or not cells:
            raise OutputError(f"{name}: no movie of warpflag, it lacks a camera, a light or the simulated time")
        self._stage, self._camera, self._light, self._cell = stage, cameras[0], lights[0], cells[0]
        self._curves = [UsdGeom.BasisCurves(prim) for prim in prims if prim.IsA(UsdGeom.BasisCurves)]
        self._capsules = [UsdGeom.Capsule(prim) for prim in prims if prim.IsA(UsdGeom.Capsule)]
        if not self._curves:
            raise OutputError(f"{name}: a movie of meshes, which is not drawn here; name the run directory")
        self.start, self.end = stage.GetStartTimeCode(), stage.GetEndTimeCode()
        samples = [cell.GetAttribute("warpflag:time").GetBracketingTimeSamples(np.finfo(float).max) for cell in cells]
        last = max(codes[-1] if codes else -np.inf for codes in samples)
        if not 0 <= self.start <= self.end <= last:
            raise OutputError(f"{name}: its time codes, {self.start:g} to {self.end:g}, are not those of its frames")
        self.codes_per_second, self.frames_per_second = stage.GetTimeCodesPerSecond(), stage.GetFramesPerSecond()
        self.facts: dict[str, Any] = dict(stage.GetRootLayer().customLayerData.get("warpflag", {}))

    @_of_file
    def time(self, code: float) -> float:
        """The simulated time at a time code [s]."""
        return self._cell.GetAttribute("warpflag:time").Get(code)

    @_of_file
    def code_at(self, time: float) -> float:
        """The time code of a simulated time [s], or of the nearest one that the movie has."""
        return float(np.interp(time, self._times, np.arange(self.start, self.end + 1)))

    @cached_property
    def _times(self) -> list[float]:
        return [self.time(code) for code in np.arange(self.start, self.end + 1)]

    @_of_file
    def thinnest(self) -> float:
        """The radius of the thinnest curves, which are the flagella [um]."""
        return min(0.5 * curves.GetWidthsAttr().Get()[0] for curves in self._curves)

    @_of_file
    def camera(self, code: float) -> Camera:
        """The camera at a time code."""
        from pxr import UsdGeom

        camera = UsdGeom.Camera(self._camera).GetCamera(code)
        right, up, back, eye = np.array(camera.transform)[:, :3]
        width, height = camera.horizontalAperture, camera.verticalAperture
        tangents = (0.5 * width / camera.focalLength, 0.5 * height / camera.focalLength)
        return Camera(eye, right, up, back, tangents, camera.focusDistance)

    @_of_file
    def light(self, code: float) -> tuple[Array, float]:
        """Unit vector toward the distant light, shape [3], and half the angle under which it is seen [rad]."""
        from pxr import UsdGeom, UsdLux

        toward = np.array(UsdGeom.Xformable(self._light).ComputeLocalToWorldTransform(code))[2, :3]
        angle = UsdLux.DistantLight(self._light).GetAngleAttr().Get(code)
        return toward / np.linalg.norm(toward), np.radians(0.5 * angle)

    @_of_file
    def rods(self, code: float, least_radius: float = 0.0) -> Rods:
        """Everything to draw at a time code.

        Args:
            code: the time code.
            least_radius: that curves have where they are thinner [um].
        """
        from pxr import UsdGeom

        placed = UsdGeom.XformCache(code)
        parts = [_curve_rods(curves, placed, code, least_radius) for curves in self._curves]
        parts += [_capsule_rod(capsule, placed, code) for capsule in self._capsules]
        return Rods(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _to_world(points: Array, prim: Any, placed: Any) -> Array:
    """Points of a prim in the axes of the stage, by a cache of transforms."""
    matrix = np.array(placed.GetLocalToWorldTransform(prim))
    return points @ matrix[:3, :3] + matrix[3, :3]


def _curve_rods(curves: Any, placed: Any, code: float, least_radius: float) -> tuple[Array, ...]:
    """Rods along linear or pinned Catmull-Rom curves, whose ends are continued by their mirror image."""
    points = _to_world(np.array(curves.GetPointsAttr().Get(code), float), curves.GetPrim(), placed)
    counts = np.array(curves.GetCurveVertexCountsAttr().Get(code))
    colors = _vertex_colors(curves, counts, code)
    is_last = np.zeros(len(points), dtype=bool)
    is_last[np.cumsum(counts) - 1] = True
    first = np.flatnonzero(~is_last)
    p1, p2 = points[first], points[first + 1]
    starts, ends = np.r_[True, is_last[:-1]][first][:, None], is_last[first + 1][:, None]
    p0 = np.where(starts, 2 * p1 - p2, points[first - 1])
    p3 = np.where(ends, 2 * p2 - p1, points[np.minimum(first + 2, len(points) - 1)])
    weights = _LINEAR if curves.GetTypeAttr().Get() == "linear" else _CUBIC
    knots = np.einsum("kw,wsx->skx", weights, np.stack([p0, p1, p2, p3]))
    share = np.linspace(0.0, 1.0, len(weights))[:, None]
    shades = (1 - share) * colors[first][:, None] + share * colors[first + 1][:, None]
    pieces = len(first) * (len(weights) - 1)
    radius = max(0.5 * curves.GetWidthsAttr().Get(code)[0], least_radius)
    ends = (knots[:, :-1], knots[:, 1:], np.full(pieces, radius), shades[:, :-1], shades[:, 1:])
    return tuple(a.reshape(pieces, 3) if a.ndim == 3 else a for a in ends)


def _vertex_colors(curves: Any, counts: NDArray[np.integer], code: float) -> Array:
    """Display colours at the vertices, whatever their interpolation, shape [vertex, 3]."""
    primvar = curves.GetDisplayColorPrimvar()
    colors = np.array(primvar.Get(code), float)
    if primvar.GetInterpolation() == "vertex":
        return colors
    return np.repeat(colors if primvar.GetInterpolation() == "uniform" else colors[[0] * len(counts)], counts, axis=0)


def _capsule_rod(capsule: Any, placed: Any, code: float) -> tuple[Array, ...]:
    """A capsule as one rod."""
    axis = np.eye(3)["XYZ".index(capsule.GetAxisAttr().Get(code))] * 0.5 * capsule.GetHeightAttr().Get(code)
    start, end = _to_world(np.stack([-axis, axis]), capsule.GetPrim(), placed)
    color = np.array(capsule.GetDisplayColorAttr().Get(code), float)
    return start[None], end[None], np.array([capsule.GetRadiusAttr().Get(code)]), color, color
