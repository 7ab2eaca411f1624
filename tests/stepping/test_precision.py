"""float32 follows float64, near the origin and a millimetre away from it: positions are relative to the body. All
numbers in float32, or those of the pair sum alone."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from warpflag.model.geometry import initial_state
from warpflag.run.simulation import CellState, Simulation
from warpflag.scene import Scene, load, with_values

ZIPPING = load(Path(__file__).parents[2] / "examples" / "zipping.toml")
DURATION = 2e-3  # s
# Largest distance of a node from where float64 puts it [um]: of float64 itself a millimetre away, where what the
# implicit stepper finds in single precision, flows of force changes and those of its first iteration, rounds
# differently; of float32.
TOLERANCE = {"rkc": {"float64": 1e-8, "float32": 1e-4}, "implicit": {"float64": 1e-6, "float32": 1e-4}}
FAR = np.array([600.0, -500.0, 624.5])  # um; a millimetre


@cache
def run(stepper: str, precision: str, far: bool, device: str, pairs: str = "same") -> CellState:
    """The zipping scene after 2 ms, its body starting at the origin or far from it."""
    step = {"rkc": 1e-5, "implicit": 5e-6}[stepper]
    values = {"stepper": stepper, "precision": precision, "time_step": step, "pair_precision": pairs}
    values = {f"numerics.{name}": value for name, value in values.items()}
    scene: Scene = with_values(ZIPPING, values)
    start = initial_state(scene)
    if far:
        start = dataclasses.replace(
            start, positions=tuple(x + FAR for x in start.positions), body_position=start.body_position + FAR
        )
    sim = Simulation(scene, device=device, starts=start)
    sim.advance(DURATION)
    return sim.cell_state()


@pytest.mark.parametrize("far", [False, True], ids=["origin", "millimetre"])
@pytest.mark.parametrize("stepper", ["rkc", "implicit"])
def test_both_precisions_give_the_same_run_wherever_it_starts(stepper, far, device, precision):
    exact, found = run(stepper, "float64", False, device), run(stepper, precision, far, device)
    place = FAR if far else np.zeros(3)
    apart = TOLERANCE[stepper][precision]
    assert np.abs(found.positions - place - exact.positions).max() < apart
    assert np.abs(found.body_position - place - exact.body_position).max() < apart
    assert np.abs(found.directors - exact.directors).max() < 100 * apart
    assert np.abs(found.motor_angle - exact.motor_angle).max() < 100 * apart
    assert exact.motor_angle.min() > 6.0  # about two turns


@pytest.mark.parametrize("far", [False, True], ids=["origin", "millimetre"])
@pytest.mark.parametrize("stepper", ["rkc", "implicit"])
def test_pairs_in_float32_leave_the_run_where_it_was(stepper, far, device):
    exact, found = run(stepper, "float64", False, device), run(stepper, "float64", far, device, "float32")
    place = FAR if far else np.zeros(3)
    distance = np.abs(found.positions - place - exact.positions).max()
    assert 1e-12 < distance < 1e-6
    assert np.abs(found.motor_angle - exact.motor_angle).max() < 1e-6


def test_slow_motion_adds_up_in_float32(device):
    """A motor so weak that it turns by 7e-6 rad a step."""
    scene = with_values(ZIPPING, {"flagella.length": 2.0, "motor.torque": 1e-3, "numerics.time_step": 1e-6})
    ends = {}
    for precision in ("float64", "float32"):
        sim = Simulation(with_values(scene, {"numerics.precision": precision}), device=device)
        sim.advance(3e-4)
        ends[precision] = sim.cell_state()
    turned = ends["float64"].motor_angle
    assert np.abs(ends["float32"].motor_angle - turned).max() < 0.02 * turned.max()


def test_rkc_controls_its_steps_unless_told_otherwise(device):
    """Water's drag in a fluid of a hundredth its viscosity: steps of 1e-5 s would be 0.1 um off, and say nothing."""
    values = {"numerics.stepper": "rkc", "fluid.viscosity": 1e-5, "duration": 2e-4}
    drag = {"fluid.drag_parallel": 1.6e-3, "fluid.drag_perpendicular": 2.8e-3, "fluid.drag_rotation": 1.26e-6}
    ends = []
    for own in ({}, {"numerics.accuracy": 1e-4}, {"numerics.time_step": 1e-5}):
        sim = Simulation(with_values(ZIPPING, {**values, **drag, **own}), device=device)
        sim.advance(1e-4)
        ends.append(sim.state.positions)
    errors = [np.linalg.norm(end - ends[1], axis=1).max() for end in ends]
    assert errors[0] < 2 * 5e-3 * 0.1 < errors[2]


def test_words_for_the_accuracy_choose_it_and_the_precision_of_large_pair_sums():
    from warpflag.model.terms import switches_of
    from warpflag.scene import Scene, SceneError, dumps, loads, with_values

    scene = Scene(name="levels")
    assert scene.numerics.asked == 5e-3
    small_and_large = {"flagella.count": 2}, {"flagella.count": 40, "body.length": 40.0, "body.width": 6.0}
    for word, asked, short in (("draft", 7e-2, True), ("standard", 5e-3, True), ("careful", 5e-4, False)):
        for values, large in zip(small_and_large, (False, True), strict=True):
            own = with_values(scene, {"numerics.accuracy": word, **values})
            assert own.numerics.asked == asked and loads(dumps(own)) == own
            assert switches_of(own).short_pairs == (short and large)
            by_hand = with_values(own, {"numerics.pair_precision": "same"})
            assert not switches_of(by_hand).short_pairs
    assert not switches_of(with_values(scene, small_and_large[1])).short_pairs  # a number, or nothing, changes nothing
    with pytest.raises(SceneError, match="draft, standard, careful"):
        with_values(scene, {"numerics.accuracy": "sloppy"})
