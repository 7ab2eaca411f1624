"""Scene files: what is accepted, what is refused and in which words, and that writing loses nothing."""

from __future__ import annotations

import dataclasses
import math
import pickle
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from warpflag.scene import FlagellumOverride, Scene, SceneError, dumps, load, loads, paper_scene, sections, with_values
from warpflag.scene.run_sections import Numerics, Start
from warpflag.scene.settings import Section

EXAMPLES = sorted((Path(__file__).parents[2] / "examples").glob("*.toml"))
SECTIONS = [Scene] + [
    cls for cls in vars(sections).values() if isinstance(cls, type) and issubclass(cls, Section) and cls is not Section
]
SETTINGS = [(cls, name) for cls in SECTIONS for name in cls.settings]
NUMERIC = [(cls, name) for cls, name in SETTINGS if cls.settings[name].kind in ("number", "integer")]


def scene_from(tmp_path: Path, toml: str, overrides=()) -> Scene:
    path = tmp_path / "cell.toml"
    path.write_text(toml, encoding="utf-8")
    return load(path, overrides)


def refusal(tmp_path: Path, toml: str, overrides=()) -> SceneError:
    with pytest.raises(SceneError) as caught:
        scene_from(tmp_path, toml, overrides)
    line = str(caught.value)
    assert "\n" not in line and len(line) < 400, line
    return caught.value


def make(cls: type[Section], name: str, value: object) -> Section:
    """A section with one value given; a Scene needs a name as well."""
    values: dict[str, Any] = {"name": "a"} if cls is Scene else {}
    return cls(**{**values, name: value})


REFUSED = [
    # toml, key of the error, words that the line must have
    ("torque = 3.4", "torque", ["unknown key", "did you mean motor.torque?"]),
    ("[motor]\ntorqe = 3.4", "motor.torqe", ["unknown key", "did you mean motor.torque?"]),
    ("[moter]\ntorque = 3.4", "moter.torque", ["unknown key", "did you mean motor.torque?"]),
    ("[moter]", "moter", ["unknown key", "did you mean motor?"]),
    ("[flagella]\nopening_angel = 23", "flagella.opening_angel", ["did you mean flagella.opening_angle?"]),
    ("[body]\nviscosity = 1e-3", "body.viscosity", ["did you mean fluid.viscosity?"]),
    ("[wall]\nenabled = true", "wall.enabled", ["unknown key; known here: flagella, motor"]),
    ("[flagella]\nheld = true", "flagella.held", ["unknown key; known here: count, length"]),
    ("[motor]\nstall = 1.26", "motor.stall", ["unknown key; known here: torque", "knee, no_load"]),
    ("[steric]\nxyzzy = 1", "steric.xyzzy", ["enabled, strength, diameter"]),
    ("motor = 3.4", "motor", ["is a section", "torque"]),
    ("[motor.torque]\nvalue = 3", "motor.torque", ["must be a number"]),
    ("[motor]\ntorque = '3.4'", "motor.torque", ['"3.4"', "must be a number", "-1000 to 1000 pN um"]),
    ("[motor]\ntorque = true", "motor.torque", ["true", "must be a number"]),
    ("[motor]\ntorque = nan", "motor.torque", ["nan", "must be a number"]),
    ("[motor]\ntorque = inf", "motor.torque", ["inf", "must be a number"]),
    ("[motor]\ntorque = 3.4e-18", "motor.torque", ["looks like newton metres", "torques are in pN um"]),
    ("[motor]\ntorque = 1" + "0" * 400, "motor.torque", ["-1000 to 1000"]),
    ("[motor]\nbearing_torque = 1", "motor.bearing_torque", ["must be true or false"]),
    ("[motor]\naxis_angle = 200", "motor.axis_angle", ["0 to 180 deg"]),
    ("[flagella]\nlength = 6e-6", "flagella.length", ["looks like metres; lengths are in um"]),
    ("[flagella]\nlength = 6000.0", "flagella.length", ["looks like nanometres"]),
    ("[flagella]\nfilament_radius = 1e-8", "flagella.filament_radius", ["looks like metres"]),
    ("[flagella]\nanchor_offset = 6e-7", "flagella.anchor_offset", ["looks like metres"]),
    ("[flagella]\nanchor_offset = 1.3", "flagella.anchor_offset", ["-1.25 to 1.25 um"]),
    ("[flagella]\nbending_rigidity = 3.5e-24", "flagella.bending_rigidity", ["newton square metres"]),
    ("[flagella]\nstretching_stiffness = 1e-9", "flagella.stretching_stiffness", ["looks like newtons"]),
    ("[flagella]\nintrinsic_curvature = [1.3, -2.1]", "flagella.intrinsic_curvature", ["three numbers"]),
    ("[flagella]\nintrinsic_curvature = 2.1", "flagella.intrinsic_curvature", ["three numbers"]),
    ("[flagella]\nintrinsic_curvature = [0, 1.3e6, 0]", "flagella.intrinsic_curvature", ["1/metre"]),
    ("[flagella]\nintrinsic_curvature = [0, 1.3, '0']", "flagella.intrinsic_curvature", ["three numbers"]),
    (
        "[flagella]\nintrinsic_curvature = [0, 1.3, -40]\nsegment_length = 0.1",
        "flagella.segment_length",
        ["4 rad", "below pi"],
    ),
    ("[flagella]\ncount = 0", "flagella.count", ["1 to 10000"]),
    ("[flagella]\ncount = 2.0", "flagella.count", ["must be a whole number"]),
    ("[flagella]\nopening_angle = -1", "flagella.opening_angle", ["0 to 180 deg"]),
    ("[flagella]\nopening_angle = 181", "flagella.opening_angle", ["0 to 180 deg"]),
    ("[flagella]\nphase_difference = 1.2", "flagella.phase_difference", ["0 to 1"]),
    ("[flagella]\ncount = 1\nphase_difference = 0.5", "flagella.phase_difference", ["needs two flagella"]),
    ("[flagella]\nlength = 0.5\nsegment_length = 0.4", "flagella.segment_length", ["2 to 10000 segments"]),
    ("flagellum = 3", "flagellum", ["[[flagellum]]"]),
    ("[flagellum]\ntorque = 3", "flagellum", ["[[flagellum]]"]),
    ("[flagella]\ncount = 3\n[[flagellum]]\n[[flagellum]]", "flagella.count", ["must be 2"]),
    ("[[flagellum]]\n[[flagellum]]\ntorqe = 1", "flagellum.1.torqe", ["did you mean flagellum.1.torque?"]),
    ("[[flagellum]]\n[[flagellum]]\ntorque = 'a'", "flagellum.1.torque", ["must be a number"]),
    ("[[flagellum]]\nsegments = 1", "flagellum.0.segments", ["2 to 10000"]),
    ("[[flagellum]]\nsegments = 2\nlength = 5", "flagellum.0.segments", ["below pi"]),
    ("[[flagellum]]\n[[flagellum]]\nanchor_offset = -2", "flagellum.1.anchor_offset", ["ends of the body"]),
    ("[[flagellum]]\n[[flagellum]]\nazimuth = 360", "flagellum.1.azimuth", ["anchor of flagellum 0"]),
    (
        "[flagella]\nphase_difference = 0.5\n[[flagellum]]\nphase = 9\n[[flagellum]]",
        "flagella.phase_difference",
        ["flagellum.0.phase"],
    ),
    ("[fluid]\nviscosity = 0.0", "fluid.viscosity", ["1e-05 to 10"]),
    ("[fluid]\ndrag_perpendicular = -2.8e-3", "fluid.drag_perpendicular", ["1e-06 to 100 pN s/um^2"]),
    ("[fluid]\ndrag_rotation = 1.26e-18", "fluid.drag_rotation", ["looks like newton seconds"]),
    ("[hydrodynamics]\nmode = 'al'", "hydrodynamics.mode", ["one of none, within", "did you mean all?"]),
    ("[hydrodynamics]\nmode = false", "hydrodynamics.mode", ["one of none, within"]),
    (
        "[hydrodynamics]\nmode = 'none'\npair_radius = 0.03",
        "hydrodynamics.pair_radius",
        ["must be absent", "mode = none"],
    ),
    (
        "[hydrodynamics]\nmode = 'as_printed'\npair_radius = 0.03",
        "hydrodynamics.pair_radius",
        ["must be absent", "filament_radius"],
    ),
    ("[steric]\nstrength = 8e-13", "steric.strength", ["looks like newtons; forces are in pN"]),
    ("[body]\nwidth = 3.0", "body.width", ["body.length = 2.5"]),
    ("[numerics]\nstepper = 'rk4'", "numerics.stepper", ["euler, rkc, implicit"]),
    ("[numerics]\nprecision = 64", "numerics.precision", ["float64, float32"]),
    ("[numerics]\npair_precision = 'float64'", "numerics.pair_precision", ["same, float32"]),
    ("duration = 1e-5\n[numerics]\ntime_step = 2e-5", "numerics.time_step", ["above duration = 1e-05 s"]),
    ("[start]\nframe = 3", "start.frame", ["needs start.record"]),
    ("[start]\nrecord = ''", "start.record", ["not empty"]),
    ("duration = 15", "duration", ["looks like milliseconds; times are in s"]),
    ("duration = 1979-05-27", "duration", ["must be a number"]),
    ("frames = 0", "frames", ["1 to 1e+07"]),
    ("name = '../up'", "name", ["starting with a letter or digit"]),
    ("name = 3", "name", ["letters, digits"]),
]


@pytest.mark.parametrize(("toml", "key", "words"), REFUSED, ids=[case[1] for case in REFUSED])
def test_malformed_scene_is_refused_in_one_line_that_names_file_and_key(tmp_path, toml, key, words):
    error = refusal(tmp_path, toml)
    line = str(error)
    assert error.key == key
    assert line.startswith(f"{tmp_path / 'cell.toml'}: {key} = ")
    for word in words:
        assert word in line


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[motor\n", "not valid TOML"),
        (b"name = mine\n", "name = mine; a text needs quotes"),
        (b"[motor]\ntorque = 1,5\n", "torque = 1,5; numbers have a decimal point"),
        (b"duration = 1\nduration = 2", "not valid TOML"),
        (b"\xff", "UTF-8"),
    ],
)
def test_a_file_that_is_no_toml_is_refused(tmp_path, content, words):
    path = tmp_path / "cell.toml"
    path.write_bytes(content)
    with pytest.raises(SceneError, match=words) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: ") and "\n" not in str(caught.value)


def test_a_path_that_is_no_file_is_refused(tmp_path):
    with pytest.raises(SceneError, match=r"absent\.toml: no such file"):
        load(tmp_path / "absent.toml")
    with pytest.raises(SceneError, match="can't be read"):
        load(tmp_path)


@pytest.mark.parametrize(("cls", "name"), NUMERIC)
def test_bounds_are_inclusive_and_hold(cls, name):
    setting = cls.settings[name]
    for bound, beyond in ((setting.low, -math.inf), (setting.high, math.inf)):
        if setting.kind == "number":
            # The section alone: a scene also compares settings with each other.
            assert setting.checked(name, bound) == bound
            outside = math.nextafter(bound, beyond)
        else:
            assert setting.checked(name, int(bound)) == bound
            outside = int(bound) + (1 if beyond > 0 else -1)
        with pytest.raises(SceneError):
            make(cls, name, outside)
    for wrong in (math.nan, math.inf, True, "3", [3.0], b"3"):
        with pytest.raises(SceneError):
            make(cls, name, wrong)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("flagella.stretching_stiffness", 1e5),
        ("motor.torque", 34.0),
        ("motor.torque", -3.4),
        ("motor.torque", 0.0),
        ("steric.strength", 80.0),
        ("flagella.segment_length", 0.02),
        ("flagella.segment_length", 1.0),
        ("fluid.viscosity", 1e-5),
        ("fluid.viscosity", 10.0),
        ("flagella.intrinsic_curvature", (0.0, 0.0, 0.0)),
        ("flagella.anchor_offset", -0.85),
    ],
)
def test_extremes_that_a_stability_study_needs_are_allowed(key, value):
    section, _, name = key.partition(".")
    assert getattr(getattr(with_values(paper_scene("a"), {key: value}), section), name) == value


@pytest.mark.parametrize(("cls", "name"), SETTINGS)
def test_docstrings_tell_every_setting(cls, name):
    line = next(line for line in cls.__doc__.splitlines() if line.startswith(f"        {name}: "))
    assert cls.settings[name].meaning in line and cls.settings[name].bounds in line
    assert line.endswith(".") and ("; default " in line or "; required" in line)


def test_defaults_are_the_papers(tmp_path):
    scene = scene_from(tmp_path, "")
    assert scene == paper_scene("cell")
    assert (scene.flagella.bending_rigidity, scene.flagella.twist_rigidity) == (3.5, 3.5)
    assert scene.flagella.intrinsic_curvature == (0.0, 1.3, -2.1)
    assert (scene.flagella.stretching_stiffness, scene.flagella.hook_twist_factor) == (1000.0, 3.0)
    assert (scene.motor.torque, scene.motor.axis_angle) == (3.4, 55.0)
    assert (scene.body.length, scene.body.width, scene.steric.strength) == (2.5, 0.8, 0.8)
    assert [spec.azimuth for spec in scene.resolved_flagella()] == [0.0, 180.0]


def test_whole_numbers_become_floats_and_lists_tuples(tmp_path):
    scene = scene_from(tmp_path, "[flagella]\nopening_angle = 23\nintrinsic_curvature = [0, 1, -2]")
    assert isinstance(scene.flagella.opening_angle, float)
    assert scene.flagella.intrinsic_curvature == (0.0, 1.0, -2.0)
    assert hash(scene) == hash(with_values(scene, {}))


def test_flagellum_tables_override_the_group(tmp_path):
    scene = scene_from(
        tmp_path,
        "[flagella]\nlength = 5.05\nopening_angle = 40\n[motor]\ntorque = 2\n"
        "[[flagellum]]\n[[flagellum]]\ntorque = -1\nlength = 3\nsegments = 7\ntilt = 10\nphase = 5\n"
        "[[flagellum]]\nazimuth = 30\nmotor_axis_angle = 60\nanchor_offset = 0.1",
    )
    first, second, third = scene.resolved_flagella()
    assert scene.flagella.count == 3
    assert (first.length, first.segment_count, first.tilt, first.torque) == (5.05, 25, 20.0, 2.0)
    assert first.segment_length == pytest.approx(5.05 / 25, rel=1e-15)
    assert first.phase is None and second.phase == 5.0
    assert (second.torque, second.tilt, second.azimuth) == (-1.0, 10.0, 120.0)
    assert second.segment_length == pytest.approx(3 / 7, rel=1e-15)
    assert (third.azimuth, third.motor_axis_angle, third.anchor_offset) == (30.0, 60.0, 0.1)


def test_overrides_are_read_as_typed(tmp_path):
    scene = scene_from(
        tmp_path,
        "[motor]\ntorque = 1.0",
        [
            "motor.torque=2",
            "hydrodynamics.mode=none",
            "steric.enabled=false",
            "start.record=runs/zip=ping",
            "start.frame=7",
            "flagella.intrinsic_curvature=[0, 1, 2]",
            'name="1"',
            "flagellum.1.torque=-2",
        ],
    )
    assert (scene.motor.torque, scene.hydrodynamics.mode, scene.steric.enabled) == (2.0, "none", False)
    assert (scene.start.record, scene.start.frame, scene.name) == ("runs/zip=ping", 7, "1")
    assert scene.flagella.intrinsic_curvature == (0.0, 1.0, 2.0)
    assert [spec.torque for spec in scene.resolved_flagella()] == [2.0, -2.0]


def test_overrides_may_be_a_mapping(tmp_path):
    as_text = scene_from(tmp_path, "", {"motor.torque": "2.5", "body.anchored": "true"})
    assert as_text == scene_from(tmp_path, "", {"motor.torque": 2.5, "body.anchored": True})
    assert as_text.body.anchored


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("motor.torqe=1", ["cell.toml --set: motor.torqe = 1", "did you mean motor.torque?"]),
        ("motor.torque=abc", ['cell.toml --set: motor.torque = "abc"', "must be a number"]),
        ("motor.torque=1\nframes = 2", ["cell.toml --set: motor.torque", "must be a number"]),
        ("motor.torque", ["--set", "must be written key=value"]),
        ("=3", ["--set", "must be written key=value"]),
        ("steric.enabled=True", ["cell.toml --set: steric.enabled", "true or false"]),
        ("flagellum.2.torque=1", ["cell.toml --set: flagellum.2.torque", "flagella 0 to 1"]),
        ("flagellum.torque=1", ["cell.toml --set: flagellum.torque", "flagellum.K.torque"]),
        ("motor=1", ["cell.toml --set: motor = 1", "is a section"]),
        # The file's time step is at fault, but only since the duration was overridden.
        ("duration=1e-6", ["cell.toml --set: numerics.time_step", "duration = 1e-06 s"]),
    ],
)
def test_an_override_at_fault_is_named(tmp_path, override, words):
    line = str(refusal(tmp_path, "[numerics]\ntime_step = 1e-5", [override]))
    for word in words:
        assert word in line


def test_an_error_of_the_file_is_not_blamed_on_an_override(tmp_path):
    assert "--set" not in str(refusal(tmp_path, "[motor]\ntorque = true", ["duration=0.01"]))


def test_with_values_checks_and_leaves_the_original(tmp_path):
    scene = scene_from(tmp_path, "[hydrodynamics]\npair_radius = 0.02\n[[flagellum]]\n[[flagellum]]\nphase = 3")
    other = with_values(scene, {"motor.torque": 2, "hydrodynamics.pair_radius": None, "duration": 0.1})
    assert (other.motor.torque, other.hydrodynamics.pair_radius, other.duration) == (2.0, None, 0.1)
    assert other.flagellum == scene.flagellum
    assert (scene.motor.torque, scene.hydrodynamics.pair_radius) == (3.4, 0.02)
    assert with_values(scene, {"flagellum.1.phase": 4}).flagellum[1].phase == 4.0
    with pytest.raises(SceneError, match=r"motor\.torque"):
        with_values(scene, {"motor.torque": None})
    with pytest.raises(SceneError, match=r"did you mean motor\.torque"):
        with_values(scene, {"motor.torq": 1})


def test_a_written_scene_reads_back_equal(tmp_path):
    scene = paper_scene(
        "all the settings",
        flagella=sections.Flagella(count=3, length=math.pi, segment_length=0.1, phase_difference=None),
        flagellum=(FlagellumOverride(), FlagellumOverride(torque=-1 / 3, phase=12.5), FlagellumOverride(60.1)),
        fluid=sections.Fluid(viscosity=2e-3 / 3, drag_rotation=1e-7),
        hydrodynamics=sections.Hydrodynamics("within", 0.02),
        numerics=Numerics("euler", 1e-9 / 7, "float32", 1e-3),
        start=Start('a "quoted" \\ path\t\x7f é', 3),
    )
    assert scene_from(tmp_path, dumps(scene)) == scene


@pytest.mark.parametrize("path", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_examples_load_and_read_back_equal(tmp_path, path):
    scene = load(path)
    assert scene.name == path.stem
    assert f"warpflag run examples/{path.name}" in path.read_text(encoding="utf-8")
    written = dumps(scene)
    assert scene_from(tmp_path, written) == scene
    assert "um, pN, s" in written.splitlines()[0]


@pytest.mark.parametrize(("cls", "name"), [case for case in SETTINGS if case[0] is not FlagellumOverride])
def test_every_setting_is_written(cls, name):
    line = next(line for line in dumps(Scene("a")).splitlines() if line.lstrip("# ").startswith(f"{name} ="))
    absent = line.startswith("#")
    assert absent == (cls is not Scene and getattr(cls(), name) is None)
    assert "absent: " in line or not absent


def test_a_name_is_made_of_the_file_name(tmp_path):
    path = tmp_path / ".my (new) scene.toml"
    path.write_text("")
    assert load(path).name == "my-new-scene"


def test_errors_travel_between_processes():
    error = SceneError("motor.torque", "x", "must be a number", ["a"], "f.toml")
    copy = pickle.loads(pickle.dumps(error))
    assert str(copy) == str(error) and copy.key == "motor.torque" and isinstance(copy, ValueError)


def test_a_scene_needs_the_standard_library_only():
    code = "import sys, warpflag.scene; print(sorted({'numpy', 'warp', 'h5py', 'pxr'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_file_without_a_format_has_the_paper_s_model_and_says_so_once(tmp_path, capsys):
    old, new = tmp_path / "old.toml", tmp_path / "new.toml"
    old.write_text('name = "x"\n')
    new.write_text('format = 1\nname = "x"\n')
    for _ in range(2):
        scene = load(old)
    assert scene == paper_scene("x")
    assert (scene.hydrodynamics.mode, scene.hook.length, scene.hook.stiffness) == ("all", 0.0, 0.0)
    (line,) = capsys.readouterr().err.splitlines()
    assert str(old) in line and "format = 1" in line and 'hydrodynamics.mode = "all"' in line
    assert load(new) == Scene("x")
    assert load(old, {"hook.length": 0.1}).hook.length == 0.1
    # As resolved, both are of the newest format, and stay what they are.
    for made in (scene, Scene("x")):
        assert "\nformat = 1 " in dumps(made) and loads(dumps(made)) == made
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("motor", 5),
        ("motor", sections.Hook()),
        ("external", Start()),
        ("flagellum", "ab"),
        ("flagellum", None),
        ("flagellum", (1,)),
    ],
    ids=str,
)
def test_a_section_from_python_is_of_its_own_kind(name, value):
    with pytest.raises(SceneError, match=rf"^{name} = .* must be a"):
        dataclasses.replace(Scene(name="a"), **{name: value})
