"""What a scene requires, before it is run: its stages, memory, step, and the time it takes on this machine."""

from __future__ import annotations

from time import perf_counter
from typing import Any

import warp as wp
from warpflag_kernels.stepping.right_hand_side import stages

from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, dumps

__all__ = ["report"]

_SAMPLE_SECONDS = 0.3


def report(scene: Scene, device: str | None = None) -> str:
    """The resolved scene as TOML, and below it as comments what it requires.

    Args:
        scene: to look at.
        device: "cpu", "cuda:0", ...; None: the preferred one.

    Raises:
        DeviceError: there is no such device.
        NumericalError: a guard is violated in the first steps.
        SceneError: the scene can't be simulated.
    """
    simulation = Simulation(scene, device=device)
    flagella = scene.resolved_flagella()
    segments = sum(spec.segment_count for spec in flagella)
    nodes = segments + len(flagella)
    model = simulation.system.model
    names = ", ".join(name for name, _launch in stages(model))
    longest = float(simulation.system.control.longest_step.numpy()[0])
    values_per_frame = 6 * nodes + 2 * len(flagella) + 14
    cost = _computing_time(simulation, longest)
    lines = [
        f"{len(flagella)} flagella, {segments} segments, {nodes} nodes",
        f"stages of a right-hand side: {names}",
        f"plan: {model.plan.summary()}",
        f"device {simulation.device.alias} ({simulation.device.name}), {scene.numerics.precision}",
        f"memory {_mebibytes(_device_bytes(simulation))} on the device, "
        f"record {_mebibytes(8 * values_per_frame * (scene.frames + 1))}",
        f"stepper {scene.numerics.stepper}, step at most {longest:.3g} s",
        f"time {cost:.3g} ms per simulated ms, {cost * scene.duration:.3g} s in all, from the first steps on this "
        "machine; contacts add to it",
        *simulation.notes[0],
    ]
    return dumps(scene) + "\n# What it requires\n" + "".join(f"# {line}\n" for line in lines)


def _computing_time(simulation: Simulation, step: float) -> float:
    """Seconds of computing per simulated second, from runs that double until one is long enough to time."""
    simulation.prepare()
    reached, end = 0.0, simulation.scenes[0].duration
    while True:
        until = min(max(2 * reached, 4 * step), end)
        began = perf_counter()
        simulation.advance(until)
        taken = perf_counter() - began
        if taken > _SAMPLE_SECONDS or until >= end:
            return taken / (until - reached)
        reached = until


def _device_bytes(simulation: Simulation) -> int:
    """Bytes of all arrays that the simulation holds, each once."""
    sizes: dict[int, int] = {}
    seen: set[int] = set()

    def visit(item: Any) -> None:
        if isinstance(item, wp.array):
            if item.ptr:
                sizes[item.ptr] = item.capacity
        elif id(item) not in seen:
            seen.add(id(item))
            if isinstance(item, list | tuple):
                parts = item
            elif hasattr(item, "_cls"):  # an instance of a Warp struct
                parts = [getattr(item, name) for name in item._cls.vars]
            else:
                own = type(item).__module__.partition(".")[0] in ("warpflag", "warpflag_kernels")
                parts = vars(item).values() if own and hasattr(item, "__dict__") else ()
            for part in parts:
                visit(part)

    visit(simulation)
    return sum(sizes.values())


def _mebibytes(count: int) -> str:
    return f"{count / 2**20:.3g} MiB"
