"""Rods are drawn where a camera sees them, in their colours, lit and shaded."""

from __future__ import annotations

import numpy as np
import pytest

from warpflag.base.device import find_device
from warpflag.view.raycaster import draw
from warpflag.view.usd.read import Camera, Rods

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


def test_a_highlight_lies_where_the_surface_mirrors_the_light():
    """Its normal halves the angle between light and eye; without gloss the brightest point faces the light."""
    picture = drawn(((0, 0, 0), (0, 0, 1e-6), 2.0, (0.02, 0.02, 0.02)))
    shown = picture.mean(axis=2)[70:130, 70:130]  # all of it the sphere
    rows, columns = np.nonzero(shown >= 0.9 * shown.max())
    halfway = LIGHT[0] + [0.0, 0.0, 1.0]
    up = 2.0 * halfway[1] / np.linalg.norm(halfway) * 200 / 8.0
    assert (70 + columns.mean(), 70 + rows.mean()) == pytest.approx((99.5, 99.5 - up), abs=2.0)


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
