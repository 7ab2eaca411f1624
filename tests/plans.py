"""Plans for tests: how a GPU executes a scene, on a CPU too, and how a CPU does with one thread for every element."""

from __future__ import annotations

import dataclasses
from typing import Any

from warpflag_kernels.base.plan import Plan

from warpflag.base.device import find_device
from warpflag.model.build import plan_of
from warpflag.scene import Scene

BLOCK = 8  # threads of a contact block, few enough for a CPU's fibers


def plan(scene: Scene, device: Any, **choices: Any) -> Plan:
    """What is chosen for a scene on a device, with other choices by name."""
    return dataclasses.replace(plan_of([scene], find_device(device)), **choices)


def by_elements(own: Plan, **choices: Any) -> Plan:
    """One thread for every element, every chain by one thread, pairs gathered by one thread."""
    pairs = "none" if own.pair_sum == "none" else "thread"
    forms = {"launch": "elements", "pair_sum": pairs, "step_pairs": "gathered", "chains": "serial"}
    return dataclasses.replace(own, **{**forms, **choices})


def as_on_gpu(own: Plan, block: int = BLOCK) -> Plan:
    """As on a GPU: a warp gathers the pairs of a node, a block solves the contacts of a cell.

    On a CPU `wp.config.enable_cpu_blocks` has to be set; the threads of a block are fibers then.
    """
    pairs = "none" if own.pair_sum == "none" else "warp"
    return by_elements(own, pair_sum=pairs, contact_block=block)
