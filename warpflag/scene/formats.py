"""Formats of scene files: which defaults a file has, and the paper's model by name.

A file says `format = 1`; what it leaves out then has the defaults of `warpflag.scene.sections`, the model that
converges with the segment length. A file without a format was written before there were any: it has the paper's model.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from warpflag.scene.scene import Scene
from warpflag.scene.sections import Hook, Hydrodynamics

__all__ = ["BEFORE_FORMATS", "paper_scene"]

BEFORE_FORMATS: dict[str, Any] = {
    "hydrodynamics.mode": "all",
    "hydrodynamics.body_flow": False,
    "hook.length": 0.0,
    "hook.stiffness": 0.0,
}
"""The paper's model, by dotted key: the values of these settings in a file that has no format and leaves them out."""

_FORMAT_SECTIONS = {"hydrodynamics": Hydrodynamics, "hook": Hook}


def paper_scene(name: str, **settings: Any) -> Scene:
    """A scene with the paper's model: Adhyapak & Stark, Phys. Rev. E 92, 052701 (2015).

    Its pair sum counts a filament's own flow twice and its hook has no length, so nothing converges with the segment
    length.

    Args:
        name: of the scene.
        settings: as those of `Scene`; sections that are given stand as they are.

    Raises:
        SceneError: the scene can't be simulated.
    """
    sections = {}
    for section, cls in _FORMAT_SECTIONS.items():
        own = {key.partition(".")[2]: value for key, value in BEFORE_FORMATS.items() if key.startswith(f"{section}.")}
        sections[section] = dataclasses.replace(cls(), **own)
    return Scene(name, **{**sections, **settings})
