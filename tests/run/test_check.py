"""`warpflag check`: what a scene leaves out, how large that would be, and the time that it takes."""

from __future__ import annotations

import math
import re
from types import SimpleNamespace

import numpy as np
import pytest

from tests.runs import executed, small
from warpflag.run.check import report, rigid, time_needed
from warpflag.run.check.left_out import EFFECTS, left_out
from warpflag.run.check.noise import of_noise
from warpflag.run.check.polymorphs import of_polymorphs
from warpflag.run.check.rigid import mesh_dependence, turning
from warpflag.run.check.time_needed import Needed, needed
from warpflag.run.simulation import Simulation
from warpflag.scene import with_values
from warpflag.scene.resistance import spheroid_mobility


def lines(**values):
    scene = small({key.replace("__", "."): value for key, value in values.items()})
    return left_out(scene, turning(scene))


def test_an_effect_that_the_scene_has_is_not_told():
    plain = lines()
    assert len(plain) == len(EFFECTS)
    for key, word in {"hook__stiffness": "hook stiffness", "hook__length": "hook length"}.items():
        assert any(line.startswith(word) for line in plain)
        assert not any(line.startswith(word) for line in lines(**{key: 0.05}))
    assert not any("lubrication" in line for line in lines(flagella__count=1))
    assert not any("hook length" in line for line in lines(body__contact=False))


def told(word: str, **values) -> float:
    """The number that the line of an effect tells before or after a word."""
    (found,) = [number for line in lines(**values) if (number := re.search(word, line))]
    return float(found[1])


def test_sizes_of_what_is_left_out_are_those_of_theory():
    """To the digits told; a straight filament, or numbers chosen so that the answer is round."""
    straight = {"flagella__intrinsic_curvature": (0.0, 0.0, 0.0), "flagella__length": 2.0}
    assert told(r"at rest are (\d+) sigma", flagella__helix_radius=0.2, flagella__helix_pitch=1.6) == 40
    assert told(r"is ([\d.]+) of the torque", motor__torque=1.3) == 0.5
    # A segment of 0.2 um that rises to 0.9 sigma over its length.
    assert told(r"by about (\d+) degrees") == round(math.degrees(math.asin(0.9 * 0.04 / 0.2)))
    assert told(r"are ([\d.]+) filament radii", steric__diameter=0.025) == 0.5
    assert any("0.5 filament radii apart; not small" in line for line in lines(steric__diameter=0.025))
    # Clamped rod in equilibrium: kT L^3/(3 A) in each of two directions.
    rest = math.sqrt(2 * 1.380649e-23 * 298.0 * 1e18 * 2.0**3 / (3 * 3.5))
    assert told(r"tips by about ([\d.]+) um", **straight, duration=10.0, frames=1) == pytest.approx(rest, rel=0.05)
    assert told(r"um \(rms\) in (\S+) ms", **straight, duration=2.5e-3) == 2.5
    # Of a helix the lever is the axial length: kT z^2 L/(3 A).
    rest *= turning(small({"flagella.length": 6.0})).axial_length * math.sqrt(6.0 / 2.0**3)
    assert told(r"tips by about ([\d.]+) um", flagella__length=6.0, duration=10.0) == pytest.approx(rest, rel=0.05)
    # SI: density of water 1000 kg/m^3, viscosity 1e-3 Pa s.
    stiff = turning(small())
    number = 1e3 * stiff.tip_speed * 1e-6 * stiff.radius * 1e-6 / 1e-3
    assert told(r"Reynolds number (\S+)") == pytest.approx(number, rel=0.5) and stiff.tip_speed > 0.0
    # The body's Stokeslet along its axis, 3/2 a/r of its speed, from where flagella begin; a sphere's a is its radius.
    sphere = {"body__length": 0.8, "body__width": 0.8, "flagella__anchor_offset": 0.0}
    far = turning(small()).axial_length + 0.4
    mean = np.mean(1.5 * 0.4 / np.linspace(0.4, far, 10001))
    assert told(r"about (\d+) % of the swimming speed", **sphere) == pytest.approx(100 * mean, abs=1.0)
    # Never more than all of it.
    assert (
        told(r"about (\d+) % of the swimming speed", body__length=50.0, body__width=20.0, flagella__length=1.0) == 100
    )
    # Near the rear pole of a long body, whose drag is that of a sphere of another radius.
    a = 1 / (6 * math.pi * 1e-3 * spheroid_mobility(2.5, 0.8, 1e-3).along)
    mean = np.mean(1.5 * a / np.linspace(1.2, 1.2 + turning(small()).axial_length, 10001))
    rear = {"body__length": 2.5, "body__width": 0.8, "flagella__anchor_offset": 1.2}
    assert told(r"about (\d+) % of the swimming speed", **rear) == pytest.approx(100 * mean, abs=1.0)


def test_noise_turns_a_filament_as_rotational_diffusion_does():
    """A straight rod about its end in two directions: <x^2> = 4 kT t L^2/(gamma L^3/3)."""
    values = {"flagella.intrinsic_curvature": (0.0, 0.0, 0.0), "fluid.temperature": 298.0, "duration": 1e-3}
    scene = small({**values, "motor.bearing_torque": True, "hydrodynamics.mode": "none", "flagella.length": 3.0})
    (_, said) = of_noise(scene, 1e-6)
    energy = 1.380649e-23 * 298.0 * 1e18  # pN um
    tip = math.sqrt(4 * energy * 1e-3 * 3.0**2 / (2.8e-3 * 3.0**3 / 3))
    found = re.search(r"tip by about ([\d.]+) um in 1 ms, ([\d.e-]+) um in a step", said)
    assert found is not None and float(found[1]) == pytest.approx(tip, rel=0.05)
    assert float(found[2]) == pytest.approx(tip * math.sqrt(1e-3), rel=0.5)
    assert of_noise(small(), 1e-6) == []
    assert "miss contacts" in of_noise(scene, 5e-6)[-1]
    assert len(of_noise(with_values(scene, {"steric.enabled": False}), 5e-6)) == 2
    # A hook that resists bending does not matter for long before drag/(2 k), 3 ms here.
    soon = of_noise(with_values(scene, {"hook.stiffness": 4.0, "duration": 1e-4}), 1e-6)[1]
    found = re.search(r"tip by about ([\d.]+) um in 0\.1 ms", soon)
    assert found is not None and float(found[1]) == pytest.approx(tip * math.sqrt(0.1), rel=0.05)
    # It holds it: <x^2> = 2 kT/k L^2; a free one lets it point anywhere: 2 L^2.
    for stiffness, far in ((4.0, math.sqrt(2 * energy / 4.0) * 3.0), (0.0, math.sqrt(2) * 3.0)):
        longest = with_values(scene, {"hook.stiffness": stiffness, "duration": 10.0})
        found = re.search(r"tip by about ([\d.]+) um", of_noise(longest, 1e-6)[1])
        assert found is not None and float(found[1]) == pytest.approx(far, rel=0.05)


def test_noise_that_stretches_segments_too_far_is_told():
    """The 5 % of the guard are six standard deviations sqrt(kT/(K h)) at 1000 K."""
    values = {"fluid.temperature": 1000.0, "hydrodynamics.mode": "none", "motor.bearing_torque": True}
    hot = small({**values, "flagella.stretching_stiffness": 1000.0, "flagella.segment_length": 0.2})
    assert len(of_noise(hot, 1e-6)) == 2
    for other in ({"fluid.temperature": 1100.0}, {"flagella.segment_length": 0.1}):
        assert "stretches segments by" in of_noise(with_values(hot, other), 1e-6)[2]


class Steady:
    """A cell that takes 3 s to compile its kernels, 1 s for the start, and then 2 s for a simulated millisecond."""

    first_node, time = np.array([0, 3]), 0.0

    def __init__(self, scene, clock):
        self.scenes, self.clock = (scene,), clock

    def load(self, recording):
        self.clock[0] += 3.0
        return 3.0

    def prepare(self, recording):
        self.clock[0] += 1.0

    @property
    def times(self):
        return np.array([self.time])

    def advance(self, until, watch):
        self.clock[0] += 2e3 * (until - self.time)
        self.time = until

    def cell_state(self):
        nodes = np.arange(9.0).reshape(3, 3)
        return SimpleNamespace(positions=nodes, directors=nodes, steric_force=0.0)


@pytest.mark.parametrize("duration", [2e-4, 2e-3, 0.5])
def test_the_time_of_stepping_is_told_by_the_speed_of_a_sample(duration, monkeypatch):
    clock, scene = [0.0], small({"duration": duration, "frames": 10})
    monkeypatch.setattr("warpflag.run.check.time_needed.time", SimpleNamespace(process_time=lambda: clock[0]))
    found = needed(Steady(scene, clock))
    assert found.startup == 1.0 and found.compiling == 3.0
    assert found.stepping == pytest.approx(2e3 * duration) and found.sampled == pytest.approx(clock[0] - 4.0)


def test_a_crowd_takes_longer_once_it_touches_and_only_where_it_can(monkeypatch):
    clock, crowds = [0.0], []
    monkeypatch.setattr("warpflag.run.check.time_needed.time", SimpleNamespace(process_time=lambda: clock[0]))
    for count, steric in ((2, True), (8, False), (8, True)):
        scene = small({"flagella.count": count, "steric.enabled": steric, "flagella.phase_difference": None})
        crowds.append(needed(Steady(scene, clock)).crowd)
    assert crowds[0] == crowds[1] < crowds[2]


@pytest.mark.parametrize("spin", [1.26e-6, 3e-4])
def test_a_stiff_helix_turns_as_resistive_force_theory_says(spin):
    """Local drag alone: closed forms for a helix of many segments, free to move along its axis."""
    values = {"flagella.length": 6.0, "flagella.segment_length": 0.05, "hydrodynamics.mode": "none"}
    scene = small({**values, "fluid.drag_rotation": spin})
    found = turning(scene)
    o = np.array(scene.flagella.intrinsic_curvature)
    strain, (along, across) = np.linalg.norm(o), (1.6e-3, 2.8e-3)
    radius, c = abs(o[1]) / strain**2, abs(o[2]) / strain
    s = math.sqrt(1 - c * c)
    turn = radius**2 * (along * s * s + across * c * c) + spin * c * c
    move, mixed = along * c * c + across * s * s, radius * s * c * (across - along)
    expected = scene.motor.torque / (6.0 * (turn - mixed**2 / move)) / (2 * math.pi)
    assert found.rate == pytest.approx(expected, rel=0.03)
    assert found.axial_length == pytest.approx(6.0 * c, rel=0.01) and found.radius == pytest.approx(radius, rel=0.01)


def test_a_stiff_helix_feels_its_own_flow_where_the_mode_has_it():
    rate = {mode: turning(small({"hydrodynamics.mode": mode})).rate for mode in ("none", "between", "within", "all")}
    assert rate["within"] == rate["all"] > 1.1 * rate["none"] and rate["between"] == rate["none"]


def test_stiff_helices_side_by_side_drag_each_other_along_where_the_mode_couples_them():
    """Neighbours in phase turn faster, and their rate depends less on the mesh, as the flow of all is smoother."""
    for mode, ratio in {"none": 1.0, "within": 1.0}.items():
        scene = small({"hydrodynamics.mode": mode})
        assert turning(scene, None, 3).rate == pytest.approx(ratio * turning(scene).rate, rel=1e-9)
    scene = small()
    rates = [turning(scene, None, count).rate for count in (1, 2, 3)]
    assert rates[0] < rates[1] < rates[2] < 3 * rates[0]
    alone, three = (mesh_dependence(small({"flagella.count": count}), 0.5) for count in (1, 3))
    assert alone is not None and three is not None and alone < 0.8 * three < 0


@pytest.mark.parametrize("mode, length, torque", [("all", 3.0, 2.0), ("none", 4.0, 1.0)])
def test_the_mesh_error_is_told_within_a_factor_of_two(mode, length, torque):
    """Beside the rate of a single flagellum on an anchored body, on both meshes."""
    rates = []
    values = {"flagella.length": length, "motor.torque": torque, "hydrodynamics.mode": mode, "flagella.count": 1}
    for h in (0.3, 0.15):
        scene = small({**values, "body.anchored": True, "body.contact": False, "flagella.segment_length": h})
        sim = Simulation(scene, device="cpu")
        sim.advance(1e-3)
        angle = sim.state.motor_angle[0]
        sim.advance(3e-3)
        rates.append(sim.state.motor_angle[0] - angle)
    said = mesh_dependence(small({**values, "flagella.segment_length": 0.3}), 0.5)
    assert said is not None and 0.5 < said / (rates[0] / rates[1] - 1) < 2.0


def test_the_time_is_a_range_of_its_parts():
    time = Needed(startup=1.0, compiling=0.0, sampled=0.5, rest=2.0, output=0.3, crowd=3.0)
    assert time.least < time.startup + time.stepping + time.output < time.most
    said = report(small(), "cpu")
    assert "# time " in said and "frames, record and movie" in said and "# What it leaves out" in said
    assert "Reynolds number" in said
    # Of 0.08 ms: the whole has two digits.
    found = re.search(r"stepping (\S+) s \((\S+) ms per simulated ms", said)
    assert found is not None and float(found[2]) == pytest.approx(1e3 * float(found[1]) / 0.08, rel=0.06)


MANY = {"flagella.count": 12, "flagella.length": 0.4, "frames": 400, "duration": 4e-7}


@pytest.mark.parametrize(
    ("values", "within"),
    [
        *(({"frames": 3}, 0.1), ({"frames": 300, "duration": 3e-6}, 0.1), ({"motor.law": "torque_speed"}, 0.1)),
        *((MANY, 0.02), ({**MANY, "motor.law": "torque_speed"}, 0.02)),
    ],
)
def test_the_size_of_the_record_is_told(values, within, tmp_path):
    scene = small({"flagella.length": 1.0, **values})
    size = re.search(r"record (\S+) MiB", report(scene, "cpu"))
    is_of = (executed(scene, tmp_path / "run") / "run.h5").stat().st_size / 2**20
    assert size is not None and float(size[1]) == pytest.approx(is_of, rel=within)


def test_what_has_no_motor_or_no_torque_is_told_of_as_that():
    free = {"body.enabled": False, "flagella.count": 1, "flagella.phase_difference": None}
    still = report(small({"motor.torque": 0.0}), "cpu")
    assert "nan" not in still.split("What it requires")[1] and "mesh: rates" in still and "Reynolds" not in still
    said = report(small(free), "cpu")
    assert "1 flagellum, " in said and "Reynolds" not in said and "mesh: how easily the filament turns" in said
    assert "where flagella touch" not in said and "times that later" in said
    assert "Reynolds" in report(small({**free, "external.force_per_length": (0.0, 0.0, -1.0)}), "cpu")
    assert not any("hook" in line for line in of_noise(small({**free, "fluid.temperature": 300.0}), 1e-6))


CURVES = [("rate", 0.0, 20.0), ("torque_speed", 0.0, 20.0), ("torque_speed", 20.0, 30.0), ("constant", 0.0, 40.0)]


@pytest.mark.parametrize("law, knee, rate", CURVES)
def test_a_stiff_flagellum_turns_by_the_law_of_its_motor(law, knee, rate):
    """Under a load of 40 Hz at stall: halfway from the knee to the rate without load, 40 Hz above it, or 20 below."""
    drag = turning(small()).drag
    motor = {"motor.law": law, "motor.torque": 40.0 * drag, "motor.rate": -20.0}
    motor |= {"motor.knee": knee, "motor.no_load": 40.0 + knee}
    assert turning(small(motor)).rate == pytest.approx(rate)
    if law == "rate":
        (hook,) = [line for line in lines(motor__law=law, motor__rate=0.65 / drag) if line.startswith("hook stiff")]
        assert "is 1 of the torque" in hook


def test_the_mesh_of_flagella_with_segments_of_their_own_is_looked_at():
    own = small({"flagellum.0.segments": 10, "flagellum.1.segments": 10})
    assert mesh_dependence(own, 0.5) == mesh_dependence(small({"flagella.segment_length": 0.2}), 0.5) != 0.0


REVERSING = {"motor.switching": "markov", "motor.to_reverse": 1e4}  # within any run


@pytest.mark.parametrize(
    "values, word",
    [
        ({}, "against the handedness"),
        ({"motor.torque": -1.0}, "beyond 1 pN um, below polymorphs.nucleation 1.1"),
        ({"motor.torque": -1.2}, None),
        ({"motor.torque": 1.2, "flagella.intrinsic_curvature": (0.0, 1.3, 2.1)}, None),
        (
            {"motor.torque": 1.2, "motor.reverse_torque": 0.9, "flagella.intrinsic_curvature": (0.0, 1.3, 2.1)},
            None,  # forward winds up
        ),
        ({"motor.torque": 1.2, "motor.switching": "schedule"}, "against the handedness"),
        ({"motor.torque": 1.2, "motor.switching": "schedule", "motor.switch_times": (1e-5,)}, None),
        ({**REVERSING, "motor.reverse_torque": 0.9}, "beyond 0.9 pN um, below"),
        ({**REVERSING, "motor.torque": 1.3, "motor.law": "torque_speed"}, "1.3 only while they switch"),
        ({"motor.torque": -1.0, "polymorphs.nucleation": 0.9}, None),
        ({"motor.torque": -1.0, "polymorphs.enabled": False}, None),
        ({"motor.law": "rate"}, "against the handedness"),
        ({"motor.law": "rate", "motor.rate": -50.0}, None),
        ({"motor.law": "rate", "motor.rate": 0.0, "motor.torque": -2.0}, "against the handedness"),
        ({"motor.switching": "schedule", "motor.switch_times": (1e-3,), "duration": 1e-3}, "within the run"),
        ({"motor.switching": "markov", "duration": 1e-3}, "within the run"),
        ({"body.enabled": False, "flagella.count": 1, "motor.torque": -3.4}, "without a body"),
        ({"motor.torque": -3.4, "polymorphs.semicoiled": (0.0, 1.3, -2.1)}, "is the ground state"),
        ({"motor.torque": 1.2, "flagella.intrinsic_curvature": (0.0, 0.0, 2.1)}, None),  # straight, but it has a hand
        ({"motor.torque": -2.0, "polymorphs.front_speed": 1000.0}, None),
        ({"motor.torque": -2.0, "polymorphs.front_speed": 1001.0}, "front_speed 1001 um/s: beyond 1000 um/s"),
        ({"motor.torque": -2.0, "polymorphs.ramp": 1e-4}, "ramp 0.0001 s, a front of 2000 um/s"),
        ({"motor.torque": -2.0, "polymorphs.ramp": 2e-4, "polymorphs.front_speed": 1e4}, None),
    ],
)
def test_polymorphs_that_no_motor_can_reach_or_that_change_too_fast_are_told(values, word):
    scene = small({"polymorphs.enabled": True, "flagella.length": 6.0, **values})
    found = of_polymorphs(scene, turning(scene))
    assert len(found) == (word is not None)
    assert all(word in line for line in found)


def test_the_torque_on_a_curve_is_where_it_meets_the_drag():
    """Steady in reverse on the straight line of its curve: told to within its printed digits."""
    values = {"motor.torque": 3.0, "motor.law": "torque_speed", **REVERSING, "flagella.length": 6.0}
    scene = small({"polymorphs.enabled": True, "polymorphs.nucleation": 2.9, **values})
    stiff = turning(scene)
    (line,) = of_polymorphs(scene, stiff)
    torque = float(line.split("about ")[1].split()[0])
    assert torque == pytest.approx(3.0 * (1 - torque / stiff.drag / 300.0), rel=0.05)


def test_a_sample_ends_when_its_time_is_over(monkeypatch):
    """Where steps are slow not one may come to its end: the time is then that of the sample over as good as nothing."""
    simulation = Simulation(small(), device="cpu")
    clock = [0.0]

    def slow(until, watch):
        while True:
            clock[0] += 1.0
            watch()

    monkeypatch.setattr("warpflag.run.check.time_needed.time", SimpleNamespace(process_time=lambda: clock[0]))
    monkeypatch.setattr(simulation, "advance", slow)
    spent, rest = time_needed.stepping_time(simulation, 2.5)
    assert spent == 3.0 and rest == pytest.approx(3.0 / 1e-9 * 8e-5)


def test_the_time_of_all_samples_is_limited(monkeypatch):
    simulation = Simulation(small(), device="cpu")
    clock = [0.0]

    def slower(until, watch):
        """The first to its end in 2 s; the next does not come to one."""
        clock[0] += 2.0
        if clock[0] == 2.0:
            simulation.system.control.time.fill_(until)
            return
        while True:
            watch()
            clock[0] += 1.0

    monkeypatch.setattr("warpflag.run.check.time_needed.time", SimpleNamespace(process_time=lambda: clock[0]))
    monkeypatch.setattr(simulation, "advance", slower)
    simulation.scenes[0] = small({"duration": 0.5, "frames": 10})
    spent, _ = time_needed.stepping_time(simulation, 5.5)
    assert spent == 6.0


def test_long_flagella_are_taken_with_fewer_segments(monkeypatch):
    scene = small({"flagella.length": 6.0, "flagella.segment_length": 0.05, "hydrodynamics.mode": "consistent"})
    fine = turning(scene)
    monkeypatch.setattr(rigid, "MOST_SEGMENTS", 60)
    coarse = turning(scene)
    assert coarse.rate == pytest.approx(fine.rate, rel=0.03) and coarse.rate != fine.rate
    assert any("mesh: not looked at with 120 segments" in line for line in left_out(scene, coarse))


def test_the_mesh_error_is_told_in_per_cent():
    assert told(r"are about ([+-][\d.]+) % off", flagella__length=3.0) == pytest.approx(
        100 * mesh_dependence(small({"flagella.length": 3.0}), 0.5), abs=0.06
    )
