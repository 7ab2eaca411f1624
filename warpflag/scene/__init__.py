"""What a cell is: settings and their sections, the scene and its file, resistance coefficients."""

from warpflag.scene.scene import (
    Body,
    Flagella,
    FlagellumOverride,
    FlagellumSpec,
    Motor,
    Scene,
    SceneError,
    dumps,
    load,
    loads,
    with_values,
)

__all__ = [
    "Body",
    "Flagella",
    "FlagellumOverride",
    "FlagellumSpec",
    "Motor",
    "Scene",
    "SceneError",
    "dumps",
    "load",
    "loads",
    "with_values",
]
