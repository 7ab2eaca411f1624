"""What a cell is: settings and their sections, the scene and its file, resistance coefficients."""

from warpflag.scene.errors import SceneError
from warpflag.scene.formats import paper_scene
from warpflag.scene.reading import dumps, flagellum_example, load, loads, with_values
from warpflag.scene.scene import FlagellumSpec, Scene
from warpflag.scene.sections import Body, Flagella, FlagellumOverride, Motor

__all__ = [
    "Body",
    "Flagella",
    "FlagellumOverride",
    "FlagellumSpec",
    "Motor",
    "Scene",
    "SceneError",
    "dumps",
    "flagellum_example",
    "load",
    "loads",
    "paper_scene",
    "with_values",
]
