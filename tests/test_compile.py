"""Every kernel compiles for CUDA (sm_80 and sm_90), in both precisions, on a machine without a GPU."""

from __future__ import annotations

import ast
import importlib
from pathlib import Path
from typing import Any

import pytest
import warp as wp
import warpflag_kernels
from warpflag_kernels.base import program
from warpflag_kernels.base.plan import CONTACT_BLOCK
from warpflag_kernels.stepping import dense_output

from tests.helpers import cell
from tests.plans import as_on_gpu, plan
from warpflag.run.simulation import Simulation

KERNELS = Path(warpflag_kernels.__file__).parent
# With the scene that has every term: each term on and off, and every pair sum.
SWITCHES = {
    "within": {"hydrodynamics.mode": "within", "steric.enabled": False, "motor.bearing_torque": False},
    "between": {"hydrodynamics.mode": "between", "body.contact": False},
    "none": {
        "hydrodynamics.mode": "none",
        "steric.enabled": False,
        "body.contact": False,
        "motor.bearing_torque": False,
    },
    "short": {"numerics.pair_precision": "float32"},
    "hook": {"hook.stiffness": 0.65},
    "free": {"body.enabled": False, "flagella.count": 1},
    "motor law": {
        "motor.law": "torque_speed",
        "polymorphs.enabled": True,
        "hook.stiffness": 0.65,
        "hook.stiffening_torque": 0.5,
    },
    "body flow": {"hydrodynamics.body_flow": True},
    "unequal": {"hydrodynamics.mode": "consistent", "flagellum.0.segments": 10, "flagellum.1.segments": 20},
    "external": {"external.body_force": (0.0, 0.0, 1.0)},
    "self": {"steric.self_contact": True},
}
STEPPERS = ("rkc", "euler", "implicit")
WARM = {"fluid.temperature": 300.0, "hook.stiffness": 4.0}  # steps with thermal noise: implicit and explicit
CROWD = {"flagella.count": 3}  # whose stability the implicit stepper measures
# What switches leave out changes the right-hand side, which all steppers share, and the matrix of the implicit one.
VARIANTS = [
    ("rkc", "within"),
    ("rkc", "between"),
    ("rkc", "none"),
    ("rkc", "short"),
    ("rkc", "external"),
    ("rkc", "self"),
    ("implicit", "self"),
    ("rkc", "motor law"),
    ("implicit", "motor law"),
    ("rkc", "body flow"),
    ("implicit", "body flow"),
    ("implicit", "unequal"),
    ("implicit", "none"),
    ("implicit", "hook"),
    ("rkc", "free"),
]


def kernels_in_source() -> set[tuple[str, str]]:
    """File and name of every function under a kernel decorator."""
    found = set()
    for path in KERNELS.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and any("wp.kernel" in ast.unparse(d) for d in node.decorator_list):
                found.add((path.name, node.name))
    return found


def launched(
    monkeypatch: pytest.MonkeyPatch, precision: str, stepper: str, switches: dict[str, Any], by_cells: bool = False
) -> set[Any]:
    """Kernels that a run of this kind launches, without compiling or running one.

    by_cells: whether one thread takes a whole cell, as on a CPU.
    """
    kernels = set()
    controlled = {} if stepper == "euler" or "fluid.temperature" in switches else {"numerics.accuracy": 1e-3}
    scene = cell({"numerics.stepper": stepper, **controlled, **switches}, precision)
    with monkeypatch.context() as patch:
        own = plan(scene, "cpu")
        sim = Simulation(scene, plan=own if by_cells else as_on_gpu(own, CONTACT_BLOCK), capture=False)
        sim.system.control.between_steps.fill_(1)  # a pass between two steps has every kernel
        if stepper == "implicit" and sim.stepper.stability is not None:
            sim.stepper.stability.due.fill_(1)
        patch.setattr(wp, "launch", lambda kernel, *_args, **_options: kernels.add(kernel))
        patch.setattr(wp, "launch_tiled", lambda kernel, *_args, **_options: kernels.add(kernel))
        patch.setattr(wp, "capture_while", lambda _condition, body, **arguments: body(**arguments))
        sim.prepare(recording=True)
        sim.stepper.launch_pass()
        program.load(sim.device)
        dense_output.take_rest(sim.system.model, sim.system.control, sim.stepper.dense)
        sim.evaluate()
        sim.cell_state()
    return kernels


def named(kernels: set[Any]) -> set[tuple[str, str]]:
    """File and name of each."""
    return {(Path(kernel.adj.filename).name, kernel.func.__name__) for kernel in kernels}


def without_precision() -> set[Any]:
    """Kernels that exist once, in module scope: pictures know no precision."""
    paths = [path.relative_to(KERNELS).with_suffix("") for path in KERNELS.rglob("*.py") if path.stem != "__init__"]
    files = [importlib.import_module(".".join(("warpflag_kernels", *path.parts))) for path in paths]
    return {value for file in files for value in vars(file).values() if isinstance(value, wp.Kernel)}


def test_every_kernel_compiles_for_cuda(precision, monkeypatch, tmp_path):
    whole = set().union(*(launched(monkeypatch, precision, stepper, {}) for stepper in STEPPERS))
    whole |= launched(monkeypatch, precision, "implicit", CROWD)
    whole |= set().union(*(launched(monkeypatch, precision, stepper, WARM) for stepper in ("implicit", "euler")))
    whole |= launched(monkeypatch, precision, "implicit", {**WARM, "fluid.noise_tolerance": 1e-3})
    lawful = {"motor.law": "torque_speed"}
    whole |= launched(monkeypatch, precision, "implicit", {**WARM, **SWITCHES["body flow"], **lawful})
    reduced = set().union(*(launched(monkeypatch, precision, stepper, SWITCHES[name]) for stepper, name in VARIANTS))
    free = {"body.enabled": False, "flagella.count": 1, "fluid.temperature": 300.0}
    reduced |= launched(monkeypatch, precision, "implicit", free)
    reduced |= launched(monkeypatch, precision, "euler", {**WARM, **SWITCHES["body flow"]})
    once = without_precision()
    on_cpu = set().union(*(launched(monkeypatch, precision, stepper, {}, by_cells=True) for stepper in STEPPERS))
    on_cpu |= launched(monkeypatch, precision, "implicit", CROWD, by_cells=True)
    on_cpu |= launched(monkeypatch, precision, "implicit", lawful, by_cells=True)
    on_cpu |= launched(monkeypatch, precision, "implicit", {**WARM, **SWITCHES["body flow"]}, by_cells=True)
    on_cpu |= launched(monkeypatch, precision, "implicit", SWITCHES["body flow"], by_cells=True)
    on_cpu |= launched(monkeypatch, precision, "rkc", SWITCHES["body flow"], by_cells=True)
    assert named(whole | reduced | once | on_cpu) == kernels_in_source()  # none is forgotten, and none lies idle
    # To keep this short, a kernel meets one architecture per precision, and its variants one of the two pairs.
    whole |= {kernel for kernel in reduced | on_cpu if not named({kernel}) <= named(whole)}
    variants = {kernel.module for kernel in reduced | on_cpu} - {kernel.module for kernel in whole}
    single = precision == "float32"
    targets = {module: [80 if single else 90] for module in sorted(variants, key=lambda own: own.name)[single::2]}
    targets |= {kernel.module: [90 if single else 80] for kernel in whole}
    targets |= {kernel.module: [80, 90] for kernel in once if single}
    for module, architectures in targets.items():
        assert module.name.startswith("warpflag_kernels.")
        folder = tmp_path / module.name
        made = wp.compile_aot_module(module, device=None, arch=architectures, module_dir=folder, use_ptx=False)
        assert [path.suffix for path in made] == [".cubin"] * len(architectures)
        for path, arch in zip(made, architectures, strict=True):
            assert f"sm{arch}" in path.name
            assert path.stat().st_size > 1000
