"""warpflag: swimming bacteria with elastic flagella, on NVIDIA Warp."""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"
__all__ = ["Scene", "SceneError", "Simulation", "__version__", "load"]

# Loaded on first use, so that `import warpflag` and the command line's --help stay quick.
_HOMES = {"Scene": "scene", "SceneError": "scene", "load": "scene", "Simulation": "simulation"}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(f"warpflag.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'warpflag' has no attribute {name!r}")
