"""Pictures show what is there: rods where the camera has them, in their colours, lit, with scale and time."""

from __future__ import annotations

import shutil
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom  # noqa: TID253 (no command line starts here)

from tests.films import FIRST_NODE, made_record
from warpflag import cli
from warpflag.base.device import find_device
from warpflag.base.output import OutputError
from warpflag.record import RecordError
from warpflag.view import images
from warpflag.view.images import write_png
from warpflag.view.lettering import _GLYPHS, draw_strokes, draw_text, text_width
from warpflag.view.raycaster import draw
from warpflag.view.render import Renderer, render
from warpflag.view.usd import Shot, movie_stage, write_movie
from warpflag.view.usd.read import Camera, Film, Rods

RED, BLUE, WHITE = (0.8, 0.05, 0.05), (0.05, 0.05, 0.8), (0.8, 0.8, 0.8)
LIGHT = (np.array([0.0, 0.6, 0.8]), 0.05)


def looking_down(distance: float = 40.0, half_width: float = 4.0) -> Camera:
    """A camera on the z axis that sees +-half_width at the origin, in a square picture."""
    tangent = half_width / distance
    return Camera(np.array([0.0, 0.0, distance]), *np.eye(3), (tangent, tangent), distance)


def rods(*given) -> Rods:
    """Of (start, end, radius, colour)."""
    start, end, radius, color = (np.array(column, dtype=float) for column in zip(*given, strict=True))
    return Rods(start, end, radius, color, color)


def drawn(*given, size=(200, 200), light=LIGHT, camera=None, device="cpu") -> np.ndarray:
    return draw(rods(*given), camera or looking_down(), light, size, find_device(device)).astype(float)


def covered(picture: np.ndarray, color) -> np.ndarray:
    """Share of each pixel that shows a colour: how far it is from the white screen along the missing channels."""
    missing = np.array(color) < 0.4
    return np.clip((picture[..., ~missing].mean(axis=2) - picture[..., missing].mean(axis=2)) / 90.0, 0.0, 1.0)


def test_a_rod_covers_what_its_projection_does(device):
    picture = drawn(((-2, 0, 0), (2, 0, 0), 0.5, RED), device=device)
    red = covered(picture, RED)
    pixel = 8.0 / 200
    assert red.sum() * pixel**2 == pytest.approx(4 * 1.0 + np.pi * 0.25, rel=0.05)
    rows, columns = np.nonzero(red > 0.5)
    assert (columns.min(), columns.max()) == pytest.approx((100 - 2.5 / pixel, 100 + 2.5 / pixel), abs=1.5)
    assert (rows.min(), rows.max()) == pytest.approx((100 - 0.5 / pixel, 100 + 0.5 / pixel), abs=1.5)


@pytest.mark.parametrize("tilt", [0.0, 0.6, np.pi / 2])
def test_rods_at_any_angle_to_the_view(tilt):
    """Straight along the view, too, where a cylinder has no side to hit."""
    end = 1.5 * np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    red = covered(drawn((-end, end, 0.4, RED)), RED)
    # The silhouette, from points of the surface.
    view = looking_down()
    across = [
        (view.eye[2] * p[0] / (view.eye[2] - p[2]), r * view.eye[2] / (view.eye[2] - p[2]))
        for p, r in ((s * end, 0.4) for s in np.linspace(-1, 1, 41))
    ]
    left, right = min(x - r for x, r in across), max(x + r for x, r in across)
    columns = np.nonzero(red.max(axis=0) > 0.5)[0]
    assert (columns.min(), columns.max()) == pytest.approx((100 + 25 * left, 100 + 25 * right), abs=1.5)


@pytest.mark.parametrize("front", [1.0, -1.0])
def test_what_is_nearer_hides_what_is_behind(front):
    picture = drawn(((-3, 0, front), (3, 0, front), 0.4, RED), ((0, -3, -front), (0, 3, -front), 0.4, BLUE))
    red, _, blue = picture[100, 100]
    assert (red > blue) == (front > 0)
    assert picture[100, 40][0] > picture[100, 40][2]  # away from the crossing each is whole
    assert picture[40, 100][2] > picture[40, 100][0]


def test_edges_are_soft_and_the_inside_is_not():
    picture = drawn(((-2, -1.3, 0), (2, 1.1, 0), 0.5, RED))
    red = covered(picture, RED)
    partly = (red > 0.08) & (red < 0.6)
    perimeter = (2 * np.hypot(4, 2.4) + np.pi) * 25
    assert 0.3 * perimeter < partly.sum() < 2.5 * perimeter
    assert red[98:107, 97:104].min() > 0.95


def test_light_comes_from_the_light():
    picture = drawn(((0, 0, 0), (0, 0, 1e-6), 2.0, WHITE))
    upper, lower = picture[100 - 30, 100], picture[100 + 30, 100]
    assert upper.min() > lower.max() + 30
    turned = drawn(((0, 0, 0), (0, 0, 1e-6), 2.0, WHITE), light=(np.array([0.0, -0.6, 0.8]), 0.05))
    assert turned[100 + 30, 100].min() > turned[100 - 30, 100].max()


def test_what_stands_in_the_light_throws_a_soft_shadow():
    body = ((-2.5, 0, 0), (2.5, 0, 0), 1.0, WHITE)
    # A thin rod in the light, out of the camera's way: it is above the picture.
    rod = ((0, 3.0, 5.0), (0, 6.0, 5.0), 0.25, WHITE)
    camera = looking_down(half_width=2.5)
    bare, shaded = drawn(body, camera=camera), drawn(body, rod, camera=camera)
    darker = bare.mean(axis=2) - shaded.mean(axis=2)
    strip = darker[60:140].max(axis=0)
    assert strip[100] > 30  # under the rod
    assert strip[[30, 170]].max() < 3  # beside it
    broad = drawn(body, rod, camera=camera, light=(LIGHT[0], 0.3))
    soft = (bare.mean(axis=2) - broad.mean(axis=2))[60:140].max(axis=0)
    assert (soft > 3).sum() > (strip > 3).sum() and soft.max() < strip.max()


def test_the_screen_is_a_gradient_with_a_shadow():
    empty = drawn(((50, 50, 0), (50, 50, 1), 0.1, RED))
    assert empty.min() > 200 and np.ptp(empty.mean(axis=(1, 2))) > 10
    darker = empty - drawn(((-1, 1, 0), (1, 1, 0), 0.4, WHITE), light=(np.array([0.0, 0.8, 0.6]), 0.05))
    below = darker[100:, 60:140].mean(axis=(1, 2))
    assert below.max() > 10 and darker[150:, :30].max() < 2


@pytest.mark.parametrize("size", [(160, 90), (90, 160), (100, 100)])
def test_a_picture_of_any_proportions_holds_what_the_camera_sees(size):
    camera = looking_down()
    marks = [((x, y, 0), (x, y, 1e-6), 0.3, RED) for x in (-3.6, 3.6) for y in (-3.6, 3.6)]
    picture = drawn(*marks, size=size, camera=camera)
    assert picture.shape == (size[1], size[0], 3)
    scale = min(size) / 8.0
    for x in (-3.6, 3.6):
        for y in (-3.6, 3.6):
            red, green, _ = picture[round(size[1] / 2 - y * scale), round(size[0] / 2 + x * scale)]
            assert red > green + 50


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    directory = tmp_path_factory.mktemp("run")
    with made_record(directory, 12) as record:
        write_movie(record, directory / "movie.usdc")
    return directory


def ink(picture: np.ndarray) -> np.ndarray:
    """Where text and bars are."""
    return (np.abs(picture.astype(int) - [38, 50, 63]).max(axis=2) < 12) & (picture.max(axis=2) < 90)


def test_flagella_are_where_the_movie_s_camera_has_them_in_their_colours(run):
    film = Film(run / "movie.usdc")
    picture = Renderer(film, (640, 360)).picture(5.0)
    stage = Usd.Stage.Open(str(run / "movie.usdc"))
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/Camera")).GetCamera(5)
    frustum = camera.frustum
    window = frustum.window  # widened to 16:9 as the picture is
    aspect = (window.max[0] - window.min[0]) / (window.max[1] - window.min[1])
    project = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    widen = np.array([min(1.0, aspect / (16 / 9)), min(1.0, (16 / 9) / aspect)])
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath("/World/Cell/Flagella"))
    colors = np.array(curves.GetDisplayColorAttr().Get(5))
    hits = total = 0
    for node, point in enumerate(curves.GetPointsAttr().Get(5)):
        x, y, _ = project.Transform(Gf.Vec3d(point))
        u, v = np.array([x, -y]) * widen
        pixel = picture[int((v + 1) / 2 * 360), int((u + 1) / 2 * 640)].astype(float)
        shades = np.stack([colors[first] for first in FIRST_NODE[:3]])
        hue = (pixel - pixel.min()) / max(np.ptp(pixel), 1.0)
        hues = (shades - shades.min(axis=1, keepdims=True)) / np.ptp(shades, axis=1, keepdims=True)
        if np.ptp(pixel) > 40:
            total += 1
            hits += np.abs(hues - hue).sum(axis=1).argmin() == np.searchsorted(FIRST_NODE, node, side="right") - 1
    assert total > 50  # nodes that nothing hides
    assert hits > 0.9 * total


def test_no_picture_is_empty_and_the_cell_moves(run):
    film = Film(run / "movie.usdc")
    pictures = [Renderer(film, (320, 180)).picture(code).astype(float) for code in (0, 4.5, 11)]
    for picture in pictures:
        vivid = np.ptp(picture, axis=2) > 50
        assert 0.003 < vivid.mean() < 0.2  # flagella
        assert ((picture[..., 0] - picture[..., 2]) > 20).mean() > 0.01  # the body is warm
    left = [np.nonzero((p[..., 0] - p[..., 2] > 20).any(axis=0))[0].min() for p in pictures]
    assert left[0] > left[1] > left[2]  # it swims to the left


def test_flagella_can_be_seen_at_thumbnail_size(run):
    film = Film(run / "movie.usdc")
    picture = Renderer(film, (128, 72)).picture(0).astype(float)
    assert (np.ptp(picture, axis=2) > 60).mean() > 0.01
    # And thinner ones are drawn as thin as asked for, where the picture is fine enough.
    shares = [
        (np.ptp(Renderer(film, (640, 360), radius).picture(0).astype(float), axis=2) > 50).mean()
        for radius in (0.05, 0.1)
    ]
    assert 1.5 < shares[1] / shares[0] < 2.5


def test_scale_bar_is_as_long_as_it_says(run):
    film, size, letter = Film(run / "movie.usdc"), (960, 540), 0.024 * 540
    camera = film.camera(0)
    found = ink(Renderer(film, size).picture(0))[400:, 600:]
    bar = found[found.sum(axis=1).argmax()].nonzero()[0]
    pixel = 2 * camera.focus * max(camera.tangents[0], camera.tangents[1] * 16 / 9) / 960
    length = (len(bar) - 0.32 * letter) * pixel  # without the round ends
    said = min((0.5, 1, 2, 5), key=lambda candidate: abs(np.log(candidate / length)))
    assert length == pytest.approx(said, rel=0.02)
    middle, label = 600.5 + bar.mean(), np.arange(400, 540)[:, None] < 540 - 2.2 * letter
    wrong = {}
    for candidate in (0.5, 1, 2, 5):
        text = f"{candidate:g} µm"
        expected = written(text, (middle - text_width(text, letter) / 2, 540 - 2.4 * letter), letter)[400:, 600:]
        wrong[candidate] = (found ^ expected)[label[:, 0]].sum() / expected.sum()
    assert wrong[said] < 0.5 and min(wrong, key=wrong.__getitem__) == said


def written(text: str, place: tuple[float, float], letter: float) -> np.ndarray:
    """Where a text is on a picture of 960x540 pixels that has nothing else."""
    picture = np.full((540, 960, 3), 245, np.uint8)
    draw_text(picture, text, place, letter, (38, 50, 63))
    return ink(picture)


def test_the_time_is_in_the_picture(run):
    film, letter = Film(run / "movie.usdc"), 0.024 * 540
    texts = {0: "0.00 ms", 7: "0.35 ms", 11: "0.55 ms"}
    shown = {code: ink(Renderer(film, (960, 540)).picture(code))[:60, :200] for code in texts}
    for code in texts:
        wrong = {
            other: (shown[code] ^ written(text, (1.4 * letter, 2.6 * letter), 1.2 * letter)[:60, :200]).sum()
            for other, text in texts.items()
        }
        assert wrong[code] < 0.1 * shown[code].sum() and min(wrong, key=wrong.__getitem__) == code


def test_a_legend_says_what_colours_mean(run):
    with made_record(run.parent / "again", 3) as record:
        film = Film(movie_stage(record, Shot(color_by="curvature")))
    plain = Film(run / "movie.usdc")
    Renderer(film, (640, 360), 3.0).picture(0)  # 300 times as thick can be written, too
    corners = [Renderer(f, (640, 360)).picture(0)[250:330, :200].astype(float) for f in (film, plain)]
    assert (np.ptp(corners[0], axis=2) > 90).sum() > 100 and (np.ptp(corners[1], axis=2) > 90).sum() == 0


def unpacked(path: Path) -> np.ndarray:
    """The pixels of a PNG, by its specification."""
    data = path.read_bytes()
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    chunks, at = {}, 8
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at : at + 8])
        body = data[at + 8 : at + 8 + length]
        assert struct.unpack(">I", data[at + 8 + length : at + 12 + length])[0] == zlib.crc32(kind + body)
        chunks[kind], at = chunks.get(kind, b"") + body, at + 12 + length
    width, height, depth, color = struct.unpack(">IIBB", chunks[b"IHDR"][:10])
    assert (depth, color) == (8, 2)
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, 3 * width + 1)
    above = np.zeros(3 * width, int)
    picture = np.zeros((height, 3 * width), int)
    for row, (kind, *rest) in enumerate(rows.astype(int)):
        line = picture[row]
        for i, value in enumerate(rest):
            a, b, c = (line[i - 3] if i > 2 else 0), above[i], (above[i - 3] if i > 2 else 0)
            nearest = min((abs(b - c), 0, a), (abs(a - c), 1, b), (abs(a + b - 2 * c), 2, c))[2]
            line[i] = (value + (0, a, b, (a + b) // 2, nearest)[kind]) % 256
        above = line
    return picture.reshape(height, width, 3)


def test_png_holds_the_pixels(tmp_path):
    smooth = np.add.outer(np.arange(40), np.arange(30))[..., None] * [1, 2, 3] % 256
    noise = np.random.default_rng(1).integers(0, 256, (20, 30, 3))
    picture = np.concatenate([smooth, noise, np.repeat(noise[:1], 9, axis=0)]).astype(np.uint8)
    write_png(tmp_path / "p.png", picture)
    np.testing.assert_array_equal(unpacked(tmp_path / "p.png"), picture)
    assert [path.name for path in tmp_path.iterdir()] == ["p.png"]


def test_a_directory_is_drawn_by_its_movie_or_filmed_anew(run, tmp_path):
    render(run, tmp_path / "last.png", size=(160, 90))
    expected = Renderer(Film(run / "movie.usdc"), (160, 90)).picture(11)
    np.testing.assert_array_equal(unpacked(tmp_path / "last.png"), expected)
    render(run / "movie.usdc", tmp_path / "same.png", size=(160, 90))
    assert (tmp_path / "same.png").read_bytes() == (tmp_path / "last.png").read_bytes()
    render(run, tmp_path / "early.png", size=(160, 90), times=[2.25e-4])
    np.testing.assert_array_equal(
        unpacked(tmp_path / "early.png"), Renderer(Film(run / "movie.usdc"), (160, 90)).picture(4.5)
    )
    shutil.copy(run / "run.h5", tmp_path)
    render(tmp_path, tmp_path / "unfilmed.png", size=(160, 90))
    assert (tmp_path / "unfilmed.png").read_bytes() == (tmp_path / "last.png").read_bytes()
    render(run, tmp_path / "curved.png", size=(160, 90), shot=Shot(color_by="curvature", follow=True))
    assert (tmp_path / "curved.png").read_bytes() != (tmp_path / "last.png").read_bytes()


@pytest.mark.parametrize("count, size", [(6, (320, 180)), (2, (320, 80)), (5, (100, 300))])
def test_a_sheet_has_every_snapshot(run, tmp_path, count, size):
    render(run, tmp_path / "sheet.png", size=size, snapshots=count)
    sheet = unpacked(tmp_path / "sheet.png").astype(float)
    assert sheet.shape == (size[1], size[0], 3)
    columns = {6: 3, 2: 2, 5: 1}[count]
    rows = -(-count // columns)
    times = set()
    for i in range(count):
        row, column = divmod(i, columns)
        panel = sheet[row * size[1] // rows :, column * size[0] // columns :][: size[1] // rows, : size[0] // columns]
        assert (np.ptp(panel, axis=2) > 50).sum() > 20, i
        times.add(ink(panel.astype(np.uint8))[:30, :60].tobytes())
    assert len(times) == count


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_films_play_at_the_movie_s_pace(run, tmp_path, suffix):
    image = pytest.importorskip("PIL.Image")
    render(run, tmp_path / f"film{suffix}", size=(96, 54), frames_per_second=25.0)
    with image.open(tmp_path / f"film{suffix}") as film:
        assert film.size == (96, 54) and film.info["loop"] == 0
        assert film.n_frames == 6  # 0.22 s: time codes 0, 2, ... 10
        durations = []
        for frame in range(6):
            film.seek(frame)
            film.load()
            durations.append(film.info["duration"])
            shown = np.array(film.convert("RGB")).astype(float)
            expected = Renderer(Film(run / "movie.usdc"), (96, 54)).picture(2 * frame)
            assert np.abs(shown - expected).mean() < 6
        assert durations == [40] * 6


def test_a_film_needs_its_program_and_says_so(run, tmp_path, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    for package in ("PIL", "imageio_ffmpeg"):
        monkeypatch.setitem(sys.modules, package, None)
    for suffix in (".mp4", ".webp", ".gif"):
        with pytest.raises(OutputError, match=r"warpflag\[render\]"):
            render(run, tmp_path / f"film{suffix}")
    assert list(tmp_path.iterdir()) == []


def test_mp4_by_ffmpeg(run, tmp_path):
    try:
        images.check_writable(tmp_path / "film.mp4")
    except OutputError:
        pytest.skip("no ffmpeg here")
    render(run, tmp_path / "film.mp4", size=(97, 55))
    data = (tmp_path / "film.mp4").read_bytes()
    assert data[4:8] == b"ftyp" and len(data) > 1000


def test_bad_input_is_one_line_and_leaves_nothing(run, tmp_path):
    (tmp_path / "junk.usdc").write_text("junk")
    Usd.Stage.CreateNew(str(tmp_path / "bare.usda")).Save()
    wrong = [
        (run, "p.bmp", {}, "must end in"),
        (run, "p.png", {"size": (5, 5)}, "5x5"),
        (run, "p.png", {"radius": -1.0}, "radius"),
        (run, "p.gif", {"frames_per_second": 0.0}, "frames per second"),
        (run, "p.gif", {"snapshots": 3}, "for pictures"),
        (run, "p.png", {"snapshots": 0}, "snapshots 0"),
        (run, "p.png", {"snapshots": 900, "size": (64, 64)}, "do not fit"),
        (run / "movie.usdc", "p.png", {"shot": Shot()}, "movie.usdc"),
        (tmp_path / "junk.usdc", "p.png", {}, "junk.usdc"),
        (tmp_path / "bare.usda", "p.png", {}, "no movie of warpflag"),
    ]
    for source, name, options, words in wrong:
        with pytest.raises(OutputError) as raised:
            render(source, tmp_path / name, **options)
        assert words in str(raised.value) and "\n" not in str(raised.value)
    with pytest.raises(RecordError, match="no such record"):
        render(tmp_path / "nowhere", tmp_path / "p.png")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bare.usda", "junk.usdc"]


def test_the_command_draws(run, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    small = ["--size", "160x90"]
    assert cli.main(["render", str(run), "-o", "last.png", *small]) == 0
    assert capsys.readouterr().out == "last.png\n"
    render(run, "expected.png", size=(160, 90))
    assert Path("last.png").read_bytes() == Path("expected.png").read_bytes()
    options = ["--times", "0.1", "0.4", "--color", "curvature", "--follow", "--radius", "0.08", "--quiet", *small]
    assert cli.main(["render", str(run), "-o", "two.png", *options]) == 0
    render(
        run,
        "expected.png",
        size=(160, 90),
        times=[1e-4, 4e-4],
        shot=Shot(color_by="curvature", follow=True),
        radius=0.08,
    )
    assert Path("two.png").read_bytes() == Path("expected.png").read_bytes()
    assert capsys.readouterr() == ("", "")
    for wrong, word in (
        (["-o", "p.tiff"], ".png"),
        (["-o", "p.png", "--device", "tpu"], "tpu"),
        (["-o", "p.png", "--color", "mood"], "curvature"),
    ):
        assert cli.main(["render", str(run), *wrong]) == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.count("\n") == 1 and word in said.err


def test_a_film_s_pace_is_the_movie_s_whatever_its_pictures_per_second(run, tmp_path):
    image = pytest.importorskip("PIL.Image")
    for slow_down, seconds in ((None, 0.22), ("800", 0.44)):
        slower = ["--slow-down", slow_down] if slow_down else ["--follow"]
        options = ["--size", "64x36", "--fps", "25", "--quiet", *slower]
        assert cli.main(["render", str(run), "-o", str(tmp_path / "film.gif"), *options]) == 0
        with image.open(tmp_path / "film.gif") as film:
            assert 0.04 * film.n_frames == pytest.approx(seconds, abs=0.04)


def test_every_letter_is_its_own_and_as_wide_as_it_says():
    shapes = {}
    for letter in set(_GLYPHS) - {" "}:
        picture = np.full((60, 60, 3), 255, np.uint8)
        draw_text(picture, letter, (10, 40), 24, (0, 0, 0))
        dark = picture[..., 0] < 128
        columns = np.nonzero(dark.any(axis=0))[0]
        assert columns.max() - columns.min() == pytest.approx(text_width(letter, 24), abs=5.5), letter
        shapes[letter] = dark.tobytes()
    assert len(set(shapes.values())) == len(shapes)
    for line in (
        "0123456789",
        "1 µm",
        "flagella drawn 5x thicker",
        "phase difference",
        "curvature 1/µm",
        "steric force pN",
    ):
        assert set(line) <= set(_GLYPHS)


def test_strokes_are_as_thick_as_asked_for():
    picture = np.full((40, 100, 3), 255, np.uint8)
    draw_strokes(picture, [np.array([[20.0, 20.0], [80.0, 20.0]])], 6.0, (0, 0, 0))
    shade = 1.0 - picture[..., 0] / 255.0
    assert shade.sum() == pytest.approx(60 * 6 + np.pi * 9, rel=0.02)
    draw_strokes(picture, [np.array([[-5.0, -5.0], [120.0, 50.0]])], 3.0, (0, 0, 0))  # beyond the edges, too
