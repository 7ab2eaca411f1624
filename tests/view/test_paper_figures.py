"""The paper's figures 2, 3 and 4 of a record made to zip at a known speed."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from tests.shapes import Zipping
from warpflag.base.output import OutputError
from warpflag.record.recorder import Recorder
from warpflag.run.simulation import Simulation
from warpflag.scene import Flagella, paper_scene
from warpflag.view import figures

pytest.importorskip("matplotlib")

sys.path.insert(0, str(Path(__file__).parents[2] / "examples" / "paper"))
import insets
import snapshots

sys.path.pop(0)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return Zipping(tmp_path_factory.mktemp("zipping"))


def curves_of(axes):
    return {line.get_label(): line.get_xydata() for line in axes.get_lines()}


def labels_of(figure):
    axes = [*figure.axes, *(child for each in figure.axes for child in each.child_axes)]
    return [(each.get_xlabel(), each.get_ylabel()) for each in axes]


def test_time_series_draws_theta_length_and_force(made, tmp_path):
    model = np.array([1.0, 2.0]), np.array([0.4, 0.5])
    runs = [insets.curves_of(made.directory, "a", model), insets.curves_of(made.directory, "b")]
    figure = insets.time_series(runs, forces_of=["b"])
    above, below = figure.axes
    assert curves_of(below)["a"][:, 0] == pytest.approx(1e3 * made.times)
    assert curves_of(below)["a"][:, 1] == pytest.approx(np.maximum(made.front(made.times), 0.0), abs=0.04)
    assert curves_of(above)["b"][:, 1] == pytest.approx(runs[1].phase_difference)
    assert any(np.array_equal(line.get_xydata(), np.stack(model, axis=1)) for line in below.get_lines())
    for axes in (above, below):
        (inset,) = axes.child_axes
        (force,) = inset.get_lines()
        assert force.get_ydata() == pytest.approx(1.0 + made.times)
    times, force = "t (ms)", r"$f_c$ (pN/µm)"
    assert labels_of(figure)[1:] == [(times, r"$l_r$"), (times, force), (times, force)]
    figures.save(figure, tmp_path / "series.png")
    assert (tmp_path / "series.png").stat().st_size > 10_000


def test_comparison_draws_every_run_and_theta_inside(made):
    runs = [insets.curves_of(made.directory, label) for label in ("a", "b", "c")]
    figure = insets.comparison(runs, dashed=["c"])
    (axes,) = figure.axes
    (inset,) = axes.child_axes
    assert list(curves_of(axes)) == ["a", "b", "c"]
    assert [line.get_linestyle() for line in inset.get_lines()] == ["-", "-", "--"]
    assert labels_of(figure) == [("t (ms)", r"$l_r$"), ("t (ms)", r"$\langle\theta\rangle$")]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "b", "c"]


def test_snapshots_follow_the_body_and_show_what_is_in_front(made):
    figure = snapshots.snapshots(made.directory, [0.0, 4.02, 8.0], columns=2)
    panels = [axes for axes in figure.axes if axes.collections]
    assert [axes.texts[0].get_text() for axes in panels] == ["0.0 ms", "4.0 ms", "8.0 ms"]
    assert figure.axes[-1].texts[-1].get_text() == "1 µm"
    for axes in panels:
        strokes = axes.collections[0]
        lines, widths = np.array(strokes.get_segments()), np.array(strokes.get_linewidths())
        body = lines[widths.argmax()]
        # Two times 30 segments with their rims, and the body, centred, 1.7 um between the centres of its caps.
        assert len(lines) == 2 * 2 * 30 + 1
        np.testing.assert_allclose(body, [[-0.85, 0.0], [0.85, 0.0]], atol=1e-9)
        points_per_um = 72 * figure.get_figwidth() * axes.get_position().width / np.ptp(axes.get_xlim())
        assert widths.max() == pytest.approx(0.8 * points_per_um)
        assert axes.get_position().height * figure.get_figheight() * 72 == pytest.approx(
            points_per_um * np.ptp(axes.get_ylim())
        )


def test_one_flagellum_has_no_bundle_to_plot(tmp_path):
    scene = paper_scene(name="one", duration=2e-5, frames=2, flagella=Flagella(count=1, length=1.0))
    Simulation(scene, device="cpu", reporters=[Recorder(tmp_path / "run.h5")]).run()
    with pytest.raises(OutputError, match="one flagellum"):
        insets.curves_of(tmp_path, "one")
