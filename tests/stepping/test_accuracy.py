"""What accuracy a run has kept: estimates of all steps added up, told, and limited."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.stepping import accuracy
from warpflag_kernels.stepping.health import Fault
from warpflag_kernels.stepping.step_control import SHORTEST_STEP

from tests.runs import executed, small, summary
from warpflag.run import execute, run
from warpflag.run.simulation import NumericalError, Simulation
from warpflag.run.summary import accuracy_kept, kept_words
from warpflag.scene import paper_scene, with_values

# Of the sums, relative: the device adds the same numbers in float64 in another order of operations.
TOLERANCE = 1e-9
# Round-off of float32 alone is thousands of times this.
HOPELESS = {"numerics.precision": "float32", "numerics.accuracy": 1e-7, "duration": 1e-5}


def sums(**given: float) -> dict[str, float]:
    return dict.fromkeys(accuracy.SUMS, 0.0) | given


def test_estimates_are_means_of_what_steps_may_make():
    """Two steps of 1 and 3 us that err by 2 and 4 times what they may."""
    systematic, independent = 1e-6 * 2 + 3e-6 * 4, 1e-6 * 2**2 + 3e-6 * 4**2
    assert accuracy.estimates(sums(total=systematic, total_time=4e-6), False) == pytest.approx((3.5, 0.0))
    found = accuracy.estimates(sums(total=independent, total_time=4e-6, window=independent, window_time=4e-6), True)
    assert found == pytest.approx((13**0.5, 13**0.5))
    assert accuracy.estimates(sums(), True) is None
    # A window that has just begun does not count beside one that has ended; half a window does.
    begun = sums(total=1.0, total_time=1.0, worst=3.0, window=5e-4, window_time=1e-5)
    assert accuracy.estimates(begun, False) == (1.0, 3.0)
    assert accuracy.estimates(begun | {"window": 6e-4, "window_time": 6e-5}, False) == pytest.approx((1.0, 10.0))
    # A run that ends at once has not spent what a tenth of a millisecond may.
    assert accuracy.last_span(sums(span=2e-4, span_time=1e-6), False) == pytest.approx(2.0)
    assert accuracy.last_span(sums(span=8e-3, span_time=5e-4), True) == pytest.approx(4.0)


@pytest.mark.parametrize("stepper", ["implicit", "rkc"])
def test_the_device_adds_up_the_estimates_of_accepted_steps(stepper, device):
    """Steps of one pass each, whose estimate is read between two: that of implicit by its definition."""
    asked = 1e-2 if stepper == "implicit" else 1e-3
    scene = small({"numerics.stepper": stepper, "numerics.accuracy": asked, "duration": 2.5e-4})
    sim = Simulation(scene, device=device, capture=False)
    steps, found, launch = sim.stepper.steps, [], sim.stepper.launch_pass

    def watched() -> None:
        before = sim.steps[0]
        launch()
        if sim.steps[0] > before:
            dt = sim.system.control.step.numpy()[0]
            if stepper == "rkc":
                error = sim.stepper.data.error.numpy().max()
            else:
                data = sim.stepper.data
                means = data.predictor_error.numpy() / (np.diff(sim.first_node) - 1)
                error = 3.5 * (1.5 * data.theta.numpy()[0] ** 2 - 0.5) * means.max()
            found.append((float(sim.times[0]), dt, float(error)))

    sim.stepper.launch_pass = watched
    sim.advance(scene.duration)
    power = 0.5 if stepper == "implicit" else 1.0
    times, lengths, errors = np.array(found)[2 if stepper == "implicit" else 0 :].T
    counted = times >= accuracy.UNCOUNTED_STEPS * SHORTEST_STEP
    times, lengths, errors = times[counted], lengths[counted], errors[counted]
    assert 5 < counted.sum() < len(counted)
    allowed = asked * (lengths / 1e-3) ** power
    if stepper == "implicit":  # within 5 us errors add up with equal sign
        assert (lengths < 3e-6).any() and (lengths > 5e-6).any()
        allowed *= np.minimum(1.0, np.sqrt(lengths / 5e-6))
    shares = (errors / allowed) ** (1 / power)
    achieved = {name: float(getattr(steps.achieved, name).numpy()[0]) for name in accuracy.SUMS}
    assert achieved["total"] == pytest.approx((lengths * shares).sum(), rel=TOLERANCE)
    assert achieved["total_time"] == pytest.approx(lengths.sum(), rel=TOLERANCE)
    # Windows, cut by hand.
    worst, worst_end, begin = 0.0, 0.0, 0
    for i in range(len(times)):
        inside = slice(begin, i + 1)
        if lengths[inside].sum() >= accuracy.WINDOW:
            level = ((lengths[inside] * shares[inside]).sum() / lengths[inside].sum()) ** power
            if level > worst:
                worst, worst_end = level, times[i]
            begin = i + 1
    assert worst > 0.0 and begin > 0
    assert (achieved["worst"], achieved["worst_end"]) == pytest.approx((worst, worst_end), rel=TOLERANCE)
    assert achieved["window_time"] == pytest.approx(lengths[begin:].sum(), rel=TOLERANCE)


@functools.cache
def counting(independent: bool) -> Any:
    """A kernel that counts steps whose estimates are a share of what they may make, until that is too much."""
    add, may_make = accuracy.functions(independent).add, accuracy.functions(independent).may_make

    @wp.kernel(module="unique")
    def count(
        achieved: accuracy.Achieved,
        dt: wp.float64,
        share: wp.float64,
        steps: wp.int32,
        stopped: wp.array(dtype=wp.int32),
    ):
        error = share * may_make(achieved.asked[0], dt)
        for i in range(steps):
            if stopped[0] == 0 and add(achieved, 0, dt, error, wp.float64(1.0), wp.float64(0.0)):
                stopped[0] = i + 1

    return count


@pytest.mark.parametrize("independent", [True, False])
@pytest.mark.parametrize("stopping", [True, False])
def test_a_run_is_stopped_by_what_a_single_millisecond_makes(independent, stopping, device):
    """Steps of 10 us that all err by a share of what they may: for ever where that is below ten, else within 1 ms."""
    for share, expected in ((9.0, 0), (11.0, 83 if independent else 91)):
        achieved = accuracy.allocate([5e-3], [stopping], device)
        stopped = wp.zeros(1, dtype=wp.int32, device=device)
        wp.launch(counting(independent), 1, inputs=[achieved, 1e-5, share, 3000, stopped], device=device)
        assert stopped.numpy()[0] == (expected if stopping else 0)
        found = {name: float(getattr(achieved, name).numpy()[0]) for name in accuracy.SUMS}
        assert accuracy.estimates(found, independent) == pytest.approx((share, share))


def test_a_run_beyond_ten_times_its_accuracy_stops_or_says_so(tmp_path):
    with pytest.raises(NumericalError) as caught:
        Simulation(small(HOPELESS), device="cpu").run()
    assert caught.value.kind == Fault.ACCURACY and 1e-6 < caught.value.time < 1e-5
    assert "numerics.on_accuracy = warn" in str(caught.value) and "segment" not in str(caught.value)
    outcome = run.start(small(HOPELESS), str(tmp_path / "stopped"), "cpu").execute(quiet=True)
    assert outcome.status == "stopped" and "error estimate" in outcome.message
    directory = executed(small({**HOPELESS, "numerics.on_accuracy": "warn"}), tmp_path / "warned")
    facts = summary(directory)["accuracy"]
    assert facts["beyond"] and facts["estimate"] > 10 * facts["asked"] == pytest.approx(1e-6)
    assert facts["steps_at_shortest"] > 100  # round-off asks for shorter steps than there are
    assert "steps as short as estimates may ask for" in kept_words(facts)


def test_a_run_that_ends_beyond_its_accuracy_is_not_done(tmp_path, monkeypatch):
    """It has erred by more than a tenth of a millisecond may, but not yet by what stops it at once."""
    scenes = [small({"duration": 4e-5, "frames": 4}), small()]
    batch = run.start_batch(scenes, [tmp_path / "sound", tmp_path / "short"], "cpu", movies=False)
    span = batch.simulation.stepper.steps.achieved.span
    span.assign([0.0, 3e-2])
    followed = []
    monkeypatch.setattr(execute, "growth", lambda scene, *given: followed.append((scene, given[3])))
    sound, outcome = batch.execute_all(quiet=True)
    found = summary(tmp_path / "short")
    assert sound.status == "done" and outcome.status == found["status"] == "stopped"
    assert found["guards"]["violated"]["kind"] == "accuracy" and found["guards"]["violated"]["time"] >= 8e-5
    assert found["frames"] == 9  # all of it is there
    assert followed == [(scenes[1], 0.5 * found["guards"]["violated"]["time"] / found["steps"])]
    # Unless the scene says so, and with fixed steps, of which nothing was asked.
    for name, values in {"warned": {"numerics.on_accuracy": "warn"}, "fixed": {"numerics.time_step": 1e-6}}.items():
        started = run.start(small(values), str(tmp_path / name), "cpu")
        started.simulation.stepper.steps.achieved.span.fill_(3e-2)
        assert started.execute(quiet=True).status == "done"
        assert summary(tmp_path / name)["accuracy"]["beyond"]


@pytest.mark.parametrize("stepper", ["implicit", "rkc", "euler"])
def test_a_summary_says_what_was_kept(stepper, tmp_path):
    scene = small({"numerics.stepper": stepper, "duration": 4e-7 if stepper == "euler" else 8e-5})
    started = run.start(scene, str(tmp_path / "run"), "cpu")
    message = started.execute(quiet=True).message
    facts = summary(tmp_path / "run")["accuracy"]
    assert facts["asked"] == 5e-3 and not facts["beyond"]
    if stepper == "euler":
        assert facts["estimate"] is None and "error estimate" not in message
        return
    said = f"{facts['estimate'] / 5e-3:.2g} times the 0.005 um/ms asked for"
    assert 1e-4 < facts["estimate"] < 5e-2 and said in message
    own = accuracy_kept(scene, started.simulation.checkpoint())
    assert own == facts


def test_thin_fluids_may_have_shorter_steps():
    """Ten times as thin, everything is ten times as fast."""
    shortest = [
        Simulation(with_values(paper_scene("x"), {"fluid.viscosity": eta}), device="cpu").stepper.steps.shortest.numpy()
        for eta in (1e-3, 1e-4, 1e-2)
    ]
    np.testing.assert_allclose(np.concatenate(shortest), SHORTEST_STEP * np.array([1.0, 0.1, 1.0]))
