"""A picture of rods as a camera sees them, drawn by the ray caster of the kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from warpflag.base.kernels import load_kernels
from warpflag.view.coloring import linear
from warpflag.view.usd.read import Camera, Rods

__all__ = ["draw"]

Array = NDArray[np.float64]

_SCREEN_TOP, _SCREEN_BOTTOM = "#fafbfc", "#dde5ee"
_SCREEN_GAP = 0.6  # um, from the farthest thing to the screen: shadows lie near what casts them
_LOADED_DEVICES: set[str] = set()  # devices for which this process has loaded the ray caster
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))  # rad; turned by it, points of a spiral lie most evenly


def draw(
    rods: Rods, camera: Camera, light: tuple[Array, float], size: tuple[int, int], device: Any
) -> NDArray[np.uint8]:
    """A picture in sRGB, shape [height, width, 3].

    Args:
        rods: what is drawn.
        camera: that sees them.
        light: unit vector toward the light, and half the angle under which it is seen [rad].
        size: width and height [pixels]; where they have other proportions than the camera, more is seen.
        device: Warp's device.
    """
    import warp as wp
    from warpflag_kernels.picture import raycast
    from warpflag_kernels.picture.rays import Capsules

    middle = camera.eye - camera.focus * camera.back  # the scene is near it: small coordinates for single precision
    start, end, eye = rods.start - middle, rods.end - middle, camera.focus * camera.back
    across, above = seen(camera, size)
    depth = (eye - np.stack([start, end])) @ camera.back
    near, far = float((depth - rods.radius).min()), float((depth + rods.radius).max())
    pixel = 2.0 * far * across / size[0]
    reach = rods.radius[:, None] + pixel

    def vectors(values: Array) -> Any:
        return wp.array(np.ascontiguousarray(values, dtype=np.float32), dtype=wp.vec3, device=device)

    bvh = wp.Bvh(vectors(np.minimum(start, end) - reach), vectors(np.maximum(start, end) + reach))
    capsules = Capsules()
    capsules.bvh = bvh.id
    capsules.start, capsules.end = vectors(start), vectors(end)
    capsules.radius = wp.array(rods.radius.astype(np.float32), dtype=wp.float32, device=device)
    capsules.color_start, capsules.color_end = vectors(rods.color_start), vectors(rods.color_end)

    view = raycast.View()
    view.width, view.height = size
    view.eye, view.forward = wp.vec3(*eye), wp.vec3(*-camera.back)
    view.right, view.up = wp.vec3(*(across * camera.right)), wp.vec3(*(above * camera.up))
    view.near, view.screen = near, far + _SCREEN_GAP
    view.light, view.lights = wp.vec3(*light[0]), vectors(_light_points(*light, raycast.LIGHT_SAMPLES))
    view.sky = wp.vec3(*camera.up)
    view.key, view.fill, view.gloss, view.haze = 0.95, 0.48, 0.3, 0.15
    view.screen_top, view.screen_bottom = wp.vec3(*linear(_SCREEN_TOP)), wp.vec3(*linear(_SCREEN_BOTTOM))
    view.vignette, view.shade = 0.12, 0.3

    picture: Any = wp.array(np.empty(3 * size[0] * size[1], np.uint8), dtype=wp.uint8, device=device)
    if str(device) not in _LOADED_DEVICES:
        load_kernels(lambda: raycast.cast(capsules, view, picture), picture.device)
        _LOADED_DEVICES.add(str(device))
    raycast.cast(capsules, view, picture)
    return picture.numpy().reshape(size[1], size[0], 3)


def seen(camera: Camera, size: tuple[int, int]) -> tuple[float, float]:
    """Tangents of half the angles of view across and up, widened to the proportions of a picture.

    Args:
        camera: whose view is widened.
        size: width and height of the picture [pixels].
    """
    across, above = camera.tangents
    proportion = size[0] / size[1]
    return max(across, above * proportion), max(above, across / proportion)


def _light_points(toward: Array, half_angle: float, count: int) -> NDArray[np.float64]:
    """Unit vectors toward points spread evenly over a disc of light, shape [count, 3]."""
    side = np.cross(toward, np.eye(3)[np.argmin(np.abs(toward))])
    side /= np.linalg.norm(side)
    index = np.arange(count)
    radius = np.tan(half_angle) * np.sqrt((index + 0.5) / count)
    turn = index * _GOLDEN_ANGLE
    offsets = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(toward, side)
    points = toward + radius[:, None] * offsets
    return points / np.linalg.norm(points, axis=1, keepdims=True)
