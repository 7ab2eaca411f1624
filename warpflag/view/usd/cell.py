"""One cell of a movie: body, flagella, motors and materials as USD prims, and their samples frame by frame.

CELL                component; custom attribute warpflag:time [s], time-sampled
CELL/Body           Capsule along its z axis, in the body's pose
CELL/Flagella       BasisCurves through every node, one curve each, coloured at the nodes
CELL/Motors         in the body's pose, with a Motor_K per flagellum
CELL/Motors/Motor_K three spokes along e1, e2 and m of the motor tripod, turned about m by the motor angle
CELL/Looks          materials: UsdPreviewSurface with the display colour

`warpflag.view.usd.mesh_cell` has the same cell as meshes.
"""

# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# (pxr comes without type stubs)

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.record import Record
from warpflag.scene import Scene
from warpflag.view.coloring import BODY_COLOR, Coloring, linear
from warpflag.view.poses import body_axes, motors
from warpflag.view.usd.camera import Extent
from warpflag.view.usd.looks import bind_material

__all__ = ["SPOKE_COLORS", "SPOKE_LENGTHS", "SPOKE_WIDTH", "UNDEFINED", "Cell", "Sample"]

UNDEFINED = -1.0
"""Raw value of a node at which a quantity is not defined: in a USD file a NaN is a fault."""
SPOKE_LENGTHS = (0.28, 0.2, 0.2)
"""Of a motor's spokes along e1, e2 and m [um]; the long one shows the turning."""
SPOKE_WIDTH = 0.07
"""Of a motor's spokes [um]."""
SPOKE_COLORS = ("#f2b01e", "#39424e", "#5c6875")
"""Of a motor's spokes, sRGB."""

Sample = tuple[Any, int, Any]
"""Path of an attribute, frame, and its value there."""


class Cell:
    """The prims of a record's cell on a stage.

    Args:
        stage: where they are defined.
        path: of the cell's prim.
        record: the run.
        scene: of the record.
        color_by: quantity that colours the flagella.

    Attributes:
        xform: the cell as a prim that can be placed.
        prim: the same as a bare prim.
        coloring: of the nodes.
        animated: value type by path of the attributes that `samples` fills.
    """

    def __init__(self, stage: Any, path: str, record: Record, scene: Scene, color_by: str):
        from pxr import Sdf, Usd, UsdGeom

        self._stage, self._path, self._record, self._scene = stage, path, record, scene
        self.coloring = Coloring(color_by, record, scene)
        # A few numbers per frame, read once; the nodes are read block by block.
        self._times, self._motor_angles = record.times, record.motor_angle
        self._positions, self._orientations = record.body_position, record.body_orientation
        self.animated: dict[Any, Any] = {}
        self.xform = UsdGeom.Xform.Define(stage, path)
        self.prim = self.xform.GetPrim()
        Usd.ModelAPI(self.prim).SetKind("component")
        self.prim.SetCustomData({"warpflag": {"scene": scene.name, "sceneSha256": record.scene_sha256}})
        time = self.prim.CreateAttribute("warpflag:time", Sdf.ValueTypeNames.Double, custom=True)
        time.SetDocumentation("Simulated time [s].")
        self._time = self._animate(time)
        UsdGeom.Scope.Define(stage, f"{path}/Looks")
        radius, height = 0.5 * record.body_width, record.body_length - record.body_width
        body = self._add_body(f"{path}/Body", radius, height)
        self._poses = [self._add_pose(body), self._add_pose(UsdGeom.Xform.Define(stage, f"{path}/Motors"))]
        self._turns = self._add_motors()
        self._add_flagella(f"{path}/Flagella")

    def samples(self, frames: slice, extent: Extent) -> Iterator[Sample]:
        """Samples of everything that changes, for a block of frames; `extent` grows by what they show."""
        from pxr import Gf

        positions = self._record.positions[frames]
        turned = np.degrees(self._motor_angles[frames])
        values = self.coloring.values(positions, frames) if self.coloring.changes else None
        extent.add(frames, positions, self._radius)
        extent.add(frames, self._body_ends(frames), 0.5 * self._record.body_width)
        for i, frame in enumerate(range(frames.start, frames.stop)):
            yield self._time, frame, float(self._times[frame])
            x, y, z, w = self._orientations[frame].tolist()
            for translate, orient in self._poses:
                yield translate, frame, Gf.Vec3d(*self._positions[frame].tolist())
                yield orient, frame, Gf.Quatd(w, x, y, z)
            for turn, angle in zip(self._turns, turned[i, : len(self._turns)].tolist(), strict=True):
                yield turn, frame, angle
        yield from self._flagella_samples(frames, positions, values)

    @property
    def _radius(self) -> float:
        """Of the flagella as they are shown [um]."""
        return self._record.filament_radius

    def _flagella_samples(self, frames: slice, positions: Any, values: Any) -> Iterator[Sample]:
        """Samples of the flagella; values are those of the quantity that colours them, None where none changes."""
        from pxr import Vt

        points, colors, raw = positions.astype(np.float32), None, None
        if values is not None:
            colors, raw = self.coloring.colors(values), np.nan_to_num(values, nan=UNDEFINED).astype(np.float32)
        radius = np.float32(self._radius)
        low, high = points.min(axis=1) - radius, points.max(axis=1) + radius
        for i, frame in enumerate(range(frames.start, frames.stop)):
            yield self._points, frame, Vt.Vec3fArray.FromNumpy(points[i])
            yield self._extent, frame, Vt.Vec3fArray.FromNumpy(np.stack([low[i], high[i]]))
            if colors is not None and raw is not None:
                yield self._colors, frame, Vt.Vec3fArray.FromNumpy(colors[i])
                yield self._raw, frame, Vt.FloatArray.FromNumpy(raw[i])

    def _body_ends(self, frames: slice) -> NDArray[np.float64]:
        """Middles of the body's round ends [um], shape [frame, 2, 3]."""
        half = 0.5 * (self._record.body_length - self._record.body_width)
        axes = np.stack([body_axes(orientation)[2] for orientation in self._orientations[frames]])
        return self._positions[frames][:, None] + half * axes[:, None] * np.array([[-1.0], [1.0]])

    def _animate(self, attribute: Any) -> Any:
        """Notes an attribute as one that changes; returns its path."""
        self.animated[attribute.GetPath()] = attribute.GetTypeName()
        return attribute.GetPath()

    def _add_pose(self, prim: Any) -> tuple[Any, Any]:
        from pxr import UsdGeom

        translate = prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
        orient = prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
        return self._animate(translate.GetAttr()), self._animate(orient.GetAttr())

    def _add_body(self, path: str, radius: float, height: float) -> Any:
        from pxr import Gf, UsdGeom

        body = UsdGeom.Capsule.Define(self._stage, path)
        body.CreateAxisAttr(UsdGeom.Tokens.z)
        body.CreateRadiusAttr(radius)
        body.CreateHeightAttr(height)
        corner = Gf.Vec3f(radius, radius, 0.5 * height + radius)
        body.CreateExtentAttr([-corner, corner])
        body.CreateDisplayColorAttr([Gf.Vec3f(*linear(BODY_COLOR).tolist())])
        self._bind(body.GetPrim(), "BodyMaterial", roughness=0.6)
        return body

    def _add_flagella(self, path: str) -> None:
        from pxr import Sdf, UsdGeom, Vt

        coloring = self.coloring
        curves = UsdGeom.BasisCurves.Define(self._stage, path)
        curves.CreateTypeAttr(UsdGeom.Tokens.cubic)
        curves.CreateBasisAttr(UsdGeom.Tokens.catmullRom)
        curves.CreateWrapAttr(UsdGeom.Tokens.pinned)
        curves.CreateCurveVertexCountsAttr(Vt.IntArray.FromNumpy(np.diff(self._record.first_node).astype(np.int32)))
        curves.CreateWidthsAttr([2.0 * self._radius])
        curves.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        colors = curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).GetAttr()
        raw = UsdGeom.PrimvarsAPI(curves).CreatePrimvar(
            coloring.primvar, Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex
        )
        self._bind(curves.GetPrim(), "FlagellaMaterial", roughness=0.4)
        self._points, self._extent = (self._animate(a) for a in (curves.CreatePointsAttr(), curves.CreateExtentAttr()))
        if coloring.changes:
            self._colors, self._raw = self._animate(colors), self._animate(raw.GetAttr())
        else:
            values = coloring.values(np.empty((0, 0, 0)), slice(0, 0))[0]
            colors.Set(Vt.Vec3fArray.FromNumpy(coloring.colors(values)))
            raw.Set(Vt.FloatArray.FromNumpy(values.astype(np.float32)))

    def _add_motors(self) -> list[Any]:
        """Adds a motor per flagellum, its tripod at angle 0 set into the body; returns where the angles go."""
        from pxr import Gf, UsdGeom

        turns = []
        for k, (anchor, axes) in enumerate(zip(*motors(self._record, self._scene), strict=True)):
            tripod = Gf.Matrix3d(*axes.ravel().tolist())
            motor = self._add_spokes(f"{self._path}/Motors/Motor_{k}")
            motor.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*anchor.tolist()))
            motor.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(
                tripod.GetOrthonormalized().ExtractRotation().GetQuat()
            )
            turns.append(self._animate(motor.AddRotateZOp(UsdGeom.XformOp.PrecisionDouble).GetAttr()))
        return turns

    def _add_spokes(self, path: str) -> Any:
        from pxr import UsdGeom, Vt

        motor = UsdGeom.BasisCurves.Define(self._stage, path)
        points = np.zeros((6, 3), dtype=np.float32)
        points[1::2] = np.diag(SPOKE_LENGTHS)
        motor.CreateTypeAttr(UsdGeom.Tokens.linear)
        motor.CreateCurveVertexCountsAttr([2, 2, 2])
        motor.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        motor.CreateWidthsAttr([SPOKE_WIDTH])
        motor.SetWidthsInterpolation(UsdGeom.Tokens.constant)
        half = 0.5 * SPOKE_WIDTH
        extent = np.array([[-half] * 3, np.add(SPOKE_LENGTHS, half)], dtype=np.float32)
        motor.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
        colors = np.stack([linear(color) for color in SPOKE_COLORS])
        motor.CreateDisplayColorPrimvar(UsdGeom.Tokens.uniform).Set(Vt.Vec3fArray.FromNumpy(colors))
        self._bind(motor.GetPrim(), "FlagellaMaterial", roughness=0.4)
        return motor

    def _bind(self, prim: Any, name: str, roughness: float, color: str | None = None) -> None:
        bind_material(prim, f"{self._path}/Looks/{name}", roughness, color)
