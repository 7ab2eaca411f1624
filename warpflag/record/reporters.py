"""Reporters: what takes the frames of a run as they are made. `warpflag.recorder.Recorder` is one."""

from __future__ import annotations

import functools
import platform
from collections.abc import Mapping
from importlib import metadata
from typing import Any, Protocol

import numpy as np

from warpflag import __version__
from warpflag.record import Frame
from warpflag.scene import Scene, dumps

__all__ = ["Reporter", "start_reporter", "versions"]


class Reporter(Protocol):
    """Takes the frames of one run: `start`, `write` frame by frame, `close`, also after an error."""

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
        """Before the first frame.

        scene_text: the scene as TOML. first_node: flagellum k has the nodes first_node[k] to first_node[k + 1] - 1.
        filament_radius, body_length, body_width: [um]. versions: of the program and what it stands on.
        """
        ...

    def write(self, frame: Frame) -> None:
        """Takes a frame; its arrays stay as they are."""
        ...

    def close(self) -> None:
        """After the last frame."""
        ...


def start_reporter(reporter: Reporter, scene: Scene, first_node: np.ndarray) -> None:
    """Starts a reporter for a run of one scene."""
    reporter.start(
        dumps(scene),
        first_node,
        filament_radius=scene.flagella.filament_radius,
        body_length=scene.body.length,
        body_width=scene.body.width,
        versions=versions(),
    )


def versions() -> dict[str, str]:
    """Versions of this program, of Python and of the packages that it stands on, by name."""
    return {"warpflag": __version__, "python": platform.python_version(), **_package_versions()}


@functools.cache
def _package_versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in ("warp-lang", "numpy", "h5py", "usd-core")}
