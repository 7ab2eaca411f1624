"""Sweeps: many runs that differ in a few values, on all devices or cores of a machine, or on a cluster."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warpflag.run.sweep.axes import grid_axes
    from warpflag.run.sweep.plan import BadMembers, Sweep, read
    from warpflag.run.sweep.sweep import SweepRun, resume, resume_or_start, start

__all__ = ["BadMembers", "Sweep", "SweepRun", "grid_axes", "read", "resume", "resume_or_start", "start"]

# Where each name lives; loaded on first use: a sweep is read without Warp.
_HOMES = {
    "grid_axes": "axes",
    **dict.fromkeys(("BadMembers", "Sweep", "read"), "plan"),
    **dict.fromkeys(("SweepRun", "resume", "resume_or_start", "start"), "sweep"),
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
