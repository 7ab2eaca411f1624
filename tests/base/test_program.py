"""Launches captured on a device: the order, conditions and loops of the function that makes them; whole numbers."""

from __future__ import annotations

import threading

import numpy as np
import pytest
import warp as wp
from warpflag_kernels.base import program


@wp.kernel(enable_backward=False)
def add(number: wp.int32, slot: wp.int32, sums: wp.array(dtype=wp.int32)):
    """Adds to a slot."""
    sums[slot] = sums[slot] + number


@wp.kernel(enable_backward=False)
def double(sums: wp.array(dtype=wp.int32)):
    i = wp.tid()
    sums[i] = 2 * sums[i]


def one(device: str, value: int) -> wp.array:
    return wp.array([value], dtype=wp.int32, device=device)


def capture(body, device):
    """A captured body that is run once a call."""
    once = one(device, 1)

    def turn() -> None:
        body()
        wp.launch(add, 1, inputs=[-1, 0, once], device=device)

    turn()  # kernels are loaded
    program.load(wp.get_device(device))
    replayed = program.captured_loop(once, turn, wp.get_device(device))

    def run() -> None:
        once.fill_(1)
        replayed()

    return run


def test_launches_keep_their_order_and_their_arguments(device):
    sums = wp.zeros(3, dtype=wp.int32, device=device)

    def body() -> None:
        for number, slot in ((1, 0), (5, 2)):
            wp.launch(add, 1, inputs=[number, slot, sums], device=device)
        wp.launch(double, sums.shape, inputs=[sums], device=device)
        wp.launch(double, 0, inputs=[sums], device=device)  # of no threads
        wp.launch(add, 1, inputs=[3, 0, sums], device=device)

    run = capture(body, device)
    sums.zero_()
    run()
    assert sums.numpy().tolist() == [5, 0, 10]
    run()
    assert sums.numpy().tolist() == [15, 0, 30]


@pytest.mark.parametrize("condition", [0, 1, 7])
def test_what_is_under_a_condition_runs_where_that_is_not_zero(device, condition):
    given, sums = one(device, 1), wp.zeros(2, dtype=wp.int32, device=device)

    def inner(slot: int) -> None:
        wp.launch(add, 1, inputs=[10, slot, sums], device=device)

    def body() -> None:
        wp.capture_if(given, inner, slot=1)
        wp.launch(add, 1, inputs=[1, 0, sums], device=device)

    run = capture(body, device)
    sums.zero_()
    given.fill_(condition)
    run()
    assert sums.numpy().tolist() == [1, 10 * (condition != 0)]


@pytest.mark.parametrize("turns", [0, 1, 3])
def test_loops_in_loops_end_where_their_conditions_are_zero(device, turns):
    outer, inner, sums = one(device, 0), one(device, 0), wp.zeros(2, dtype=wp.int32, device=device)

    def within() -> None:
        wp.launch(add, 1, inputs=[1, 1, sums], device=device)
        wp.launch(add, 1, inputs=[-1, 0, inner], device=device)

    def turn() -> None:
        wp.launch(add, 1, inputs=[1, 0, sums], device=device)
        wp.launch(add, 1, inputs=[2, 0, inner], device=device)
        wp.capture_while(inner, within)
        wp.launch(add, 1, inputs=[-1, 0, outer], device=device)

    run = capture(lambda: wp.capture_while(outer, turn), device)
    sums.zero_()
    outer.fill_(turns)
    run()
    assert sums.numpy().tolist() == [turns, 2 * turns]


def test_arrays_are_copied_and_cleared_at_every_turn(device):
    given, sums, kept = (wp.zeros(3, dtype=wp.int32, device=device) for _ in range(3))

    def body() -> None:
        wp.copy(kept, sums)
        sums.zero_()
        wp.launch(add, 1, inputs=[2, 1, sums], device=device)
        wp.launch(add, 1, inputs=[1, 0, given], device=device)

    run = capture(body, device)
    sums.fill_(5)
    given.zero_()
    run()
    assert sums.numpy().tolist() == [0, 2, 0] and kept.numpy().tolist() == [5, 5, 5]
    run()
    assert kept.numpy().tolist() == [0, 2, 0] and given.numpy()[0] == 2


def test_what_would_not_be_repeated_is_refused():
    sums, half = wp.zeros(4, dtype=wp.int32, device="cpu"), wp.zeros(2, dtype=wp.int32, device="cpu")
    for body in (
        lambda: sums.fill_(1),
        lambda: sums.assign([1, 2, 3, 4]),
        lambda: wp.copy(sums, half),
        lambda: sums[::2].zero_(),
    ):
        with pytest.raises(RuntimeError, match="a captured pass"):
            program.Program(body, wp.get_device("cpu"))
    sums.fill_(3)
    assert sums.numpy().tolist() == [3, 3, 3, 3]


def test_kernels_in_blocks_of_fibers_are_left_to_warp(monkeypatch):
    monkeypatch.setattr(wp.config, "enable_cpu_blocks", True)
    sums = wp.zeros(2, dtype=wp.int32, device="cpu")

    def body() -> None:
        wp.launch(double, sums.shape, inputs=[sums], device="cpu", block_dim=2)

    assert program.Program(body, wp.get_device("cpu")).in_blocks
    run = capture(body, "cpu")
    sums.fill_(1)
    run()
    assert sums.numpy().tolist() == [2, 2]


def test_warp_has_its_own_functions_back_where_a_body_fails():
    own = wp.launch, wp.capture_if, wp.capture_while

    def body() -> None:
        raise ValueError("no launch")

    with pytest.raises(ValueError, match="no launch"):
        program.Program(body, wp.get_device("cpu"))
    assert own == (wp.launch, wp.capture_if, wp.capture_while)


def test_other_threads_go_on_while_one_captures():
    sums = wp.full(2, 7, dtype=wp.int32, device="cpu")

    def body() -> None:
        other = threading.Thread(target=sums.fill_, args=(3,))
        other.start()
        other.join()
        sums.zero_()

    made = program.Program(body, wp.get_device("cpu"))
    assert sums.numpy().tolist() == [3, 3]
    made.run()
    assert sums.numpy().tolist() == [0, 0]


def test_what_a_program_points_to_lives_as_long_as_it_does():
    sums = wp.zeros(1, dtype=wp.int32, device="cpu")

    def body() -> None:
        given = wp.array(np.array([4], dtype=np.int32), device="cpu")  # nothing else keeps it
        wp.launch(add, 1, inputs=[1, 0, given], device="cpu")
        wp.launch(add, 1, inputs=[1, 0, sums], device="cpu")

    body()
    program.load(wp.get_device("cpu"))
    made = program.Program(body, wp.get_device("cpu"))
    for _ in range(1000):
        wp.zeros(1, dtype=wp.int32, device="cpu")
        made.run()
    assert sums.numpy()[0] == 1001
