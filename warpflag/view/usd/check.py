"""Faults of a movie that the usual validators of USD files pass: it opens and does not play, or shows wrong things.

`pxr.UsdValidation` and usd-validation-nvidia pass files with impossible time ranges, counts that do not fit their
points, unknown tokens and misspelt types. These checks look at every time sample of every attribute.
"""

# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# (pxr comes without type stubs)

from __future__ import annotations

from typing import Any

import numpy as np

from warpflag.view.usd.read import opened, reading

__all__ = ["problems", "problems_of"]


def problems_of(path: str) -> list[str]:
    """What is wrong with a USD file, by these checks and by those that come with USD, a line each.

    Raises:
        OutputError: it can't be read.
    """
    from pxr import UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    with reading(path):
        stage = opened(path)
        findings = UsdValidation.ValidationContext(validators).Validate(stage)
        return [f"{finding.GetName()}: {finding.GetMessage()}" for finding in findings] + problems(stage)


def problems(stage: Any) -> list[str]:
    """What is wrong with a stage, a line each, once for all time samples; empty where it is sound."""
    from pxr import UsdGeom

    found = _stage_problems(stage)
    for prim in stage.TraverseAll():
        if prim.GetTypeName() and prim.GetPrimTypeInfo().GetSchemaType().isUnknown:
            found.append(f"{prim.GetPath()}: there is no prim type {prim.GetTypeName()}")
        for attribute in prim.GetAttributes():
            found += _attribute_problems(attribute, stage)
        if prim.IsA(UsdGeom.BasisCurves):
            found += _curve_problems(UsdGeom.BasisCurves(prim))
        if prim.IsA(UsdGeom.Boundable):
            found += _extent_problems(UsdGeom.Boundable(prim))
    return list(dict.fromkeys(found))


def _stage_problems(stage: Any) -> list[str]:
    """Times, units, default prim, camera and files that are referred to."""
    from pxr import UsdGeom, UsdUtils

    found = []
    root = stage.GetRootLayer()
    if not (stage.HasAuthoredTimeCodeRange() and stage.GetStartTimeCode() <= stage.GetEndTimeCode()):
        found.append("the time codes do not run from a start to a later end")
    for name in ("timeCodesPerSecond", "framesPerSecond"):
        if not stage.HasAuthoredMetadata(name) or not stage.GetMetadata(name) > 0:
            found.append(f"{name} is not given")
    if not UsdGeom.StageHasAuthoredMetersPerUnit(stage) or not stage.HasAuthoredMetadata("upAxis"):
        found.append("the unit of length or the axis that is up is not given")
    if not stage.GetDefaultPrim():
        found.append("there is no default prim")
    if not any(prim.IsA(UsdGeom.Camera) for prim in stage.Traverse()):
        found.append("there is no camera")
    if not root.anonymous:
        _layers, _assets, missing = UsdUtils.ComputeAllDependencies(root.identifier)
        found += [f"{path}: is referred to and not there" for path in missing]
    return found


def _attribute_problems(attribute: Any, stage: Any) -> list[str]:
    """Times of the samples outside those of the stage, unknown tokens and numbers that are not finite."""
    path, allowed = attribute.GetPath(), attribute.GetMetadata("allowedTokens")
    times = attribute.GetTimeSamples()
    found = []
    if times and not stage.GetStartTimeCode() <= times[0] <= times[-1] <= stage.GetEndTimeCode():
        found.append(f"{path}: has samples outside the time codes of the stage")
    for time in times or [None]:
        value = attribute.Get() if time is None else attribute.Get(time)
        if value is None:
            continue
        if allowed and isinstance(value, str) and value not in allowed:
            found.append(f"{path}: {value} is none of {', '.join(allowed)}")
        if not _is_finite(value):
            found.append(f"{path}: not finite")
    return found


def _is_finite(value: Any) -> bool:
    """Whether all numbers of a value are finite; true for what holds none."""
    try:
        return bool(np.isfinite(np.asarray(value, dtype=float)).all())
    except (TypeError, ValueError):  # no numbers
        return True


def _curve_problems(curves: Any) -> list[str]:
    """Counts that do not add up to the points, and primvars of the wrong length, at every time sample."""
    from pxr import UsdGeom

    found, path = [], curves.GetPath()
    primvars = UsdGeom.PrimvarsAPI(curves).GetPrimvarsWithAuthoredValues()
    attributes = [curves.GetCurveVertexCountsAttr(), curves.GetPointsAttr(), *(p.GetAttr() for p in primvars)]
    for time in sorted({time for attribute in attributes for time in attribute.GetTimeSamples()}) or [0.0]:
        counts, points = curves.GetCurveVertexCountsAttr().Get(time), curves.GetPointsAttr().Get(time)
        if counts is None or points is None or sum(counts) != len(points):
            found.append(f"{path}: curveVertexCounts do not add up to the points")
            continue
        sizes = {"constant": 1, "uniform": len(counts), "vertex": len(points), "varying": len(points)}
        for primvar in primvars:
            value, size = primvar.ComputeFlattened(time), sizes.get(primvar.GetInterpolation())
            if value is None or size is None or len(value) != size:
                found.append(f"{primvar.GetAttr().GetPath()}: not one value per {primvar.GetInterpolation()}")
    return found


def _extent_problems(boundable: Any) -> list[str]:
    """Extents that are not the bounds of what is shown, at every time sample."""
    from pxr import UsdGeom

    found, extent = [], boundable.GetExtentAttr()
    if not extent.HasAuthoredValue() and not extent.GetTimeSamples():
        return []
    for time in extent.GetTimeSamples() or [0.0]:
        computed = UsdGeom.Boundable.ComputeExtentFromPlugins(boundable, time)
        if computed is not None and not np.allclose(extent.Get(time), computed, rtol=1e-5, atol=1e-5):
            found.append(f"{extent.GetPath()}: not the bounds of what is there")
    return found
