"""What a notebook shows: short lines and tables of scenes, simulations and records, and the example notebooks."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

import warpflag
from tests.films import FIRST_NODE, THREE, made_record
from tests.runs import small


def test_the_package_lists_its_public_names():
    assert set(dir(warpflag)) == set(warpflag.__all__) >= {"Scene", "Simulation", "Record", "Motor", "load"}
    for name in dir(warpflag):
        assert getattr(warpflag, name) is not None
    assert warpflag.Motor(torque=2.0).torque == 2.0


def test_short_lines_say_what_something_is(tmp_path):
    simulation = warpflag.Simulation(small(), device="cpu")
    assert repr(simulation) == "<Simulation of small on cpu: 0 of 0.08 ms, stepper implicit>"
    assert repr(simulation.state) == "<CellState at 0 ms, step 0: 2 flagella, 22 nodes>"
    simulation.advance(2e-5)
    assert repr(simulation) == "<Simulation of small on cpu: 0.02 of 0.08 ms, stepper implicit>"
    assert repr(simulation.state).startswith(f"<CellState at 0.02 ms, step {simulation.steps[0]}: ")
    with made_record(tmp_path, 3) as record:
        assert repr(record) == f"<Record {tmp_path}/run.h5: 3 flagella, 3 frames to 0.1 ms>"


def test_a_scene_shows_what_differs_and_everything():
    shown = THREE._repr_html_()
    changed, everything = shown.split("<details>")
    assert f"</b>: {1e3 * THREE.duration:g} ms, 3 flagella" in changed
    assert "flagella.opening_angle" in changed and "50.0" in changed and "flagellum.1.length" in changed
    assert "motor.torque" not in changed
    assert "motor.torque" in everything and "pN µm" in everything
    assert "<script" not in warpflag.with_values(THREE, {"start.record": "<script>"})._repr_html_()


def test_xarray_has_names_units_and_the_record_s_numbers(tmp_path):
    pytest.importorskip("xarray")
    with made_record(tmp_path, 4) as record:
        data = record.to_xarray()
        np.testing.assert_array_equal(data["position"], record.positions[:])
        np.testing.assert_array_equal(data["motor_rate"].sel(flagellum=1), record.observables["motor_rate"][:, 1])
    assert data["position"].dims == ("time", "node", "axis") and data["position"].attrs["units"] == "um"
    found = {name: data[name].attrs["units"] for name in ("motor_angle", "motor_rate", "bundle_length")}
    assert found == {"motor_angle": "rad", "motor_rate": "Hz", "bundle_length": ""}
    assert data["time"].attrs["units"] == "s" and list(data["axis"].values) == ["x", "y", "z"]
    of_second = data["position"].where(data["flagellum_of_node"] == 1, drop=True)
    assert of_second.sizes["node"] == FIRST_NODE[2] - FIRST_NODE[1]
    assert int(data["number_in_flagellum"][FIRST_NODE[1]]) == 0


NOTEBOOKS = sorted((Path(__file__).parents[2] / "examples" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_example_notebooks_run(path, tmp_path):
    nbclient = pytest.importorskip("nbclient", reason="notebooks need the group pages: uv run --group pages pytest")
    pytest.importorskip("ipykernel")
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(path, as_version=4)
    os.environ["PYDEVD_DISABLE_FILE_VALIDATION"] = "1"
    nbclient.NotebookClient(
        notebook, timeout=110, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    ).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    assert not [output for output in outputs if output.output_type == "error"]
    assert any("image/png" in output.get("data", {}) for output in outputs)
