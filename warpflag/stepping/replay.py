"""The captured pass of a stepper, replayed until every cell of a simulation has reached its target."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from typing import Any

import numpy as np
from warpflag_kernels.base import program

from warpflag.base.device import LAUNCHING
from warpflag.stepping.stepper import Stepper

__all__ = ["Replay"]

_SECONDS_PER_REPLAY = 0.2  # between two reads of the clocks by the host: signals wait no longer; a read takes 1e-5 s


class Replay:
    """Repeats one pass on the device, whose loop condition lies there, too.

    Args:
        control: struct `Control`: the loop condition and how many cells are short of their targets.
        stepper: whose `launch_pass` launches one pass.
        device: Warp's device.
        capture: whether the pass is captured; otherwise every kernel is launched from Python, for the same numbers.
    """

    def __init__(self, control: Any, stepper: Stepper, device: Any, capture: bool) -> None:
        self._control, self._stepper, self._device, self._capture = control, stepper, device, capture
        self._replayed: Callable[[], None] | None = None
        self._passes = 200  # per replay

    def prepare(self) -> None:
        """Captures the pass, if that has not been done; all of its kernels are loaded."""
        if not self._capture or self._replayed is not None:
            return
        self._replayed = program.captured_loop(self._control.proceed, self._stepper.launch_pass, self._device)

    def launch_once(self) -> None:
        """Launches one pass, and what replays it: with all of their kernels."""
        self._stepper.launch_pass()
        program.load(self._device)

    def forget(self) -> None:
        """Drops the captured pass: what it launches has changed."""
        self._replayed = None

    def advance(self, watch: Callable[[], None] | None = None, seconds: float = math.inf) -> None:
        """Replays the pass until no cell is short of its target.

        Args:
            watch: called a few times a second; what it raises ends the advance.
            seconds: wall time after which cells rest at the ends of their steps.
        """
        control = self._control
        began = clock.perf_counter()
        while control.unfinished.numpy()[0] > 0:
            with LAUNCHING:
                control.budget.fill_(self._passes)
                control.proceed.fill_(1)
            started = clock.perf_counter()
            self._replay()
            done = control.budget.numpy()[0] <= 0
            if done:  # a full replay: aim at a fixed wall time between two reads of the clocks
                per_pass = (clock.perf_counter() - started) / self._passes
                self._passes = int(np.clip(_SECONDS_PER_REPLAY / per_pass, 20, 1_000_000))
            if clock.perf_counter() - began > seconds:
                with LAUNCHING:
                    control.rest.fill_(1)
            if watch is not None:
                watch()

    def _replay(self) -> None:
        if self._replayed is not None:
            self._replayed()
            return
        with LAUNCHING:
            while self._control.proceed.numpy()[0] > 0:
                self._stepper.launch_pass()
