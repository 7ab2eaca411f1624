"""The movie of a record, movie.usdc: one curve set for all flagella, a capsule for the body, camera and
lights.

Units and time: 1 scene unit is 1 um (metersPerUnit 1e-6), z is up, time code = frame index. Played at its 50
frames per second, the film is slower than the cell by the factor in customLayerData; the simulated time is a
custom attribute of the cell.

    /World                       assembly /World/Cell                  component; custom attribute
    warpflag:time [s], time-sampled /World/Cell/Body             Capsule along its z axis, translated and
    oriented per frame /World/Cell/Flagella         BasisCurves (catmullRom, pinned: they pass through every
    node), points per frame /World/Cell/Looks            materials: UsdPreviewSurface with the display colour
    /World/Camera, /World/Lights the camera holds the whole path in view

The points have the order of the record's nodes.
"""

# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# (pxr comes without type stubs)

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.record import Record, RecordError

__all__ = ["FRAMES_PER_SECOND", "write_movie"]

FRAMES_PER_SECOND = 50.0

_BODY_COLOR = (0.72, 0.74, 0.70)
# Okabe & Ito's colours, told apart by colour-blind eyes too; repeated beyond eight flagella.
_FLAGELLUM_COLORS = (
    (0.84, 0.37, 0.00),
    (0.00, 0.45, 0.70),
    (0.00, 0.62, 0.45),
    (0.80, 0.47, 0.65),
    (0.90, 0.62, 0.00),
    (0.34, 0.71, 0.91),
    (0.94, 0.89, 0.26),
    (0.45, 0.45, 0.45),
)
_APERTURE = (36.0, 20.25)  # 16:9, in tenths of a scene unit as the focal length; only their ratio counts
_FOCAL_LENGTH = 50.0
_FRAMING_MARGIN = 1.1


def write_movie(record: Record, path: str | Path) -> None:
    """Writes the movie of a record under a temporary name and renames it: `path` (ending .usdc) is whole or
    absent.

    Raises RecordError for a record without frames, OSError where the file can't be written.
    """
    from pxr import Sdf, Usd, UsdGeom

    path = Path(path)
    if record.frame_count == 0:
        raise RecordError(f"{record.path}: holds no frames to make a movie of")
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.micrometers)
    stage.SetTimeCodesPerSecond(FRAMES_PER_SECOND)
    stage.SetFramesPerSecond(FRAMES_PER_SECOND)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(record.frame_count - 1)
    world = UsdGeom.Xform.Define(stage, "/World")
    stage.SetDefaultPrim(world.GetPrim())
    Usd.ModelAPI(world).SetKind("assembly")
    cell = UsdGeom.Xform.Define(stage, "/World/Cell")
    Usd.ModelAPI(cell).SetKind("component")
    time = cell.GetPrim().CreateAttribute("warpflag:time", Sdf.ValueTypeNames.Double, custom=True)
    time.SetDocumentation("Simulated time [s].")
    for frame, value in enumerate(record.times):
        time.Set(float(value), frame)

    _add_body(stage, record)
    view = _view_axes(record)
    bounds = _add_flagella(stage, record, view)
    _add_camera(stage, view, bounds)
    _add_lights(stage, view)
    stage.GetRootLayer().customLayerData = {"warpflag": _provenance(record)}

    temporary = path.with_name(f".{path.stem}.tmp.usdc")
    if not stage.GetRootLayer().Export(str(temporary)):
        raise OSError(f"{path}: the movie could not be written")
    os.replace(temporary, path)


def _provenance(record: Record) -> dict[str, Any]:
    """What the file says of its origin; the slow-down is that of the mean frame interval, 0 for a single
    frame."""
    times = record.times
    interval = float(times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 0.0
    return {
        "version": record.versions.get("warpflag", "unknown"),
        "sceneSha256": record.scene_sha256,
        "frameInterval": interval,
        "slowDown": 1.0 / (FRAMES_PER_SECOND * interval) if interval > 0.0 else 0.0,
    }


def _add_body(stage: Any, record: Record) -> None:
    from pxr import Gf, UsdGeom

    radius, height = 0.5 * record.body_width, record.body_length - record.body_width
    body = UsdGeom.Capsule.Define(stage, "/World/Cell/Body")
    body.CreateAxisAttr(UsdGeom.Tokens.z)
    body.CreateRadiusAttr(radius)
    body.CreateHeightAttr(height)
    corner = Gf.Vec3f(radius, radius, 0.5 * height + radius)
    body.CreateExtentAttr([-corner, corner])
    translate = body.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    orient = body.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
    poses = zip(record.body_position, record.body_orientation, strict=True)
    for frame, (position, (x, y, z, w)) in enumerate(poses):
        translate.Set(Gf.Vec3d(*map(float, position)), frame)
        orient.Set(Gf.Quatd(float(w), float(x), float(y), float(z)), frame)
    body.CreateDisplayColorAttr([Gf.Vec3f(*_BODY_COLOR)])
    _bind_material(stage, body.GetPrim(), "BodyMaterial", roughness=0.6)


def _add_flagella(stage: Any, record: Record, view: NDArray[np.float64]) -> NDArray[np.float64]:
    """The curves of all flagella. Returns the bounds of the whole path in the camera's axes, shape [2, 3]."""
    from pxr import UsdGeom, Vt

    curves = UsdGeom.BasisCurves.Define(stage, "/World/Cell/Flagella")
    curves.CreateTypeAttr(UsdGeom.Tokens.cubic)
    curves.CreateBasisAttr(UsdGeom.Tokens.catmullRom)
    curves.CreateWrapAttr(UsdGeom.Tokens.pinned)
    counts = np.diff(record.first_node)
    curves.CreateCurveVertexCountsAttr(Vt.IntArray.FromNumpy(counts.astype(np.int32)))
    radius = record.filament_radius
    curves.CreateWidthsAttr([2.0 * radius])
    curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
    colors = np.array([_FLAGELLUM_COLORS[k % len(_FLAGELLUM_COLORS)] for k in range(len(counts))], np.float32)
    curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.uniform).Set(Vt.Vec3fArray.FromNumpy(colors))
    points_attribute, extent_attribute = curves.CreatePointsAttr(), curves.CreateExtentAttr()
    positions = record.positions
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for frame in range(record.frame_count):
        points = np.ascontiguousarray(positions[frame], dtype=np.float32)
        extent = np.stack([points.min(axis=0) - radius, points.max(axis=0) + radius]).astype(np.float32)
        points_attribute.Set(Vt.Vec3fArray.FromNumpy(points), frame)
        extent_attribute.Set(Vt.Vec3fArray.FromNumpy(extent), frame)
        in_view = points @ view.T
        low, high = np.minimum(low, in_view.min(axis=0)), np.maximum(high, in_view.max(axis=0))
    _bind_material(stage, curves.GetPrim(), "FlagellaMaterial", roughness=0.4)
    body = record.body_position @ view.T
    reach = 0.5 * record.body_length
    return np.stack([np.minimum(low, body.min(axis=0) - reach), np.maximum(high, body.max(axis=0) + reach)])


def _bind_material(stage: Any, prim: Any, name: str, roughness: float) -> None:
    """A plain surface that shows the prim's displayColor, whatever its interpolation."""
    from pxr import Sdf, UsdShade

    material = UsdShade.Material.Define(stage, f"/World/Cell/Looks/{name}")
    reader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Color"))
    reader.CreateIdAttr("UsdPrimvarReader_float3")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
    color = reader.CreateOutput("result", Sdf.ValueTypeNames.Float3)
    surface = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(color)
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(roughness)
    output = surface.CreateOutput("surface", Sdf.ValueTypeNames.Token)
    material.CreateSurfaceOutput().ConnectToSource(output)
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)


def _view_axes(record: Record) -> NDArray[np.float64]:
    """The camera's right, up and back axes as rows: e_b3, e_b1 and e_b2 of the first frame.

    So the cell lies across the picture and swims to the left, and flagella at azimuth 0 and 180 open in its
    plane.
    """
    x, y, z, w = record.body_orientation[0]
    e1 = (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y))
    e3 = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    return np.stack([e3, e1, np.cross(e3, e1)])


def _add_camera(stage: Any, view: NDArray[np.float64], bounds: NDArray[np.float64]) -> None:
    """A fixed camera that looks across the box of the whole path from far enough to see all of it."""
    from pxr import Gf, UsdGeom

    low, high = bounds
    half_width, half_height, depth = 0.5 * (high[0] - low[0]), 0.5 * (high[1] - low[1]), high[2] - low[2]
    distance = 2.0 * _FRAMING_MARGIN * _FOCAL_LENGTH * max(half_width / _APERTURE[0], half_height / _APERTURE[1])
    centre = 0.5 * (low + high)
    place = np.array([centre[0], centre[1], high[2] + distance]) @ view
    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    camera.CreateFocalLengthAttr(_FOCAL_LENGTH)
    camera.CreateHorizontalApertureAttr(_APERTURE[0])
    camera.CreateVerticalApertureAttr(_APERTURE[1])
    camera.CreateClippingRangeAttr(Gf.Vec2f(0.5 * distance, 2.0 * (distance + depth)))
    camera.CreateFocusDistanceAttr(distance + 0.5 * depth)
    camera.AddTransformOp().Set(_placed(view, place))


def _add_lights(stage: Any, view: NDArray[np.float64]) -> None:
    """Soft light from everywhere and a key light over the camera's left shoulder."""
    from pxr import Gf, UsdGeom, UsdLux

    lights = UsdGeom.Xform.Define(stage, "/World/Lights")
    lights.AddTransformOp().Set(_placed(view, np.zeros(3)))
    UsdLux.DomeLight.Define(stage, "/World/Lights/Dome").CreateIntensityAttr(0.5)
    key = UsdLux.DistantLight.Define(stage, "/World/Lights/Key")
    key.CreateIntensityAttr(2.0)
    key.CreateAngleAttr(2.0)
    key.AddRotateXYZOp().Set(Gf.Vec3f(-40.0, -35.0, 0.0))


def _placed(axes: NDArray[np.float64], origin: NDArray[np.float64]) -> Any:
    """USD's matrix (row vectors) of a frame with these axes as rows, at this origin."""
    from pxr import Gf

    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = axes, origin
    return Gf.Matrix4d(matrix.tolist())
