"""What the tests of movies share: prims by path, and every fault that validators find in a stage."""

from __future__ import annotations

from pxr import UsdValidation  # noqa: TID253 (no command line starts here)

from warpflag.view.usd.check import problems


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
