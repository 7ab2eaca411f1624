"""Every number of a record and of the summary beside it, found anew from the recorded nodes and the scene in NumPy."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

from tests.helpers import attachment, carried, cell, matrix, unit
from tests.oracles import body_gaps, elastic_energies, segment_distances
from tests.run.test_batch_settings import FIRST, SHARED
from tests.runs import executed, small, summary
from warpflag.model.geometry import InitialState
from warpflag.scene import Scene, load

# Two flagella of unequal lengths side by side, in contact, with constant torques; and two whose motors reverse along a
# ramp on the plateau of their curves, so that the joints change their form.
TOUCHING = small(
    {"flagella.opening_angle": 0.0, "flagellum.0.azimuth": 0.0, "flagellum.1.azimuth": 6.1, "flagellum.1.length": 1.6}
    | {"motor.torque": 2.0, "flagellum.1.torque": 1.5, "behaviour": True}
)
REVERSING = cell(
    {**SHARED, **FIRST, "duration": 4e-5, "frames": 8, "numerics.on_accuracy": "warn", "numerics.time_step": 2e-7}
    | {"motor.switch_times": (1.2e-5,), "flagellum.1.switch_times": (2e-5,), "motor.switch_ramp": 2e-5}
    | {"motor.knee": 1e5, "motor.no_load": 1e6, "motor.reverse_knee": 1e5, "motor.reverse_no_load": 1e6}
    | {"polymorphs.nucleation": 0.02, "polymorphs.nucleation_back": 0.01, "polymorphs.propagation": 0.01}
    | {"polymorphs.propagation_back": 0.0, "polymorphs.front_speed": 1e5, "numerics.accuracy": None}
)
SCENES = {"touching": TOUCHING, "reversing": REVERSING}
UNITS = {
    **{"particles/flagella/position": "um", "particles/flagella/e1": "", "particles/flagella/form": ""},
    **{"cell/motor_angle": "rad", "cell/body_position": "um", "cell/body_orientation": ""},
    **{"observables/phase_difference": "", "observables/bundle_length": "", "observables/elastic_energy": "pN um"},
    **{"observables/steric_force_density": "pN um-1", "observables/body_speed": "um s-1"},
    **{"observables/body_rate": "Hz", "observables/motor_rate": "Hz", "observables/motor_torque": "pN um"},
    **{"observables/motor_drive": "", "observables/target_form_share": ""},
}


class Recorded:
    """The record of a run as HDF5 has it, and what its summary says."""

    def __init__(self, directory: Path) -> None:
        self.scene: Scene = load(directory / "scene.toml")
        self.text = (directory / "scene.toml").read_text(encoding="utf-8")
        self.said = summary(directory)
        with h5py.File(directory / "run.h5") as file:
            self.entries = {name: file[name] for name in UNITS if name in file}
            self.units = {name: own["value"].attrs.get("units", "") for name, own in self.entries.items()}
            self.kinds = {name: own["value"].dtype.kind for name, own in self.entries.items()}
            self.values = {name: own["value"][:] for name, own in self.entries.items()}
            self.times, self.steps = (file["particles/flagella/position"][name][:] for name in ("time", "step"))
            self.names = {f"observables/{name}" for name in file["observables"]} | {
                f"{group}/{name}" for group in ("particles/flagella", "cell") for name in file[group] if name != "box"
            }
            self.parameters = {name: own[()] for name, own in file["parameters"].items() if hasattr(own, "shape")}

    def __getattr__(self, name: str) -> np.ndarray:
        return next(values for path, values in self.values.items() if path.endswith(f"/{name}"))

    @property
    def rows(self) -> list[slice]:
        first = self.parameters["first_node"]
        return [slice(int(a), int(b)) for a, b in pairwise(first)]

    def start(self, frame: int) -> InitialState:
        nodes, e1 = ([values[frame, own] for own in self.rows] for values in (self.position, self.e1))
        return InitialState(tuple(nodes), tuple(e1), self.body_position[frame], self.body_orientation[frame])

    def window(self) -> slice:
        return slice(int(np.flatnonzero(self.times >= self.times[-1] * (2 / 3) - 1e-12)[0]), None)

    def axes(self) -> np.ndarray:
        return np.array([matrix(q)[:, 2] for q in self.body_orientation])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> dict[str, Recorded]:
    where = tmp_path_factory.mktemp("runs")
    return {name: Recorded(executed(scene, where / name)) for name, scene in SCENES.items()}


def phase_difference(run: Recorded, frame: int) -> float:
    start = run.start(frame)
    t, e1 = [unit(np.diff(x, axis=0)) for x in start.positions], [e1[1:] for e1 in start.directors]
    n = min(map(len, t))
    turned = carried(e1[1][:n], t[1][:n], t[0][:n])
    return float(np.mean(np.arccos(np.clip(np.sum(e1[0][:n] * turned, axis=1), -1, 1)) / math.pi))


def near(x: np.ndarray, other: np.ndarray) -> list[bool]:
    """Whether points are within 2R, 0.44 um, of a chain of nodes."""
    found = segment_distances(x, np.full_like(x, 1e-9), other[:-1], np.diff(other, axis=0))
    return (found.min(axis=1) <= 0.44).tolist()


def bundle_length(run: Recorded, frame: int) -> float:
    one, other = run.start(frame).positions
    shares = []
    for x, y in ((one, other), (other, one)):
        bundled = [*near(x, y), False]
        first = bundled.index(True) if any(bundled) else 0
        shares.append(max(bundled.index(False, first) - 1, 0) / (len(x) - 1))
    return float(np.mean(shares))


def steric_force_density(run: Recorded, frame: int) -> float:
    one, other = run.start(frame).positions
    r = segment_distances(one[:-1], np.diff(one, axis=0), other[:-1], np.diff(other, axis=0))
    x = r / (4 * run.scene.flagella.filament_radius)
    y = np.maximum(x, 0.7)
    slope = 26 * 0.7**-14 - 7 * 0.7**-8
    force = np.where(x < 2 ** (1 / 6), 2 * y**-13 - y**-7 + slope * (y - x), 0.0)
    mean_length = np.mean([spec.length for spec in run.scene.resolved_flagella()])
    return float(run.scene.steric.strength * force.sum() / mean_length)


def drives(run: Recorded) -> np.ndarray:
    """1 up to the time of each motor's switch, from there falling to -1 within the ramp, shape [frame, motor]."""
    begins = np.array([spec.switch_times[0] for spec in run.scene.resolved_flagella()])
    return np.clip(1 - 2 * (run.times[:, None] - begins) / run.scene.motor.switch_ramp, -1, 1)


def turns(run: Recorded, window: slice) -> np.ndarray:
    """Rotation vectors of the body from each frame to the next, in body axes [rad]."""
    found = []
    for before, after in pairwise(run.body_orientation[window]):
        m = matrix(before).T @ matrix(after)
        axis = np.array([m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]) / 2  # sin(angle) about it
        found.append(axis * (math.asin(np.linalg.norm(axis)) / (np.linalg.norm(axis) or 1.0)))
    return np.array(found)


@pytest.mark.parametrize("name", SCENES)
def test_a_record_has_its_entries_with_units_and_shapes(name, recorded):
    run = recorded[name]
    law = {"observables/motor_torque", "observables/motor_drive"}
    forms = {"particles/flagella/form", "observables/target_form_share"}
    assert run.names == set(UNITS) - (law | forms if name == "touching" else set())
    assert run.units == {path: UNITS[path] for path in run.names}
    nodes, frames = int(run.parameters["first_node"][-1]), run.scene.frames + 1
    by_motor = {"motor_angle", "motor_rate", "motor_torque", "motor_drive", "target_form_share"}
    shapes = {"position": (nodes, 3), "e1": (nodes, 3), "form": (nodes,), "body_position": (3,)}
    shapes |= {"body_orientation": (4,), **dict.fromkeys(by_motor, (2,))}
    for path, values in run.values.items():
        assert values.shape == (frames, *shapes.get(path.rpartition("/")[2], ())), path
        assert run.kinds[path] == ("i" if path.endswith("form") else "f"), path
        assert np.isfinite(values[1:]).all(), path
    interval = run.scene.duration / run.scene.frames
    np.testing.assert_allclose(run.times, interval * np.arange(frames), rtol=1e-12)
    assert run.steps[0] == 0 and (np.diff(run.steps) > 0).all()
    assert run.parameters["scene"].decode() == run.text
    assert run.parameters["scene_sha256"].decode() == hashlib.sha256(run.text.encode()).hexdigest()
    sizes = [run.parameters[key] for key in ("filament_radius", "body_length", "body_width")]
    assert sizes == [run.scene.flagella.filament_radius, run.scene.body.length, run.scene.body.width]
    counts = [spec.segment_count + 1 for spec in run.scene.resolved_flagella()]
    assert run.parameters["first_node"].tolist() == [0, *np.cumsum(counts)]


@pytest.mark.parametrize("name", SCENES)
def test_poses_of_a_record_belong_together(name, recorded):
    """Anchors stand on the body, motors turn about their axes by their angles, and directors lie across segments."""
    run = recorded[name]
    for frame in range(len(run.times)):
        turn, first = matrix(run.body_orientation[frame]), matrix(run.body_orientation[0])
        for k, (spec, own) in enumerate(zip(run.scene.resolved_flagella(), run.rows, strict=True)):
            place, m = attachment(run.scene, spec)
            x, e1 = run.position[frame, own], run.e1[frame, own]
            np.testing.assert_allclose(x[0], run.body_position[frame] + turn @ place, atol=1e-9)
            begun = first.T @ run.e1[0, own.start]
            angle = run.motor_angle[frame, k] - run.motor_angle[0, k]
            turned = begun * math.cos(angle) + np.cross(m, begun) * math.sin(angle)
            np.testing.assert_allclose(turn.T @ e1[0], turned, atol=1e-6)
            np.testing.assert_allclose(np.sum(e1[1:] * unit(np.diff(x, axis=0)), axis=1), 0.0, atol=1e-9)
            np.testing.assert_allclose(np.linalg.norm(e1, axis=1), 1.0, rtol=1e-9)
    assert np.ptp(run.motor_angle, axis=0).min() > 0.3


@pytest.mark.parametrize("name", SCENES)
def test_observables_are_those_of_the_recorded_nodes(name, recorded):
    run = recorded[name]
    frames = range(len(run.times))
    expected: dict[str, Any] = {
        "phase_difference": [phase_difference(run, k) for k in frames],
        "bundle_length": [bundle_length(run, k) for k in frames],
        "steric_force_density": [steric_force_density(run, k) for k in frames],
    }
    intervals, moves, axes = np.diff(run.times), np.diff(run.body_position, axis=0), run.axes()
    along = np.sum(moves * unit(axes[1:] + axes[:-1]), axis=1)
    expected["body_speed"] = [np.nan, *(-along / intervals)]
    expected["motor_rate"] = np.diff(run.motor_angle, axis=0, prepend=np.nan) / (2 * math.pi * intervals[0])
    for observable, values in expected.items():
        np.testing.assert_allclose(getattr(run, observable), values, rtol=1e-6, atol=1e-7, err_msg=observable)
    spun = turns(run, slice(None))[:, 2] / (2 * math.pi * intervals)
    np.testing.assert_allclose(run.body_rate[1:], spun, rtol=1e-2, atol=0.05)
    assert np.isnan(run.body_rate[0])
    if name == "touching":
        energies = [elastic_energies(run.scene, run.start(k)).sum() for k in frames]
        np.testing.assert_allclose(run.elastic_energy, energies, rtol=1e-6, atol=1e-9)
        assert run.steric_force_density.min() > 0.1 and np.ptp(run.bundle_length) > 0.0
        return
    np.testing.assert_allclose(run.motor_drive, drives(run), rtol=1e-9, atol=1e-9)
    forward = [spec.torque for spec in run.scene.resolved_flagella()]
    torques = np.where(drives(run) > 0, forward, run.scene.motor.reverse_torque) * drives(run)
    np.testing.assert_allclose(run.motor_torque[1:], torques[1:], atol=0.02)
    assert run.motor_torque.min() < -0.9 and run.motor_torque[2:].max() > 1.2
    joints = np.array([(run.form[:, own] > 0).sum(axis=1) / (own.stop - own.start - 2) for own in run.rows]).T
    np.testing.assert_allclose(run.target_form_share, joints)
    assert run.target_form_share[-2].min() > 0.0 and run.target_form_share[2].max() == 0.0


def flat(said: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in said.items():
        found |= flat(value, f"{before}{key}.") if isinstance(value, dict) else {before + key: value}
    return found


# Told of the computing, or looked at on runs that are made for it.
OTHERS = {
    **dict.fromkeys(f"accuracy.{key}" for key in ("asked", "estimate", "worst_window", "worst_window_end", "beyond")),
    **dict.fromkeys(f"growth.{key}" for key in ("factor", "from", "within", "between")),
    **dict.fromkeys(["accuracy.steps_at_shortest", "growth", "device_name", "kernel_flags", "wall_time"]),
    **dict.fromkeys(f"versions.{key}" for key in ("warpflag", "python", "warp-lang", "numpy", "h5py", "usd-core")),
    **dict.fromkeys(f"behaviour.wobble.{of}.{key}" for of in ("body", "bundle") for key in (
        *("angle", "precession_rate", "nutation", "nutation_rate"),
    )),
}  # fmt: skip


@pytest.mark.parametrize("name", SCENES)
def test_a_summary_says_what_the_record_has(name, recorded):
    run = recorded[name]
    said, window = flat(run.said), run.window()
    passed = float(run.times[-1] - run.times[window][0])
    motors = (run.motor_angle[-1] - run.motor_angle[window][0]) / (2 * math.pi * passed)
    axes = np.array([attachment(run.scene, spec)[1] for spec in run.scene.resolved_flagella()])
    spun = turns(run, window).sum(axis=0) / (2 * math.pi * passed)

    def first(reached: np.ndarray) -> float | None:
        return float(run.times[reached.argmax()]) if reached.any() else None

    expected: dict[str, Any] = {
        **{"status": "done", "message": "", "scene": run.scene.name, "duration": run.scene.duration, "batch": 1},
        **{"scene_sha256": hashlib.sha256(run.text.encode()).hexdigest(), "start": [], "noise_products": 0},
        **{"stepper": "implicit", "precision": "float64", "device": "cpu", "guards.steps_between_checks": 1},
        **{"guards.violated": None, "balance.judged": True, "balance.violations": 0},
        **{"time": run.times[-1], "frames": len(run.times)},
        **{path.replace("/", "."): values[-1] for path, values in run.values.items() if path.startswith("obs")},
        **{"rates.from": run.times[window][0], "rates.to": run.times[-1], "rates.motor_rate": motors},
        "rates.net_speed": np.linalg.norm(run.body_position[-1] - run.body_position[window][0]) / passed,
        "events.synchronised": first(run.phase_difference < 0.15),
        "events.zipped": first(run.bundle_length >= 0.98),
    }
    about = {"rates.motor_rate_lab": motors + axes @ spun, "rates.body_rate": spun[2]}  # about the axes between frames
    if run.scene.behaviour:
        frames = range(len(run.times))[window]
        joined = []
        for k in frames:
            one, other = run.start(k).positions
            joined.append(max(np.mean(near(one, other)), np.mean(near(other, one))) >= 1 / 3)
        beside = []
        for k in frames:
            for x in run.start(k).positions:
                along = np.abs((x - run.body_position[k]) @ run.axes()[k]) < run.scene.body.length / 2
                beside.append(np.mean(along & (body_gaps(run.scene, run.start(k), x) < 0.44)))
        torques = np.array([spec.torque for spec in run.scene.resolved_flagella()])
        expected |= {"behaviour.runs": None, "behaviour.bundles.count": float(np.mean(joined))}
        expected |= {"behaviour.bundles.members": float(np.mean(joined)), "behaviour.wrapped.flagella": 0.0}
        expected |= {
            "behaviour.wrapped.along_body": np.mean(beside),
            "behaviour.motor_drag": torques / (2 * math.pi * motors),
        }
        forward = run.body_position[-1] - run.body_position[window][0]
        angles = [math.acos(-axis @ unit(forward)) for axis in run.axes()[window]]
        assert said["behaviour.wobble.body.angle"] == pytest.approx(math.degrees(float(np.mean(angles))), rel=1e-6)
    assert said["evaluations"] == said["steps"] + said["rejected_steps"] and said["steps"] >= run.steps[-1]
    counted = {"steps", "rejected_steps", "evaluations"}
    assert set(said) - set(OTHERS) == set(expected) | set(about) | counted
    for key, value in expected.items():
        if isinstance(value, float | np.ndarray | np.floating):
            np.testing.assert_allclose(said[key], value, rtol=1e-6, atol=1e-9, err_msg=key)
        else:
            assert said[key] == value, key
    for key, value in about.items():
        np.testing.assert_allclose(said[key], value, rtol=1e-2, atol=0.05, err_msg=key)
