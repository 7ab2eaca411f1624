"""Materials of a movie: plain surfaces in one colour, or in the display colour of what they are bound to."""

# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# (pxr comes without type stubs)

from __future__ import annotations

from typing import Any

from warpflag.view.coloring import linear

__all__ = ["bind_material"]


def bind_material(prim: Any, path: str, roughness: float, color: str | None = None) -> None:
    """Binds a material (UsdPreviewSurface) to a prim, and defines it where it is not there yet.

    Args:
        prim: to be shown with it.
        path: of the material.
        roughness: 0 for a mirror, 1 for chalk.
        color: sRGB "#rrggbb" for one colour, which every program shows; None for the prim's primvar displayColor,
            whatever its interpolation, which some programs leave out.
    """
    from pxr import Gf, Sdf, UsdShade

    stage = prim.GetStage()
    material = UsdShade.Material.Get(stage, path)
    if not material:
        material = UsdShade.Material.Define(stage, path)
        surface = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Surface"))
        surface.CreateIdAttr("UsdPreviewSurface")
        diffuse = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
        if color is None:
            reader = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("Color"))
            reader.CreateIdAttr("UsdPrimvarReader_float3")
            reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("displayColor")
            diffuse.ConnectToSource(reader.CreateOutput("result", Sdf.ValueTypeNames.Float3))
        else:
            diffuse.Set(Gf.Vec3f(*linear(color).tolist()))
        surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(roughness)
        material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material)
