"""Every number of a batch, on the device and on the host, is that of its own scene.

Whatever a simulation holds is walked: a new array needs no line here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from tests.helpers import cell
from tests.model.contents import numbers_of, settings_of
from tests.plans import by_elements, plan
from warpflag.run.simulation import Simulation
from warpflag.scene import Scene, with_values

SHARED = {
    **{"motor.bearing_torque": True, "motor.switching": "schedule", "polymorphs.enabled": True},
    **{"hydrodynamics.body_flow": False, "numerics.stepper": "implicit"},
}
FIRST = {
    **{"duration": 4e-5, "frames": 4, "flagella.filament_radius": 0.010, "flagella.hook_twist_factor": 3.0},
    **{"hook.length": 0.055, "hook.stiffness": 0.65, "hook.stiffening_torque": 0.5, "steric.strength": 0.8},
    **{"motor.law": "torque_speed", "motor.torque": 1.26, "motor.knee": 50.0, "motor.no_load": 200.0},
    **{"motor.reverse_torque": 1.0, "motor.reverse_knee": 40.0, "motor.reverse_no_load": 190.0},
    **{"motor.switch_times": (0.1, 0.2), "motor.switch_ramp": 1e-3, "motor.axis_angle": 50.0},
    **{"polymorphs.nucleation": 1.1, "polymorphs.propagation": 0.6, "polymorphs.front_speed": 200.0},
    **{"polymorphs.nucleation_back": 0.4, "polymorphs.propagation_back": 0.3},
    **{"polymorphs.target": "semicoiled", "polymorphs.semicoiled": (0.0, 2.84, 2.29)},
    **{"external.force_per_length": (0.0, 0.1, 0.0), "external.body_force": (0.2, 0.0, 0.0)},
    **{"fluid.viscosity": 1e-3, "body.length": 2.5, "body.width": 0.8, "hydrodynamics.mode": "consistent"},
    **{"flagella.bending_rigidity": 3.5, "flagella.twist_rigidity": 3.4, "flagella.stretching_stiffness": 1e3},
    **{"flagella.intrinsic_curvature": (0.0, 1.3, -2.1), "flagella.segment_length": 0.2, "flagella.length": 2.0},
    **{"flagella.opening_angle": 90.0, "flagella.anchor_offset": 0.6, "flagella.count": 2},
    **{"numerics.accuracy": 5e-3, "numerics.on_accuracy": "stop"},
}
OTHER = {
    **{"duration": 3e-5, "frames": 7, "flagella.filament_radius": 0.012, "flagella.hook_twist_factor": 2.0},
    **{"hook.length": 0.1, "hook.stiffness": 0.4, "hook.stiffening_torque": 0.2, "steric.strength": 0.5},
    **{"motor.law": "rate", "motor.torque": 0.7, "motor.knee": 20.0, "motor.no_load": 90.0, "motor.rate": 30.0},
    **{"motor.reverse_torque": 0.3, "motor.reverse_knee": 10.0, "motor.reverse_no_load": 80.0},
    **{"motor.switch_times": (0.3, 0.5, 0.7), "motor.switch_ramp": 3e-3, "motor.axis_angle": 30.0},
    **{"polymorphs.nucleation": 1.5, "polymorphs.propagation": 0.4, "polymorphs.front_speed": 40.0},
    **{"polymorphs.nucleation_back": 0.5, "polymorphs.propagation_back": 0.2},
    **{"polymorphs.target": "coiled", "polymorphs.coiled": (0.0, 1.8, -0.5), "polymorphs.semicoiled": (0.0, 2.8, 2.3)},
    **{"external.force_per_length": (0.3, 0.0, 0.1), "external.body_force": (0.0, 0.4, 0.1)},
    **{"fluid.viscosity": 5e-4, "body.length": 3.0, "body.width": 1.0, "hydrodynamics.mode": "all"},
    **{"flagella.bending_rigidity": 3.0, "flagella.twist_rigidity": 4.0, "flagella.stretching_stiffness": 2e3},
    **{"flagella.intrinsic_curvature": (0.0, 1.0, -2.0), "flagella.segment_length": 0.25, "flagella.length": 2.5},
    **{"flagella.opening_angle": 60.0, "flagella.anchor_offset": 0.7, "flagella.count": 3},
    **{"numerics.accuracy": 1e-3, "numerics.on_accuracy": "warn"},
}
# Each kind of simulation: what its scenes share, and what of the above is otherwise in the first and in the other.
KINDS: dict[str, tuple[Mapping[str, Any], Mapping[str, Any], Mapping[str, Any]]] = {
    "implicit": ({}, {}, {}),
    "second form": (
        {"numerics.stepper": "rkc"},
        {"polymorphs.second": "curly_1", "polymorphs.second_rate": 0.68, "polymorphs.ramp": 1e-3},
        {"polymorphs.second": "semicoiled", "polymorphs.second_rate": 3.0, "polymorphs.curly_1": (0.0, 2.5, 4.0)}
        | {"hydrodynamics.pair_radius": 0.08},
    ),
    "drawn switches": (
        {"motor.switching": "markov"},
        {"motor.to_reverse": 30.0, "motor.to_forward": 50.0, "motor.seed": 11, "duration": 0.1},
        {"motor.to_reverse": 20.0, "motor.to_forward": 90.0, "motor.seed": 503, "duration": 0.2}
        | {"motor.coupling": 0.5, "numerics.time_step": 1e-6},
    ),
    "own values": (
        {"numerics.stepper": "euler"},
        {"flagellum.0.azimuth": 10.0, "flagellum.1.azimuth": 200.0, "flagellum.0.anchor_offset": 0.5}
        | {"flagellum.1.motor_axis_angle": 40.0, "flagellum.0.tilt": 20.0, "flagellum.0.torque": 0.3}
        | {"flagellum.1.law": "rate", "flagellum.0.knee": 15.0, "flagellum.0.no_load": 70.0, "flagellum.1.rate": 9.0}
        | {"flagellum.1.switch_times": (0.2, 0.3), "flagellum.0.length": 1.5, "flagellum.1.segments": 9}
        | {"flagellum.0.phase": 30.0, "polymorphs.second": "coiled"},
        {"fluid.drag_parallel": 1.5e-3, "fluid.drag_perpendicular": 2.7e-3, "fluid.drag_rotation": 1.2e-6}
        | {"flagella.helix_radius": 0.2, "flagella.helix_pitch": 2.2, "flagella.nodes_on_helix": True}
        | {"flagella.on_axis": True, "steric.diameter": 0.05}
        | {"flagella.phase_difference": 0.2, "flagella.intrinsic_curvature": (0.0, 1.3, -2.1)}
        | {"flagellum.0.length": 1.8, "hydrodynamics.mode": "consistent"},
    ),
    "flow round the body": (
        {"hydrodynamics.body_flow": True},
        {"body.translation": False, "hydrodynamics.body_beads": 40},
        {"body.axial_rotation": False, "hydrodynamics.body_beads": 50},
    ),
    "in contact": (
        {"flagella.opening_angle": 0.0, "flagellum.0.azimuth": 0.0, "polymorphs.enabled": False},
        {"flagellum.1.azimuth": 6.0, "motor.switch_times": (2e-7,)},
        {"flagellum.1.azimuth": 5.7, "flagellum.2.azimuth": 180.0, "motor.switch_times": (5e-7, 1e-2)},
    ),
    "held": ({}, {"body.anchored": True}, {}),
    "noise": (
        {"polymorphs.enabled": False},
        {"fluid.temperature": 298.0, "fluid.noise_tolerance": 0.1, "fluid.seed": 11}
        | {"motor.averaging_time": 1e-3, "numerics.time_step": 1e-6},
        {"fluid.temperature": 310.0, "fluid.noise_tolerance": 0.05, "fluid.seed": 503}
        | {"motor.averaging_time": 2e-3, "numerics.time_step": 2e-6},
    ),
    "noise, explicit": (
        {"numerics.stepper": "rkc", "motor.switching": "none", "polymorphs.enabled": False},
        {"fluid.temperature": 298.0, "fluid.seed": 11, "motor.law": "constant"},
        {"fluid.temperature": 310.0, "fluid.seed": 503, "motor.law": "constant", "fluid.noise_tolerance": 0.05},
    ),
}
ALIKE = {  # in all scenes of a batch, or of no number that a simulation holds
    **dict.fromkeys(["polymorphs.enabled", "hydrodynamics.body_flow", "steric.enabled", "steric.self_contact"]),
    **dict.fromkeys(["body.enabled", "body.contact", "motor.bearing_torque", "motor.switching"]),
    **dict.fromkeys(["numerics.stepper", "numerics.precision", "numerics.pair_precision"]),
    **dict.fromkeys(["name", "behaviour", "format", "start.record", "start.frame"]),
}


def scenes_of(kind: str) -> list[Scene]:
    shared, first, other = KINDS[kind]
    values = []
    for own, more in ((FIRST, first), (OTHER, other)):
        # Random switches and motors without a law have no schedule; fixed steps and noise have no accuracy.
        joined = {**SHARED, **own, **shared, **more}
        left_out = [] if joined["motor.switching"] == "schedule" else ["motor.switch_times"]
        if "fluid.temperature" in joined:
            left_out += ["numerics.accuracy", "numerics.on_accuracy"]
        values.append({key: value for key, value in joined.items() if key not in left_out})
    return [cell(own) for own in values]


def test_scenes_of_batches_differ_in_every_setting():
    differing = set()
    for kind in KINDS:
        one, other = map(settings_of, scenes_of(kind))
        differing |= {key for key in one | other if one.get(key) != other.get(key)}
    known = set().union(*(settings_of(scene) for kind in KINDS for scene in scenes_of(kind)))
    assert known - differing == set(ALIKE)


def joined_tables(tables: list[Any]) -> np.ndarray:
    """Tables that begin with 0 and end with a count, those of all members in one."""
    return np.concatenate([[0], np.cumsum(np.concatenate([np.diff(table) for table in tables]))])


def assert_joined(batch: Simulation, members: list[Simulation]) -> tuple[set[str], set[str]]:
    """Every array of the batch consists of those of its members alone.

    Returns:
        Names of the arrays that have something of each member, and of those among them that tell the members apart.
    """
    both, own = numbers_of(batch), [numbers_of(member) for member in members]
    parted, telling = set(), set()
    for name, values in both.items():
        parts = [found[name] for found in own]
        lengths = list(map(len, parts))
        if isinstance(values, list | tuple):
            np.testing.assert_equal(list(values), [value for part in parts for value in part], err_msg=name)
        elif all(np.shape(part) == np.shape(values) == (1,) for part in parts):  # of the whole batch, a count or a flag
            assert values[0] in (parts[0][0], sum(parts)[0]), name
        elif len(values) == sum(lengths):
            parted.add(name)
            for c, (end, part) in enumerate(zip(np.cumsum(lengths), parts, strict=True)):
                found = values[end - len(part) : end]
                shifts = np.unique(found - part) if values.dtype.kind == "i" else []
                if len(shifts) == 1 and (shifts[0] > 0 if c else shifts[0] == 0):
                    continue  # it says where things lie; a setting of the first member in place of another is less
                np.testing.assert_array_equal(found, part, err_msg=f"{name} of member {c}")
            least = min(lengths)
            if not np.array_equal(values[:least], values[-least:]):
                telling.add(name)
        elif values.dtype.kind == "i" and len(values) == sum(lengths) - len(members) + 1:
            np.testing.assert_array_equal(values, joined_tables(parts), err_msg=name)
        else:
            assert not np.any(values), f"{name}: what of it is whose?"  # scratch whose members are padded
    return parted, telling


@pytest.mark.parametrize("kind", KINDS)
def test_every_number_of_a_member_is_that_of_its_own_scene(kind, device):
    scenes = scenes_of(kind)
    simulations = [Simulation(own, device=device) for own in (scenes, *scenes)]
    for simulation in simulations:
        simulation.take_frames()
    parted, telling = assert_joined(simulations[0], simulations[1:])
    numbers = numbers_of(simulations[0])
    settings = {
        name
        for name in parted
        if name.startswith("system.model.") and numbers[name].dtype.kind == "f" and numbers[name].size
    }
    assert len(settings) > 20 and settings <= telling


@pytest.mark.parametrize("kind", ["implicit", "own values", "in contact"])
def test_forces_and_powers_of_a_member_are_those_of_its_own_scene(kind, device):
    scenes = scenes_of(kind)
    batch, *alone = (Simulation(own, device=device) for own in (scenes, *scenes))
    for c, member in enumerate(alone):
        both, own = vars(batch.evaluate(c)), vars(member.evaluate())
        assert both["supplied"].keys() == own["supplied"].keys() and sum(map(abs, own["supplied"].values())) > 0.0
        for name in own:
            np.testing.assert_equal(both[name], own[name], err_msg=f"{name} of member {c}")


def carried(simulation: Simulation) -> dict[str, np.ndarray]:
    """What goes on from step to step, and the tolerance of gaps in the last one, by name."""
    law = getattr(simulation.stepper, "law", None)
    return simulation.checkpoint() | ({} if law is None else {"law.gap_tolerance": law.gap_tolerance.numpy().copy()})


GOING_ON = ["implicit", "own values", "flow round the body", "in contact", "noise", "noise, explicit"]


@pytest.mark.parametrize(
    ("kind", "more"),
    [*((kind, {}) for kind in GOING_ON), ("in contact", {"numerics.stepper": "rkc"}), ("flow round the body", None)],
)
def test_members_that_differ_in_every_number_go_on_as_alone(kind, more, device):
    """Whichever of them is the first; also with a thread for every element, as on a GPU (`more` is None)."""
    scenes = [with_values(scene, more or {}) for scene in scenes_of(kind)]
    how: dict[str, Any] = {"device": device} if more is not None else {"plan": by_elements(plan(scenes[0], device))}
    until = 4 * max(scene.numerics.time_step or 2.5e-7 for scene in scenes)
    alone = []
    for scene in scenes:
        member = Simulation(scene, **how)
        member.advance(until)
        alone.append(carried(member))
        assert (member.cell_state().steric_force > 0.0) == (kind == "in contact")
    for order in ((0, 1), (1, 0)):
        batch = Simulation([scenes[k] for k in order], **how)
        batch.advance(until)
        kept = carried(batch)
        for c, k in enumerate(order):
            part = batch.part(kept, c)
            for name, values in alone[k].items():
                np.testing.assert_array_equal(part[name], values, err_msg=f"{name} of member {c} of {order}")


def test_frames_of_members_that_differ_in_every_number_are_those_alone(device):
    """Observables, too, drives and torques of motors that switch meanwhile among them."""
    scenes = [
        with_values(own, {"duration": end}) for own, end in zip(scenes_of("in contact"), (1e-6, 8e-7), strict=True)
    ]
    found: dict[int, list[Any]] = {0: [], 1: []}
    for frames in Simulation(scenes, device=device).cell_frames():
        for c, frame in frames.items():
            found[c].append(frame)
    for c, scene in enumerate(scenes):
        expected = [frames[0] for frames in Simulation(scene, device=device).cell_frames()]
        assert len(found[c]) == len(expected) == scene.frames + 1
        assert (
            expected[-1].observables["motor_drive"][0] < 1.0 and expected[-1].observables["steric_force_density"] > 0.0
        )
        for one, other in zip(found[c], expected, strict=True):
            for name, values in vars(other).items():
                np.testing.assert_equal(getattr(one, name), values, err_msg=f"{name} of member {c}")
