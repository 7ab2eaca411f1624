"""One cell of a movie as meshes, for programs that leave out curves, capsules or their colours, such as Blender.

CELL/Body                    Mesh of a capsule
CELL/Flagella/Flagellum_K    Mesh of a tube, as thick as in pictures
CELL/Motors/Motor_K/Spoke_I  Mesh of a tube
CELL/Looks                   materials in one colour each; where colours follow a quantity, in the display colour

The rest is as in `warpflag.view.usd.cell`.
"""

# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# (pxr comes without type stubs)

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.record import Record
from warpflag.scene import Scene
from warpflag.view.coloring import BODY_COLOR, DISPLAY_RADIUS, FLAGELLUM_COLORS, linear
from warpflag.view.usd.cell import SPOKE_COLORS, SPOKE_LENGTHS, SPOKE_WIDTH, UNDEFINED, Cell, Sample
from warpflag.view.usd.tubes import SIDES, capsule_points, faces, node_of_vertex, tube

__all__ = ["MeshCell"]

_BODY_SIDES = 32  # of the body's mesh: its outline is then within half a per cent of round


class MeshCell(Cell):
    """A cell whose body, flagella and motors are meshes; see `Cell`."""

    def __init__(self, stage: Any, path: str, record: Record, scene: Scene, color_by: str):
        self._nodes = [slice(first, end) for first, end in pairwise(record.first_node.tolist())]
        self._meshes: list[tuple[Any, ...]] = []
        super().__init__(stage, path, record, scene, color_by)

    @property
    def _radius(self) -> float:
        return max(DISPLAY_RADIUS, self._record.filament_radius)

    def _flagella_samples(self, frames: slice, positions: Any, values: Any) -> Iterator[Sample]:
        from pxr import Vt

        for nodes, (points, normals, extent, colors, raw) in zip(self._nodes, self._meshes, strict=True):
            vertices, directions = (each.astype(np.float32) for each in tube(positions[:, nodes], self._radius))
            low, high = vertices.min(axis=1), vertices.max(axis=1)
            nearest = node_of_vertex(nodes.stop - nodes.start)
            for i, frame in enumerate(range(frames.start, frames.stop)):
                yield points, frame, Vt.Vec3fArray.FromNumpy(vertices[i])
                yield normals, frame, Vt.Vec3fArray.FromNumpy(directions[i])
                yield extent, frame, Vt.Vec3fArray.FromNumpy(np.stack([low[i], high[i]]))
                if values is not None:
                    shown = values[i, nodes][nearest]
                    yield colors, frame, Vt.Vec3fArray.FromNumpy(self.coloring.colors(shown))
                    shown = np.nan_to_num(shown, nan=UNDEFINED).astype(np.float32)
                    yield raw, frame, Vt.FloatArray.FromNumpy(shown)

    def _add_body(self, path: str, radius: float, height: float) -> Any:
        body = self._mesh(path, _BODY_SIDES, *capsule_points(height, radius, sides=_BODY_SIDES))
        self._paint(body, BODY_COLOR)
        self._bind(body.GetPrim(), "BodyMaterial", 0.6, BODY_COLOR)
        return body

    def _add_flagella(self, path: str) -> None:
        from pxr import Sdf, UsdGeom

        UsdGeom.Scope.Define(self._stage, path)
        start = self._record.positions[0]
        for k, nodes in enumerate(self._nodes):
            vertices, normals = (each[0] for each in tube(start[None, nodes], self._radius))
            mesh = self._mesh(f"{path}/Flagellum_{k}", SIDES, vertices, normals)
            attributes = (mesh.GetPointsAttr(), mesh.GetNormalsAttr(), mesh.GetExtentAttr())
            for attribute in attributes:
                attribute.Clear()  # they change with the frame
            changing = [self._animate(attribute) for attribute in attributes]
            if self.coloring.changes:
                primvars = UsdGeom.PrimvarsAPI(mesh)
                raw = primvars.CreatePrimvar(
                    self.coloring.primvar, Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex
                )
                colors = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
                changing += [self._animate(each.GetAttr()) for each in (colors, raw)]
                self._bind(mesh.GetPrim(), "FlagellaMaterial", 0.4)
            else:
                color = k % len(FLAGELLUM_COLORS)
                self._paint(mesh, FLAGELLUM_COLORS[color])
                self._bind(mesh.GetPrim(), f"FlagellumMaterial_{color}", 0.4, FLAGELLUM_COLORS[color])
                changing += [None, None]
            self._meshes.append(tuple(changing))

    def _add_spokes(self, path: str) -> Any:
        from pxr import UsdGeom

        motor = UsdGeom.Xform.Define(self._stage, path)
        for i, (length, color) in enumerate(zip(SPOKE_LENGTHS, SPOKE_COLORS, strict=True)):
            ends = np.stack([np.zeros(3), length * np.eye(3)[i]])
            vertices, normals = (each[0] for each in tube(ends[None], 0.5 * SPOKE_WIDTH))
            spoke = self._mesh(f"{path}/Spoke_{i}", SIDES, vertices, normals)
            self._paint(spoke, color)
            self._bind(spoke.GetPrim(), f"SpokeMaterial_{i}", 0.4, color)
        return motor

    def _mesh(self, path: str, sides: int, vertices: NDArray, normals: NDArray) -> Any:
        """A mesh of rings of vertices."""
        from pxr import UsdGeom, Vt

        mesh = UsdGeom.Mesh.Define(self._stage, path)
        corners = faces(len(vertices) // sides, sides)
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(corners), 4, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(corners.ravel()))
        points = vertices.astype(np.float32)
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals.astype(np.float32)))
        mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
        return mesh

    def _paint(self, mesh: Any, color: str) -> None:
        from pxr import Gf, UsdGeom

        mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant).Set([Gf.Vec3f(*linear(color).tolist())])
