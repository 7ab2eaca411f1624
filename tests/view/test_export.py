"""A record read back by other programs, or by the rules of their formats."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

from tests.films import FIRST_NODE, THREE, made_record
from warpflag import cli
from warpflag.record import Record, RecordError
from warpflag.record.recorder import Recorder
from warpflag.scene import dumps
from warpflag.view.coloring import Coloring
from warpflag.view.export import write_csv, write_vtkhdf, write_xyz


@pytest.fixture
def record(tmp_path):
    with made_record(tmp_path / "run", 5) as record:
        yield record


def test_vtkhdf_read_by_the_rules_of_the_format(record, tmp_path):
    """By the offsets of each step, as VTK's documentation of the format says."""
    write_vtkhdf(record, tmp_path / "run.vtkhdf")
    with h5py.File(tmp_path / "run.vtkhdf") as file:
        root = file["VTKHDF"]
        assert root.attrs["Type"] == b"PolyData" and root.attrs["Version"][0] == 2
        steps = root["Steps"]
        assert steps.attrs["NSteps"] == 5
        np.testing.assert_array_equal(steps["Values"], record.times)
        for step in range(5):
            part = steps["PartOffsets"][step]
            assert steps["NumberOfParts"][step] == 1
            count, begin = root["NumberOfPoints"][part], steps["PointOffsets"][step]
            points = root["Points"][begin : begin + count]
            np.testing.assert_array_equal(points, record.positions[step])
            for kind, cells in zip(
                ("Vertices", "Lines", "Polygons", "Strips"), steps["CellOffsets"][step], strict=True
            ):
                number = root[kind]["NumberOfCells"][part]
                assert number == (3 if kind == "Lines" else 0)
                offsets = root[kind]["Offsets"][cells : cells + number + 1]
                assert list(np.diff(offsets)) == ([31, 21, 31] if kind == "Lines" else [])
            first = steps["ConnectivityIdOffsets"][step][1]
            ids = root["Lines/Connectivity"][first : first + root["Lines/NumberOfConnectivityIds"][part]]
            np.testing.assert_array_equal(ids, np.arange(83))
            for name in ("curvature", "steric_force", "phase_difference"):
                begin = steps["PointDataOffsets"][name][step]
                block = slice(step, step + 1)
                expected = Coloring(name, record, THREE).values(record.positions[block], block)[0]
                np.testing.assert_allclose(
                    root["PointData"][name][begin : begin + count], expected, rtol=1e-6, atol=1e-6
                )
            assert steps["PointDataOffsets/flagellum"][step] == 0
            begin = steps["FieldDataOffsets/body_position"][step]
            np.testing.assert_array_equal(root["FieldData/body_position"][begin], record.body_position[step])
            assert list(steps["FieldDataSizes/body_position"][step]) == [3, 1]
            assert list(steps["FieldDataSizes/bundle_length"][step]) == [1, 1]
        np.testing.assert_array_equal(root["PointData/flagellum"], np.repeat([0, 1, 2], [31, 21, 31]))


def test_vtk_reads_what_was_written(record, tmp_path):
    vtk = pytest.importorskip("vtk")
    from vtk.util.numpy_support import vtk_to_numpy  # pyright: ignore[reportMissingImports]

    write_vtkhdf(record, tmp_path / "run.vtkhdf")
    reader = vtk.vtkHDFReader()
    reader.SetFileName(str(tmp_path / "run.vtkhdf"))
    reader.UpdateInformation()
    assert reader.GetNumberOfSteps() == 5
    for step in range(5):
        reader.SetStep(step)
        reader.Update()
        read = reader.GetOutput()
        np.testing.assert_array_equal(vtk_to_numpy(read.GetPoints().GetData()), record.positions[step])
        assert [read.GetCell(k).GetNumberOfPoints() for k in range(read.GetNumberOfCells())] == [31, 21, 31]
        position = vtk_to_numpy(read.GetFieldData().GetArray("body_position"))
        np.testing.assert_array_equal(position.ravel(), record.body_position[step])


def test_mdanalysis_reads_the_record(record):
    """With the call that docs/records.md gives."""
    analysis = pytest.importorskip("MDAnalysis")
    universe = analysis.Universe.empty(FIRST_NODE[-1])
    universe.load_new(str(record.path), format="H5MD", convert_units=False)
    assert len(universe.trajectory) == 5
    for step in universe.trajectory:
        np.testing.assert_allclose(step.positions, record.positions[step.frame], rtol=1e-6, atol=1e-6)


def test_csv_read_by_the_standard_library(record, tmp_path):
    write_csv(record, tmp_path / "table.csv")
    with open(tmp_path / "table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5
    for i, row in enumerate(rows):
        assert float(row["time"]) == record.times[i] and int(row["step"]) == 7 * i
        assert [float(row[f"body_position_{axis}"]) for axis in "xyz"] == list(record.body_position[i])
        assert [float(row[f"body_orientation_{axis}"]) for axis in "xyzw"] == list(record.body_orientation[i])
        assert [float(row[f"motor_angle_{k}"]) for k in range(3)] == list(record.motor_angle[i])
        assert float(row["bundle_length"]) == record.observables["bundle_length"][i]
        assert [row[f"motor_rate_{k}"] for k in range(3)] == [""] * 3 if i == 0 else [f"{i}.0"] * 3
    with open(tmp_path / "table_nodes.csv", newline="") as file:
        nodes = list(csv.DictReader(file))
    assert len(nodes) == 5 * 83
    positions = np.array([[float(row[axis]) for axis in "xyz"] for row in nodes]).reshape(5, 83, 3)
    np.testing.assert_array_equal(positions, np.asarray(record.positions))
    assert [(row["flagellum"], row["node"]) for row in nodes[29:33]] == [
        ("0", "29"),
        ("0", "30"),
        ("1", "0"),
        ("1", "1"),
    ]
    assert float(nodes[83]["time"]) == record.times[1]


def test_xyz_by_its_own_heading(record, tmp_path):
    write_xyz(record, tmp_path / "run.xyz")
    lines = (tmp_path / "run.xyz").read_text().splitlines()
    assert len(lines) == 5 * (2 + 84)
    for frame in range(5):
        count, comment, *rows = lines[frame * 86 : (frame + 1) * 86]
        assert count == "84" and f"Time={record.times[frame]:.9g}" in comment
        columns = re.findall(r"(\w+):[SRI]:(\d)", comment.partition("Properties=")[2].split()[0])
        found = [dict(_fields(columns, row.split())) for row in rows]
        assert [own["species"] for own in found] == [["B"], *[["N"]] * 83]
        body = found[0]
        np.testing.assert_allclose(np.array(body["aspherical_shape"], float), [0.4, 0.4, 1.25])
        assert (body["radius"], body["flagellum"]) == (["1.25"], ["-1"])  # of the sphere round it
        np.testing.assert_allclose(np.array(body["pos"], float), record.body_position[frame], rtol=1e-8)
        np.testing.assert_allclose(np.array(body["orientation"], float), record.body_orientation[frame], rtol=1e-8)
        places = np.array([own["pos"] for own in found[1:]], float)
        np.testing.assert_allclose(places, record.positions[frame], rtol=1e-8, atol=1e-9)
        assert [own["flagellum"] for own in found[1:]] == [["0"]] * 31 + [["1"]] * 21 + [["2"]] * 31
        assert {tuple(own["radius"]) for own in found[1:]} == {("0.01",)}


def _fields(columns, values):
    """Names of an extended XYZ file's columns, each with its own of the values of a row."""
    assert len(values) == sum(int(width) for _, width in columns)
    for name, width in columns:
        yield name, values[: int(width)]
        values = values[int(width) :]


@pytest.mark.parametrize("write, name", [(write_csv, "run.csv"), (write_vtkhdf, "run.vtkhdf")])
def test_a_record_without_frames_is_no_export(tmp_path, write, name):
    made_record(tmp_path, 1).close()
    empty = Recorder(tmp_path / "run.h5", resume_step=-1)
    empty.start(dumps(THREE), FIRST_NODE, filament_radius=0.01, body_length=2.5, body_width=0.8)
    empty.close()
    with Record(tmp_path) as record, pytest.raises(RecordError, match="no frames"):
        write(record, tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["run.h5"]


def test_the_command_writes_every_format(record, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for to, names in (("usd", ["movie.usdc"]), ("vtkhdf", ["run.vtkhdf"]), ("csv", ["run.csv", "run_nodes.csv"])):
        assert cli.main(["export", "run", "--to", to]) == 0
        assert capsys.readouterr().out == f"{Path('run', names[0])}\n"
        assert all(Path("run", name).stat().st_size > 1000 for name in names)
    assert (
        cli.main(["export", "run", "run", "--to", "usd", "-o", "two.usda", "--color", "curvature", "--fps", "24"]) == 0
    )
    assert capsys.readouterr().out == "two.usda\n"
    text = Path("two.usda").read_text()
    assert "Cell_1" in text and "primvars:curvature" in text and "framesPerSecond = 24" in text
    assert (
        cli.main(["export", "run", "--to", "usd", "-o", "clips.usdc", "--clip-frames", "2", "--slow-down", "100"]) == 0
    )
    assert len(list(Path("clips.usdc.clips").iterdir())) == 4  # 2 + 2 + 1 frames, manifest


def test_the_command_refuses_in_one_line(record, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for arguments, word in (
        (["run", "run", "--to", "csv", "-o", "two.csv"], "several DIR"),
        (["run", "run", "--to", "usd"], "-o"),
        (["run", "--to", "csv", "--mesh"], "--to usd"),
        (["run", "--to", "usd", "--color", "mood"], "phase_difference"),
        (["run", "--to", "usd", "-o", "movie.avi"], ".usdz"),
    ):
        assert cli.main(["export", *arguments]) == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.count("\n") == 1 and word in said.err
    assert [path.name for path in Path("run").iterdir()] == ["run.h5"]


def test_check_tells_what_is_wrong_with_a_movie(record, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["export", "run", "--to", "usd", "-o", "movie.usda"]) == 0
    assert cli.main(["check", "movie.usda"]) == 0
    assert capsys.readouterr().out.endswith("movie.usda: plays\n")
    for option in (["--set", "frames=2"], ["--device", "cpu"], ["--precision", "float32"]):
        assert cli.main(["check", "movie.usda", *option]) == 2
        assert capsys.readouterr().err == f"warpflag: {option[0]} is of scenes, and movie.usda is a movie\n"
    Path("movie.usda").write_text(Path("movie.usda").read_text().replace("catmullRom", "catmulRom"))
    assert cli.main(["check", "movie.usda"]) == 2
    assert "catmulRom" in capsys.readouterr().out


def test_xyz_read_by_the_rules_of_the_format(record, tmp_path):
    """A count, a comment with the names and widths of the columns, then a line per particle."""
    write_xyz(record, tmp_path / "run.xyz")
    lines = (tmp_path / "run.xyz").read_text().splitlines()
    assert len(lines) == 5 * (2 + 84)
    for frame in range(5):
        count, comment, *rows = lines[frame * 86 : (frame + 1) * 86]
        assert int(count) == len(rows) == 84
        facts = dict(word.split("=", 1) for word in comment.replace('"F F F"', "none").split())
        assert float(facts["Time"]) == pytest.approx(record.times[frame])
        assert float(facts["bundle_length"]) == pytest.approx(0.1 * frame)
        described = facts["Properties"].split(":")
        names, widths = described[::3], [int(width) for width in described[2::3]]
        table = [row.split() for row in rows]
        assert {len(row) for row in table} == {sum(widths)}
        ends = np.cumsum(widths)
        column = {
            name: [row[end - width : end] for row in table]
            for name, width, end in zip(names, widths, ends, strict=True)
        }
        assert [species for (species,) in column["species"]] == ["B", *"N" * 83]
        positions = np.array(column["pos"], float)
        np.testing.assert_allclose(positions[1:], record.positions[frame], rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(positions[0], record.body_position[frame], rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(np.array(column["orientation"][0], float), record.body_orientation[frame], atol=1e-8)
        assert column["aspherical_shape"][0] == ["0.4", "0.4", "1.25"]
        flagella = np.array(column["flagellum"], int).ravel()
        np.testing.assert_array_equal(flagella, [-1, *np.repeat([0, 1, 2], np.diff(FIRST_NODE))])
        expected = Coloring("curvature", record, THREE).values(
            record.positions[frame : frame + 1], slice(frame, frame + 1)
        )
        np.testing.assert_allclose(np.array(column["curvature"], float).ravel()[1:], expected[0], rtol=1e-8)
