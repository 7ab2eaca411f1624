"""warpflag: swimming bacteria with elastic flagella, on NVIDIA Warp."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warpflag.record import Record
    from warpflag.record.recorder import Recorder
    from warpflag.run.simulation import NumericalError, Simulation
    from warpflag.scene import Scene, SceneError, load, paper_scene, with_values
    from warpflag.scene.run_sections import Numerics, Start
    from warpflag.scene.sections import (
        Body,
        External,
        Flagella,
        FlagellumOverride,
        Fluid,
        Hook,
        Hydrodynamics,
        Motor,
        Polymorphs,
        Steric,
    )

__version__ = "0.1.0"
__all__ = [
    "Body",
    "External",
    "Flagella",
    "FlagellumOverride",
    "Fluid",
    "Hook",
    "Hydrodynamics",
    "Motor",
    "NumericalError",
    "Numerics",
    "Polymorphs",
    "Record",
    "Recorder",
    "Scene",
    "SceneError",
    "Simulation",
    "Start",
    "Steric",
    "__version__",
    "load",
    "paper_scene",
    "with_values",
]

# Where each name lives; loaded on first use, so that `import warpflag` and the command line's --help stay quick.
_HOMES = {
    "Body": "scene.sections",
    "External": "scene.sections",
    "Flagella": "scene.sections",
    "FlagellumOverride": "scene.sections",
    "Fluid": "scene.sections",
    "Hook": "scene.sections",
    "Hydrodynamics": "scene.sections",
    "Motor": "scene.sections",
    "NumericalError": "run.simulation",
    "Numerics": "scene.run_sections",
    "Polymorphs": "scene.sections",
    "Record": "record",
    "Recorder": "record.recorder",
    "Scene": "scene",
    "SceneError": "scene",
    "Simulation": "run.simulation",
    "Start": "scene.run_sections",
    "Steric": "scene.sections",
    "load": "scene",
    "paper_scene": "scene",
    "with_values": "scene",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"warpflag.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'warpflag' has no attribute {name!r}")


def __dir__() -> list[str]:
    return __all__
