"""Starts of many scenes: those that differ only in what leaves the shape alone share theirs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from warpflag.model.geometry import InitialState
from warpflag.model.start import starting_state
from warpflag.scene import Scene, SceneError

__all__ = ["Starts", "starting_states"]


class Starts:
    """Starts that were found, by shape."""

    def __init__(self) -> None:
        self._found: dict[Scene, InitialState | SceneError] = {}

    def of(self, scene: Scene) -> InitialState:
        """The start of a scene; found once for scenes that differ only in settings that leave the shape alone.

        Raises:
            SceneError: it has none.
        """
        flagella = tuple(dataclasses.replace(own, torque=None) for own in scene.flagellum)
        motor = dataclasses.replace(scene.motor, torque=1.0)
        shape = dataclasses.replace(scene, name="shape", duration=1.0, frames=1, motor=motor, flagellum=flagella)
        if shape not in self._found:
            try:
                self._found[shape] = starting_state(scene)
            except SceneError as error:
                self._found[shape] = error
        found = self._found[shape]
        if isinstance(found, SceneError):
            raise found
        return found


def starting_states(scenes: Sequence[Scene]) -> list[InitialState]:
    """The start of every scene.

    Raises:
        SceneError: a scene has none.
    """
    starts = Starts()
    return [starts.of(scene) for scene in scenes]
