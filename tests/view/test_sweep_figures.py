"""Figures of a sweep's table, made up: what they draw, how they are labelled, what they refuse."""

from __future__ import annotations

import itertools
import os

import numpy as np
import pytest

from warpflag import cli
from warpflag.base.output import OutputError

pytest.importorskip("matplotlib")

from warpflag.view import sweep_figures


def sweep(directory, axes: dict[str, list], rows: list[str], columns: str):
    directory.mkdir()
    lines = [f'"{key}" = {values}' for key, values in axes.items()]
    (directory / "sweep.toml").write_text("[axes]\n" + "\n".join(lines) + "\n")
    header = ",".join(["member,point,repeat", *axes, "status", columns])
    (directory / "table.csv").write_text("\n".join([header, *rows]) + "\n")
    return directory


@pytest.fixture
def line(tmp_path):
    """Three torques, two repeats each; the last zips never, one repeat of the second neither."""
    rows = ["0,0,0,1.0,done,10,0.004", "1,0,1,1.0,done,14,0.006", "2,1,0,2.0,done,20,0.003", "3,1,1,2.0,done,22,"]
    rows += ["4,2,0,3.0,done,31,", "5,2,1,3.0,stopped,,"]
    return sweep(tmp_path / "line", {"motor.torque": [1.0, 2.0, 3.0]}, rows, "rates.net_speed,events.zipped")


@pytest.fixture
def grid(tmp_path):
    rows = [
        f"{k},{k},0,{t},{m},done,{10 * t + i}"
        for k, (t, i, m) in enumerate((t, i, m) for t in (10, 2, 3) for i, m in enumerate(("none", "all", "within")))
    ]
    return sweep(
        tmp_path / "grid",
        {"motor.torque": [10, 2, 3], "hydrodynamics.mode": ["none", "all", "within"]},
        rows,
        "rates.net_speed",
    )


def test_a_map_shows_the_means_of_the_repeats(tmp_path):
    rows = [f"{2 * k + i},{k},{i},{k // 2},{k % 2},done,{10 * k + 4 * i}" for k in range(4) for i in range(2)]
    made = sweep(tmp_path / "made", {"motor.torque": [0, 1], "flagella.tilt": [0, 1]}, rows, "rates.net_speed")
    drawn = sweep_figures.maps(sweep_figures.read(made)).axes[0].images[0].get_array()
    np.testing.assert_array_equal(drawn, [[2, 22], [12, 32]])


def test_curves_show_means_and_standard_errors_of_the_repeats(line):
    figure = sweep_figures.curves(sweep_figures.read(line))
    speed, zipped = figure.axes
    drawn, _, bars = speed.containers[0]
    assert drawn.get_xydata().tolist() == [[1.0, 12.0], [2.0, 21.0], [3.0, 31.0]]
    heights = [np.ptp(segment[:, 1]) for segment in bars[0].get_segments()]
    assert heights == pytest.approx([2 * 2.0, 2 * 1.0, 0.0])  # the deviation over the root of two, each side
    assert (speed.get_xlabel(), speed.get_ylabel()) == ("motor torque [pN µm]", "net speed [µm/s]")
    points = zipped.containers[0][0].get_xydata()
    np.testing.assert_allclose(points[:2], [[1.0, 5.0], [2.0, 3.0]])  # ms
    assert np.isnan(points[2, 1]) and zipped.get_ylabel() == "time to zip [ms]"


def test_a_second_axis_makes_a_line_each(grid):
    figure = sweep_figures.curves(sweep_figures.read(grid), numbers=["rates.net_speed"])
    (panel,) = figure.axes
    lines = [container[0].get_xydata().tolist() for container in panel.containers]
    assert lines == [[[2, 20 + i], [3, 30 + i], [10, 100 + i]] for i in range(3)]
    assert [text.get_text() for text in panel.get_legend().get_texts()] == ["mode none", "mode all", "mode within"]


def test_an_axis_of_words_has_a_place_for_each(tmp_path):
    rows = ["0,0,0,rate,True,done,10", "1,1,0,rate,False,done,14", "2,2,0,constant,True,done,20"]
    made = sweep(tmp_path / "w", {"motor.law": ["rate", "constant"], "a.on": ["x"]}, rows, "rates.net_speed")
    (panel,) = sweep_figures.curves(sweep_figures.read(made)).axes
    assert [container[0].get_xydata().tolist() for container in panel.containers] == [[[0, 10], [1, 20]], [[0, 14]]]
    assert [text.get_text() for text in panel.get_xticklabels()] == ["rate", "constant"]
    (panel,) = sweep_figures.curves(sweep_figures.read(made), "a.on").axes
    assert [text.get_text() for text in panel.get_xticklabels()] == ["True", "False"]
    assert panel.containers[0][0].get_linestyle() == "None"  # there is nothing between two words


@pytest.mark.parametrize(("values", "scale"), [((1, 2, 4), "log"), ((1, 2, 3), "linear"), ((1, 4), "linear")])
def test_an_axis_of_equal_ratios_is_drawn_as_one(values, scale, tmp_path):
    rows = [f"{k},{k},0,{value},done,{k}" for k, value in enumerate(values)]
    made = sweep(tmp_path / "ratios", {"motor.torque": list(values)}, rows, "rates.net_speed")
    (panel,) = sweep_figures.curves(sweep_figures.read(made)).axes
    assert panel.get_xscale() == scale and panel.get_xlim()[0] < values[0] < values[-1] < panel.get_xlim()[1]


def test_a_mean_over_a_third_axis_says_so(tmp_path):
    values = [(a, b, c) for a in (1, 2, 3) for b in (1, 2, 3) for c in (44, 90)]
    rows = [f"{k},{k},0,{a},{b},{c},done,{a + b + c}" for k, (a, b, c) in enumerate(values)]
    axes = {"motor.torque": [1, 2, 3], "fluid.viscosity": [1, 2, 3], "flagella.opening_angle": [44, 90]}
    table = sweep_figures.read(sweep(tmp_path / "three", axes, rows, "rates.net_speed"))
    for figure in (sweep_figures.curves(table), sweep_figures.maps(table)):
        assert figure.get_supxlabel() == "means over flagella opening angle [deg]"
    (panel,) = sweep_figures.curves(table).axes
    assert panel.containers[0][0].get_ydata().tolist() == [69, 70, 71]


def test_points_that_are_not_what_they_say_are_hollow(tmp_path):
    """Rates of cells that had not zipped when their window began; zip times that not every repeat reached."""
    rows = ["0,0,0,1.0,done,10,0.010,0.004", "1,0,1,1.0,done,14,0.010,0.006", "2,1,0,2.0,done,20,0.010,0.012"]
    rows += ["3,1,1,2.0,done,22,0.010,", "4,2,0,3.0,done,31,0.010,0.002", "5,2,1,3.0,done,30,0.010,"]
    columns = "rates.net_speed,rates.from,events.zipped"
    table = sweep_figures.read(sweep(tmp_path / "mixed", {"motor.torque": [1.0, 2.0, 3.0]}, rows, columns))
    figure = sweep_figures.curves(table, numbers=["net_speed", "zipped"])
    for panel in figure.axes:
        _, full, hollow = panel.get_lines()[0], *panel.get_lines()[-2:]
        assert full.get_xdata().tolist() == [1.0] and hollow.get_xdata().tolist() == [2.0, 3.0]
        assert hollow.get_markerfacecolor() == "white"
    assert figure.axes[0].get_xlim() == figure.axes[1].get_xlim()
    assert "not bundled" in figure.get_supxlabel() and "every repeat" in figure.get_supxlabel()


def test_without_an_axis_members_are_drawn_with_their_mean(tmp_path):
    rows = ["0,0,0,done,10,0.004", "1,0,1,done,14,0.006", "2,0,2,done,12,"]
    directory = sweep(tmp_path / "repeats", {}, rows, "rates.net_speed,events.zipped")
    speed = sweep_figures.curves(sweep_figures.read(directory)).axes[0]
    points, _, _ = speed.containers[0]
    assert points.get_xydata().tolist() == [[0, 10], [1, 14], [2, 12]] and points.get_linestyle() == "None"
    assert speed.get_title() == f"12 ± {2 / 3**0.5:.2g}" and speed.get_xlabel() == "member"


def test_nothing_is_hollow_where_no_member_zips(grid):
    assert sweep_figures.curves(sweep_figures.read(grid), numbers=["net_speed"]).get_supxlabel() == ""


def test_two_axes_make_a_map_where_both_have_three_values(grid, tmp_path):
    axes = {"motor.torque": [1, 2, 3], "hydrodynamics.mode": ["none", "all"]}
    rows = [f"{k},{k},0,{t},{m},done,{k}" for k, (t, m) in enumerate(itertools.product(*axes.values()))]
    few = sweep_figures.figure([sweep(tmp_path / "few", axes, rows, "rates.net_speed")])
    assert not few.axes[0].images and len(few.axes[0].containers) == 2  # a line for each of two
    assert sweep_figures.figure([grid]).axes[0].images


def test_a_map_has_its_axes_in_order(grid):
    figure = sweep_figures.maps(sweep_figures.read(grid))
    panel = figure.axes[0]
    np.testing.assert_array_equal(panel.images[0].get_array(), [[20 + i, 30 + i, 100 + i] for i in range(3)])
    assert [text.get_text() for text in panel.get_xticklabels()] == ["2", "3", "10"]
    assert [text.get_text() for text in panel.get_yticklabels()] == ["none", "all", "within"]
    assert (panel.get_xlabel(), panel.get_ylabel()) == ("motor torque [pN µm]", "hydrodynamics mode")


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--y", "nothing at all"], ["no column nothing at all", "rates.net_speed"]),
        (["--y", "net_sped"], ["did you mean rates.net_speed?"]),
        (["--x", "nothing"], ["no column nothing"]),
        (["--y", "status"], ["does not hold numbers"]),
        (["--as", "map"], ["takes two axes"]),
        (["--as", "dashboard"], ["is a sweep"]),
    ],
)
def test_what_cannot_be_drawn_is_one_line(arguments, words, line, capsys):
    assert cli.main(["plot", str(line), "-o", str(line / "x.png"), *arguments]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and all(word in said for word in words), said
    assert not (line / "x.png").exists()


def test_a_table_without_the_usual_numbers_names_those_it_has(tmp_path, capsys):
    made = sweep(tmp_path / "short", {"motor.torque": [1.0]}, ["0,0,0,1.0,done,3"], "observables.motor_rate")
    assert cli.main(["plot", str(made), "-o", str(tmp_path / "x.png")]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "--y" in said and "observables.motor_rate" in said
    assert cli.main(["plot", str(made), "-o", str(tmp_path / "x.png"), "--y", "motor_rate"]) == 0


def test_the_command_draws_what_it_was_asked_for(line, grid, tmp_path, capsys):
    for directory, more in ((line, []), (grid, []), (grid, ["--as", "curves"]), (line, ["--x", "events.zipped"])):
        path = tmp_path / "figure.svg"
        assert cli.main(["plot", str(directory), "-o", str(path), *more]) == 0
        assert path.read_text().count("<svg") == 1
        path.unlink()
    assert cli.main(["plot", str(line), str(grid), "-o", str(tmp_path / "x.png")]) == 2
    assert "draws one sweep" in capsys.readouterr().err
    assert cli.main(["plot", str(line / "table.csv"), "-o", str(tmp_path / "x.png")]) == 2  # one of runs/sweep/*
    said = capsys.readouterr().err
    assert f"warpflag plot {line};" in said and f"warpflag plot {line}/0*" in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("table.csv", lambda text: text[:-30], r"line \d+ has \d+ entries, not \d+ as the first"),
        ("table.csv", lambda text: text + b"\n", r"has 0 entries"),
        ("table.csv", lambda text: text + b"x" * 200_000, "field larger"),
        ("table.csv", lambda text: text + b"\xe9", "UTF-8"),
        ("table.csv", None, "is no file"),
        ("sweep.toml", lambda text: b"axes = [1]", "axes is no table"),
        ("sweep.toml", None, "is no file"),
    ],
)
def test_a_damaged_table_is_refused_in_one_line(line, name, change, words):
    path = line / name
    text = path.read_bytes()
    path.unlink()
    os.mkfifo(path) if change is None else path.write_bytes(change(text))
    with pytest.raises(OutputError, match=words) as caught:
        sweep_figures.read(line)
    assert "\n" not in str(caught.value)


def test_what_is_not_finite_is_not_drawn(line):
    path = line / "table.csv"
    header, first, rest = path.read_text().split("\n", 2)
    values = first.split(",")
    values[header.split(",").index("rates.net_speed")] = "inf"
    path.write_text("\n".join([header, ",".join(values), rest]))
    assert np.isnan(sweep_figures.read(line).numbers("rates.net_speed")[0])
    assert sweep_figures.figure([line]) is not None


def test_an_empty_or_missing_table_is_refused(line):
    (line / "table.csv").write_text("member,status\n")
    with pytest.raises(OutputError, match="no rows"):
        sweep_figures.read(line)
    (line / "table.csv").unlink()
    with pytest.raises(OutputError, match=r"table\.csv: can't be read"):
        sweep_figures.read(line)


def test_levels_are_told_apart_and_stand_clear_of_each_other_and_of_the_lines(tmp_path):
    lengths = [1 + 0.001 * k for k in range(8)]
    rows = [f"{k},{k},0,{t},{x},done,{k}" for k, (t, x) in enumerate((t, x) for t in (1, 2) for x in lengths)]
    made = sweep(tmp_path / "a", {"motor.torque": [1, 2], "flagella.length": lengths}, rows, "rates.net_speed")
    figure = sweep_figures.curves(sweep_figures.read(made))
    figure.canvas.draw()
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [f"length {x:.4g}" for x in lengths]
    assert legend.get_window_extent().x0 >= figure.axes[0].get_window_extent().x1
    drawn = sweep_figures.maps(sweep_figures.read(made)).axes[0].get_yticklabels()
    assert [text.get_text() for text in drawn] == [f"{x:.4g}" for x in lengths]
    words = [f"runs/some_long_name/{k}/run.h5" for k in range(6)]
    rows = [f"{k},{k},0,{word},done,{k}" for k, word in enumerate(words)]
    made = sweep(tmp_path / "b", {"start.record": words}, rows, "rates.net_speed")
    ticks = sweep_figures.curves(sweep_figures.read(made)).axes[0].get_xticklabels()
    assert len({text.get_text() for text in ticks}) == 6 and all(text.get_rotation() == 40 for text in ticks)
    assert max(len(text.get_text()) for text in ticks) <= 20


def test_what_differs_by_round_off_alone_and_what_nobody_has(tmp_path):
    rows = [f"{k},{k},0,{t},done,{274.01774840 + 1e-9 * k}," for k, t in enumerate((1.0, 2.0))]
    made = sweep(tmp_path / "made", {"motor.torque": [1.0, 2.0]}, rows, "rates.net_speed,events.zipped")
    speed, zipped = sweep_figures.curves(sweep_figures.read(made), None, ["net_speed", "zipped"]).axes
    assert np.ptp(speed.get_ylim()) > 10.0
    assert [text.get_text() for text in zipped.texts] == ["no member has any"] and not len(zipped.get_yticks())
