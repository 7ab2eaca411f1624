"""The page holds the record, loads nothing from outside, and works in a browser."""

from __future__ import annotations

import base64
import html
import io
import json
import os
import re
import shutil

import h5py  # noqa: TID253 (no command line starts here)
import numpy as np
import pytest

from tests.films import FIRST_NODE, THREE, made_record
from warpflag import cli
from warpflag.base.output import OutputError
from warpflag.record import Record
from warpflag.scene import paper_scene, with_values
from warpflag.view.coloring import DISPLAY_RADIUS, Coloring
from warpflag.view.page import page_of, write_page

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
GRAPHICS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    with made_record(tmp_path_factory.mktemp("run")) as record:
        yield record


def content_of(page: str) -> dict:
    """What the page's script reads."""
    (text,) = re.findall(r'<script type="application/json" id="content">(.*?)</script>', page, re.DOTALL)
    return json.loads(text)


def numbers(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def positions_of(shown: dict) -> np.ndarray:
    """Nodes as the page has them, relative to where the body started [um]."""
    sent = shown["positions"]
    nodes = numbers(sent["values"], "<u2").reshape(len(shown["times"]), -1, 3)
    centres = numbers(shown["body"]["positions"], "<f4").reshape(-1, 1, 3)
    return np.array(sent["low"]) + np.array(sent["step"]) * nodes + centres


@pytest.mark.parametrize("radius, shown", [(0.01, DISPLAY_RADIUS), (0.2, 0.2)])
def test_thin_flagella_are_shown_thicker_and_thick_ones_as_they_are(radius, shown, tmp_path):
    scene = with_values(THREE, {"flagella.filament_radius": radius})
    with made_record(tmp_path / "run", 2, scene=scene) as record:
        content = content_of(page_of(record))
    assert content["radius"] == pytest.approx(radius) and content["displayRadius"] == pytest.approx(shown)


def test_the_page_has_the_record_s_frames(record):
    shown = content_of(page_of(record))
    expected = record.positions[:] - record.body_position[0]
    np.testing.assert_allclose(positions_of(shown), expected, atol=2e-4)  # um; 1 % of a flagellum's thickness
    np.testing.assert_allclose(shown["times"], 1e3 * record.times)
    turns = numbers(shown["body"]["orientations"], "<f4").reshape(-1, 4)
    np.testing.assert_allclose(turns, record.body_orientation, atol=1e-7)
    assert shown["firstNode"] == FIRST_NODE and shown["scene"] == record.scene_text
    motor_rate = next(curve for curve in shown["curves"] if curve["label"].startswith("motor rate"))
    assert motor_rate["lines"] == [[None, *map(float, range(1, 12))]] * 3


def test_the_view_holds_a_body_longer_than_the_flagella(tmp_path):
    values = {"body.length": 16.0, "body.width": 0.8, "flagella.length": 2.0}
    with made_record(tmp_path / "long", 1, scene=with_values(paper_scene("long"), values)) as record:
        view = content_of(page_of(record))["view"]
    along = np.array(view["axes"]) @ [0.0, 0.0, 1.0]  # of the body's axis, to the right
    assert along == pytest.approx([1.0, 0.0, 0.0]) and view["half"][0] >= 8.0


@pytest.mark.parametrize("name", ["phase_difference", "curvature", "steric_force"])
def test_the_page_has_the_movie_s_colours(record, name):
    sent = content_of(page_of(record))["colorings"][name]
    shares = numbers(sent["shares"], "u1").reshape(12, -1)
    coloring = Coloring(name, record, THREE)
    values = coloring.values(record.positions[:], slice(0, 12))
    assert sent["highest"] == pytest.approx(coloring.highest)
    np.testing.assert_array_equal(shares == 255, np.isnan(values))
    shown = ~np.isnan(values)
    expected = np.clip(values[shown] / coloring.highest, 0.0, 1.0)
    np.testing.assert_allclose(shares[shown] / 254, expected, atol=0.5 / 254 + 1e-6)


def test_three_hundred_frames_stay_below_three_megabytes(tmp_path):
    with made_record(tmp_path, 301, scene=paper_scene(name="two")) as record:
        page = page_of(record)
        assert len(page.encode()) < 3e6
        # A notebook leaves frames out evenly, and says so.
        shorter, whole = content_of(page_of(record, most_bytes=100_000)), content_of(page)
        assert shorter["frameStride"] == 2 and shorter["times"] == whole["times"][::2]
        np.testing.assert_allclose(positions_of(shorter), positions_of(whole)[::2], atol=4e-4)
        for part, name, size in (("body", "positions", 3), ("body", "orientations", 4), ("motors", "angles", 2)):
            few, all_of_them = (numbers(shown[part][name], "<f4").reshape(-1, size) for shown in (shorter, whole))
            np.testing.assert_array_equal(few, all_of_them[::2], err_msg=name)
        for name, sent in shorter["colorings"].items():
            few, all_of_them = (numbers(own["shares"], "u1") for own in (sent, whole["colorings"][name]))
            np.testing.assert_array_equal(few.reshape(151, -1), all_of_them.reshape(301, -1)[::2], err_msg=name)
        for few, all_of_them in zip(shorter["curves"], whole["curves"], strict=True):
            assert few["lines"] == [line[::2] for line in all_of_them["lines"]]


def test_what_can_t_be_shown_is_told(record, tmp_path):
    with pytest.raises(OutputError, match=r"\.html"):
        write_page(record, tmp_path / "page.pdf")
    with pytest.raises(OutputError, match="phase_difference"):
        write_page(record, tmp_path / "page.html", color_by="mood")
    assert list(tmp_path.iterdir()) == []
    shutil.copy(record.path, tmp_path / "run.h5")
    with h5py.File(tmp_path / "run.h5", "r+") as file:  # of a version without checksums
        del file["checksums"]
        file["cell/motor_angle/value"][3] = np.nan
    with pytest.raises(OutputError, match="motor angles that are not finite"):
        page_of(Record(tmp_path))
    with h5py.File(tmp_path / "run.h5", "r+") as file:
        file["particles/flagella/position/value"][3] = np.inf
    with pytest.raises(OutputError, match="holds positions that are not finite"):
        page_of(Record(tmp_path))


def test_a_scene_s_text_can_not_break_the_page(tmp_path):
    scene = with_values(paper_scene(name="sly"), {"start.record": "</script><script>alert(1)</script>"})
    with made_record(tmp_path, 2, scene=scene) as record:
        page = page_of(record)
    assert page.count("</script>") == 3
    assert "</script><script>alert(1)" in content_of(page)["scene"]


@pytest.fixture(scope="module")
def browser():
    """Chromium without a screen; where there is none, these tests are skipped, or fail where they are required."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        sync_playwright = None
    if CHROMIUM is None or sync_playwright is None:
        missing = "needs Chromium (apt-get install chromium) and playwright (uv run --group pages)"
        if os.environ.get("WARPFLAG_REQUIRE_CHROMIUM"):
            pytest.fail(missing)
        pytest.skip(missing)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=GRAPHICS)
        yield browser
        browser.close()


class Opened:
    """A page in the browser, with everything that it said and asked for."""

    def __init__(self, browser, path, width=1000, height=700):
        self.said, self.asked = [], []
        self.page = browser.new_page(viewport={"width": width, "height": height})
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())
        self.settle()

    def settle(self):
        """Waits until two pictures have been drawn."""
        self.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(0))))")

    def picture(self) -> np.ndarray:
        from PIL import Image

        self.settle()
        shot = self.page.locator("canvas").screenshot()
        return np.array(Image.open(io.BytesIO(shot)).convert("RGB")).astype(int)

    def go(self, frame: int):
        self.page.locator("#slider").fill(str(frame))
        self.settle()

    @property
    def time(self) -> str:
        return self.page.locator("#time").inner_text()

    @property
    def cursors(self) -> list[float]:
        """Where the cursors of the curves stand, as shares of their plots."""
        return self.page.eval_on_selector_all(
            ".cursor", "found => found.map(c => c.offsetLeft / c.parentElement.clientWidth)"
        )


@pytest.fixture(scope="module")
def path(record, tmp_path_factory):
    pytest.importorskip("PIL")
    path = tmp_path_factory.mktemp("page") / "cell.html"
    write_page(record, path, follow=False)
    return path


@pytest.fixture
def opened(browser, path):
    opened = Opened(browser, path)
    yield opened
    assert opened.said == []
    assert opened.asked == [path.as_uri()]
    opened.page.close()


def vivid(picture: np.ndarray) -> np.ndarray:
    """Where flagella are: the background and the body are pale."""
    return np.ptp(picture, axis=2) > 70


def test_the_cell_is_drawn(opened):
    picture = opened.picture()
    assert 0.002 < vivid(picture).mean() < 0.2
    body = (picture[..., 0] - picture[..., 2] > 20) & ~vivid(picture)
    assert 0.003 < body.mean() < 0.2
    # The three colours of the flagella, by their channels.
    red, green, blue = (picture[..., i][vivid(picture)] for i in range(3))
    assert all(found.sum() > 50 for found in (red > blue + 70, blue > red + 70, (green > red + 40) & (green > blue)))


def test_slider_moves_cell_and_curves(opened):
    first = opened.picture()
    assert opened.time == "0.00 ms" and set(opened.cursors) == {0.0}
    opened.go(11)
    last = opened.picture()
    assert opened.time == "0.55 ms" and opened.cursors == pytest.approx([1.0] * len(opened.cursors), abs=0.01)
    assert len(opened.cursors) == 2
    left = [np.nonzero(vivid(picture).any(axis=0))[0].min() for picture in (first, last)]
    assert left[1] < left[0] - 20  # it swims to the left
    opened.page.locator(".plot").first.click(position={"x": 1, "y": 10})
    assert opened.time == "0.00 ms"
    assert np.abs(opened.picture() - first).max() <= 1  # the browser rounds the background's gradient either way


def test_following_keeps_the_cell_in_place(opened):
    opened.page.locator("#follow").check()
    opened.page.locator("#reset").click()
    places = []
    for frame in (0, 11):
        opened.go(frame)
        picture = opened.picture()
        pale = (picture[..., 0] - picture[..., 2] > 20) & ~vivid(picture)
        places.append(np.nonzero(pale.any(axis=0))[0].min())
    assert abs(places[1] - places[0]) < 8


def test_it_plays_and_stops(opened):
    opened.page.locator("#speed").select_option("0.2")
    opened.page.locator("#play").click()
    opened.page.wait_for_function("document.getElementById('slider').value >= 3")
    assert opened.page.locator("#play").inner_text() == "Pause"
    opened.page.locator("#play").click()
    stopped = opened.time
    opened.page.wait_for_timeout(300)
    assert opened.time == stopped != "0.00 ms"


def test_keys_do_what_the_page_says(opened):
    press = opened.page.keyboard.press
    for _ in range(3):
        press("ArrowRight")
    press("ArrowLeft")
    assert opened.time == "0.10 ms"
    press("End")
    assert opened.time == "0.55 ms"
    press("Home")
    opened.page.locator("canvas").focus()
    before = opened.picture()
    press("ArrowLeft")
    turned = opened.picture()
    assert (np.abs(turned - before).max(axis=2) > 40).mean() > 0.005
    press("r")
    assert np.abs(opened.picture() - before).mean() < 0.5
    press("Space")
    opened.page.wait_for_function("document.getElementById('slider').value >= 2")
    press("Space")


def test_dragging_turns_the_cell(opened):
    before, canvas = opened.picture(), opened.page.locator("canvas").bounding_box()
    mouse = opened.page.mouse
    mouse.move(canvas["x"] + 200, canvas["y"] + 100)
    mouse.down()
    mouse.move(canvas["x"] + 320, canvas["y"] + 140, steps=4)
    mouse.up()
    assert (np.abs(opened.picture() - before).max(axis=2) > 40).mean() > 0.005
    assert opened.time == "0.00 ms"


def test_colours_can_be_chosen(opened):
    before = opened.picture()
    opened.page.locator("#color").select_option("curvature")
    after = opened.picture()
    changed = np.abs(after - before).max(axis=2) > 40
    assert (changed & vivid(before)).sum() / vivid(before).sum() > 0.2
    assert "curvature" in opened.page.locator("#color-label").inner_text()


def test_scale_bar_is_as_long_as_it_says(opened):
    """Against the body, which is 0.8 um wide."""
    bar = opened.page.locator("#scale-bar").bounding_box()["width"]
    length = float(opened.page.locator("#scale-label").inner_text().split()[0])
    picture = opened.picture()
    body = (picture[..., 0] - picture[..., 2] > 20) & ~vivid(picture)
    widths = body.sum(axis=0)
    measured = np.median(widths[widths > 0.6 * widths.max()]) * length / bar
    assert measured == pytest.approx(0.8, rel=0.1)


@pytest.mark.parametrize("width", [360, 400, 800, 1400])
def test_the_page_fits_screens(browser, path, width):
    opened = Opened(browser, path, width, 800)
    assert opened.page.evaluate("document.documentElement.scrollWidth") <= width
    assert vivid(opened.picture()).mean() > 0.002
    for box in (opened.page.locator(name).bounding_box() for name in ("#slider", "#play", "#reset")):
        assert box["x"] >= 0 and box["x"] + box["width"] <= width and box["height"] >= 30
    opened.page.close()


def test_fingers_work_as_the_mouse_does(browser, path):
    context = browser.new_context(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    page = context.new_page()
    page.goto(path.as_uri())
    plot = page.locator(".plot").last
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    page.touchscreen.tap(box["x"] + box["width"] - 2, box["y"] + 20)
    assert page.locator("#time").inner_text() == "0.55 ms"
    page.locator("#play").tap()
    page.wait_for_function("document.getElementById('slider').value >= 2 && slider.value < 11")
    context.close()


def test_without_webgl_the_curves_work_and_the_page_says_so(browser, path):
    blind = browser.browser_type.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-3d-apis"])
    page = blind.new_page()
    page.goto(path.as_uri())
    assert page.locator("#no-view").is_visible()
    page.locator("#slider").fill("11")
    assert page.eval_on_selector(".cursor", "c => c.style.left") == "100%"
    blind.close()


def test_a_record_shows_itself_in_a_notebook(browser, record, tmp_path):
    frame = record._repr_html_()
    assert html.unescape(frame).count("<!DOCTYPE html>") == 1
    path = tmp_path / "notebook.html"
    path.write_text(f"<!DOCTYPE html><html><body>{frame}</body></html>", encoding="utf-8")
    page = browser.new_page(viewport={"width": 900, "height": 700})
    page.goto(path.as_uri())
    inner = page.frame_locator("iframe")
    inner.locator("#play").click()
    inner.locator("#play", has_text="Pause").wait_for()
    assert inner.locator(".plot").count() == 2
    page.close()


def test_command_writes_the_page(record, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = str(record.path.parent)
    assert cli.main(["export", run, "--to", "html", "-o", "a.html", "--color", "curvature"]) == 0
    assert capsys.readouterr().out == "a.html\n"
    assert content_of((tmp_path / "a.html").read_text())["colorBy"] == "curvature"
    assert cli.main(["export", run, "--to", "html", "-o", "a.pdf"]) == 2
    said = capsys.readouterr().err
    assert ".html" in said and said.count("\n") == 1


def test_one_flagellum_has_no_bundle(tmp_path):
    with made_record(tmp_path, 3, scene=with_values(paper_scene(name="one"), {"flagella.count": 1})) as record:
        shown = content_of(page_of(record))
    assert "phase_difference" not in shown["colorings"]
    assert [curve["label"] for curve in shown["curves"]] == ["motor rate (Hz)"]
