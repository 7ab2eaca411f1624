"""Computing time of a step with noise beside the same step without."""

from __future__ import annotations

import time
from contextlib import ExitStack
from typing import Any
from unittest.mock import patch

import warp as wp
from warpflag_kernels.fluid import noise
from warpflag_kernels.thermal import end_strains, equilibrium, mean_drift, strain_gradients, turned_forces

from .ensembles import ensemble
from .joints import FLOW, HOOKED

CASES = (
    ("two flagella, the paper's model", {}),
    ("three flagella", {"flagella.count": 3}),
    ("eight flagella", {"flagella.count": 8}),
    ("two flagella, flow round the body, hooks", {**FLOW, **HOOKED}),
)


def _quiet_contacts(model: Any, state: Any, s: Any, _noise: Any, _share: float, out: Any) -> None:
    wp.copy(out, s.law.force)


def cost(share: float) -> None:
    """Least times over turns: whole steps, and those of the same stepper at temperature 0: it draws nothing and
    takes linear steps."""
    print("\n| cell | step [µs] | without noise [µs] | ratio |\n|---|---|---|---|")
    for name, values in CASES:
        found: dict[bool, list[float]] = {True: [], False: []}
        for _ in range(max(3, int(share * 15))):
            for noisy, times in found.items():
                with ExitStack() as stack:
                    _, sim = ensemble({"flagella.count": 2, "steric.enabled": True, "body.contact": True,
                                       "numerics.time_step": 1e-6, **values}, 1)  # fmt: skip
                    if not noisy:
                        stack.enter_context(patch.object(noise, "draw_local", lambda *_, **_k: None))
                        stack.enter_context(patch.object(strain_gradients, "add_random_moments", lambda *_: None))
                        stack.enter_context(patch.object(equilibrium, "random_contacts", _quiet_contacts))
                        stack.enter_context(patch.object(end_strains, "correct", lambda *_: None))
                        for step in ("find", "add"):
                            stack.enter_context(patch.object(turned_forces, step, lambda *_: None))
                        for step in ("add_forces", "add_velocities", "remember"):
                            stack.enter_context(patch.object(mean_drift, step, lambda *_: None))
                        stack.enter_context(patch.object(sim.stepper, "draw_flows", lambda **_: None))
                    sim.prepare()
                    sim.advance(1e-5)
                    began = time.process_time()
                    sim.advance(5.1e-4)
                    times.append((time.process_time() - began) / 500)
        with_noise, without = (1e6 * min(times) for times in found.values())
        print(f"| {name} | {with_noise:.0f} | {without:.0f} | {with_noise / without:.2f} |", flush=True)
