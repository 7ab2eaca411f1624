"""What step control decides of single steps whose errors are given: accepted or repeated, and how long the next is."""

from __future__ import annotations

import functools
from typing import Any

import pytest
import warp as wp
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.stepping import step_control

# Relative; decisions are taken in float64 in either precision, which only chooses the round-off of an estimate.
TOLERANCE = 1e-9
ACCURACY = 5e-3  # um/ms
LONGEST = 5e-5  # s
# Independent errors, those of implicit steps, and errors of equal sign: by how much an estimate may exceed what is
# allowed.
KINDS = {"independent": {"float64": 5.0, "float32": 5.0}, "systematic": {"float64": 5.0, "float32": 25.0}}


def allowed(kind: str, dt: float) -> float:
    """Error that a step may make [um]."""
    if kind == "systematic":
        return ACCURACY * dt / 1e-3
    return ACCURACY * min((dt / 1e-3) ** 0.5, dt / (5e-6 * 1e-3) ** 0.5)


@functools.cache
def attempt(kind: str, precision: str) -> Any:
    """A kernel: a step is judged, then the next one chosen."""
    f = step_control.functions(Precision(precision), independent=kind == "independent")
    accept, next_step = f.accept, f.next_step

    @wp.kernel(module="unique")
    def judge(
        control: step_control.StepControl,
        dt: wp.float64,
        error: wp.float64,
        lost: wp.float64,
        sound: wp.bool,
        left: wp.float64,
        accepted: wp.array(dtype=wp.bool),
        step: wp.array(dtype=wp.float64),
    ):
        accepted[0] = accept(control, 0, dt, error, lost, sound, True)
        step[0] = next_step(control, 0, wp.float64(LONGEST), left)

    return judge


class Cell:
    """Step control of one cell; a call is an attempted step and returns whether it was accepted."""

    def __init__(self, kind: str, precision: str, device: str, wanted: float = 1e-5) -> None:
        self.data = step_control.allocate([ACCURACY], [False], [True], [1.0], device)
        self.data.wanted_step.fill_(wanted)
        self._kernel, self._device = attempt(kind, precision), device
        self._accepted = wp.zeros(1, dtype=wp.bool, device=device)
        self._step = wp.zeros(1, dtype=wp.float64, device=device)

    def __call__(self, dt: float, error: float, sound: bool = True, lost: float = 0.0, left: float = 1.0) -> bool:
        inputs = [self.data, dt, error, lost, sound, left, self._accepted, self._step]
        wp.launch(self._kernel, 1, inputs=inputs, device=self._device)
        return bool(self._accepted.numpy()[0])

    def value(self, name: str) -> float:
        return float(getattr(self.data, name).numpy()[0])

    @property
    def next(self) -> float:
        return float(self._step.numpy()[0])


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def cell(kind, precision, device) -> Cell:
    return Cell(kind, precision, device)


def test_a_step_is_repeated_by_halves_where_its_estimate_is_far_above_what_it_may_make(cell, kind, precision):
    most = KINDS[kind][precision] * allowed(kind, 1e-5)
    assert cell(1e-5, 0.99 * most) and cell.value("rejected") == 0
    assert not cell(1e-5, 1.01 * most)
    assert cell.value("rejected") == 1 and cell.value("wanted_step") == 5e-6 == cell.next
    assert not cell(5e-6, 0.0, sound=False)  # what can't be solved is tried with a quarter
    assert cell.value("rejected") == 2 and cell.value("wanted_step") == 1.25e-6


def test_where_halving_does_not_help_a_step_is_accepted(cell, kind):
    """A smooth error falls by eight; where the velocity jumps it falls by two at most."""
    large = 1e3 * allowed(kind, 1e-5)
    assert not cell(1e-5, large)
    assert not cell(5e-6, 0.24 * large)  # it helped: go on
    assert cell(2.5e-6, 0.26 * 0.24 * large)
    assert cell.value("error_time") == 0.0  # jumps say nothing of the level
    # What an accepted step was before is forgotten.
    assert cell(2.5e-6, 0.1 * allowed(kind, 2.5e-6))
    assert not cell(2.5e-6, large)


def test_the_shortest_step_is_accepted_and_counted_where_it_errs_too_much(cell, kind):
    dt = step_control.SHORTEST_STEP
    assert cell(dt, 1e3 * allowed(kind, dt)) and int(cell.data.achieved.at_shortest.numpy()[0]) == 1
    assert cell(dt, 0.5 * allowed(kind, dt)) and int(cell.data.achieved.at_shortest.numpy()[0]) == 1


def test_steps_of_one_level_settle_where_they_err_by_what_is_kept(cell, kind):
    """error = k dt^3: the step at which that is four fifths of what is allowed, reached by factors of two at most."""
    k = 0.8 * allowed(kind, 1e-5) / 1e-5**3
    dt = 1e-7
    for _ in range(10):
        assert cell(dt, k * dt**3)
        assert cell.value("wanted_step") <= 2 * dt * (1 + TOLERANCE)
        dt = cell.value("wanted_step")
    assert dt == pytest.approx(1e-5, rel=TOLERANCE)
    # A step cut to end on a target leaves the one wanted after it as it was, though the level has risen by then.
    assert cell(6e-6, 1.3 * k * 6e-6**3)
    assert cell.value("wanted_step") == pytest.approx(1e-5, rel=TOLERANCE)
    # A level four times as high asks for shorter steps, a little more with each, until they err as before; where errors
    # add up, what was too much is made up for meanwhile by steps that are shorter still.
    lengths = []
    for _ in range(600):
        assert cell(dt, 4 * k * dt**3)
        dt = cell.value("wanted_step")
        lengths.append(dt)
    assert lengths[0] > 7e-6 and (kind == "systematic" or lengths == sorted(lengths, reverse=True))
    assert 4 * k * dt**3 == pytest.approx(0.8 * allowed(kind, dt), rel=1e-2) and dt < 6e-6


def test_estimates_of_round_off_never_shorten_a_step(cell, kind):
    k = 0.8 * allowed(kind, 1e-5) / 1e-5**3
    for _ in range(3):
        assert cell(1e-5, k * 1e-5**3)
    kept = cell.value("wanted_step")
    assert cell(1e-5, 2 * k * 1e-5**3, lost=4 * k * 1e-5**3)
    assert cell.value("wanted_step") >= kept * (1 - TOLERANCE)


def test_the_next_step_ends_on_the_target_or_leaves_two_halves(cell, kind):
    for left, step in ((3e-5, 1e-5), (1.5e-5, 0.75e-5), (0.9e-5, 0.9e-5), (1e-5, 1e-5)):
        cell.data.wanted_step.fill_(0.5e-5)
        assert cell(0.5e-5, 1e-3 * allowed(kind, 0.5e-5), left=left)
        assert cell.value("wanted_step") == pytest.approx(1e-5, rel=TOLERANCE)
        assert cell.next == pytest.approx(step, rel=TOLERANCE)
    assert cell(5e-5, 0.0, left=1.0) and cell.next == LONGEST
