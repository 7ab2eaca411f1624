"""Figures of a record made to zip at a known speed: what they draw, how they are labelled, what they refuse."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from tests.films import THREE, made_record
from tests.runs import executed, small
from tests.shapes import Zipping
from warpflag import cli
from warpflag.base.output import OutputError
from warpflag.observables.bundle import bundle_length
from warpflag.record import Frame, Record
from warpflag.record.recorder import Recorder
from warpflag.scene import dumps, paper_scene, with_values
from warpflag.view.coloring import FLAGELLUM_COLORS, linear
from warpflag.view.curves import curves
from warpflag.view.labels import labels_of

matplotlib = pytest.importorskip("matplotlib")

from warpflag.view import figures  # noqa: E402


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return Zipping(tmp_path_factory.mktemp("zipping"))


def panels_of(figure):
    """Panels by their title."""
    return {axes.get_title(loc="left"): axes for axes in figure.axes}


THETA, LENGTH, FORCE = r"phase difference $\langle\theta\rangle$", "bundle length $l_r$", "contact force $f_c$ (pN/µm)"


def test_a_comparison_draws_each_quantity_in_a_panel_of_its_own(made):
    run = figures.read(made.directory)
    panels = panels_of(figures.comparison([run, run, run]))
    assert list(panels) == [THETA, LENGTH, FORCE]
    for axes in panels.values():
        assert len(axes.get_lines()) == 3
        assert all(line.get_xdata() == pytest.approx(1e3 * made.times) for line in axes.get_lines())
    assert panels[LENGTH].get_lines()[0].get_ydata() == pytest.approx(np.maximum(made.front(made.times), 0.0), abs=0.04)
    assert panels[FORCE].get_lines()[0].get_ydata() == pytest.approx(1.0 + made.times)
    assert panels[FORCE].get_xlabel() == "t (ms)"


def boxes_of(figure):
    """Where panels and legends are, in pixels."""
    figure.draw_without_rendering()
    return [axes.get_window_extent() for axes in figure.axes], [each.get_window_extent() for each in figure.legends]


def test_nothing_is_drawn_over_curves(made):
    runs = [figures.read(made.directory, f"a rather long label of run {k}") for k in range(20)]
    for figure in (figures.comparison(runs), figures.dashboard(made.directory)):
        panels, legends = boxes_of(figure)
        for a, b in itertools.combinations(panels + legends, 2):
            assert not a.overlaps(b)
        assert all(not axes.child_axes and not axes.texts and axes.get_legend() is None for axes in figure.axes)
        for axes, box in zip(figure.axes, panels, strict=True):
            assert box.width > 150 and box.height > 60, axes.get_title(loc="left")


def test_twenty_runs_look_different(made):
    runs = [figures.read(made.directory, str(k)) for k in range(20)]
    lines = figures.comparison(runs).axes[0].get_lines()
    assert len({(line.get_color(), line.get_linestyle()) for line in lines}) == 20


def test_twelve_colours_are_told_apart():
    """By their distance in CIE L*a*b*, where 2 can just be seen."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])

    def lab(color):
        share = to_xyz @ linear(color) / np.array([0.9505, 1.0, 1.089])
        x, y, z = np.where(share > 0.008856, np.cbrt(share), 7.787 * share + 16 / 116)
        return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])

    assert len(FLAGELLUM_COLORS) == 12
    for a, b in itertools.combinations(FLAGELLUM_COLORS, 2):
        assert np.linalg.norm(lab(a) - lab(b)) > 20, (a, b)


def test_a_dashboard_draws_everything_known_of_a_run(tmp_path):
    directory = executed(small({"flagella.count": 3, "flagella.length": 1.0}), tmp_path / "run")
    figure = figures.dashboard(directory)
    panels = panels_of(figure)
    assert len(panels) == 7 and len(figure.axes) == 7
    (motors,) = (axes for title, axes in panels.items() if title.startswith("motor rate (Hz)"))
    assert len(motors.get_lines()) == 3
    energy = figures.read(directory).curves["elastic_energy"].values[:, 0]
    assert panels["elastic energy (pN µm)"].get_lines()[0].get_ydata() == pytest.approx(energy)
    assert all(axes.get_ylim()[0] <= 0.0 for axes in panels.values())
    (compared,) = figures.comparison([directory], ["motor_rate"]).axes
    mean = figures.read(directory).curves["motor_rate"].values.mean(axis=1)
    np.testing.assert_array_equal(compared.get_lines()[0].get_ydata(), mean)  # of what each flagellum has by itself


PANELS = {  # of every observable: its title in figures, and how many lines a cell with two flagella has
    "phase_difference": (THETA, 1),
    "bundle_length": (LENGTH, 1),
    "steric_force_density": (FORCE, 1),
    "body_speed": ("swimming speed $v$ (µm/s)", 1),
    "motor_rate": ("motor rate (Hz), a line per flagellum", 2),
    "motor_torque": ("motor torque (pN µm), a line per flagellum", 2),
    "motor_drive": ("motor drive, a line per flagellum", 2),
    "target_form_share": ("share in the target form, each", 2),
    "body_rate": ("body rate (Hz)", 1),
    "elastic_energy": ("elastic energy (pN µm)", 1),
}


def test_every_observable_is_drawn_as_it_was_recorded_in_the_panel_that_names_it(tmp_path):
    random, counts = np.random.default_rng(1), {name: count for name, (_, count) in PANELS.items()}
    measured = {name: random.uniform(0.1, 1.0, (9, count)) for name, count in counts.items()}
    with made_record(tmp_path / "made", 9, scene=paper_scene(name="two")) as record:
        recorder = Recorder(tmp_path / "run.h5")
        sizes = {"filament_radius": 0.01, "body_length": 2.5, "body_width": 0.8}
        recorder.start(record.scene_text, record.first_node, **sizes)
        for k in range(9):
            own = {name: values[k] if counts[name] > 1 else float(values[k, 0]) for name, values in measured.items()}
            recorder.write(replace(record.frame(k), observables=own, forms=None))
        recorder.close()
        measured["bundle_length"] = bundle_length(record.positions[:], record.first_node, gap=1.0)[:, None]
    figure = figures.dashboard(tmp_path)
    assert set(panels_of(figure)) == {title for title, _ in PANELS.values()}
    compared = panels_of(figures.comparison([tmp_path], list(PANELS)))
    for name, (title, count) in PANELS.items():
        lines = panels_of(figure)[title].get_lines()
        assert len(lines) == count
        for line, values in zip(lines, measured[name].T, strict=True):
            np.testing.assert_allclose(line.get_xdata(), 0.05 * np.arange(9), atol=1e-12)  # ms
            np.testing.assert_allclose(line.get_ydata(), values)
        (line,) = compared[title.partition(", ")[0]].get_lines()
        np.testing.assert_allclose(line.get_ydata(), measured[name].mean(axis=1))


@pytest.mark.parametrize("order", [1, -1])
def test_runs_of_unequal_length_are_compared_to_the_end_of_the_longest(order, tmp_path):
    made_record(tmp_path, 12).close()
    whole = figures.read(tmp_path)
    curves_of_part = {name: replace(curve, values=curve.values[:5]) for name, curve in whole.curves.items()}
    part = replace(whole, label="part", times=whole.times[:5], curves=curves_of_part)
    (axes,) = figures.comparison([whole, part][::order], ["motor_rate"]).axes
    assert axes.get_xlim() == (whole.times[0], whole.times[-1])


def test_one_flagellum_has_a_dashboard_without_a_bundle(tmp_path):
    directory = executed(small({"flagella.count": 1}), tmp_path / "run")
    panels = panels_of(figures.dashboard(directory))
    assert "swimming speed $v$ (µm/s)" in panels and LENGTH not in panels
    assert "swimming speed $v$ (µm/s)" in panels_of(figures.comparison([directory, directory]))


def test_the_bundle_of_a_figure_passes_over_a_short_gap(tmp_path):
    """Two lines beside each other but for 0.6 um: the record says a third, the figure all of it."""
    first = np.stack([0.0 * np.arange(31), 0.0 * np.arange(31), 0.2 * np.arange(31)], axis=1)
    second = first + np.array([0.3, 0.0, 0.0])
    second[10:13, 0] += 1.0
    recorder = Recorder(tmp_path / "run.h5")
    scene = dumps(paper_scene(name="gap"))
    recorder.start(scene, [0, 31, 62], filament_radius=0.01, body_length=2.5, body_width=0.8)
    nodes = np.concatenate([first, second])
    plain = float(bundle_length(nodes, np.array([0, 31, 62])))
    at_rest = {"motor_angle": np.zeros(2), "body_position": np.zeros(3), "body_orientation": np.array([0.0, 0, 0, 1])}
    recorder.write(Frame(0.0, 0, nodes, nodes, observables={"bundle_length": plain}, **at_rest))
    recorder.close()
    (drawn,) = (curve for curve in curves(Record(tmp_path)) if curve.name == "bundle_length")
    assert plain < 0.4 and drawn.values.tolist() == [[1.0]]


def test_forms_are_drawn_along_each_flagellum_one_above_the_other(tmp_path):
    """A cell edge half way between frames and between joints; each flagellum begins where the one before ends."""
    scene = with_values(THREE, {"polymorphs.enabled": True})
    made_record(tmp_path, 6, scene=scene).close()
    run = figures.read(tmp_path)
    (panel,) = [axes for title, axes in panels_of(figures.dashboard(run)).items() if title.startswith("forms")]
    meshes = panel.collections
    assert len(meshes) == 3
    for mesh, begin, length, forms in zip(meshes, (0.0, 6.0, 10.0), (6.0, 4.0, 6.0), run.forms, strict=True):
        places = mesh.get_coordinates()
        assert places[0, 0, 1] == pytest.approx(begin + 0.1) and places[-1, 0, 1] == pytest.approx(begin + length - 0.1)
        assert places[0, [0, 1, -1], 0].tolist() == pytest.approx([0.0, 0.5 * run.times[1], run.times[-1]])
        np.testing.assert_array_equal(np.reshape(mesh.get_array(), forms.T.shape), forms.T)
    assert panel.get_ylim()[1] > 16.0


def test_a_short_peak_does_not_flatten_the_rest_and_is_told(tmp_path):
    with made_record(tmp_path, 400) as record:
        assert record.observables["motor_rate"].shape == (400, 3)
    run = figures.read(tmp_path)
    run.curves["motor_rate"].values[:] = 10.0
    run.curves["motor_rate"].values[1] = 5000.0
    axes = next(axes for title, axes in panels_of(figures.dashboard(run)).items() if title.startswith("motor"))
    assert 10.0 < axes.get_ylim()[1] < 20.0
    assert axes.get_title(loc="right") == "up to 5000"
    run.curves["motor_rate"].values[:] = 0.0
    axes = next(axes for title, axes in panels_of(figures.dashboard(run)).items() if title.startswith("motor"))
    assert axes.get_title(loc="right") == "zero throughout" and -0.1 < axes.get_ylim()[0] < 0.0


@pytest.mark.parametrize(
    "changes, expected",
    [
        ([{"motor.torque": 2.0}, {"motor.torque": 3.0}], ("motor.torque (pN µm)", ["2", "3"], [2.0, 3.0])),
        ([{"steric.enabled": True}, {"steric.enabled": False}], ("steric.enabled", ["True", "False"], None)),
        (
            [{"motor.torque": 2.0, "duration": 0.1}, {"flagella.length": 8.0}],
            ("", ["length 6, torque 2", "length 8, torque 3.4"], None),
        ),
        ([{"duration": 0.1}, {"duration": 0.2}], ("duration (s)", ["0.1", "0.2"], [0.1, 0.2])),
        ([{"name": "a"}, {"name": "b"}], ("", ["a", "b"], None)),
        (
            [{"motor.torque": 2.0}, {"motor.torque": 3.0, "start.record": "runs/s"}],
            ("motor.torque (pN µm)", ["2", "3"], [2.0, 3.0]),
        ),
        ([{}, {"name": "b"}, {}], ("", ["s (1)", "b", "s (3)"], None)),
        (
            [{"flagella.count": 2, "flagellum.1.torque": 1.0}, {"flagella.count": 2, "flagellum.1.torque": 2.0}],
            ("flagellum.1.torque (pN µm)", ["1", "2"], [1.0, 2.0]),
        ),
    ],
)
def test_runs_are_labelled_by_what_differs(changes, expected):
    assert labels_of([with_values(paper_scene(name="s"), values) for values in changes]) == expected


def test_a_figure_displays_itself_in_a_notebook(made):
    assert figures.dashboard(made.directory)._repr_png_().startswith(b"\x89PNG")


def drawn_by_the_command(monkeypatch, *arguments):
    """The figure that the command saved."""
    kept = []
    monkeypatch.setattr(figures, "save", lambda figure, path: kept.append((figure, path)))
    assert cli.main(["plot", *arguments]) == 0
    ((figure, path),) = kept
    assert path == arguments[arguments.index("-o") + 1]
    return figure


def test_command_draws_a_dashboard_of_one_run_and_compares_several(made, monkeypatch):
    run = str(made.directory)
    assert len(panels_of(drawn_by_the_command(monkeypatch, run, "-o", "a.png"))) == 4
    assert list(panels_of(drawn_by_the_command(monkeypatch, run, run, "-o", "a.png"))) == [THETA, LENGTH, FORCE]
    assert len(panels_of(drawn_by_the_command(monkeypatch, run, "--as", "comparison", "-o", "a.png"))) == 3


def test_command_draws_the_observables_that_are_named(made, monkeypatch, capsys):
    run = str(made.directory)
    assert list(panels_of(drawn_by_the_command(monkeypatch, run, run, "--y", "bundle_length", "-o", "a.png"))) == [
        LENGTH
    ]
    assert cli.main(["plot", run, "--y", "wobble", "-o", "a.png"]) == 2
    assert "this run has no wobble; known: phase_difference" in capsys.readouterr().err
    assert cli.main(["plot", run, run, "--y", "net_energy", "-o", "a.png"]) == 2
    assert "these runs have no net_energy in common; did you mean elastic_energy? known:" in capsys.readouterr().err


def test_many_flagella_are_drawn_as_mean_and_range(tmp_path):
    with made_record(tmp_path, 40) as record:
        assert record.observables["motor_rate"].shape[1] == 3
    run = figures.read(tmp_path)
    rates = np.linspace(1.0, 8.0, 8) + np.zeros((40, 8))
    many = figures.Curve("motor_rate", "motor rate", "", "Hz", rates)
    (axes,) = figures.dashboard(figures.Run("", run.scene, run.times, {"motor_rate": many})).axes
    assert axes.get_lines()[0].get_ydata() == pytest.approx(4.5) and len(axes.collections) == 1
    edge = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert (edge.min(), edge.max()) == (1.0, 8.0)


def test_command_writes_the_format_of_the_ending_and_refuses_others(made, tmp_path, capsys):
    good, bad = str(tmp_path / "a.svg"), str(tmp_path / "a.docx")
    assert cli.main(["plot", str(made.directory), "-o", good]) == 0
    assert capsys.readouterr().out == f"{good}\n"
    assert "<svg" in (tmp_path / "a.svg").read_text()
    assert cli.main(["plot", str(made.directory), "-o", bad]) == 2
    said = capsys.readouterr().err
    assert "a.docx" in said and ".png" in said and said.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.svg"]
    assert cli.main(["plot", str(tmp_path / "absent"), "-o", good]) == 2
    assert cli.main(["plot", str(made.directory), str(made.directory), "--as", "dashboard", "-o", good]) == 2
    with pytest.raises(OutputError, match=r"\.docx"):
        figures.save(figures.dashboard(made.directory), bad)


def test_single_frames_are_points_and_a_filament_alone_has_no_motor(tmp_path):
    scene = small({"frames": 1, "duration": 1e-5})
    panels = panels_of(figures.dashboard(executed(scene, tmp_path / "two")))
    (line,) = panels["swimming speed $v$ (µm/s)"].get_lines()
    assert np.isfinite(line.get_ydata()).sum() == 1 and line.get_marker() == "o"
    free = {"body.enabled": False, "flagella.count": 1, "flagella.phase_difference": None}
    alone = executed(with_values(scene, free), tmp_path / "free")
    assert list(panels_of(figures.dashboard(alone))) == ["swimming speed $v$ (µm/s)", "elastic energy (pN µm)"]
    pxr = pytest.importorskip("pxr.Usd")
    stage = pxr.Stage.Open(str(alone / "movie.usdc"))
    assert not [prim for prim in stage.Traverse() if "Motor_" in prim.GetName()]
