"""Errors of equal sign: their sum is kept, however the estimates of single steps fluctuate; made-up estimates."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.stepping import step_control

from tests.helpers import cell
from warpflag.run.simulation import Simulation

RATE, LEVEL = 5.0, 1.0e11  # um/s, um/s^3: steps of some 6 us
TIME = 4.0e-3  # s


def stepped(spread: float, jumps: float, precision: str, device: str) -> tuple[float, float]:
    """Sum of the errors over what was asked for, in the second half of a run; the rate aimed at, over that asked for.

    Args:
        spread: standard deviation of the logarithm of an estimate.
        jumps: size of an error that does not depend on the step, at every tenth attempt, over what is allowed.
    """
    accept = step_control.functions(Precision(precision), independent=False).accept

    @wp.kernel(module="unique", enable_backward=False)
    def follow(
        # Model:
        noise: wp.array(dtype=wp.float64),
        jump: wp.float64,
        # Out:
        steps: step_control.StepControl,
        sums: wp.array(dtype=wp.float64),
    ):
        time = wp.float64(0.0)
        i = wp.int32(0)
        while time < wp.static(wp.float64(TIME)) and i < noise.shape[0]:
            dt = wp.min(steps.wanted_step[0], wp.float64(1.0e-4))
            error = wp.static(wp.float64(LEVEL)) * dt * dt * dt * noise[i]
            if i % 10 == 0:
                error += jump * dt
            if accept(steps, 0, dt, error, wp.float64(0.0), True, True):
                time += dt
                if time > wp.static(wp.float64(0.5 * TIME)):
                    sums[0] += error
                    sums[1] += dt
            i += 1

    noise = np.exp(spread * np.random.default_rng(3).standard_normal(200_000))
    steps = step_control.allocate([RATE * 1e-3], [False], [False], [1.0], device)
    steps.wanted_step.fill_(1.0e-8)
    sums = wp.zeros(2, dtype=wp.float64, device=device)
    made = wp.array(noise, dtype=wp.float64, device=device)
    wp.launch(follow, 1, inputs=[made, jumps * RATE], outputs=[steps, sums], device=device)
    error, time = sums.numpy()
    assert time > 0.4 * TIME
    return error / (RATE * time), float(steps.lowered.numpy()[0])


@pytest.mark.parametrize(("spread", "jumps"), [(1.0, 0.0), (1.5, 0.0), (0.3, 5.0), (1.5, 3.0)])
def test_the_sum_of_fluctuating_errors_is_what_was_asked(spread, jumps, device, precision):
    accepted = min(jumps, 0.8 * step_control.REJECTED_SYSTEMATIC[precision])
    share, lowered = stepped(spread, accepted, precision, device)
    assert 0.8 < share < 1.2 and lowered < 0.9, (share, lowered)


def test_steady_errors_are_aimed_at_below_what_was_asked(device, precision):
    share, lowered = stepped(0.1, 0.0, precision, device)
    assert share == pytest.approx(step_control.SAFETY, rel=0.05) and lowered == 1.0


def test_a_restored_run_goes_on_with_the_rate_that_it_aimed_at(device, precision):
    """A hundredth of the rate takes steps a tenth as long."""
    sim = Simulation(cell({}, precision), device=device)
    sim.advance(2e-5)
    held, taken = sim.checkpoint(), []
    for lowered in (1.0, 0.01):
        sim.restore({**held, "stepper.lowered": np.full_like(held["stepper.lowered"], lowered)})
        sim.advance(5e-5)
        taken.append(sim.steps[0] - held["control.steps"][0])
    assert taken[1] > 2.5 * taken[0]
