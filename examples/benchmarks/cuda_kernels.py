"""Registers, stack and shared memory of every kernel on a GPU, and the occupancy that they allow; needs no GPU.

    uv run examples/benchmarks/cuda_kernels.py                        some minutes: it compiles everything
    uv run examples/benchmarks/cuda_kernels.py --precision float32 --arch 90 --kernels mobility steric

The kernels are those that a run launches with every term on, under each stepper, and those of the pictures. Warp
compiles them for the architectures asked for, and the cubins say what they take. Stack: spilled registers and local
arrays per thread, in bytes; it lies in global memory, behind the caches. With 255 registers, the most there are, it is
spills; with fewer, arrays that are indexed at run time, or the long way through a sine. Shared: per block, 1024 bytes
of it Warp's own. Occupancy: the largest share of an SM's threads that can be resident with blocks of --block threads,
by registers and shared memory. A launch here is seldom large enough to fill a GPU: a stack costs at any size, low
occupancy does not.

With cuobjdump on the PATH the numbers are checked against `cuobjdump -res-usage`.
"""

from __future__ import annotations

import argparse
import dataclasses
import importlib
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import warp as wp
import warpflag_kernels
from tools.cells import spread
from tools.cubin import Usage, usage
from tools.harness import table
from warpflag_kernels.base.plan import CONTACT_BLOCK, Plan

from warpflag.base.device import find_device
from warpflag.model.build import plan_of
from warpflag.run.simulation import Simulation
from warpflag.scene import with_values

STEPPERS = ("rkc", "euler", "implicit")


@contextmanager
def collected() -> Iterator[set[Any]]:
    """Kernels that are launched meanwhile, of which none is compiled or run."""
    kernels: set[Any] = set()
    kept = {name: getattr(wp, name) for name in ("launch", "launch_tiled")}
    try:
        for name in kept:
            setattr(wp, name, lambda kernel, *_arguments, **_options: kernels.add(kernel))
        yield kernels
    finally:
        for name, function in kept.items():
            setattr(wp, name, function)


def as_on_gpu(own: Plan) -> Plan:
    """As on a GPU, on the plan's own device."""
    ways = {"launch": "elements", "pair_sum": "warp", "step_pairs": "gathered", "chains": "serial"}
    return dataclasses.replace(own, contact_block=CONTACT_BLOCK, **ways)


def launched(precision: str, stepper: str) -> set[Any]:
    """Kernels of a run with every term of the model."""
    values = {"numerics.stepper": stepper} | ({} if stepper == "euler" else {"numerics.accuracy": 1e-3})
    scene = with_values(spread(3, 10, precision), values)
    sim = Simulation(scene, plan=as_on_gpu(plan_of([scene], find_device("cpu"))))
    sim.system.control.between_steps.fill_(1)  # a pass between two steps has every kernel
    if stepper == "implicit":
        sim.stepper.stability.due.fill_(1)
    with collected() as kernels:
        sim.stepper.launch_pass()
        sim.evaluate()
        sim.cell_state()
    return kernels


def without_precision() -> set[Any]:
    """Kernels in module scope: those of the pictures."""
    folder = Path(warpflag_kernels.__file__).parent
    paths = [path.relative_to(folder).with_suffix("") for path in folder.rglob("[!_]*.py")]
    files = [importlib.import_module(".".join(("warpflag_kernels", *path.parts))) for path in paths]
    return {value for file in files for value in vars(file).values() if isinstance(value, wp.Kernel)}


def label(kernel: Any) -> str:
    """Stage and function, and the switches compiled in."""
    _package, stage, *parts = kernel.module.name.split(".")
    variant = [part.strip("_") for part in parts if part not in ("float64", "float32", "fast")]
    return f"{stage}.{kernel.func.__name__}" + (f" ({', '.join(variant)})" if variant else "")


def compiled(kernels: Iterable[Any], architectures: list[int]) -> dict[tuple[Any, int], Usage]:
    """Usage of every kernel on every architecture."""
    found = {}
    wanted = set(kernels)
    for module in {kernel.module for kernel in wanted}:
        with tempfile.TemporaryDirectory() as folder:
            made = wp.compile_aot_module(module, device=None, arch=architectures, module_dir=folder, use_ptx=False)
            for architecture, path in zip(architectures, made, strict=True):
                resources = usage(path)
                check(path, resources)
                for kernel in (k for k in wanted if k.module is module):
                    name = f"{kernel.get_mangled_name()}_cuda_kernel_forward"
                    if name in resources:
                        found[kernel, architecture] = resources[name]
    missing = [label(k) for k in wanted for a in architectures if (k, a) not in found]
    assert not missing, f"not in the cubins: {missing}"
    return found


def check(cubin: Path, resources: dict[str, Usage]) -> None:
    """Compares with cuobjdump where there is one."""
    tool = shutil.which("cuobjdump")
    if tool is None:
        return
    text = subprocess.run([tool, "-res-usage", str(cubin)], check=True, capture_output=True, text=True).stdout
    stated = re.findall(r"Function (\S+):\s+REG:(\d+) STACK:(\d+) SHARED:(\d+)", text)
    assert {name for name, *_ in stated} == set(resources), cubin
    for name, registers, stack, shared in stated:
        own = resources[name]
        reserved = int(shared) - own.shared
        assert (own.registers, own.stack) == (int(registers), int(stack)) and reserved in (0, 1024), name


def report(found: dict[tuple[Any, int], Usage], architectures: list[int], block: int) -> str:
    """One row per kernel, the heaviest first."""
    head = ["kernel"]
    for architecture in architectures:
        head += [f"sm_{architecture}: registers", "stack", "shared", "occupancy"]
    rows = []
    for kernel in {kernel for kernel, _ in found}:
        uses = [found[kernel, architecture] for architecture in architectures]
        cells = [label(kernel)]
        for architecture, use in zip(architectures, uses, strict=True):
            cells += [use.registers, use.stack, use.shared, f"{100 * use.occupancy(architecture, block):.0f} %"]
        rows.append((max((use.stack, use.registers) for use in uses), cells))
    rows.sort(key=lambda row: (*row[0], row[1][0]), reverse=True)
    return table(head, [cells for _, cells in rows])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--precision", nargs="+", choices=["float64", "float32"], default=["float64", "float32"])
    parser.add_argument("--arch", nargs="+", type=int, default=[80, 90], help="compute capabilities")
    parser.add_argument("--block", type=int, default=256, help="threads of a block")
    parser.add_argument("--kernels", nargs="+", help="only those whose stage or name contains one of these")
    args = parser.parse_args()
    wp.config.quiet = True

    def wanted(kernels: set[Any]) -> set[Any]:
        return {k for k in kernels if not args.kernels or any(word in label(k) for word in args.kernels)}

    groups = {p: set().union(*(launched(p, stepper) for stepper in STEPPERS)) for p in args.precision}
    once = without_precision()
    groups = {p: kernels - once for p, kernels in groups.items()} | {"without precision": once}
    for name, kernels in groups.items():
        if chosen := wanted(kernels):
            print(f"{name}\n\n{report(compiled(chosen, args.arch), args.arch, args.block)}\n", flush=True)
    if shutil.which("cuobjdump"):
        print("All numbers equal cuobjdump's.")


if __name__ == "__main__":
    main()
