"""A stage that a scene does not need is not compiled, allocated or launched; and what all kernel files keep to."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import warp as wp
import warpflag_kernels
from warpflag_kernels.stepping.right_hand_side import stages
from warpflag_kernels.stepping.terms import TERMS as KERNEL_TERMS

from tests.helpers import cell
from tests.plans import as_on_gpu, plan
from warpflag.model.terms import SCENE_TERMS
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene

FILES = sorted(Path(warpflag_kernels.__file__).parent.rglob("*.py"))
BARE = {"numerics.stepper": "rkc", "hydrodynamics.mode": "none", "steric.enabled": False, "body.contact": False}
# A term, the scene without it, and what then is missing: the stage, its modules, the arrays of the state.
TERMS = {
    "steric": ({"steric.enabled": False}, "steric", {"steric", "steric_measure"}, {"steric_first", "steric_second"}),
    "body contact": ({"body.contact": False}, "body contact", {"steric_body"}, {"body_contact"}),
}


def launches(scene: Scene, monkeypatch: pytest.MonkeyPatch, by_cells: bool = False) -> list[Any]:
    """Kernels that one pass, an evaluation and a look at the state launch, in order.

    Args:
        scene: of the simulation.
        monkeypatch: puts a recorder in place of Warp's launch.
        by_cells: whether one thread takes a whole cell, as on a CPU; else stage by stage, as on a GPU.
    """
    kernels: list[Any] = []
    own = plan(scene, "cpu")
    sim = Simulation(scene, plan=own if by_cells else as_on_gpu(own))
    sim.system.control.between_steps.fill_(1)  # a pass between two steps has every kernel
    with monkeypatch.context() as patch:
        patch.setattr(wp, "launch", lambda kernel, *_args, **_options: kernels.append(kernel))
        sim.stepper.launch_pass()
        sim.evaluate()
        sim.cell_state()
    return kernels


def stages_of(kernels: list[Any]) -> set[str]:
    """First part of the module names: warpflag_kernels.STAGE.precision..."""
    return {kernel.module.name.split(".")[1] for kernel in kernels}


def variants_of(kernels: list[Any], stage: str) -> set[str]:
    names = {kernel.module.name for kernel in kernels if kernel.module.name.split(".")[1] == stage}
    return {name.partition(".fast")[2].lstrip(".") for name in names}


def test_scenes_know_the_terms_that_kernels_have():
    assert [term.name for term in SCENE_TERMS] == [term.name for term in KERNEL_TERMS]


@pytest.mark.parametrize("term", TERMS)
def test_a_term_that_is_off_has_no_stage_no_arrays_and_no_launch(term, monkeypatch):
    values, stage, modules, arrays = TERMS[term]
    with_it, without = cell(), cell(values)
    models = [Simulation(scene, device="cpu").system.model for scene in (with_it, without)]
    names = [[name for name, _launch in stages(model)] for model in models]
    assert names[1] == [name for name in names[0] if name != stage]
    for scene, present in ((with_it, True), (without, False)):
        assert stages_of(launches(scene, monkeypatch)) & modules == (modules if present else set())
        state = Simulation(scene, device="cpu").system.state.data
        for name in arrays:
            assert (getattr(state, name) is not None) == present, name


def test_on_a_cpu_the_forces_of_a_cell_and_their_sums_are_one_launch(monkeypatch):
    scene = cell({"numerics.stepper": "rkc"})
    parts = {"elastic", "steric", "steric_body", "forces", "body", "body_motion"}
    assert not stages_of(launches(scene, monkeypatch, by_cells=True)) & parts
    assert stages_of(launches(scene, monkeypatch)) >= parts


def test_an_implicit_step_without_contacts_has_no_contact_solver(monkeypatch):
    implicit = {"numerics.stepper": "implicit"}
    solver = {"contacts", "contact_search", "contact_solve"}
    assert stages_of(launches(cell(implicit), monkeypatch)) & solver == solver
    off = {"steric.enabled": False, "body.contact": False, **implicit}
    assert not stages_of(launches(cell(off), monkeypatch)) & solver


@pytest.mark.parametrize("mode", ["none", "within", "between", "all"])
def test_the_pair_sum_is_the_one_asked_for(mode, monkeypatch):
    scene, gathered = cell({"hydrodynamics.mode": mode}), "none" if mode == "none" else "warp"
    assert variants_of(launches(scene, monkeypatch), "mobility") == {f"{mode}_{gathered}"}
    own = "none" if mode == "none" else "symmetric"
    assert variants_of(launches(scene, monkeypatch, by_cells=True), "mobility") == {f"{mode}_{own}"}
    model = Simulation(scene, device="cpu").system.model.data
    assert (model.pairs.radius is None) == (mode == "none")


def test_a_single_flagellum_has_no_partner(monkeypatch):
    scene = cell({"flagella.count": 1})
    kernels, both = launches(scene, monkeypatch), launches(cell(), monkeypatch)
    assert variants_of(kernels, "mobility") == {"within_warp"}
    assert not stages_of(kernels) & {"steric", "steric_measure"}
    crossings = [[k for k in found if k.func.__name__ == "check_crossings"] for found in (kernels, both)]
    assert [len(found) for found in crossings] == [0, 1]
    assert Simulation(scene, device="cpu").system.guard.position is None
    between = cell({"flagella.count": 1, "hydrodynamics.mode": "between"})
    assert variants_of(launches(between, monkeypatch), "mobility") == {"none_none"}


def test_contact_with_itself_has_kernels_of_its_own_and_only_then(monkeypatch):
    def with_self(values: dict[str, Any], by_cells: bool) -> set[str]:
        found = launches(cell({"numerics.stepper": "implicit", **values}), monkeypatch, by_cells)
        return {kernel.module.name.split(".")[1] for kernel in found if "self" in kernel.module.name}

    for by_cells in (False, True):
        assert not with_self({}, by_cells) and not with_self({"flagella.count": 1}, by_cells)
        alone = with_self({"steric.self_contact": True, "flagella.count": 1}, by_cells)
        assert alone == with_self({"steric.self_contact": True}, by_cells) >= {"contact_search", "health", "neighbours"}
        assert not with_self({"steric.self_contact": True, "steric.enabled": False}, by_cells)


@pytest.mark.parametrize(
    "stage, values",
    [
        ("body", {"steric.enabled": False}),
        ("forces", {"motor.bearing_torque": False}),
        ("mobility", {"hydrodynamics.body_flow": True}),
        ("first_velocity", {"hydrodynamics.body_flow": True}),
    ],
)
def test_a_kernel_is_not_compiled_again_for_a_switch_that_it_does_not_know(stage, values, monkeypatch):
    implicit = {"numerics.stepper": "implicit"} if stage == "first_velocity" else {}
    both = [launches(cell({**implicit, **own}), monkeypatch, bool(implicit)) for own in ({}, values)]
    modules = [{kernel.module for kernel in found if stage in kernel.module.name.split(".")} for found in both]
    assert modules[0] == modules[1] != set()


@pytest.mark.parametrize("stepper", ["rkc", "euler", "implicit"])
def test_a_stepper_brings_only_its_own_kernels(stepper, monkeypatch):
    stages = stages_of(launches(cell({"numerics.stepper": stepper}), monkeypatch))
    own = {"implicit": "collocation"}
    assert stages & {"rkc", "euler", "collocation"} == {own.get(stepper, stepper)}
    assert ("block_band" in stages) == (stepper == "implicit")


def test_a_bare_scene_loads_a_handful_of_modules(tmp_path):
    """In a fresh process: what Warp says that it compiles or loads."""
    scene = tmp_path / "bare.toml"
    scene.write_text('name = "bare"\n[flagella]\nlength = 0.6\n[numerics]\nstepper = "rkc"\n', encoding="utf-8")
    code = (
        "import warp as wp; from warpflag.scene import load; from warpflag.run.simulation import Simulation; "
        f"scene = load({str(scene)!r}, {[f'{key}={str(value).lower()}' for key, value in BARE.items()]!r}); "
        "sim = Simulation(scene, device='cpu'); wp.config.log_level = wp.LOG_INFO; sim.advance(1e-7); sim.cell_state()"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    loaded = set(re.findall(r"Module warpflag_kernels\.(\S+) \S+ load on", said))
    assert loaded == {
        "clock",
        "program",
        "rkc.float64.fast.cells",
        "rkc_estimate.float64.fast",
        "reconstruction.float64.fast",
        "chart.float64.fast",
        "whole_cell.float64.fast.motor_elastic_bearing",
        "mobility.float64.fast.none_none",
        "elastic_energy.float64.fast",
        "health.float64.fast",
    }


def kernel_functions(tree: ast.Module) -> list[ast.FunctionDef]:
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return [f for f in functions if any("wp.kernel" in ast.unparse(d) for d in f.decorator_list)]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_kernel_arguments_are_grouped_as_model_state_out(path):
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines()
    for function in kernel_functions(ast.parse(source)):
        arguments = function.args.args
        head = [line.strip() for line in lines[function.lineno : arguments[-1].lineno - 1]]
        groups = [line for line in head if line.startswith("#")]
        order = ["# Scene:", "# Model:", "# State:", "# Out:"]  # a scene is what a picture has for a model
        assert groups, f"{path.name}: {function.name}"
        assert groups == [group for group in order if group in groups], f"{path.name}: {function.name}"
        assert head[0] == groups[0], f"{path.name}: {function.name}: arguments before the first group"


def test_no_kernel_is_differentiable_and_none_adds_floats_atomically(precision, monkeypatch):
    for stepper in ("rkc", "euler", "implicit"):
        for kernel in launches(cell({"numerics.stepper": stepper}, precision), monkeypatch):
            assert kernel.module.options["enable_backward"] is False, kernel.module.name
            assert kernel.module.options["fast_math"] is False, kernel.module.name
    integers, atomics = set(), {}
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.AnnAssign) and "dtype=wp.int32" in ast.unparse(node.annotation):
                integers.add(ast.unparse(node.target))
            if isinstance(node, ast.Call) and ast.unparse(node.func).startswith("wp.atomic_"):
                atomics[f"{path.name}: {ast.unparse(node)}"] = ast.unparse(node.args[0]).rpartition(".")[2]
    assert atomics, "the guards note faults atomically: has the search gone blind?"
    assert {call for call, array in atomics.items() if array not in integers} == set()
