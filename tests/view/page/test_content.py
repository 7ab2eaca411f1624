"""Everything that a page is told of a record is compared with the record, key by key."""

from __future__ import annotations

import base64
import html
from typing import Any

import numpy as np
import pytest

from tests.films import FIRST_NODE, THREE, made_record
from tests.helpers import attachment, matrix
from warpflag.record import Record
from warpflag.record.recorder import Recorder
from warpflag.scene import with_values
from warpflag.view.coloring import BODY_COLOR, FLAGELLUM_COLORS, UNDEFINED_COLOR
from warpflag.view.curves import curves
from warpflag.view.page import notebook_frame, page_of, write_page
from warpflag.view.page.content import content

SCENE = with_values(THREE, {"polymorphs.enabled": True, "body.length": 3.0, "body.width": 0.9})
# What else a page is told: how it is shown at first, and colours, both looked at with the page itself.
SHOWN = {"colorings", "colorBy", "follow", "map", "view"}


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """Nine frames, the first of which has the body turned already."""
    where = tmp_path_factory.mktemp("run")
    recorder = Recorder(where / "run.h5")
    with made_record(where / "made", scene=SCENE, offset=(2.0, -1.0, 3.0)) as made:
        sizes = {"filament_radius": made.filament_radius, "body_length": 3.0, "body_width": 0.9}
        recorder.start(made.scene_text, made.first_node, versions=made.versions, **sizes)
        for k in range(3, 12):
            recorder.write(made.frame(k))
    recorder.close()
    with Record(where) as record:
        yield record


def floats(text: str, *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(shape)


@pytest.mark.parametrize("most_bytes", [None, 9 * 83 * 3])
def test_a_page_is_told_what_the_record_has(record, most_bytes):
    """Also with every third frame alone, where it may take so many bytes."""
    told = content(record, "flagellum", True, most_bytes)
    stride = 1 if most_bytes is None else 3
    frames = slice(0, 12, stride)
    count = len(range(9)[frames])
    centres, begun = record.body_position[frames], record.body_position[0]
    kept: dict[str, Any] = {
        **{"name": "three", "scene": record.scene_text, "version": "9.8", "frameStride": stride},
        **{"times": [pytest.approx(1e3 * time, rel=1e-6) for time in record.times[frames]], "firstNode": FIRST_NODE},
        **{"radius": record.filament_radius, "displayRadius": 0.05},
        **{"flagellumColors": FLAGELLUM_COLORS, "undefinedColor": UNDEFINED_COLOR},
    }
    assert set(told) == set(kept) | SHOWN | {"positions", "body", "motors", "path", "curves"}
    assert {key: told[key] for key in kept} == kept

    sent = told["positions"]
    nodes = np.frombuffer(base64.b64decode(sent["values"]), "<u2").reshape(count, -1, 3)
    relative = np.array(sent["low"]) + np.array(sent["step"]) * nodes
    np.testing.assert_allclose(relative, record.positions[frames] - centres[:, None], atol=2e-4)

    body = told["body"]
    assert (body["length"], body["width"], body["color"]) == (3.0, 0.9, BODY_COLOR) and len(body) == 5
    np.testing.assert_allclose(floats(body["positions"], count, 3), centres - begun, atol=1e-6)
    np.testing.assert_allclose(floats(body["orientations"], count, 4), record.body_orientation[frames], atol=1e-7)
    half = count // 8  # frames that the path averages to each side; its ends are those of the body's path
    path = floats(told["path"], count, 3)
    middle = [(centres[k - half : k + half + 1] - begun).mean(axis=0) for k in range(half, count - half)]
    np.testing.assert_allclose(path[half : count - half], middle, atol=1e-6)
    np.testing.assert_allclose(path[[0, -1]], (centres - begun)[[0, -1]], atol=1e-6)

    motors = told["motors"]
    assert (motors["lengths"], motors["width"], len(motors["colors"])) == ((0.28, 0.2, 0.2), 0.07, 3)
    angles = floats(motors["angles"], count, 3)
    np.testing.assert_allclose(angles, record.motor_angle[frames], rtol=1e-6)
    for k, spec in enumerate(SCENE.resolved_flagella()):
        anchor, axis = attachment(SCENE, spec)
        e1, e2, m = np.array(motors["tripods"])[k]
        np.testing.assert_allclose(motors["anchors"][k], anchor, atol=1e-9)
        np.testing.assert_allclose(m, axis, atol=1e-9)
        for frame in range(count):  # turned by the motor's angle it is the recorded tripod
            turned = np.cos(angles[frame, k]) * e1 + np.sin(angles[frame, k]) * e2
            in_lab = matrix(record.body_orientation[frames][frame]) @ turned
            np.testing.assert_allclose(in_lab, record.directors[frames][frame, FIRST_NODE[k]], atol=1e-5)

    assert [own["label"] for own in told["curves"]] == [curve.label for curve in curves(record)]
    for own, curve in zip(told["curves"], curves(record), strict=True):
        values = np.array([[np.nan if x is None else x for x in line] for line in own["lines"]]).T
        np.testing.assert_allclose(values, curve.values[frames], rtol=1e-4)


def test_a_page_in_a_notebook_has_room_for_two_mebibytes_and_one_in_a_file_for_all(record, tmp_path, monkeypatch):
    asked: list[int | None] = []

    def noted(record, color_by="flagellum", follow=True, most_bytes=None):
        asked.append(most_bytes)
        return page_of(record, color_by, follow, 9 * 83 * 3 if most_bytes else None)

    monkeypatch.setattr("warpflag.view.page.document.page_of", noted)
    write_page(record, tmp_path / "cell.html")
    for page, stride in ((html.unescape(notebook_frame(record)), 3), ((tmp_path / "cell.html").read_text(), 1)):
        assert f'"frameStride":{stride},' in page
    assert asked == [None, 2 << 20]
