"""Scenes that no user writes on purpose: huge, deep, doubled, of other kinds; and several problems at once."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from examples.reliability.malformed import malformed
from warpflag.scene import FlagellumOverride, Motor, SceneError, dumps, load, loads, paper_scene, with_values


def lines_of(caught: pytest.ExceptionInfo[SceneError]) -> list[str]:
    return str(caught.value).split("\n")


def refusal(path: Path) -> str:
    with pytest.raises(SceneError) as caught:
        load(path)
    (line,) = lines_of(caught)
    assert line.startswith(f"{path}: ") and line.isprintable() and len(line) < 400, line
    return line


@pytest.fixture
def path(tmp_path) -> Path:
    return tmp_path / "cell.toml"


@pytest.mark.parametrize("seed", range(0, 500, 100))
def test_malformed_scenes_are_refused_in_printable_lines_that_name_the_file(path, seed):
    refused = 0
    for number in range(seed, seed + 100):
        path.write_bytes(malformed(number))
        try:
            load(path)
        except SceneError as error:
            refused += 1
            for line in str(error).split("\n"):
                assert line.startswith(f"{path}: ") and line.isprintable() and len(line) < 500, (number, line)
    assert refused > 80


def test_a_byte_order_mark_is_passed_over(path):
    path.write_bytes(b'\xef\xbb\xbfname = "bom"\nduration = 2e-4')
    assert load(path) == paper_scene("bom", duration=2e-4)


DEEP = 1000


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ("duration = 1" + "0" * 5000, "number or key of 1000 digits"),
        ("frames = 0x" + "f" * 5000, "number or key of 1000 digits"),
        ("duration = 1" + "0" * 900, "must be a number, 1e-12 to 10 s"),
        ("x = " + "[" * DEEP + "]" * DEEP, "nested more than 16 deep"),
        ("x = " + "{a = " * DEEP + "1" + "}" * DEEP, "nested more than 16 deep"),
        (".".join(["a"] * DEEP) + " = 1", "dotted key of more than 16 parts"),
        ("[" + ".".join(['"a"'] * DEEP) + "]", "dotted key of more than 16 parts"),
        ("[motor]\n" + " . ".join(["torque"] * 100_000) + " = 1", "dotted key of more than 16 parts"),
        ('name = "' + "x" * 5_000_000 + '"', "larger than 4 MiB"),
        ("#" * 5_000_000, "larger than 4 MiB"),
        ("# " + "é" * 2_200_000, "larger than 4 MiB"),
        ("k" * 100_000 + " = 1", "unknown key"),
        ('"a\\nb" = 1', "unknown key"),
        ('start.record = "' + "a" * 100_000, "not valid TOML"),
    ],
    ids=lambda value: value[:12] if "=" in value or value[0] in "[#" else "",
)
def test_extremes_are_refused_in_one_line(path, toml, words):
    path.write_text(toml, encoding="utf-8")
    assert words in refusal(path)


@pytest.mark.parametrize(
    "toml",
    [
        'name = "a.b.c.d.e.f.g.h.i.j.k.l.m.n.o.p.q.r.s.t"',
        "name = 'a' # [[[[[[[[[[[[[[[[[[[[ a.b.c.d.e.f.g.h.i.j.k.l.m.n.o.p.q.r.s.t",
        'name = "a"\n[start]\nrecord = "[[[[[[[[[[[[[[[[[[[[{{{\\"[[[[/1' + "1" * 1200 + '"',
        "name = 'a'\n[start]\nrecord = '''\n" + "[" * 30 + "''' # '",
        'name = """a"""\n[start]\nrecord = """""' + "[" * 30 + '"""',
    ],
)
def test_what_looks_extreme_in_a_text_or_comment_is_allowed(path, toml):
    path.write_text(toml, encoding="utf-8")
    assert load(path).name.startswith("a")


def test_ten_thousand_flagella_of_their_own_fit(path):
    own = tuple(
        FlagellumOverride(azimuth=0.036 * k + 1e-13, anchor_offset=k / 3e4, phase=-k / 7e3) for k in range(10_000)
    )
    scene = with_values(paper_scene("crowd"), {"flagella.count": 10_000, "steric.enabled": False})
    scene = dataclasses.replace(scene, flagellum=own)
    path.write_text(dumps(scene))
    assert load(path) == scene


KINDS = ["directory", "device", *(["pipe"] if hasattr(os, "mkfifo") else [])]


@pytest.mark.parametrize("kind", KINDS)
def test_only_regular_files_are_opened(tmp_path, kind):
    path = tmp_path / "cell.toml"
    if kind == "directory":
        path.mkdir()
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path = Path(os.devnull)
    assert "can't be read: it is " in refusal(path)


@pytest.mark.parametrize(
    ("toml", "key"),
    [
        ('"motor.torque" = 2.0\n[motor]\ntorque = 3.0', "motor.torque"),
        ('"flagellum.0.phase" = 2.0\n[[flagellum]]\nphase = 3.0', "flagellum.0.phase"),
    ],
)
def test_a_value_given_twice_is_refused(path, toml, key):
    path.write_text(toml)
    assert f"{key} = 3.0: is given twice; the other value is 2.0" in refusal(path)
    path.write_text(toml.partition("\n")[0])
    assert "twice" not in str(load(path, {key: 2.5}) if key == "motor.torque" else "")


def test_a_flagellum_has_one_spelling(path):
    path.write_text("")
    with pytest.raises(SceneError, match="unknown key"):
        load(path, ["flagellum.0.phase=1", "flagellum.00.phase=2"])


def test_all_problems_are_told_at_once(path):
    path.write_text(
        "frames = 0\nspeed = 3\n[motor]\ntorque = 'x'\naxis_angle = 200\n[[flagellum]]\nphase = 'y'\ntilt = -1"
    )
    with pytest.raises(SceneError) as caught:
        load(path, {"body.width": -1.0})
    lines = lines_of(caught)
    keys = [line.split(": ")[1].split(" = ")[0] for line in lines]
    assert sorted(keys) == sorted(
        ["frames", "speed", "motor.torque", "motor.axis_angle", "flagellum.0.phase", "flagellum.0.tilt", "body.width"]
    )
    assert all(line.startswith(f"{path}: ") or line.startswith(f"{path} --set: body.width") for line in lines)
    assert caught.value.key == keys[0] and len(caught.value.others) == 6


def test_problems_between_settings_are_told_at_once():
    one = "[flagella]\ncount = 1\nphase_difference = 0.5"
    with pytest.raises(SceneError) as caught:
        loads(f'name = "a"\nduration = 1e-6\n[numerics]\ntime_step = 1e-5\n[start]\nframe = 3\n{one}')
    keys = [error.key for error in (caught.value, *caught.value.others)]
    assert keys == ["numerics.time_step", "start.frame", "flagella.phase_difference"]


@pytest.mark.parametrize(
    "values",
    [
        {"duration": 1e-5, "numerics.time_step": 1e-5},
        {"body.width": 2.0, "body.length": 2.0},
        {"body.length": 2.5, "flagella.anchor_offset": 1.25, "flagella.count": 1},
        {"polymorphs.enabled": True, "polymorphs.propagation": 0.5, "polymorphs.propagation_back": 0.5},
    ],
)
def test_what_must_not_be_above_a_limit_may_be_equal_to_it(values):
    with_values(paper_scene("a"), values)


def test_of_very_many_problems_the_first_are_told_and_the_rest_counted(path):
    path.write_text("".join(f"k{i} = 1\n" for i in range(1000)) + "[motor]\ntorque = 1e9\naxis_angle = -1\n")
    with pytest.raises(SceneError) as caught:
        load(path)
    lines = lines_of(caught)
    assert len(lines) == 21 and lines[-1].endswith("and 982 more problems")


def test_a_value_of_the_group_is_at_fault_once():
    with pytest.raises(SceneError) as caught:
        with_values(paper_scene("a"), {"flagella.count": 50, "flagella.anchor_offset": 3.0})
    assert len(lines_of(caught)) == 1


@pytest.mark.parametrize(
    ("key", "number", "plain"),
    [
        ("frames", np.int64(3), 3),
        ("frames", np.uint8(3), 3),
        ("motor.torque", np.float32(2), 2.0),
        ("motor.torque", np.array(2.0), 2.0),
        ("motor.torque", np.int16(-2), -2.0),
        ("body.anchored", np.bool_(True), True),
        ("hydrodynamics.mode", np.str_("none"), "none"),
        ("flagella.intrinsic_curvature", np.array([0, 1.3, -2.1]), (0.0, 1.3, -2.1)),
        ("flagella.intrinsic_curvature", [np.float64(0), np.int32(1), -2.1], (0.0, 1.0, -2.1)),
        ("flagellum.1.segments", np.int32(20), 20),
    ],
)
def test_numbers_of_numpy_are_taken_as_pythons(key, number, plain):
    taken, expected = (with_values(paper_scene("a"), {key: value}) for value in (number, plain))
    assert taken == expected and dumps(taken) == dumps(expected)


@pytest.mark.parametrize(
    "value", [np.array([2.0]), np.zeros(5), np.float64("nan"), np.bool_(True), np.datetime64("now")]
)
def test_what_is_no_number_of_numpy_is_refused(value):
    with pytest.raises(SceneError, match="must be a number") as caught:
        Motor(torque=value)
    assert len(lines_of(caught)) == 1


@pytest.mark.parametrize("offset", [-4.6e-05, 1e-5, 6e-6, 0.0, 5.6e-17, -1e-10, 0.01, -0.85])
def test_small_offsets_of_a_random_draw_are_allowed(offset):
    scene = with_values(paper_scene("a"), {"flagella.anchor_offset": offset, "flagellum.1.anchor_offset": offset})
    assert scene.flagella.anchor_offset == offset


@pytest.mark.parametrize("offset", [2.5e-6, -6e-7, 1e-8, 0.85e-6])
@pytest.mark.parametrize("key", ["flagella.anchor_offset", "flagellum.0.anchor_offset"])
def test_an_offset_in_metres_is_recognised(key, offset):
    with pytest.raises(SceneError, match="looks like metres; lengths are in um; write 0 for none"):
        with_values(paper_scene("a"), {key: offset})


@pytest.mark.parametrize(
    "key", ["flagella.length", "flagella.segment_length", "body.length", "body.width", "steric.diameter"]
)
def test_a_length_in_metres_is_recognised(key):
    with pytest.raises(SceneError, match="looks like metres"):
        with_values(paper_scene("a"), {key: 0.5e-6})


def test_a_torque_in_newton_metres_is_recognised_and_a_small_one_allowed():
    with pytest.raises(SceneError, match="looks like newton metres"):
        Motor(torque=-3.4e-18)
    assert Motor(torque=1e-7).torque == 1e-7


MEMORY = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (1 << 30, 1 << 30))
from warpflag.scene import SceneError, load
try:
    load(sys.argv[1])
except SceneError as error:
    print(error)
"""


def test_a_long_dotted_key_takes_no_gigabytes(path):
    pytest.importorskip("resource")
    path.write_text(".".join(["a"] * 100_000) + " = 1")
    command = [sys.executable, "-c", MEMORY, str(path)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=30)
    assert "dotted key of more than 16 parts" in done.stdout


@pytest.mark.parametrize(
    ("values", "key"),
    [
        ({"flagella.count": 200}, "flagella.count"),
        ({"flagella.count": 10_000}, "flagella.count"),
        ({"body.width": 0.05, "flagella.count": 12, "flagella.anchor_offset": 0.1}, "flagella.count"),
        ({"flagellum.1.azimuth": 2.0}, "flagellum.1.azimuth"),
        ({"flagellum.1.azimuth": 359.0, "flagellum.1.anchor_offset": 0.61}, "flagellum.1.azimuth"),
    ],
)
def test_crowded_anchors_are_refused_by_name(values, key):
    with pytest.raises(SceneError, match=r"nearer than a filament is thick, 0\.02 um") as caught:
        with_values(paper_scene("a"), values)
    assert caught.value.key == key and len(lines_of(caught)) == 1
    with_values(paper_scene("a"), {**values, "steric.enabled": False})


@pytest.mark.parametrize(
    "values",
    [
        {"flagella.count": 120},
        {"flagellum.1.azimuth": 3.0},
        {"flagellum.1.azimuth": 0.0, "flagellum.1.anchor_offset": 0.62001},
        {"flagella.count": 300, "body.width": 2.0, "flagella.filament_radius": 0.01, "flagella.anchor_offset": 0.2},
    ],
)
def test_anchors_a_filament_apart_are_allowed(values):
    with_values(paper_scene("a"), values)


def test_two_flagella_without_a_body_are_one_problem(path):
    """Their anchors, which there are none of, are no second one."""
    path.write_text("format = 1\n[flagella]\ncount = 2\n[body]\nenabled = false")
    assert "must be 1 where body.enabled = false" in refusal(path)
