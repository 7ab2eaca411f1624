"""What a sweep file makes: its members, what is random in them, what is refused, and which advance together."""

from __future__ import annotations

import csv
import json
import math
import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from tests.runs import small
from warpflag.model.geometry import initial_state
from warpflag.run.sweep import BadMembers, Sweep, grid_axes, read, resume, start, table
from warpflag.scene import SceneError, dumps, load, with_values


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "base.toml").write_text(dumps(small()))
    return tmp_path


def members(folder, text: str, **options):
    (folder / "sweep.toml").write_text(f'base = "base.toml"\n{text}')
    return read(folder / "sweep.toml", **options).members()


def test_members_are_all_combinations_in_order(folder):
    text = '[axes]\nmotor.torque = [1.0, 2.0]\n"flagella.opening_angle" = { from = 40, to = 90, count = 3 }\n'
    found = members(folder, text)
    assert [tuple(m.values.values()) for m in found] == [(t, a) for t in (1.0, 2.0) for a in (40.0, 65.0, 90.0)]
    assert [m.number for m in found] == [m.point for m in found] == list(range(6))
    assert [m.scene.name for m in found][:2] == ["sweep-0000", "sweep-0001"]
    assert (found[4].scene.motor.torque, found[4].scene.flagella.opening_angle) == (2.0, 65.0)
    assert found[4].scene.flagella.length == 2.0  # the base's


def test_the_sweep_file_of_the_documentation_is_sound(tmp_path):
    root = Path(__file__).parents[3]
    (block,) = re.findall(r"```toml\n(base = .*?)```", (root / "docs" / "sweeps.md").read_text(encoding="utf-8"), re.S)
    (tmp_path / "zipping.toml").write_bytes((root / "examples" / "zipping.toml").read_bytes())
    (tmp_path / "sweep.toml").write_text(block.replace("draws = 16", "draws = 1"))
    assert len(read(tmp_path / "sweep.toml").members()) == 8 * 2 * 3


def test_the_command_line_replaces_axes_and_values(folder):
    found = members(
        folder,
        "[set]\nframes = 2\n[axes]\nmotor.torque = [1.0, 2.0]\n",
        overrides=["frames=4"],
        grid=["motor.torque=3:4:2", "motor.axis_angle=30,40"],
    )
    assert [(m.scene.motor.torque, m.scene.motor.axis_angle) for m in found] == [(3, 30), (3, 40), (4, 30), (4, 40)]
    assert {m.scene.frames for m in found} == {4}
    scene = read(folder / "base.toml", grid=["hydrodynamics.mode=none,all"]).members()
    assert [m.scene.hydrodynamics.mode for m in scene] == ["none", "all"]


def test_a_sweep_is_written_and_read_back(folder):
    text = (
        "repeats = 2\n[set]\nfluid.viscosity = 2e-3\n[axes]\nmotor.torque = {from = 0.1, to = 0.7, count = 3}\n"
        "hydrodynamics.mode = ['none', 'all']\n[random]\nseed = 3\ndraws = 2\nbody.length = {low = 2.0, high = 3.0}\n"
        "flagellum.torque = {mean = 3.0, deviation = 0.2}\nanchors = {placement = 'random', least_distance = 0.3}\n"
    )
    found = members(folder, text)
    assert len(found) == 3 * 2 * 2 * 2
    sweep = read(folder / "sweep.toml")
    again = folder / "again"
    again.mkdir()
    (again / "base.toml").write_text(sweep.base_text())
    (again / "sweep.toml").write_text(sweep.dumps())
    assert [m.scene for m in read(again / "sweep.toml").members()] == [m.scene for m in found]


def test_draws_belong_to_points_and_spreads_to_repeats(folder):
    text = (
        "repeats = 3\n[axes]\nmotor.axis_angle = [40, 50]\n[random]\nseed = 1\ndraws = 4\n"
        "fluid.viscosity = {low = 1e-3, high = 3e-3}\nflagellum.torque = {low = 1.0, high = 2.0}\n"
    )
    found = members(folder, text)
    viscosities = np.array([m.scene.fluid.viscosity for m in found]).reshape(2, 4, 3)
    torques = np.array([[own.torque for own in m.scene.flagellum] for m in found]).reshape(2, 4, 3, 2)
    assert (viscosities[:, :, :1] == viscosities).all() and len(set(viscosities[0, :, 0])) == 4
    np.testing.assert_array_equal(viscosities[0], viscosities[1])  # axes share their draws
    assert len(set(torques[0].ravel())) == 24 and (torques[0] == torques[1]).all()
    assert ((viscosities >= 1e-3) & (viscosities <= 3e-3)).all() and ((torques >= 1.0) & (torques <= 2.0)).all()
    other = members(folder, text.replace("seed = 1", "seed = 2"))
    assert all(a.scene.fluid.viscosity != b.scene.fluid.viscosity for a, b in zip(found, other, strict=True))
    more = members(folder, text.replace("[random]\n", "[random]\nbody.length = {low = 2.0, high = 3.0}\n"))
    assert [m.scene.fluid.viscosity for m in more] == [m.scene.fluid.viscosity for m in found]


@pytest.mark.parametrize(
    "section, values",
    [
        ("motor", 'motor.switching = "markov"'),
        ("fluid", 'fluid.temperature = 298.0\nmotor.bearing_torque = true\nhydrodynamics.mode = "none"'),
    ],
)
def test_every_draw_and_repeat_has_random_numbers_of_its_own(section, values, folder):
    """All but the first, which has the base's; the same at other values of an axis."""
    text = f"repeats = 2\n[set]\n{values}\n{section}.seed = 7\n[axes]\nmotor.torque = [2.0, 3.0]\n[random]\ndraws = 3\n"
    text += "flagella.length = {low = 2.0, high = 2.0}\n"
    seeds = np.array([getattr(m.scene, section).seed for m in members(folder, text)]).reshape(2, 6)
    assert seeds[0, 0] == 7 and len(set(seeds[0])) == 6
    np.testing.assert_array_equal(seeds[0], seeds[1])
    others = [getattr(m.scene, section).seed for m in members(folder, text.replace("seed = 7", "seed = 8"))]
    assert not set(others) & set(seeds[0])  # a sweep of another seed is more samples, none of them twice


def test_normal_spreads_have_their_mean_and_deviation(folder):
    text = "[set]\nflagella.count = 400\nsteric.enabled = false\n[random]\n"
    text += "flagellum.torque = {mean = 3.0, deviation = 0.3}\n"
    (only,) = members(folder, text)
    torques = np.array([own.torque for own in only.scene.flagellum])
    assert abs(torques.mean() - 3.0) < 5 * 0.3 / 20 and abs(torques.std() - 0.3) < 5 * 0.3 / math.sqrt(800)


def test_random_anchors_keep_their_distances(folder):
    text = (
        "repeats = 2\n[set]\nflagella.count = 12\nbody.length = 6.0\n[random]\nseed = 5\n"
        "anchors = {placement = 'random', least_distance = 0.4, clearance = 0.12, from = -1.0, to = 2.5}\n"
    )
    first, second = members(folder, text)
    assert first.values != second.values
    for member in (first, second):
        specs = member.scene.resolved_flagella()
        assert all(-1.0 <= spec.anchor_offset <= 2.5 for spec in specs)
        for a, b in combinations(specs, 2):
            turn = abs((a.azimuth - b.azimuth + 180) % 360 - 180)
            assert math.hypot(math.radians(turn) * 0.4, a.anchor_offset - b.anchor_offset) >= 0.4
        shapes = [nodes[1:] for nodes in initial_state(member.scene).positions]
        for a, b in combinations(shapes, 2):
            assert np.linalg.norm(a[:, None] - b, axis=-1).min() >= 0.12


def test_random_anchors_keep_their_distance_all_round_the_body(folder):
    """On a ring, where the arc between two anchors may lead through azimuth 0."""
    text = (
        "repeats = 20\n[set]\nflagella.count = 5\n[random]\nseed = 1\n"
        "anchors = {placement = 'random', least_distance = 0.3, clearance = 0.0, from = 0.0, to = 0.0}\n"
    )
    gaps = []
    for member in members(folder, text):
        azimuths = np.sort([own.azimuth for own in member.scene.flagellum])
        gaps.append(np.radians(np.diff([*azimuths, azimuths[0] + 360.0])) * member.scene.body.width / 2)
    assert np.min(gaps) >= 0.3
    assert np.min(np.array(gaps)[:, -1]) < 0.5  # some came near over azimuth 0


def test_even_and_given_anchors(folder):
    (even,) = members(
        folder, "[set]\nflagella.count = 40\n[random]\nanchors = {placement = 'even', from = -0.5, to = 0.5}\n"
    )
    offsets = np.array([own.anchor_offset for own in even.scene.flagellum])
    np.testing.assert_allclose(np.diff(offsets), 1.0 / 40, rtol=1e-9)
    np.testing.assert_allclose([offsets[0], offsets[-1]], [-0.4875, 0.4875])
    azimuths = np.sort([own.azimuth for own in even.scene.flagellum])
    assert np.diff([*azimuths, azimuths[0] + 360]).max() < 2 * 360 / 40  # all round the body
    (given,) = members(folder, "[random]\nanchors = {placement = 'given', given = [[10, 0.1], [200, -0.2]]}\n")
    assert [(own.azimuth, own.anchor_offset) for own in given.scene.flagellum] == [(10, 0.1), (200, -0.2)]


@pytest.mark.parametrize(
    "text, words",
    [
        ("axis = 3\n", ["axis", "axes"]),
        ("repeats = 0\n", ["repeats", "1 to"]),
        ("repeats = 2\n[axes]\nmotor.torque = [1.0]\n", ["repeats", "again and again"]),
        ("[axes]\nmotor.torque = []\n", ["motor.torque", "list of values"]),
        ("[axes]\nmotor.torque = [1, 2.0, 1.0]\n", ["motor.torque", "1.0 twice"]),
        ('[axes]\nname = ["a", "b"]\n', ["axes.name", "numbers"]),
        ("[axes]\nmotor.torque = {from = 1, to = 2}\n", ["motor.torque", "count"]),
        ("[axes]\nmotor.torque = {from = 1, to = inf, count = 3}\n", ["motor.torque"]),
        ("[axes]\nmotor.torque = {from = 1, to = 2, count = 1.5}\n", ["motor.torque.count"]),
        ("[axes]\nmotor.torque = {from = 1, to = 2, count = 1}\n", ["motor.torque.count = 1", "2 or more"]),
        ("[random]\nseed = -1\n", ["random.seed"]),
        ("[random]\ndraws = 0\n", ["random.draws"]),
        ("[random]\nmotor.torque = {low = 3, high = 2}\n", ["random.motor.torque", "low"]),
        ("[random]\nmotor.torque = {low = 3, hgh = 2}\n", ["random.motor.torque", "high"]),
        ("[random]\nmotor.torque = {mean = 3, deviation = -1}\n", ["deviation"]),
        (
            "[axes]\nmotor.torque = [1, 2]\n[random]\nmotor.torque = {low = 1, high = 2}\n",
            ["axes.motor.torque", "drawn"],
        ),
        (
            "[axes]\nflagellum.1.torque = [1, 2]\n[random]\nflagellum.torque = {low = 1, high = 2}\n",
            ["axes.flagellum.1.torque", "and 1 more", "drawn"],
        ),
        ("[random]\nanchors = {placement = 'anywhere'}\n", ["random.anchors.placement", "even, given, random"]),
        ("[random]\nanchors = {placement = 'random', distance = 1}\n", ["random.anchors", "least_distance"]),
        ("[random]\nanchors = {placement = 'given', given = [[1, 0.1]]}\n", ["random.anchors.given", "2 pairs"]),
        ("[random]\nanchors = {placement = 'random', least_distance = 9.0}\n", ["no place for flagellum 1"]),
        ("[set]\nflagella.phase_difference = 0.5\n[random]\nanchors = {placement = 'random'}\n", ["phase_difference"]),
    ],
)
def test_what_is_no_sweep_is_one_line(text, words, folder):
    with pytest.raises((SceneError, BadMembers)) as refused:
        members(folder, text)
    line = str(refused.value)
    assert "\n" not in line and all(word in line for word in words), line


@pytest.mark.parametrize(
    "argument",
    [
        *("motor.torque", "motor.torque=", "motor.torque=1:2:x", "motor.torque=1:2:0", "=1:2:3"),
        *("motor.torque=1:2:3:exp", "motor.torque=0:2:3:log", "motor.torque=1:2:3:log:4"),
    ],
)
def test_a_malformed_grid_is_refused(argument):
    with pytest.raises(SceneError, match="--grid"):
        grid_axes([argument])


def test_a_logarithmic_axis_has_equal_ratios(folder):
    text = "[axes]\nfluid.viscosity = { from = 1e-3, to = 8e-3, count = 4, spacing = 'log' }\n"
    found = [member.scene.fluid.viscosity for member in members(folder, text)]
    np.testing.assert_allclose(found, [1e-3, 2e-3, 4e-3, 8e-3], rtol=1e-12)
    assert (found[0], found[-1]) == (1e-3, 8e-3)
    assert grid_axes(["fluid.viscosity=1e-3:8e-3:4:log"]) == {"fluid.viscosity": found}
    for low in (0.0, -1e-3):
        with pytest.raises(SceneError, match=r"axes\.fluid\.viscosity = .* must have from and to above 0"):
            members(folder, text.replace("1e-3", str(low)))
    linear = "[axes]\nfluid.viscosity = { from = 1e-3, to = 8e-3, count = 2, spacing = 'linear' }\n"
    assert [member.scene.fluid.viscosity for member in members(folder, linear)] == [1e-3, 8e-3]


@pytest.mark.parametrize(
    "section, key", [("fluid.temperature = 298.0", "fluid"), ("motor.switching = 'markov'", "motor")]
)
def test_every_repeat_tells_its_seed(section, key, folder):
    text = f"repeats = 3\n[set]\n{section}\n{key}.seed = 7\n[axes]\nmotor.torque = [1.0, 2.0]\n"
    found = members(folder, text)
    seeds = [member.values[f"{key}.seed"] for member in found]
    assert seeds == [getattr(member.scene, key).seed for member in found]
    assert seeds[0] == 7 and len(set(seeds[:3])) == 3 and seeds[3:] == seeds[:3]


def test_every_line_names_its_member(folder):
    with pytest.raises(BadMembers) as refused:
        members(folder, "[axes]\nmotor.torque = [1.0, 5e3]\nfluid.viscosity = [1e-3, -1.0]\n")
    lines = str(refused.value).splitlines()
    assert [line.partition(": ")[0] for line in lines] == ["member 0001 and 1 more", "member 0002 and 1 more"]


def test_a_base_that_is_a_run_names_its_scene(folder):
    (folder / "run").mkdir()
    (folder / "run" / "scene.toml").write_text(dumps(small()))
    (folder / "of_run.toml").write_text('base = "run"\n[axes]\nmotor.torque = [1.0]\n')
    with pytest.raises(SceneError, match=r"is a directory; did you mean .*run/scene\.toml\?"):
        read(folder / "of_run.toml")


def test_an_axis_of_vectors_on_the_command_line_and_one_given_twice():
    vectors = grid_axes(["external.force_per_length=[0,0,1],[0,0,2]", "motor.torque=1,2"])
    assert vectors == {"external.force_per_length": [[0, 0, 1], [0, 0, 2]], "motor.torque": [1, 2]}
    with pytest.raises(SceneError, match=r"^--grid: motor\.torque = .* is given twice"):
        grid_axes(["motor.torque=1,2", "motor.torque=3,4"])


def test_a_sweep_of_python_values_is_read_back_the_same(tmp_path):
    """Arrays of NumPy, ranges and None are written as what TOML has."""
    axes = {
        "motor.torque": np.linspace(1.0, 2.0, 3),
        "flagella.count": range(2, 4),
        "steric.enabled": np.array([True, False]),
        "numerics.time_step": (None, np.float64(1e-7)),
        "external.force_per_length": np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 2.0]]),
        "motor.axis_angle": {"from": 40, "to": 50, "count": 2},
    }
    plan = Sweep(small(), axes, {"draws": np.int64(2), "fluid.viscosity": {"low": np.float64(1e-3), "high": 2e-3}})
    started = start(plan, str(tmp_path / "out"))
    again = resume(tmp_path / "out")
    assert [member.values for member in again.members] == [member.values for member in started.members]
    assert [dumps(member.scene) for member in again.members] == [dumps(member.scene) for member in started.members]
    assert len(started.members) == 192 and started.members[0].scene.numerics.time_step is None


@pytest.mark.parametrize(
    "arguments",
    [
        ("base.toml", {}),
        (small(), {"motor.torque": 2.0}),
        (small(), {"motor.torque": "12"}),
        (small(), {"motor.torque": []}),
        (small(), ["motor.torque"]),
        (small(), {}, None),
        (small(), {}, {}, 0),
        (small(), {}, {}, 1, "a/b"),
    ],
)
def test_what_is_no_sweep_in_python_is_refused_at_once(arguments):
    with pytest.raises(SceneError):
        Sweep(*arguments)


def test_all_bad_members_are_named_before_anything_starts(folder, monkeypatch):
    monkeypatch.chdir(folder)
    text = 'base = "base.toml"\n[axes]\nmotor.torque = [1.0, 5e3, 2.0, "x"]\n'
    (folder / "sweep.toml").write_text(text)
    with pytest.raises(BadMembers) as refused:
        start(read("sweep.toml"))
    lines = str(refused.value).splitlines()
    assert len(lines) == 2 and "member 0001: motor.torque = 5000.0" in lines[0] and "member 0003" in lines[1]
    # Whether a shape begins inside the body is known only once it is made.
    alone = with_values(load("base.toml"), {"flagella.count": 1})
    deep = Sweep(alone, {"flagellum.0.tilt": [45.0, 180.0], "flagella.anchor_offset": [0.6, 1.25]})
    with pytest.raises(BadMembers, match="inside the body") as refused:
        start(deep)
    assert not (folder / "runs").exists()


@pytest.mark.parametrize(
    "table, key",
    [
        ("[axes]\nmotor.torqe = [1.0, 2.0, 3.0]\n", "motor.torque"),
        ("[random]\ndraws = 3\nmotor.torqe = {low = 1, high = 2}\n", "motor.torque"),
        ("[random]\ndraws = 3\nflagellum.torqe = {low = 1, high = 2}\n", "flagellum.torque"),
        ("[random]\ndraws = 3\nflagellum.0.torque = {low = 1, high = 2}\n", "flagellum.torque"),
    ],
)
def test_a_mistyped_key_is_named_once_with_what_was_meant(table, key, folder):
    with pytest.raises(SceneError, match=f"(did you mean|write) {re.escape(key)}") as refused:
        members(folder, table)
    assert "\n" not in str(refused.value)


def test_a_problem_that_members_share_is_told_once(folder):
    text = "[axes]\nmotor.torque = [1.0, 2.0, 3.0]\n[random]\nflagellum.phase = {low = 0, high = 360}\n"
    with pytest.raises(BadMembers, match=r"^member 0000 and 2 more: flagella\.phase_difference.*absent"):
        members(folder, f"[set]\nflagella.phase_difference = 0.6\n{text}")
    (folder / "base.toml").write_text(dumps(small({"flagella.phase_difference": 0.6})))
    assert len(members(folder, f'[set]\nflagella.phase_difference = "absent"\n{text}')) == 3


def test_of_many_bad_members_the_first_are_named(folder):
    with pytest.raises(BadMembers, match="and 80 more members") as refused:
        members(folder, "[axes]\nmotor.torque = {from = 2e4, to = 3e4, count = 100}\n")
    assert len(str(refused.value).splitlines()) == 21


def test_means_are_of_the_repeats_that_are_done(tmp_path):
    """Of four one was stopped and one has only begun; of those that are done one had not zipped when it ended."""
    made = [("done", 1.0, 2e-3), ("done", 4.0, None), ("stopped", 100.0, 1e-3), ("begun", 50.0, None)]
    for k, (status, speed, zipped) in enumerate(made):
        (tmp_path / f"{k}").mkdir()
        said = {"status": status, "rates": {"net_speed": speed}, "events": {"zipped": zipped}}
        (tmp_path / f"{k}" / "summary.json").write_text(json.dumps(said))
    plan = Sweep(small(), random={"flagellum.torque": {"low": 1.0, "high": 2.0}}, repeats=4)
    table.write(tmp_path, plan.members(), [f"{k}" for k in range(4)])
    with open(tmp_path / "means.csv", newline="") as file:
        (mean,) = csv.DictReader(file)
    assert (mean["status"], mean["count"]) == ("2 of 4 done", "2")
    assert float(mean["rates.net_speed"]) == 2.5 and float(mean["rates.net_speed.error"]) == pytest.approx(1.5)
    assert float(mean["events.zipped"]) == 2e-3 and mean["events.zipped.count"] == "1"
    assert mean["events.zipped.error"] == ""


def test_ranges_of_whole_numbers_are_whole_where_a_key_is(folder):
    scene = folder / "base.toml"
    absent = ["flagella.phase_difference=absent"]
    assert [m.scene.flagella.count for m in read(scene, absent, ["flagella.count=1:3:3"]).members()] == [1, 2, 3]
    assert read(scene, grid=["motor.torque=1:2:2"]).members()[0].values == {"motor.torque": 1.0}
    with pytest.raises(BadMembers, match=r"member 0001: flagella\.count = 1\.5"):
        read(scene, absent, ["flagella.count=1:2:3"]).members()
    with pytest.raises(SceneError, match="finite numbers as from and to"):
        read(scene, grid=["motor.torque=1:inf:3"])


def test_what_draws_and_repeats_have_of_their_own(folder):
    noisy = "repeats = 2\n[set]\nnumerics.time_step = 1e-6\n[random]\nfluid.temperature = { low = 280, high = 300 }\n"
    seeds = [m.scene.fluid.seed for m in members(folder, noisy + "draws = 2\n")]
    assert len(set(seeds)) == 4 and seeds[0] == 0
    with pytest.raises(SceneError, match=r"random\.draws = 3: would be the same run"):
        members(folder, "[random]\ndraws = 3\n")
    switching = '[set]\nmotor.switching = "markov"\n[random]\ndraws = 3\n'
    assert len({m.scene.motor.seed for m in members(folder, switching)}) == 3
    found = members(folder, '[set]\nstart.frame = -1\n[axes]\nstart.record = ["absent"]\n')
    assert found[0].scene.start.record is None


def test_an_axis_of_frames_keeps_its_values_in_the_table(tmp_path):
    varied = Sweep(small(), {"frames": [4, 8]}).members()
    for name in ("0000", "0001"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "summary.json").write_text(json.dumps({"status": "done", "frames": 99, "steps": 3}))
    table.write(tmp_path, varied, ["0000", "0001"])
    with open(tmp_path / "table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [(row["frames"], row["steps"], row["status"]) for row in rows] == [("4", "3", "done"), ("8", "3", "done")]
