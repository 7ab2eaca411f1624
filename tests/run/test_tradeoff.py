"""The trade-off study: what it measures, its resumption, and shapes on other meshes."""

from __future__ import annotations

import csv
import dataclasses
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from tests.runs import executed, small
from warpflag.cli import main
from warpflag.model.geometry import initial_state
from warpflag.record import Record
from warpflag.run.faults import NumericalError
from warpflag.run.run_directory import RunError
from warpflag.run.simulation import Simulation
from warpflag.run.tradeoff import Study, choices, compared, points, report, windows
from warpflag.scene import dumps, with_values

SCENE = {"duration": 8e-4, "frames": 8, "flagella.length": 3.0}
MEASURED = ("accuracy 0.07", "accuracy 0.0005", "pairs float32", "h 0.3", "h 0.1")


@pytest.fixture(scope="module")
def studied(tmp_path_factory):
    """A study of a few choices, and how many points its second start measured."""
    directory = tmp_path_factory.mktemp("study") / "made"
    every = choices.choices_of
    with pytest.MonkeyPatch.context() as patch:
        few = lambda scene, devices: [c for c in every(scene, devices) if c.name in MEASURED]  # noqa: E731
        patch.setattr(choices, "choices_of", few)
        said = Study(small(SCENE), str(directory), "cpu").execute(120.0, quiet=True)
        again, measured = [], points.measured
        patch.setattr(points, "measured", lambda *given: again.append(given) or measured(*given))
        assert Study(small(SCENE), str(directory), "cpu").execute(120.0, quiet=True) == said
    return directory, said, again


def test_finished_points_are_not_measured_again(studied):
    assert studied[2] == []


def test_the_table_has_every_point_beside_its_reference(studied):
    directory, said, _ = studied
    with open(directory / "tradeoff.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    names = {row["window"] for row in rows}
    assert {"start", "late"} <= names and len(rows) == len(names) * (len(MEASURED) + 1)
    assert all(row["status"] == "done" and float(row["cost_ms_per_ms"]) > 0 for row in rows)
    for window in names:
        error = {row["choice"]: float(row["node_error_um"]) for row in rows if row["window"] == window}
        assert 0 < 5 * error["accuracy 0.0005"] < error["accuracy 0.07"] < 0.1
        assert np.isnan(error["h 0.1"]) and np.isnan(error["reference"])
        off = {row["choice"]: float(row["speed_off"]) for row in rows if row["window"] == window}
        assert off["h 0.1"] == 0.0 != off["reference"]
    first = points.load(directory / "points" / "0000.npz")
    assert (first.window, first.choice) == ("late", "reference")  # what lasts longest of a run is known first
    assert (directory / "tradeoff.png").stat().st_size > 1000
    for level in ("draft", "standard", "careful"):
        assert f"# {level}: " in said
    assert "[numerics]" in said and "accuracy = " in said


def test_a_directory_of_another_scene_is_refused(studied):
    with pytest.raises(RunError, match=r"motor\.torque"):
        Study(small({**SCENE, "motor.torque": 1.0}), str(studied[0]), "cpu")


def test_hardly_any_time_gives_no_error(tmp_path):
    said = Study(small(SCENE), str(tmp_path / "made"), "cpu").execute(0.01, quiet=True)
    assert "run it again" in said and "\n" not in said


def test_nonsense_is_refused_before_anything_is_made(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text('name = "wrong"\n[motor]\ntorque = "much"\n')
    assert main(["tradeoff", str(tmp_path / "scene.toml"), "-o", str(tmp_path / "made")]) == 2
    assert "motor.torque" in capsys.readouterr().err and not (tmp_path / "made").exists()


def test_the_course_is_that_of_the_record_which_is_named(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(dumps(small(SCENE)))
    given = [str(tmp_path / "scene.toml"), "-o", str(tmp_path / "made"), "--record", str(tmp_path / "none")]
    assert main(["tradeoff", *given, "--budget", "1"]) == 2
    assert "none: no such record" in capsys.readouterr().err


def test_windows_begin_before_what_they_are_named_after():
    """Of a course of 20 ms in 400 frames, in which flagella touch from 8 ms on and lie side by side from 12 ms on."""

    def frame(k):
        touching, zipped = k >= 160, k >= 240
        observables = {"steric_force_density": float(touching), "bundle_length": float(zipped)}
        observables |= {"body_speed": 1.0, "body_rate": 1.0, "motor_rate": np.ones(2)}
        nodes = np.zeros((6, 3))
        own = {"positions": nodes, "directors": nodes, "body_position": nodes[0], "body_orientation": np.eye(4)[3]}
        return SimpleNamespace(time=k * 5e-5, observables=observables, forms=None, **own)

    nodes, text = np.array([0, 3, 6]), dumps(small())
    record = SimpleNamespace(frame_count=401, frame=frame, first_node=nodes, scene_text=text, path="run.h5")
    course = windows.found_in_record(small(), record)
    assert [window.name for window in course.windows] == ["start", "contact", "zip", "late"]
    assert [window.time for window in course.windows] == pytest.approx([5e-5, 7.5e-3, 11.7e-3, 19e-3], abs=5.1e-5)
    assert course.length == 1e-3


def test_a_mean_is_known_to_a_per_cent_after_as_many_parts_as_its_spread_asks_for():
    """Parts of 2 ms that differ by 5 % of their mean: the mean of 25 of them has an error of 1 %."""
    rates = {"body_speed": (-100.0, 5.0), "body_rate": (-100.0, 0.9), "motor_rate": (0.0, 1.0)}
    late = windows.Window("late", 47e-3, initial_state(small()))
    said = report.text([], [], windows.Course([late], 1e-3, 48e-3, rates, 2e-3, "the record ends there"))
    assert said.startswith("windows of 1 ms: late from 47 ms\nthe course was followed to 48 ms, not to")
    assert "means over the last third of 48 ms" in said
    assert "body_speed: -100, parts of 2 ms differ by 5: 50 ms" in said
    assert "differ by 0.9: one part will do" in said and "differ by 1: unknown" in said


def test_deviations_of_rates_are_told_over_their_reference():
    measures = dict.fromkeys(points.MEASURES, 125.0)
    point = points.Point("start", "float32", "precision", "done", 1.0, 10, measures, {}, np.zeros((2, 22, 3)))
    row = compared.Row(point, 1e-3, dict.fromkeys(points.MEASURES, 25.0))
    said = report.text([row], [], windows.Course([], 1e-3, 1e-2, {}, 1e-3))
    (line,) = (line for line in said.splitlines() if line.startswith("float32"))
    assert line.count("+25 %") == len({"f_c", "motor_rate", "body_rate", "speed"} & set(points.MEASURES)) > 0


def test_a_mesh_that_was_stopped_is_no_reference():
    """Meshes are compared with the finest one that came to its end."""

    def point(choice: str, source: str, status: str, nodes: int, speed: float) -> points.Point:
        measures = dict.fromkeys(points.MEASURES, speed)
        return points.Point("start", choice, source, status, 1.0, 10, measures, {}, np.zeros((2, nodes, 3)))

    given = [point("reference", "time step", "done", 22, 1.0), point("h 0.1", "mesh", "done", 42, 2.0)]
    given += [point("h 0.05", "mesh", "stopped", 82, 30.0), point("h 0.4", "mesh", "done", 12, 0.5)]
    off = {row.point.choice: row.off["speed"] for row in compared.compared(given)}
    assert off == {"reference": -1.0, "h 0.1": 0.0, "h 0.05": 28.0, "h 0.4": -1.5}


def test_costs_are_guessed_by_steps_and_segments():
    """Half the segment length: twice the nodes and, at the same accuracy, twice the steps or more."""
    scene = small()

    def cost(**values: object) -> float:
        own = {"numerics.stepper": "implicit"} | {key.replace("__", "."): value for key, value in values.items()}
        return choices.relative_cost(choices.Choice("any", "mesh", own), scene)

    assert cost() == 1.0 and cost(flagella__segment_length=scene.flagella.segment_length) == 1.0
    assert cost(flagella__segment_length=0.5 * scene.flagella.segment_length) == pytest.approx(4.0)
    assert cost(flagella__segment_length=2.0 * scene.flagella.segment_length) == pytest.approx(0.25)
    assert cost(numerics__accuracy=5e-4) > 1.5 and cost(numerics__accuracy=5e-2) < 0.7
    assert cost(numerics__stepper="rkc") > 2.0


def test_a_shape_on_another_mesh_is_the_same_curve():
    coarse = small({"flagella.length": 6.0, "flagella.segment_length": 0.2})
    fine = with_values(coarse, {"flagella.segment_length": 0.05})
    shape = initial_state(coarse)
    assert all(
        np.array_equal(a, b) for a, b in zip(windows.on_mesh(shape, coarse).positions, shape.positions, strict=True)
    )
    there = windows.on_mesh(shape, fine)
    back = windows.on_mesh(there, coarse)
    for old, new, again in zip(shape.positions, there.positions, back.positions, strict=True):
        assert len(new) == 121
        np.testing.assert_allclose(np.linalg.norm(np.diff(new, axis=0), axis=1), 0.05, rtol=1e-12)
        np.testing.assert_allclose(new[0], old[0], rtol=0, atol=1e-12)
        assert np.abs(new[::4] - old).max() < 0.1 and np.abs(again - old).max() < 0.2
    moved = windows.on_mesh(shape, with_values(coarse, {"hook.length": 0.1}))
    assert np.linalg.norm(moved.positions[0] - shape.positions[0], axis=1) == pytest.approx(0.1)
    Simulation(fine, device="cpu", starts=there).advance(2e-5)  # no guard stops it


def summary(name, cost, error, **more):
    found = compared.Summary(name, "time step", cost, error, 2, True, {"stepper": "implicit"})
    return dataclasses.replace(found, **more)


def test_the_front_and_what_is_recommended():
    found = [
        summary("a", 1.0, 4e-2),
        summary("b", 2.0, 4e-3),
        summary("worse", 3.0, 5e-3),
        summary("c", 5.0, 4e-4),
        summary("stopped", 0.5, 1e-6, sound=False),
        summary("elsewhere", 0.5, 1e-6, windows=1),
        summary("model", 0.5, 1e-6, source="model"),
        summary("fixed", 0.9, 4.1e-2, settings={"time_step": 1e-5}),
    ]
    assert [s.choice for s in compared.front(found)] == ["fixed", "a", "b", "c"]
    assert {level: s.choice for level, s in compared.recommended(found).items()} == {
        "draft": "a",
        "standard": "b",
        "careful": "c",
    }


def none_late() -> bool:
    return False


def course_of(values, late=none_late) -> windows.Course:
    return windows.found_by_run(small(values), "cpu", late, lambda share: None)


def test_motors_stand_in_a_window_as_they_do_in_the_course():
    """A motor of given rate that reverses in the middle of the course, within the windows beside that."""
    values = {"duration": 4e-4, "flagella.count": 1, "flagella.length": 1.0, "motor.law": "rate", "motor.rate": 50.0}
    scene = small({**values, "motor.switching": "schedule", "motor.switch_times": [2e-4], "motor.switch_ramp": 1e-6})
    course = windows.found_by_run(scene, "cpu", none_late, lambda share: None)
    rates = {}
    for window in course.windows:
        point = points.measured(scene, course, window, choices.reference(5e-3), "cpu", lambda: None)
        assert point.status == "done" and 40 <= len(point.positions) <= 42
        rates[window.name] = point.measures["motor_rate"]
    assert rates["start"] == pytest.approx(50.0, rel=0.01) and rates["late"] == pytest.approx(-50.0, rel=0.01)


def test_forms_go_along_to_windows_files_and_meshes(tmp_path):
    scene = small({"flagella.count": 1, "polymorphs.enabled": True})
    forms = np.array([0, 1, 1, 0, 0, 0, 0, 0, 2, 2, 0])
    shape = dataclasses.replace(initial_state(scene), forms=forms, time=2e-3)
    course = windows.Course([windows.Window("late", 2e-3, shape)], 1e-3, 3e-3, {}, 1e-4, "stopped")
    windows.save(course, tmp_path / "course.npz")
    kept = windows.load(tmp_path / "course.npz")
    again = kept.windows[0].shape
    assert np.array_equal(again.forms, forms) and again.time == 2e-3 and kept.cut == "stopped"
    fine = windows.on_mesh(again, with_values(scene, {"flagella.segment_length": 0.1})).forms
    assert fine is not None and len(fine) == 21 and np.array_equal(fine[::2], forms)
    assert np.array_equal(windows.on_mesh(again, scene).forms, forms)


def test_a_course_that_ends_early_says_why():
    wound = {"flagella.length": 2.0, "duration": 4e-4, "motor.torque": 20.0, "flagella.phase_difference": None}
    course = course_of(wound)
    said = report.text([], [], course)
    assert course.until < 4e-4 and "followed to" in said and "stopped at" in said
    assert "nan" not in said and "no settings to recommend" in said
    with pytest.raises(NumericalError, match="twisted"):
        course_of({**wound, "motor.torque": 500.0})
    late = iter([False, True, *[True] * 100])
    cut = course_of({"duration": 1.0}, lambda: next(late))
    assert 0.0 < cut.until < 0.1 and "budget" in cut.cut


def test_a_record_of_another_scene_or_of_one_frame_gives_no_course(tmp_path):
    scene = small({"frames": 2, "duration": 2e-5})
    with Record(executed(scene, tmp_path / "run")) as record:
        course = windows.found_in_record(with_values(scene, {"duration": 1e-3, "numerics.accuracy": 1e-3}), record)
        assert "record" in course.cut
        with pytest.raises(RunError, match=r"another scene: motor\.torque = 1\.0, recorded with 3\.4"):
            windows.found_in_record(with_values(scene, {"motor.torque": 1.0}), record)


def test_damaged_points_are_measured_again_and_none_is_lost(studied, tmp_path, capsys):
    directory = shutil.copytree(studied[0], tmp_path / "made")
    every, (damaged, gone, *_) = len(list((directory / "points").iterdir())), sorted((directory / "points").iterdir())
    damaged.write_bytes(damaged.read_bytes()[:500])
    gone.unlink()
    said = Study(small(SCENE), str(directory), "cpu").execute(0.01, quiet=True)
    assert f"{every - 2} points" in said and "0000.npz: can't be read" in capsys.readouterr().err
    (directory / "course.npz").write_bytes(b"")
    with pytest.raises(RunError, match=r"course\.npz: can't be read"):
        Study(small(SCENE), str(directory), "cpu").execute(0.01, quiet=True)
    (directory / "course.npz").unlink()
    with pytest.raises(RunError, match=r"no course\.npz"):
        Study(small(SCENE), str(directory), "cpu")


def test_no_run_goes_on_in_the_directory_of_a_study(studied, capsys):
    assert main(["run", "--resume", str(studied[0])]) == 2
    assert "holds a trade-off" in capsys.readouterr().err
    (studied[0].parent / "scene.toml").write_text(dumps(small(SCENE)))
    assert main(["run", str(studied[0].parent / "scene.toml"), "-o", str(studied[0])]) == 2
    assert "holds a trade-off" in capsys.readouterr().err


def test_what_was_not_compared_is_not_said_to_be_off():
    """One window of two has a point beside its reference, the other a reference that was stopped."""

    def point(window: str, choice: str, status: str) -> points.Point:
        settings = {"stepper": "implicit", "accuracy": 5e-3}
        measures = dict.fromkeys(points.MEASURES, 1.0)
        return points.Point(window, choice, "time step", status, 1.0, 10, measures, settings, np.zeros((2, 9, 3)))

    given = [point("late", "reference", "done"), point("late", "accuracy 0.005", "done")]
    given += [point("start", "reference", "stopped: accuracy")]
    rows = compared.compared(given)
    found = compared.summaries(rows, 1e-3)
    begins = [windows.Window(name, 0.0, initial_state(small())) for name in ("start", "late")]
    said = report.text(rows, found, windows.Course(begins, 1e-3, 1e-2, {}, 1e-3))
    assert "nothing is compared in window start: its reference was stopped: accuracy" in said
    assert "+0 %" not in said.split("mesh of the scene")[1].split("\n")[0]
    assert "standard: accuracy 0.005" in said and "in 1 of 2 windows" in said
