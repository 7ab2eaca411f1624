"""The report of `warpflag check`: the resolved scene, what it requires, and what it leaves out."""

from __future__ import annotations

from time import process_time
from typing import Any

import warp as wp
from warpflag_kernels.stepping.right_hand_side import stages

from warpflag.run.check import large
from warpflag.run.check.left_out import left_out
from warpflag.run.check.noise import of_noise
from warpflag.run.check.polymorphs import of_polymorphs
from warpflag.run.check.rigid import turning
from warpflag.run.check.time_needed import Needed, needed
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, dumps, flagellum_example

__all__ = ["report"]

_RECORD_BYTES, _ENTRY_BYTES = 62_000, 4_500  # of a record without frames, scene and all; of a further entry; measured
_CHUNK_BYTES = 1 << 20  # of a chunk of frames


def report(scene: Scene, device: str | None = None) -> str:
    """The resolved scene as TOML, and below it as comments what it requires and what it leaves out.

    Args:
        scene: to look at.
        device: "cpu", "cuda:0", ...; None: the preferred one.

    Raises:
        DeviceError: there is no such device.
        NumericalError: a guard is violated in the first steps.
        SceneError: the scene can't be simulated.
    """
    began = process_time()
    simulation = Simulation(scene, device=device)
    built = process_time() - began
    flagella = scene.resolved_flagella()
    segments = sum(spec.segment_count for spec in flagella)
    nodes = segments + len(flagella)
    model = simulation.system.model
    names = ", ".join(name for name, _launch in stages(model))
    longest = float(simulation.system.control.longest_step.numpy()[0])
    if nodes > large.LARGEST:
        time, parts = large.needed_by_parts(scene, built, device)
        simulation.take_frames()
    else:
        time, parts = needed(simulation), []
    stiff = turning(scene)
    lines = [
        f"{len(flagella)} {'flagella' if len(flagella) > 1 else 'flagellum'}, {segments} segments, {nodes} nodes",
        f"stages of a right-hand side: {names}",
        f"plan: {model.plan.summary()}",
        f"device {simulation.device.alias} ({simulation.device.name}), {scene.numerics.precision}",
        f"memory {_mebibytes(_device_bytes(simulation))} on the device, "
        f"record {_mebibytes(_record_bytes(simulation, nodes))}",
        f"stepper {scene.numerics.stepper}, step at most {longest:.3g} s",
        *_times(time, scene, parts),
        *simulation.notes[0],
        *of_noise(scene, longest),
        *of_polymorphs(scene, stiff),
    ]
    without = left_out(scene, stiff)
    own = "" if scene.flagellum else "\n" + flagellum_example()
    return (
        dumps(scene)
        + own
        + "\n# What it requires\n"
        + "".join(f"# {line}\n" for line in lines)
        + "\n# What it leaves out, and how large that would be (docs/tradeoff.md)\n"
        + "".join(f"# {line}\n" for line in without)
    )


def _times(time: Needed, scene: Scene, parts: list[int]) -> list[str]:
    per_ms = time.stepping / (1e3 * scene.duration)
    least, most = f"{time.least:.2g}", f"{time.most:.2g}"
    touching = scene.steric.enabled and (len(scene.resolved_flagella()) > 1 or scene.steric.self_contact)
    lines = [
        f"time {least if least == most else f'{least} to {most}'} s of computing: start {time.startup:.1f} s, stepping "
        f"{time.stepping:.2g} s ({1e3 * per_ms:.3g} ms per simulated ms; up to {time.crowd:.2g} times that "
        f"{'where flagella touch' if touching else 'later'}), frames, record and movie {time.output:.2g} s"
    ]
    if parts:
        lines.append(f"which is a guess: from parts of it with {' and '.join(map(str, parts))} nodes")
    if time.compiling:
        lines.append(f"kernels were compiled just now, in {time.compiling:.0f} s, and are in the cache")
    return lines


def _record_bytes(simulation: Simulation, nodes: int) -> int:
    """Of the record: what a frame has of each node, of each flagellum, and of the cell with its checksums; frames are
    stored in chunks."""
    scene, switches = simulation.scenes[0], simulation.system.model.switches
    count, frames = len(scene.resolved_flagella()), scene.frames + 1
    law, forms = switches.has("motor law"), switches.has("polymorphs")
    per_frame = 8 * (6 * nodes + (4 if law else 2) * count + 23) + forms * nodes
    chunk = min(max(_CHUNK_BYTES // (24 * nodes), 16), max(min(frames, 64), 16))
    return _RECORD_BYTES + (2 * law + forms) * _ENTRY_BYTES + per_frame * -(-frames // chunk) * chunk


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
