"""warpflag: swimming bacteria with elastic flagella, on NVIDIA Warp."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from warpflag.record import Record
    from warpflag.record.recorder import Recorder
    from warpflag.run.simulation import NumericalError, Simulation
    from warpflag.scene import Scene, SceneError, load, with_values

__version__ = "0.1.0"
__all__ = [
    "NumericalError",
    "Record",
    "Recorder",
    "Scene",
    "SceneError",
    "Simulation",
    "__version__",
    "load",
    "with_values",
]

# Loaded on first use, so that `import warpflag` and the command line's --help stay quick.
_HOMES = {
    "NumericalError": "run.simulation",
    "Record": "record",
    "Recorder": "record.recorder",
    "Scene": "scene",
    "SceneError": "scene",
    "Simulation": "run.simulation",
    "load": "scene",
    "with_values": "scene",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"warpflag.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'warpflag' has no attribute {name!r}")
