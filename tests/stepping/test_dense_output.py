"""Frames are taken from inside steps: they leave steps alone, and lie on the path that the steps follow."""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
import pytest
from warpflag_kernels.stepping import frame_slots

from tests.helpers import as_start
from tests.runs import small
from warpflag.run.simulation import Simulation

TOLERANCE = {"float64": 1e-12, "float32": 2e-5}  # um, rad: round-off of poses that are chained anew
STEPPERS = ("implicit", "rkc", "euler")


def scene_of(stepper: str, precision: str = "float64", **values):
    duration = 4e-7 if stepper == "euler" else 8e-5
    return small({"numerics.stepper": stepper, "numerics.precision": precision, "duration": duration, **values})


@functools.cache
def moving():
    """The cell 2 ms after its start, when steps are long."""
    scene = scene_of("implicit", duration=2e-3)
    sim = Simulation(scene, device="cpu")
    sim.advance(2e-3)
    return dataclasses.replace(as_start(scene, sim.cell_state()), time=0.0)


@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_steps_do_not_depend_on_frames(stepper, device, monkeypatch):
    """Nor on how many of them fall into one step, nor on how many the device holds."""
    monkeypatch.setattr(frame_slots, "MOST_SLOTS", 3)
    ends, times = [], []
    for frames in (2, 1000):
        scene = scene_of(stepper, frames=frames, duration=4e-4)
        sim = Simulation(scene, device=device, strict=True, starts=moving())
        found = list(sim.frames(scene.duration))
        times.append([frame.time for frame in found])
        ends.append((sim.steps[0], sim.state.positions, sim.state.motor_angle))
    assert np.bincount([frame.step for frame in found]).max() > 3  # of one step
    for a, b in zip(*ends, strict=True):
        np.testing.assert_array_equal(a, b)
    assert times[1] == [scene.duration * k / 1000 for k in range(1001)] and times[1][::500] == times[0]


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("stepper", STEPPERS)
def test_the_path_ends_where_the_step_does(stepper, precision, device):
    scene = scene_of(stepper, precision)
    sim = Simulation(scene, device=device)
    *_, frame = sim.frames(scene.duration)
    state, at = sim.state, TOLERANCE[precision]
    assert frame.time == state.time == scene.duration and frame.step == state.step
    np.testing.assert_allclose(frame.positions, state.positions, rtol=0, atol=at)
    np.testing.assert_allclose(frame.directors, state.directors, rtol=0, atol=at)
    np.testing.assert_allclose(frame.motor_angle, state.motor_angle, rtol=0, atol=at)
    np.testing.assert_allclose(frame.body_position, state.body_position, rtol=0, atol=at)
    energy = frame.observables["elastic_energy"]
    assert energy == pytest.approx(state.elastic_energy.sum(), rel=1e-9 if precision == "float64" else 1e-2)


@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_frames_inside_steps_are_of_second_order(stepper, device):
    """Fixed steps, compared with fine ones at the same times: many frames in a step, some motion between two."""
    at = {}
    for step in (4e-6, 2e-6, 2.5e-7):
        scene = scene_of(stepper, duration=1e-4, frames=400, **{"numerics.time_step": step})
        sim = Simulation(scene, device=device, starts=moving())
        at[step] = np.array([frame.positions for frame in sim.frames(scene.duration)])
    coarse, fine = (np.abs(at[step] - at[2.5e-7])[200:].max() for step in (4e-6, 2e-6))
    assert 1e-6 < fine < coarse / 2.5


def test_a_record_does_not_jump_from_step_to_step(device):
    """Second differences of dense frames are alike inside steps and across their ends."""
    scene = scene_of("implicit", duration=4e-4, frames=4000)
    frames = list(Simulation(scene, device=device, starts=moving()).frames(scene.duration))[2000:]
    steps, x = np.array([f.step for f in frames]), np.array([f.positions for f in frames])
    bends = np.abs(x[2:] - 2 * x[1:-1] + x[:-2]).max(axis=(1, 2))
    inside = steps[2:] == steps[:-2]
    assert 5 < np.count_nonzero(~inside) < 500
    assert bends[~inside].max() < 10 * np.median(bends[inside])
