"""Every setting of a scene reaches the numbers of a simulation that it is for, with its value, and no others."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tests.helpers import cell
from tests.model.contents import numbers_of, settings_of
from warpflag.run.simulation import Simulation

# Where numbers lie that are watched, and how they are called here; those of the model and its parts by their own names.
WATCHED = {
    **{"system.model.data.": "", "system.model.optional.": "", "system.chart.base.": "start."},
    **{
        "system.control.longest_step": "longest_step",
        "stepper.steps.": "steps.",
        "stepper.noise.energy": "noise.energy",
    },
    **{"stepper.noise.seed": "noise.seed", "stepper.lanczos.data.tolerance": "noise.tolerance"},
    **{"stepper.motors.time": "averaging_time", "_frames._durations": "duration", "_frames._counts": "frames"},
    **{"_frames._lengths": "mean_length"},
}
PLAIN = {
    **{"flagella.length": 1.0, "numerics.stepper": "implicit", "hook.length": 0.05, "hook.stiffness": 0.5},
    **{"hydrodynamics.mode": "consistent", "hydrodynamics.body_flow": False, "duration": 1e-4, "frames": 10},
}
BARE = {"hook.stiffness": 0.0}
CURVE = {"motor.law": "torque_speed"}  # 3.4 pN um up to 175 Hz, none from 300 Hz on
RATE = {"motor.law": "rate"}
HELIX = {"flagella.helix_radius": 0.25, "flagella.helix_pitch": -2.1}
TIMES = {"motor.switching": "schedule", "motor.switch_times": (2e-5, 6e-5)}
DRAWN = {"motor.switching": "markov", "motor.to_reverse": 3e4, "motor.to_forward": 5e4}
FORMS = {"polymorphs.enabled": True, "motor.torque": -1.26}
SECOND = {**FORMS, "polymorphs.second": "curly_1", "polymorphs.second_rate": 3e4}
NOISE = {"fluid.temperature": 298.0, "numerics.time_step": 1e-6}
PAPER = {"hydrodynamics.mode": "all"}
ROUND = {"hydrodynamics.body_flow": True}


def curve(torque: float = 3.4, knee: float = 175.0, no_load: float = 300.0) -> tuple[float, float, float]:
    """Numbers of the curve of a motor in one sense: torque [pN um], knee [rad/s], slope beyond it [pN um s]."""
    return torque, 2 * math.pi * knee, torque / (2 * math.pi * (no_load - knee))


FORWARD, REVERSE = curve(), curve(knee=0.0)
SHAPE = dict.fromkeys(["start.position", "start.tangent", "start.director"])
REST = {**SHAPE, "rod.rest_strain": None, "hook.helix_axis": None}
PLACE = {"start.position": None, "motor.anchor": None}
STEPS = {"steps.wanted_step": None}
LAW = {"motor_law.*": None}
SWITCHES = {"motor_law.first_switch": None, "shapes": None}
DRAG = {"drag.mobility_along": None, "drag.mobility_across": None, "pairs.radius": None}
BODY = dict.fromkeys(
    f"body.{name}" for name in ("mobility_along", "mobility_across", "spin_mobility", "tumble_mobility")
)
HELD = {"body.mobility_along": 0.0, "body.mobility_across": 0.0}

# Key, what is set beside it, its other value, and all that changes with it: with numbers, those that are there then
# (one for all, or one for each), without, whatever they are. "terms" are those that come and go, "shapes" changes of
# size.
ROWS: list[tuple[str, Mapping[str, Any], Any, Mapping[str, Any]]] = [
    ("name", {}, "other", {}),
    ("behaviour", {}, True, {}),
    ("duration", {}, 2e-4, {"duration": 2e-4}),
    ("frames", {}, 20, {"frames": 20}),
    ("flagella.count", {}, 3, {"shapes": None, "first_flagellum": [0, 3]}),
    ("flagella.length", {}, 1.2, {"shapes": None, "mean_length": 1.2, "first_node": [0, 7, 14]}),
    (
        *("flagella.segment_length", {}, 0.25),
        {"shapes": None, "first_node": [0, 5, 10], "rod.segment_length": 0.25, "pairs.radius": None}
        | {"drag.spin_mobility": 1 / (1.26e-6 * 0.25), "hook.helix_axis": None},
    ),
    ("flagella.opening_angle", {}, 60.0, SHAPE),
    ("flagella.phase_difference", {}, 0.5, SHAPE),
    ("flagella.anchor_offset", {}, 0.7, PLACE),
    ("flagella.bending_rigidity", {}, 3.0, {"rod.bending_rigidity": 3.0}),
    ("flagella.twist_rigidity", {}, 3.0, {"rod.twist_rigidity": 3.0, "rod.hook_rigidity": 9.0}),
    ("flagella.stretching_stiffness", {}, 900.0, {"rod.stretching_stiffness": 900.0}),
    ("flagella.intrinsic_curvature", {}, (0.0, 1.2, -2.0), REST),
    ("flagella.helix_radius", HELIX, 0.2, REST),
    ("flagella.helix_pitch", HELIX, -2.4, REST),
    ("flagella.nodes_on_helix", {}, True, REST),
    ("flagella.on_axis", {}, True, REST),
    ("flagella.filament_radius", {}, 0.012, {**DRAG, "steric.diameter": 0.048}),
    ("flagella.hook_twist_factor", {}, 2.0, {"rod.hook_rigidity": 7.0}),
    ("flagellum.azimuth", {}, 170.0, {**SHAPE, "motor.anchor": None, "motor.axis": None}),
    ("flagellum.anchor_offset", {}, 0.7, PLACE),
    ("flagellum.motor_axis_angle", {}, 40.0, {**SHAPE, "motor.anchor": None, "motor.axis": None}),
    ("flagellum.tilt", {}, 30.0, SHAPE),
    ("flagellum.torque", {}, 2.0, {"motor.torque": [3.4, 2.0]}),
    ("flagellum.law", {}, "rate", {**LAW, "terms": "-motor +motor law", "motor_law.kind": [0, 1]}),
    ("flagellum.knee", CURVE, 150.0, {"motor_law.curve": [FORWARD, REVERSE, curve(knee=150.0), REVERSE]}),
    (
        *("flagellum.no_load", CURVE, 250.0),
        {"motor_law.curve": [FORWARD, REVERSE, curve(no_load=250.0), curve(knee=0.0, no_load=250.0)]},
    ),
    ("flagellum.rate", RATE, 50.0, {"motor_law.rate": [200 * math.pi, 100 * math.pi]}),
    (
        *("flagellum.switch_times", TIMES, (1e-5,)),
        {"shapes": None, "motor_law.first_switch": [0, 4, 7]},
    ),
    ("flagellum.length", {}, 1.2, {"shapes": None, "mean_length": 1.1, "first_node": [0, 6, 13]}),
    (
        *("flagellum.segments", {}, 6),
        {"shapes": None, "first_node": [0, 6, 13], "rod.segment_length": [0.2, 1 / 6], "pairs.radius": None}
        | {"drag.spin_mobility": [1 / (1.26e-6 * 0.2), 1 / (1.26e-6 / 6)], "hook.helix_axis": None},
    ),
    ("flagellum.phase", {}, 30.0, SHAPE),
    ("motor.torque", {}, 2.0, {"motor.torque": 2.0}),
    ("motor.axis_angle", {}, 40.0, {**SHAPE, "motor.anchor": None, "motor.axis": None}),
    ("motor.bearing_torque", BARE, False, {"terms": "-bearing"}),
    ("motor.law", {}, "torque_speed", {**LAW, "terms": "-motor +motor law", "motor_law.curve": [FORWARD, REVERSE] * 2}),
    ("motor.knee", CURVE, 150.0, {"motor_law.curve": [curve(knee=150.0), REVERSE] * 2}),
    (
        *("motor.no_load", CURVE, 250.0),
        {"motor_law.curve": [curve(no_load=250.0), curve(knee=0.0, no_load=250.0)] * 2},
    ),
    ("motor.reverse_torque", CURVE, 2.0, {"motor_law.curve": [FORWARD, curve(2.0, 0.0)] * 2}),
    ("motor.reverse_knee", CURVE, 40.0, {"motor_law.curve": [FORWARD, curve(knee=40.0)] * 2}),
    ("motor.reverse_no_load", CURVE, 200.0, {"motor_law.curve": [FORWARD, curve(knee=0.0, no_load=200.0)] * 2}),
    ("motor.rate", RATE, 50.0, {"motor_law.rate": 100 * math.pi}),
    ("motor.averaging_time", {**CURVE, **NOISE}, 2e-3, {"averaging_time": 2e-3}),
    ("motor.switching", {}, "markov", {**LAW, "terms": "-motor +motor law"}),
    ("motor.switch_times", TIMES, (3e-5, 7e-5), {"motor_law.switch_time": [0.0, 3e-5, 7e-5, 1.1e-4] * 2}),
    (
        *("motor.switch_ramp", TIMES, 1e-4),
        {"motor_law.switch_drive": [1.0, 1.0, 0.2, 1.0] * 2},
    ),
    ("motor.to_reverse", DRAWN, 6e4, SWITCHES),
    ("motor.to_forward", DRAWN, 8e4, SWITCHES),
    ("motor.coupling", DRAWN, 0.5, SWITCHES),
    ("motor.seed", DRAWN, 7, SWITCHES),
    ("hook.length", {}, 0.06, PLACE),
    ("hook.stiffness", {}, 0.6, {"hook.stiffness": 0.6}),
    ("hook.stiffening_torque", {}, 2.0, {"hook.stiffening": 0.5}),
    ("polymorphs.enabled", {}, True, {"polymorphs.*": None, "terms": "+polymorphs"}),
    ("polymorphs.target", FORMS, "coiled", {"polymorphs.rest_strain": None}),
    (
        *("polymorphs.second", FORMS, "curly_1"),
        {"polymorphs.rest_strain": None, "polymorphs.first_second": [0, 1, 2], "shapes": None},
    ),
    ("polymorphs.second_rate", SECOND, 6e4, {"polymorphs.second": None}),
    ("polymorphs.semicoiled", FORMS, (0.0, 2.8, 2.2), {"polymorphs.rest_strain": None}),
    ("polymorphs.curly_1", SECOND, (0.0, 2.5, 4.0), {"polymorphs.rest_strain": None}),
    ("polymorphs.coiled", {**FORMS, "polymorphs.target": "coiled"}, (0.0, 1.7, -0.5), {"polymorphs.rest_strain": None}),
    ("polymorphs.nucleation", FORMS, 1.2, {"polymorphs.nucleation": [(1.2, -0.4)] * 2}),
    ("polymorphs.nucleation_back", FORMS, 0.5, {"polymorphs.nucleation": [(1.1, -0.5)] * 2}),
    ("polymorphs.propagation", FORMS, 0.6, {"polymorphs.propagation": [(0.6, 0.3)] * 2}),
    ("polymorphs.propagation_back", FORMS, 0.2, {"polymorphs.propagation": [(0.4, 0.2)] * 2}),
    ("polymorphs.front_speed", FORMS, 100.0, {"polymorphs.ramp": 2e-3}),
    ("polymorphs.ramp", FORMS, 3e-3, {"polymorphs.ramp": 3e-3}),
    (
        *("fluid.viscosity", {}, 2e-3),
        {"drag.mobility_along": None, "drag.mobility_across": None, **BODY, "pairs.mobility": 1 / (16e-3 * math.pi)}
        | {"drag.spin_mobility": 1 / (2.52e-6 * 0.2)},
    ),
    (  # everything is ten times as fast there, and so are the shortest and the first step
        *("fluid.viscosity", {}, 1e-4),
        {"drag.mobility_along": None, "drag.mobility_across": None, **BODY, "pairs.mobility": 1 / (8e-4 * math.pi)}
        | {"drag.spin_mobility": 1 / (1.26e-7 * 0.2), "steps.shortest": 2e-9, "steps.wanted_step": 1e-9},
    ),
    ("fluid.drag_parallel", PAPER, 1.7e-3, {"drag.mobility_along": [*[5e3 / 1.7] * 5, 1e4 / 1.7] * 2}),
    (
        *("fluid.drag_perpendicular", PAPER, 3e-3),
        {"drag.mobility_across": [*[5e3 / 3] * 5, 1e4 / 3] * 2, "pairs.radius": 0.6e-3 / (6e-3 * math.pi)},
    ),
    ("fluid.drag_rotation", {}, 1.4e-6, {"drag.spin_mobility": 1 / (1.4e-6 * 0.2)}),
    ("fluid.temperature", NOISE, 310.0, {"noise.energy": 1.380649e-5 * 310.0}),
    ("fluid.seed", NOISE, 5, {"noise.seed": None}),
    ("fluid.noise_tolerance", NOISE, 0.01, {"noise.tolerance": 0.01}),
    ("hydrodynamics.mode", {}, "within", {**DRAG, "flows": "all within"}),
    ("hydrodynamics.pair_radius", {}, 0.095, {**DRAG, "pairs.radius": 0.095}),
    ("hydrodynamics.body_flow", {}, True, {**BODY, "body.shell_mobility": None, "flows": "all body"}),
    ("hydrodynamics.body_beads", ROUND, 70, {"body.shell_mobility": None}),
    ("steric.enabled", {}, False, {"terms": "-steric"}),
    ("steric.strength", {}, 0.9, {"steric.strength": 0.9}),
    ("steric.diameter", {}, 0.05, {"steric.diameter": 0.05}),
    ("steric.self_contact", {}, True, {"terms": "-steric +steric with self"}),
    ("body.length", {}, 2.6, {**BODY, "body.half_length": 0.9}),
    ("body.width", {}, 0.9, {**BODY, **PLACE, "body.half_length": 0.8, "body.radius": 0.45}),
    (
        *("body.enabled", {"flagella.count": 1}, False),
        {**BODY, **SHAPE, "motor.anchor": 0.0, "motor.axis": None, "motor.torque": None, "rod.hook_rigidity": 0.0}
        | {"hook.*": None, "flows": "within free", "terms": "-motor -bearing -hook -body contact +free end"},
    ),
    ("body.contact", {}, False, {"terms": "-body contact"}),
    ("body.translation", {}, False, HELD),
    ("body.axial_rotation", {}, False, {"body.spin_mobility": 0.0}),
    ("body.anchored", {}, True, {**HELD, "body.spin_mobility": 0.0, "body.tumble_mobility": 0.0}),
    (
        *("external.force_per_length", {}, (0.1, 0.2, 0.3)),
        {"external.force_per_length": [(0.1, 0.2, 0.3)], "external.body_force": 0.0, "terms": "+external"},
    ),
    (
        *("external.body_force", {}, (0.1, 0.2, 0.3)),
        {"external.body_force": [(0.1, 0.2, 0.3)], "external.force_per_length": 0.0, "terms": "+external"},
    ),
    ("numerics.stepper", {}, "rkc", {"longest_step": 1e-4}),
    (
        *("numerics.time_step", {}, 1e-6),
        {**STEPS, "longest_step": 1e-6, "steps.error_rate": 0.0, "steps.achieved.limit": 0.0},
    ),
    ("numerics.precision", {}, "float32", {"types": None}),
    ("numerics.accuracy", {}, 1e-3, {"steps.error_rate": 1.0, "steps.achieved.asked": 1.0}),
    ("numerics.on_accuracy", {}, "warn", {"steps.achieved.limit": 0.0}),
    ("numerics.pair_precision", {}, "float32", {"flows": "all short pairs"}),
]
ELSEWHERE = {"format", "start.record", "start.frame"}  # of files: tests of scene files and of starts have them


def watched(values: Mapping[str, Any]) -> dict[str, Any]:
    simulation = Simulation(cell(values), device="cpu")
    found: dict[str, Any] = {}
    for path, numbers in numbers_of(simulation).items():
        for begin, name in WATCHED.items():
            if path.startswith(begin) and not path.endswith(("cell_of", "flagellum_of")):
                found[name + path.removeprefix(begin)] = np.asarray(numbers)
    switches = simulation.system.model.switches
    flows = [switches.flows.pairs, *["body"] * switches.flows.body, *["short pairs"] * switches.short_pairs]
    return found | {"terms": [term.name for term in simulation.system.model.terms], "flows": flows}


def changes(before: Mapping[str, Any], after: Mapping[str, Any]) -> set[str]:
    """Names of what is not as before; of numbers of another size or precision only that there are any."""
    found = set()
    for name in before.keys() | after.keys():
        one, other = before.get(name), after.get(name)
        if one is None or other is None:
            found.add(name)
        elif isinstance(one, list):
            found |= {name} if one != other else set()
        elif one.shape != other.shape:
            found.add("shapes")
        else:
            close = 1e-6 if one.dtype != other.dtype else 1e-12
            found |= {"types"} if one.dtype != other.dtype else set()
            found |= {name} if not np.allclose(one, other, rtol=close, atol=0.1 * close) else set()
    return found


@pytest.fixture(scope="module")
def plain() -> dict[str, dict[str, Any]]:
    """What is watched before a setting is changed, by what is set beside it; found once."""
    return {}


def test_every_setting_has_a_row():
    assert {row[0] for row in ROWS} | ELSEWHERE == set(settings_of(cell({"flagellum.1.torque": 1.0})))


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_a_setting_changes_what_it_is_for_and_nothing_else(row, plain):
    key, beside, value, expected = row
    own = PLAIN | beside
    before = plain.setdefault(repr(own), watched(own) if repr(own) not in plain else {})
    name = key.replace("flagellum.", "flagellum.1.")
    after = watched(own | {name: value})
    found = changes(before, after)
    wholes = tuple(each[:-1] for each in expected if each.endswith("*"))
    assert {each for each in found if not each.startswith(wholes or "\0")} == {
        each for each in expected if not each.startswith(wholes or "\0")
    }
    assert all(any(each.startswith(whole) for each in found) for whole in wholes)
    for each, wanted in expected.items():
        if each == "terms":
            words = [*(f"-{term}" for term in before["terms"]), *(f"+{term}" for term in after["terms"])]
            kept = set(before["terms"]) & set(after["terms"])
            assert " ".join(word for word in words if word[1:] not in kept) == wanted
        elif each == "flows":
            assert " ".join(dict.fromkeys(before["flows"] + after["flows"])) == wanted
        elif wanted is not None:
            numbers = after[each]
            whole = np.reshape(wanted, numbers.shape) if np.ndim(wanted) else np.full(numbers.shape, wanted)
            np.testing.assert_allclose(numbers, whole, rtol=1e-12, atol=1e-15, err_msg=each)
