"""Keys that vary together along one axis: members, the command line, what is refused, and figures."""

from __future__ import annotations

import itertools

import pytest

from tests.run.sweep.test_sweep_plan import folder, members
from warpflag.run.sweep import Sweep, read
from warpflag.scene import SceneError
from warpflag.view import sweep_figures

__all__ = ["folder"]

TOGETHER = '"motor.knee, motor.no_load" = [[100, 200], [175, 300], [175, 400]]\n'
LAW = '[set]\nmotor.law = "torque_speed"\n[axes]\n'


def test_members_take_their_values_together(folder):
    found = members(folder, f"{LAW}{TOGETHER}motor.torque = [1.0, 2.0]\n")
    wanted = itertools.product([(100, 200), (175, 300), (175, 400)], [1.0, 2.0])
    assert [list(m.values) for m in found] == [["motor.knee", "motor.no_load", "motor.torque"]] * 6
    assert [tuple(m.values.values()) for m in found] == [(*both, torque) for both, torque in wanted]
    assert (found[2].scene.motor.knee, found[2].scene.motor.no_load) == (175.0, 300.0)


def test_the_command_line_and_python_have_them_too(folder):
    grid = ["motor.knee,motor.no_load=[100,200],[175,300]", "motor.torque=1,2"]
    found = read(folder / "base.toml", overrides=["motor.law=torque_speed"], grid=grid).members()
    assert [(m.scene.motor.no_load, m.scene.motor.torque) for m in found] == [(200, 1), (200, 2), (300, 1), (300, 2)]
    axes = {"external.body_force,motor.torque": [([0, 0, 1.0], 1.0), ([0, 0, 2.0], 3.0)]}
    made = Sweep(found[0].scene, axes)
    assert [m.scene.external.body_force[2] for m in made.members()] == [1.0, 2.0]
    # As it is written beside its base it makes the same members.
    (folder / "base.toml").write_text(made.base_text())
    (folder / "again.toml").write_text(made.dumps())
    assert [m.values for m in read(folder / "again.toml").members()] == [m.values for m in made.members()]


def test_vectors_and_words_on_the_command_line(folder):
    grid = ['motor.switching,external.body_force=["none",[0,0,1]],["markov",[0,0,2]]']
    found = read(folder / "base.toml", grid=grid).members()
    assert [(m.scene.motor.switching, m.scene.external.body_force[2]) for m in found] == [("none", 1), ("markov", 2)]
    for text in ("", "[none,1]", "1:2:3"):
        with pytest.raises(SceneError, match=r"--grid: motor.switching, motor.torque = "):
            read(folder / "base.toml", grid=[f"motor.switching,motor.torque={text}"])


def test_motors_that_switch_along_such_an_axis_have_random_repeats(folder):
    both = '"motor.switching, motor.to_reverse" = [["none", 1.0], ["markov", 2.0]]\n'
    found = members(folder, f"repeats = 2\n[axes]\n{both}")
    assert len({m.values["motor.seed"] for m in found}) == 2


@pytest.mark.parametrize(
    "axes, problem",
    [
        ('"motor.knee, motor.no_load" = [[100, 200], [175]]', r"motor.no_load = \[175\]: must be a list of 2 values"),
        ('"motor.knee, motor.no_load" = [100, 200]', "= 100: must be a list of 2 values, one for each key"),
        ('"motor.knee, motor.no_load" = { from = 1, to = 2, count = 2 }', "must be a list of lists of 2 values"),
        ('"motor.knee, motor.knee" = [[100, 200]]', "has motor.knee, which is twice in one axis"),
        (
            TOGETHER + "motor.knee = [100]",
            "motor.knee, which is in another axis as well, motor.knee, motor",
        ),
        (TOGETHER + '"motor.knee,motor.no_load" = [[100, 250]]', "axes.motor.knee, motor.no_load = .* is given twice"),
        ('"motor.knee, " = [[100, 200]]', "has no key before or after a comma"),
        ('"motor.knee, motor.nope" = [[100, 200]]', "motor.nope = .*unknown key"),
        ('"motor.knee, motor.no_load" = [[100, 200], [100, 200]]', "twice, which makes the same members twice"),
    ],
)
def test_what_does_not_go_together_is_refused(folder, axes, problem):
    with pytest.raises(SceneError, match=problem):
        members(folder, f"{LAW}{axes}\n")


def test_values_that_such_an_axis_has_are_neither_set_nor_drawn(folder):
    with pytest.raises(SceneError, match=r"motor.knee = 20: varies along an axis .*, motor.knee, motor.no_load"):
        members(folder, LAW + TOGETHER, overrides=["motor.knee=20"])
    with pytest.raises(ValueError, match=r"motor.no_load = \[200, 300, 400\]: is drawn at random, too"):
        members(folder, LAW + TOGETHER + "[random]\nmotor.no_load = { low = 300, high = 400 }\n")


@pytest.mark.parametrize(
    "values, axes",
    [
        ([(1, 5), (2, 5)], ("motor.knee",)),
        ([(1, 5), (1, 6)], ("motor.no_load",)),
        ([(1, 5), (1, 6), (2, 5)], ("motor.knee", "motor.no_load")),
    ],
)
def test_figures_are_drawn_against_the_key_that_tells_the_points_apart(tmp_path, values, axes):
    pytest.importorskip("matplotlib")
    (tmp_path / "sweep.toml").write_text(f'[axes]\n"motor.knee, motor.no_load" = {[list(v) for v in values]}\n')
    rows = [f"{k},{k},0,{a},{b},done,{k}" for k, (a, b) in enumerate(values)]
    header = "member,point,repeat,motor.knee,motor.no_load,status,rates.net_speed"
    (tmp_path / "table.csv").write_text("\n".join([header, *rows]) + "\n")
    table = sweep_figures.read(tmp_path)
    assert table.axes == axes
    assert sweep_figures.curves(table).axes[0].get_xlabel() == axes[0].replace(".", " ").replace("_", " ") + " [Hz]"
