"""A movie of meshes shows the cell that the one of curves shows: closed surfaces, with colours that are bound."""

from __future__ import annotations

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdShade  # noqa: TID253 (no command line starts here)

from tests.films import FIRST_NODE, THREE, made_record
from tests.view.usd.stages import at, faults
from warpflag import cli
from warpflag.base.output import OutputError
from warpflag.scene import with_values
from warpflag.view.coloring import BODY_COLOR, DISPLAY_RADIUS, FLAGELLUM_COLORS, QUANTITIES, Coloring, linear
from warpflag.view.render import render
from warpflag.view.usd import Shot, movie_stage, write_movie


@pytest.fixture(scope="module")
def movie(tmp_path_factory):
    record = made_record(tmp_path_factory.mktemp("movie"))
    return record, movie_stage(record, Shot(mesh=True))


def meshes_of(stage):
    return [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]


@pytest.mark.parametrize("color_by", QUANTITIES)
def test_validators_find_nothing(tmp_path, color_by):
    record = made_record(tmp_path, 4)
    write_movie(record, tmp_path / "movie.usdc", Shot(color_by=color_by, mesh=True))
    assert faults(Usd.Stage.Open(str(tmp_path / "movie.usdc"))) == []


def test_it_has_meshes_alone(movie):
    _, stage = movie
    kinds = {prim.GetTypeName() for prim in stage.Traverse()}
    assert "Mesh" in kinds and not kinds & {"BasisCurves", "Capsule"}
    assert len(meshes_of(stage)) == 1 + 3 + 3 * 3


def surface_of(mesh, frame):
    """Corners of the faces, shape [face, 4, 3]."""
    points = np.array(mesh.GetPointsAttr().Get(frame), float)
    return points[np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)]


def volume(surface):
    """What a closed surface encloses, positive where its faces are seen anticlockwise from outside."""
    a, b, c, d = surface.transpose(1, 0, 2)
    return (np.vecdot(a, np.cross(b, c)) + np.vecdot(a, np.cross(c, d))).sum() / 6


def test_surfaces_enclose_what_they_show(movie):
    record, stage = movie
    body = at(stage, "/World/Cell/Body")
    straight = record.body_length - record.body_width
    expected = np.pi * 0.4**2 * (straight + 4 / 3 * 0.4)
    assert volume(surface_of(UsdGeom.Mesh(body), 0)) == pytest.approx(expected, rel=0.03)
    for k in range(3):
        tube = UsdGeom.Mesh(at(stage, f"/World/Cell/Flagella/Flagellum_{k}"))
        length = 0.2 * (FIRST_NODE[k + 1] - FIRST_NODE[k] - 1)
        octagon = 2 * np.sqrt(2) * DISPLAY_RADIUS**2
        for frame in (0, 11):
            assert volume(surface_of(tube, frame)) == pytest.approx(octagon * length, rel=0.05)


def test_tubes_go_through_the_nodes(movie):
    record, stage = movie
    for k in range(3):
        mesh = UsdGeom.Mesh(at(stage, f"/World/Cell/Flagella/Flagellum_{k}"))
        for frame in (0, 7):
            nodes = record.positions[frame][FIRST_NODE[k] : FIRST_NODE[k + 1]]
            vertices = np.array(mesh.GetPointsAttr().Get(frame), float)
            distances = np.linalg.norm(vertices[:, None] - nodes, axis=-1)
            ring = np.sort(distances, axis=0)[:8]  # the eight vertices nearest to each node are the ring about it
            np.testing.assert_allclose(ring[:, 1:-1], DISPLAY_RADIUS, rtol=1e-3)
            normals = np.array(mesh.GetNormalsAttr().Get(frame), float)
            np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)
            nearest = nodes[distances.argmin(axis=1)]
            outward = np.vecdot(vertices - nearest, normals)
            assert (outward > 0.0).mean() > 0.99


def test_motors_are_where_those_of_curves_are(movie):
    record, stage = movie
    curves = movie_stage(record)
    for k in range(3):
        path = f"/World/Cell/Motors/Motor_{k}"
        for frame in (0, 5):
            places = [UsdGeom.Xformable(at(s, path)).ComputeLocalToWorldTransform(frame) for s in (stage, curves)]
            assert Gf.IsClose(places[0], places[1], 1e-9)
        lengths = [np.ptp(np.array(UsdGeom.Mesh(at(stage, f"{path}/Spoke_{i}")).GetPointsAttr().Get()), axis=0)[i]
                   for i in range(3)]  # fmt: skip
        np.testing.assert_allclose(lengths, np.add((0.28, 0.2, 0.2), 0.07), rtol=1e-4)


def test_materials_have_the_colours_themselves(movie):
    """Programs that leave out the display colour show these."""
    _, stage = movie
    shown = {"Body": BODY_COLOR} | {f"Flagella/Flagellum_{k}": FLAGELLUM_COLORS[k] for k in range(3)}
    for name, color in shown.items():
        prim = at(stage, f"/World/Cell/{name}")
        material, _ = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()
        surface, _, _ = material.ComputeSurfaceSource()
        np.testing.assert_allclose(surface.GetInput("diffuseColor").Get(), linear(color), atol=1e-6)
        np.testing.assert_allclose(UsdGeom.Mesh(prim).GetDisplayColorAttr().Get()[0], linear(color), atol=1e-6)


@pytest.mark.parametrize("color_by", ["curvature", "form"])
def test_colours_and_values_of_a_quantity_are_those_of_the_nearest_node(color_by, tmp_path):
    record = made_record(tmp_path, scene=with_values(THREE, {"polymorphs.enabled": True}))  # forms change by the frame
    meshes, curves = (movie_stage(record, Shot(color_by=color_by, mesh=mesh)) for mesh in (True, False))
    flagella = UsdGeom.BasisCurves(at(curves, "/World/Cell/Flagella"))
    mesh = UsdGeom.Mesh(at(meshes, "/World/Cell/Flagella/Flagellum_1"))
    own = slice(FIRST_NODE[1], FIRST_NODE[2])
    for frame in (0, 5, 11):
        vertices = np.array(mesh.GetPointsAttr().Get(frame))
        distances = np.linalg.norm(vertices[:, None] - record.positions[frame][own], axis=-1)
        on_ring = distances.min(axis=1) < 1.01 * DISPLAY_RADIUS
        nearest = distances.argmin(axis=1)[on_ring]
        for read in (
            lambda prim: prim.GetDisplayColorAttr(),
            lambda prim: UsdGeom.PrimvarsAPI(prim).GetPrimvar(Coloring(color_by, record, THREE).primvar),
        ):
            shown, expected = (np.array(read(prim).Get(frame)) for prim in (mesh, flagella))
            np.testing.assert_allclose(shown[on_ring], expected[own][nearest], atol=1e-6)


def test_command_writes_meshes_which_are_not_drawn_from(tmp_path, monkeypatch, capsys):
    made_record(tmp_path / "run", 3).close()
    monkeypatch.chdir(tmp_path)
    assert cli.main(["export", "run", "--to", "usd", "--mesh", "-o", "movie.usda"]) == 0
    assert len(meshes_of(Usd.Stage.Open("movie.usda"))) == 13
    with pytest.raises(OutputError, match="meshes"):
        render("movie.usda", "picture.png")
