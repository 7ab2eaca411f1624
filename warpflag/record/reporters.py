"""Reporters, which take the frames of a run as they are made; `warpflag.record.recorder.Recorder` is one."""

from __future__ import annotations

import functools
import platform
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from typing import Any, Protocol

import numpy as np

from warpflag import __version__
from warpflag.record import Frame
from warpflag.scene import Scene, dumps

__all__ = ["Reporter", "hand_over", "start_reporter", "versions"]


class Reporter(Protocol):
    """Takes the frames of one run: `start`, then `write` for every frame, then `close`, also after an error."""

    def start(
        self,
        scene_text: str,
        first_node: Any,
        *,
        filament_radius: float,
        body_length: float,
        body_width: float,
        versions: Mapping[str, str],
    ) -> None:
        """Called before the first frame.

        Args:
            scene_text: the scene as TOML.
            first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
            filament_radius: of the flagella [um].
            body_length: over the round ends [um].
            body_width: of the body [um].
            versions: of the program and the packages that it uses, by name.
        """
        ...

    def write(self, frame: Frame) -> None:
        """Called for every frame; its arrays must not be changed."""
        ...

    def close(self) -> None:
        """Called after the last frame."""
        ...


def start_reporter(reporter: Reporter, scene: Scene, first_node: np.ndarray, text: str | None = None) -> None:
    """Starts a reporter for a run of one scene.

    Args:
        reporter: the reporter.
        scene: what is run.
        first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1, shape [flagellum_count + 1].
        text: the scene as TOML, where it is at hand.
    """
    thick = 2 * scene.flagella.filament_radius
    length, width = (scene.body.length, scene.body.width) if scene.body.enabled else (thick, thick)
    reporter.start(
        text or dumps(scene),
        first_node,
        filament_radius=scene.flagella.filament_radius,
        body_length=length,
        body_width=width,
        versions=versions(),
    )


def hand_over(reporters: Sequence[Reporter], scene: Scene, first_node: np.ndarray, frames: Iterable[Frame]) -> None:
    """Starts reporters, hands them the frames of a run as they are made, and closes them, also after an error.

    Args:
        reporters: of the run.
        scene: what is run.
        first_node: as in `start_reporter`.
        frames: of the run.
    """
    started: list[Reporter] = []
    try:
        for reporter in reporters:
            started.append(reporter)
            start_reporter(reporter, scene, first_node)
        for frame in frames:
            for reporter in started:
                reporter.write(frame)
    finally:
        for reporter in started:
            reporter.close()


def versions() -> dict[str, str]:
    """Versions of this program, of Python and of the packages that it uses, by name."""
    return {"warpflag": __version__, "python": platform.python_version(), **_package_versions()}


@functools.cache
def _package_versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in ("warp-lang", "numpy", "h5py", "usd-core")}
