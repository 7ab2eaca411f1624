"""The movie of a record, movie.usdc: a shot that plays as it is, with cells, camera, lights and colours.

Units and time: 1 scene unit is 1 um (metersPerUnit 1e-6), z is up, time code = frame index. Played at its rate the
film is slower than the cell by the factor in customLayerData; the simulated time is a custom attribute of the cell.

    /World         assembly
    /World/Cell    what `warpflag.view.usd.cell` describes; of several records Cell_0, Cell_1, ... side by side
    /World/Camera  holds the whole path in view, or follows the cell
    /World/Lights

The points have the order of the record's nodes. A movie of more than 256 MiB is written as value clips, files of so
many frames each in the folder NAME.usdc.clips beside it; a program that opens the movie finds them.
"""

# pyright: reportAttributeAccessIssue=false, reportCallIssue=false
# (pxr comes without type stubs)

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from uuid import uuid4

import numpy as np

from warpflag.base.output import OutputError, whole
from warpflag.record import Record, RecordError
from warpflag.scene import loads
from warpflag.view.coloring import QUANTITIES
from warpflag.view.usd.camera import Extent, add_camera, add_lights, arranged, steady_path, view_axes
from warpflag.view.usd.cell import Cell
from warpflag.view.usd.checksum import add_checksum
from warpflag.view.usd.mesh_cell import MeshCell

__all__ = ["Shot", "movie_stage", "write_movie"]

SUFFIXES = (".usdc", ".usda", ".usdz")
_CLIP_BYTES = 1 << 28  # of a file of samples: larger movies are cut into clips, which programs load one by one
_BLOCK_BYTES = 1 << 21  # of samples that are made at once: fit a core's cache
_BYTES_PER_NODE = 28  # point, colour and raw value
_BYTES_PER_MESH_NODE = 16 * (28 + 12)  # two rings of eight vertices, each with its normal


@dataclass(frozen=True)
class Shot:
    """How a record is filmed.

    Attributes:
        color_by: flagellum, phase_difference, curvature, steric_force or form.
        follow: whether the camera goes with the cell.
        frames_per_second: of the film.
        slow_down: how many times slower than the cell the film plays; None: a frame of it per frame of the record.
        clip_frames: frames per value clip; None: one file as long as its samples fit in 256 MiB.
        mesh: whether body, flagella and motors are meshes, see `warpflag.view.usd.mesh_cell`.

    Raises:
        OutputError: values that make no film.
    """

    color_by: str = "flagellum"
    follow: bool = False
    frames_per_second: float = 50.0
    slow_down: float | None = None
    clip_frames: int | None = None
    mesh: bool = False

    def __post_init__(self) -> None:
        if self.color_by not in QUANTITIES:
            raise OutputError(f"color {self.color_by}: must be one of {', '.join(QUANTITIES)}")
        for name in ("frames_per_second", "slow_down", "clip_frames"):
            value = getattr(self, name)
            if value is not None and not 0 < value < np.inf:
                raise OutputError(f"{name.replace('_', ' ')} {value:g}: must be positive and finite")


def write_movie(records: Record | Sequence[Record], path: str | Path, shot: Shot | None = None) -> None:
    """Writes the movie of a record, or of several cells side by side; the file is whole or absent.

    Args:
        records: the run, or several.
        path: ends in .usdc, .usda (text) or .usdz (one file that phones and web viewers open).
        shot: how it is filmed; None for the defaults.

    Raises:
        RecordError: records without frames or with unequal frame intervals.
        OutputError: another ending.
        OSError: the file can't be written.
    """
    path, shot = Path(path), shot or Shot()
    if path.suffix not in SUFFIXES:
        raise OutputError(f"{path}: a movie must end in {', '.join(SUFFIXES)}")
    film = _Film(records, shot)
    token = uuid4().hex[:8]
    clips = path.with_name(f"{path.name}.clips")
    if path.suffix != ".usdz" and film.clip_frames < film.frame_count:
        film.write_clips(clips, token)
    else:
        film.fill()
    film.finish()
    with whole(path) as temporary:
        (_package if path.suffix == ".usdz" else _export)(film.stage, temporary)
        if path.suffix == ".usdc":
            add_checksum(temporary)
    for stale in clips.glob("*.usdc"):
        if not stale.name.startswith(token):
            stale.unlink()
    with contextlib.suppress(OSError):
        clips.rmdir()  # where no clips are left


def movie_stage(records: Record | Sequence[Record], shot: Shot | None = None) -> Any:
    """The movie as a stage in memory.

    Args:
        records: the run, or several.
        shot: how it is filmed; None for the defaults.

    Raises:
        RecordError: records without frames or with unequal frame intervals.
    """
    film = _Film(records, shot or Shot())
    film.fill()
    film.finish()
    return film.stage


def _export(stage: Any, path: Path) -> None:
    if not stage.GetRootLayer().Export(str(path)):
        raise OSError(f"{path}: the movie could not be written")


def _package(stage: Any, path: Path) -> None:
    from pxr import Sdf, UsdUtils

    with tempfile.TemporaryDirectory() as folder:
        layer = Path(folder) / "movie.usdc"
        _export(stage, layer)
        if not UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(path)):
            raise OSError(f"{path}: the movie could not be packed")


class _Film:
    """A stage that is being filled: cells, then their samples, at last the camera, which needs the extent of all."""

    def __init__(self, records: Record | Sequence[Record], shot: Shot):
        from pxr import Usd

        self.records = [records] if isinstance(records, Record) else list(records)
        self.frame_count = _frame_count(self.records)
        scenes = [loads(record.scene_text) for record in self.records]
        self.stage = Usd.Stage.CreateInMemory()
        self._shot = shot
        self._define_world()
        kind = MeshCell if shot.mesh else Cell
        names = ["Cell"] if len(self.records) == 1 else [f"Cell_{k}" for k in range(len(self.records))]
        cells = zip(names, self.records, scenes, strict=True)
        self._cells = [kind(self.stage, f"/World/{name}", *cell, shot.color_by) for name, *cell in cells]
        self._view = view_axes(self.records[0].body_orientation[0])
        self._path = self._followed() if shot.follow else np.zeros((self.frame_count, 3))
        self._extents = [Extent(self._view, self._path) for _ in self._cells]

    @property
    def clip_frames(self) -> int:
        """Frames per value clip; there are no clips where it is not less than the number of frames."""
        return int(self._shot.clip_frames or max(1, _CLIP_BYTES // self._frame_bytes))

    @property
    def _frame_bytes(self) -> int:
        per_node = _BYTES_PER_MESH_NODE if self._shot.mesh else _BYTES_PER_NODE
        return per_node * max(1, sum(int(record.first_node[-1]) for record in self.records))

    def fill(self) -> None:
        """Puts all samples into the stage."""
        self._fill(self.stage.GetRootLayer(), 0, self.frame_count)

    def write_clips(self, folder: Path, token: str) -> None:
        """Writes the samples as value clips, TOKEN_NUMBER.usdc, and refers to them.

        Each clip also holds the first frame of the next, so that values between the two are interpolated.

        Args:
            folder: where the clips go.
            token: tells them from those of earlier movies.
        """
        from pxr import Gf, Sdf, Usd, Vt

        folder.mkdir(exist_ok=True)
        starts = range(0, self.frame_count, self.clip_frames)
        names = [f"{token}_{number:04d}.usdc" for number in range(len(starts))]
        for start, name in zip(starts, names, strict=True):
            clip = self._declared(Sdf.Layer.CreateAnonymous(".usdc"))
            self._fill(clip, start, min(start + self.clip_frames + 1, self.frame_count))
            clip.Export(str(folder / name))
            add_checksum(folder / name)
        manifest = f"{token}_manifest.usdc"
        self._declared(Sdf.Layer.CreateAnonymous(".usdc")).Export(str(folder / manifest))
        add_checksum(folder / manifest)
        last = self.frame_count - 1
        for cell in self._cells:
            clips = Usd.ClipsAPI(cell.prim)
            clips.SetClipPrimPath(str(cell.prim.GetPath()))
            clips.SetClipAssetPaths([Sdf.AssetPath(f"./{folder.name}/{name}") for name in names])
            clips.SetClipManifestAssetPath(Sdf.AssetPath(f"./{folder.name}/{manifest}"))
            clips.SetClipActive(Vt.Vec2dArray([Gf.Vec2d(start, number) for number, start in enumerate(starts)]))
            clips.SetClipTimes(Vt.Vec2dArray([Gf.Vec2d(0, 0), Gf.Vec2d(last, last)]))

    def finish(self) -> None:
        """Places cells, camera and lights, once all samples have passed."""
        from pxr import Gf

        places, reach = arranged([extent.reach for extent in self._extents])
        if len(self._cells) > 1:
            for cell, place in zip(self._cells, places, strict=True):
                cell.xform.AddTranslateOp().Set(Gf.Vec3d(*(place @ self._view).tolist()))
        add_camera(self.stage, self._view, reach, self._path if self._shot.follow else None)
        add_lights(self.stage, self._view)
        self.stage.GetRootLayer().customLayerData = {"warpflag": self._provenance()}

    def _define_world(self) -> None:
        from pxr import Usd, UsdGeom

        stage, shot = self.stage, self._shot
        interval = _interval(self.records[0])
        rate = shot.frames_per_second
        if shot.slow_down is not None and interval > 0.0:
            rate = 1.0 / (shot.slow_down * interval)
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.micrometers)
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(shot.frames_per_second)
        stage.SetStartTimeCode(0)
        stage.SetEndTimeCode(self.frame_count - 1)
        world = UsdGeom.Xform.Define(stage, "/World")
        stage.SetDefaultPrim(world.GetPrim())
        Usd.ModelAPI(world).SetKind("assembly")

    def _provenance(self) -> dict[str, Any]:
        """Origin and colours of the movie, for its customLayerData; the slow-down is 0 for a single frame."""
        first, coloring = self.records[0], self._cells[0].coloring
        interval = _interval(first)
        return {
            "version": first.versions.get("warpflag", "unknown"),
            "sceneSha256": first.scene_sha256,
            "frameInterval": interval,
            "slowDown": 1.0 / (self.stage.GetTimeCodesPerSecond() * interval) if interval > 0.0 else 0.0,
            "colorBy": coloring.quantity,
            "colorLabel": coloring.label,
            "colorHighest": coloring.highest,
            "colorNames": ", ".join(coloring.names),
        }

    def _followed(self) -> Any:
        """The mean steady path of the bodies; a cell whose record ends earlier stays where it is."""
        paths = [steady_path(record.body_position) for record in self.records]
        paths = [np.pad(path, ((0, self.frame_count - len(path)), (0, 0)), mode="edge") for path in paths]
        return np.mean(paths, axis=0)

    def _declared(self, layer: Any) -> Any:
        """A layer with every attribute that changes, still without samples."""
        from pxr import Sdf

        for cell in self._cells:
            for path, kind in cell.animated.items():
                Sdf.JustCreatePrimAttributeInLayer(layer, path, kind)
        return layer

    def _fill(self, layer: Any, start: int, end: int) -> None:
        block = max(1, _BLOCK_BYTES // self._frame_bytes)
        for cell, extent, record in zip(self._cells, self._extents, self.records, strict=True):
            for first in range(start, min(end, record.frame_count), block):
                frames = slice(first, min(first + block, end, record.frame_count))
                for path, frame, value in cell.samples(frames, extent):
                    layer.SetTimeSample(path, frame, value)


def _frame_count(records: Sequence[Record]) -> int:
    """Number of frames of the longest record.

    Raises:
        RecordError: a record without frames, or with another interval between them.
    """
    for record in records:
        if record.frame_count == 0:
            raise RecordError(f"{record.path}: holds no frames to make a movie of")
        if abs(_interval(record) - _interval(records[0])) > 1e-6 * _interval(records[0]):
            raise RecordError(f"{record.path}: its frames are not as far apart as those of {records[0].path}")
    return max(record.frame_count for record in records)


def _interval(record: Record) -> float:
    """Mean time from frame to frame [s], 0 of a single one."""
    times = record.times
    return float(times[-1] - times[0]) / (len(times) - 1) if len(times) > 1 else 0.0
