"""Reads the record of a run, run.h5, whose layout `warpflag.record.layout` describes.

A damaged file gives a RecordError, never other numbers: every frame and the parameters are compared with their
checksums as they are read. Records of versions that wrote no checksums are read without that comparison.
"""

from __future__ import annotations

import math
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.base.above import method_from
from warpflag.record.frame_array import FrameArray, reading
from warpflag.record.layout import (
    BODY_ORIENTATION,
    BODY_POSITION,
    E1,
    ENTRIES,
    FORM,
    MOTOR_ANGLE,
    POSITION,
    RECORD_NAME,
    Frame,
    RecordError,
    dataset_path,
)
from warpflag.record.opening import Contents, open_file, read_contents

__all__ = ["Record"]

_BEHAVIOUR = "warpflag.observables.behaviour.of_record"  # options of its functions are those of the methods


class Record:
    """Reads run.h5, also while a run writes it or after one was killed: the frames committed by then.

    Every access opens the file and closes it again, so that other readers in the same process (xarray, MDAnalysis,
    h5py) find it free; in a `with` block it stays open, which is quicker where frames are read one by one. How many
    frames there are is looked up once; close() forgets it, and the next access sees what was committed since. Every
    access raises RecordError where the file is damaged or no record of this program.

    Args:
        path: the file, or the run directory that holds it.

    Raises:
        RecordError: there is no such file.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        if self.path.is_dir():
            self.path = self.path / RECORD_NAME
        self._arrays: dict[str, FrameArray] = {}
        self._datasets: dict[str, Any] = {}
        self._file: Any = None
        self._stays_open = False
        if not self.path.is_file():
            raise RecordError(f"{self.path}: no such record{_runs_within(self.path.parent)}")

    def __repr__(self) -> str:
        try:
            times, count = self.times, len(self.first_node) - 1
        except RecordError:
            return f"<Record {self.path}: not readable>"
        until = f" to {1e3 * times[-1]:g} ms" if len(times) else ""
        return f"<Record {self.path}: {count} flagell{'a' if count > 1 else 'um'}, {self.frame_count} frames{until}>"

    to_xarray = method_from(
        "warpflag.view.tables", "dataset", "The record as an xarray.Dataset in memory; needs the extra `notebook`."
    )
    runs_and_tumbles = method_from(_BEHAVIOUR, "runs_and_tumbles", "Runs and tumbles of the body's path.")
    bundle_membership = method_from(_BEHAVIOUR, "bundle_membership", "The bundle of every flagellum in every frame.")
    wobble = method_from(_BEHAVIOUR, "wobble", "Precession and nutation of the body's axis, or the bundle's.")
    wrapping = method_from(_BEHAVIOUR, "wrapping", "How far each flagellum is wrapped round the body in every frame.")
    motor_loads = method_from(_BEHAVIOUR, "motor_loads", "Rate, torque and drag at which each motor works.")
    _repr_html_ = method_from("warpflag.view.page", "notebook_frame", "The page of the record, as a notebook shows it.")

    def __enter__(self) -> Record:
        self._stays_open = True
        return self

    def __exit__(self, *exception: object) -> None:
        self._stays_open = False
        self.close()

    def close(self) -> None:
        """Closes the file, if it is open, and forgets what was read; the record may be used again."""
        self._arrays.clear()
        self._datasets.clear()
        self.__dict__.pop("_contents", None)
        file, self._file = self._file, None
        if file is not None:
            with reading(self.path, "can't be closed"):
                file.close()

    @cached_property
    def _contents(self) -> Contents:
        contents, file = read_contents(self.path, self._stays_open)
        if file is not None:
            self._file = file
        return contents

    @property
    def entries(self) -> tuple[str, ...]:
        """Names of what is kept frame by frame: step, time, the entries, the observables, and checksums if any."""
        return tuple(self._contents.shapes)

    @property
    def frame_count(self) -> int:
        """Number of committed frames at the first access, or the first one after close()."""
        return self._contents.frame_count

    @property
    def parameters(self) -> dict[str, Any]:
        """What /parameters holds: scene, scene_sha256, first_node, filament_radius, body_length, body_width, versions.

        Lengths in um; first_node has the shape [flagellum_count + 1], versions maps names to versions.
        """
        return self._contents.parameters

    def _frames(self, name: str) -> FrameArray:
        """The frames of one entry."""
        if name not in self._arrays:
            contents = self._contents
            if name not in contents.shapes:
                raise RecordError(f"{self.path}: has no /{dataset_path(name)}")
            read = partial(self._read, name)
            shape, sums = contents.shapes[name], contents.sums.get(name)
            self._arrays[name] = FrameArray(read, shape, sums, contents.frame_count, self.path, name)
        return self._arrays[name]

    def _read(self, name: str, first: int, last: int) -> NDArray[Any]:
        """Frames first to last - 1 of one entry, as the file holds them."""
        if not self._stays_open:
            with open_file(self.path) as file:
                return file[dataset_path(name)][first:last]
        if self._file is None:
            self._file = open_file(self.path)
        if name not in self._datasets:  # kept, because HDF5 forgets the chunks of a dataset that is opened anew
            self._datasets[name] = self._file[dataset_path(name)]
        return self._datasets[name][first:last]

    @property
    def times(self) -> NDArray[np.float64]:
        """Times of the frames [s], shape [frame_count]."""
        return self._frames("time")[:]

    @property
    def steps(self) -> NDArray[np.int64]:
        """Steps taken when each frame was made, shape [frame_count]."""
        return self._frames("step")[:].astype(np.int64)

    @property
    def positions(self) -> FrameArray:
        """Nodes in lab coordinates [um], shape [frame_count, node_count, 3], flagellum after flagellum."""
        return self._frames(POSITION)

    @property
    def directors(self) -> FrameArray:
        """Directors e1 of tripod and segments, shape [frame_count, node_count, 3]."""
        return self._frames(E1)

    @property
    def forms(self) -> FrameArray | None:
        """Forms of the joints, as in `Frame`, shape [frame_count, node_count]; None for a run without polymorphs."""
        return self._frames(FORM) if FORM in self.entries else None

    @property
    def motor_angle(self) -> NDArray[np.float64]:
        """Accumulated angles of the tripods relative to the body [rad], shape [frame_count, flagellum_count]."""
        return self._frames(MOTOR_ANGLE)[:]

    @property
    def body_position(self) -> NDArray[np.float64]:
        """Centre of the body [um], shape [frame_count, 3]."""
        return self._frames(BODY_POSITION)[:]

    @property
    def body_orientation(self) -> NDArray[np.float64]:
        """Quaternions (x, y, z, w) from body to lab axes, shape [frame_count, 4]."""
        return self._frames(BODY_ORIENTATION)[:]

    @property
    def observables(self) -> dict[str, NDArray[np.float64]]:
        """Observables by name, shape [frame_count] or [frame_count, flagellum_count]."""
        return {name: self._frames(f"observables/{name}")[:] for name in self._observable_names}

    @property
    def _observable_names(self) -> list[str]:
        prefix = "observables/"
        return [name.removeprefix(prefix) for name in self.entries if name.startswith(prefix)]

    @property
    def first_node(self) -> NDArray[np.int64]:
        """Flagellum k has the nodes first_node[k] to first_node[k + 1] - 1; shape [flagellum_count + 1]."""
        return self.parameters["first_node"]

    @property
    def scene_text(self) -> str:
        """The scene as TOML, every value written out."""
        return self.parameters["scene"]

    @property
    def scene_sha256(self) -> str:
        """Hash of the scene text, hexadecimal."""
        return self.parameters["scene_sha256"]

    @property
    def filament_radius(self) -> float:
        """Radius of the flagella [um]."""
        return self.parameters["filament_radius"]

    @property
    def body_length(self) -> float:
        """Length of the body over its round ends [um]."""
        return self.parameters["body_length"]

    @property
    def body_width(self) -> float:
        """Width of the body [um]."""
        return self.parameters["body_width"]

    @property
    def versions(self) -> dict[str, str]:
        """Versions that were given for the run, by name."""
        return dict(self.parameters["versions"])

    def window(self, start: float | None = None, stop: float | None = None) -> slice:
        """The frames between two times.

        Args:
            start: [s]; default: after two thirds of the recorded time.
            stop: [s]; default: the last frame.

        Raises:
            ValueError: a time is no number.
        """
        if any(time is not None and math.isnan(time) for time in (start, stop)):
            raise ValueError(f"a window is between two times, not {start} and {stop}")
        times = self.times
        start = times[0] + 2 / 3 * (times[-1] - times[0]) if start is None else start
        stop = times[-1] if stop is None else stop
        slack = 1e-9 * times[-1]  # k duration/frames and a time typed by hand differ in the last bit
        return slice(int(np.searchsorted(times, start - slack)), int(np.searchsorted(times, stop + slack)))

    def frame(self, index: int) -> Frame:
        """One frame; a negative index counts from the end.

        Raises:
            RecordError: there is no such frame, or it can't be read.
        """
        if not -self.frame_count <= index < self.frame_count:
            raise RecordError(f"{self.path}: has no frame {index}, only {self.frame_count} frames")
        at = {name: self._frames(name)[index] for name in ("step", "time", *ENTRIES)}
        forms = self.forms
        return Frame(
            time=float(at["time"]),
            step=int(at["step"]),
            positions=at[POSITION],
            directors=at[E1],
            motor_angle=at[MOTOR_ANGLE],
            body_position=at[BODY_POSITION],
            body_orientation=at[BODY_ORIENTATION],
            observables={name: self._frames(f"observables/{name}")[index] for name in self._observable_names},
            forms=None if forms is None else forms[index].astype(np.int8),
        )


def _runs_within(directory: Path) -> str:
    """What to say of a directory without a record but with runs in it, as that of a sweep is."""
    found = sorted(directory.glob(f"*/{RECORD_NAME}"))
    return f"; it holds {len(found)} runs, name one: {found[0].parent}" if len(found) > 1 else ""
