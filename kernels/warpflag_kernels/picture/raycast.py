"""Pictures of capsules: a ray caster that needs no screen and no graphics driver.

One launch finds what lies behind each pixel's centre. A second one takes several rays through every pixel in which
something begins, ends or curves, and leaves the others as they are. Each of these rays asks a different point of the
broad light whether it is in sight, so shadows have soft edges. What is hit neither reflects nor refracts.

Behind everything stands a screen across the view. The shadow on it is cast on a coarse grid and smoothed.

Lengths in um, seen from a centre near the scene: single precision is enough. Colours are linear RGB.
"""

from typing import Any

import warp as wp

from warpflag_kernels.picture.rays import MODULE, NO_HIT, Capsules, capsule_hit, is_dark, nearest_hit

SAMPLES = 3
"""Rays along each side of a pixel that shows more than background."""
SAMPLES_INSIDE = 2
"""The same where nothing begins or ends."""
LIGHT_SAMPLES = SAMPLES * SAMPLES
SHADOW_CELL = 4
"""Pixels along each side of a cell of the screen's shadow."""

_SampleRays = wp.types.matrix((LIGHT_SAMPLES, 3), wp.float32)
_SampleDistances = wp.types.vector(LIGHT_SAMPLES, wp.float32)
_SampleHits = wp.types.vector(LIGHT_SAMPLES, wp.int32)
_OUTWARD = wp.constant(2.0e-3)  # um, from a surface to where its shadow ray starts


@wp.struct
class View:
    """Camera, light and screen. Vectors of length 1 unless it is said otherwise."""

    width: wp.int32  # [pixels]
    height: wp.int32
    eye: wp.vec3  # [um]
    right: wp.vec3  # half the width of what is seen at distance 1
    up: wp.vec3  # half its height
    forward: wp.vec3
    near: wp.float32  # distance of the nearest thing along forward [um]
    screen: wp.float32  # distance of the screen along forward [um]
    light: wp.vec3  # toward the middle of the light
    lights: wp.array(dtype=wp.vec3)  # toward points all over it [LIGHT_SAMPLES]
    sky: wp.vec3  # where most of the light from everywhere comes from
    key: wp.float32  # strength of the light
    fill: wp.float32  # strength of the light from everywhere
    gloss: wp.float32  # strength of highlights
    haze: wp.float32  # share of what is farthest away that is lost in the colour of the screen
    screen_top: wp.vec3  # linear RGB
    screen_bottom: wp.vec3
    vignette: wp.float32  # share of the screen's light that is missing in a corner
    shade: wp.float32  # share of it that a shadow takes


@wp.func
def ray_through(view: View, x: wp.float32, y: wp.float32):
    """Direction from the eye through a place of the picture, in pixels from its upper left corner."""
    across = 2.0 * x / float(view.width) - 1.0
    above = 1.0 - 2.0 * y / float(view.height)
    return wp.normalize(view.forward + across * view.right + above * view.up)


@wp.func
def shadow_at(shadow: wp.array2d(dtype=wp.float32), x: wp.float32, y: wp.float32):
    """The screen's shadow at a place of the picture, 0 to 1."""
    u = wp.clamp(x / float(SHADOW_CELL) - 0.5, 0.0, float(shadow.shape[1]) - 1.001)
    v = wp.clamp(y / float(SHADOW_CELL) - 0.5, 0.0, float(shadow.shape[0]) - 1.001)
    i, j = int(v), int(u)
    above = wp.lerp(shadow[i, j], shadow[i, j + 1], u - float(j))
    below = wp.lerp(shadow[i + 1, j], shadow[i + 1, j + 1], u - float(j))
    return wp.lerp(above, below, v - float(i))


@wp.func
def screen_color(view: View, shadow: wp.array2d(dtype=wp.float32), x: wp.float32, y: wp.float32):
    """The screen: lighter where the light comes from, darker toward the corners and in shadow."""
    u = x / float(view.width)
    v = y / float(view.height)
    color = wp.lerp(view.screen_top, view.screen_bottom, v)
    corner = 2.0 * ((u - 0.5) * (u - 0.5) + (v - 0.5) * (v - 0.5))
    return color * (1.0 - view.vignette * corner) * (1.0 - view.shade * shadow_at(shadow, x, y))


@wp.func
def surface_color(capsules: Capsules, view: View, hit: int, point: wp.vec3, ray: wp.vec3, light: wp.vec3):
    """What is seen of a point of a capsule along a ray, lit from one point of the light."""
    start = capsules.start[hit]
    axis = capsules.end[hit] - start
    along = wp.clamp(wp.dot(point - start, axis) / wp.max(wp.dot(axis, axis), 1.0e-12), 0.0, 1.0)
    normal = wp.normalize(point - start - along * axis)
    albedo = wp.lerp(capsules.color_start[hit], capsules.color_end[hit], along)
    facing = wp.dot(normal, view.light)
    color = view.fill * (0.65 + 0.35 * wp.dot(normal, view.sky)) * albedo
    if facing > 0.0 and not is_dark(capsules, point + _OUTWARD * normal, light):
        halfway = wp.normalize(view.light - ray)
        gloss = view.gloss * wp.pow(wp.max(wp.dot(normal, halfway), 0.0), 50.0)
        color += view.key * (facing * albedo + wp.vec3(gloss * facing))
    depth = wp.clamp((wp.dot(point - view.eye, view.forward) - view.near) / (view.screen - view.near), 0.0, 1.0)
    return wp.lerp(color, view.screen_bottom, view.haze * depth)


@wp.func
def encoded(linear: wp.float32):
    """sRGB byte of a linear intensity."""
    x = wp.clamp(linear, 0.0, 1.0)
    y = 12.92 * x
    if x > 0.0031308:
        y = 1.055 * wp.pow(x, 1.0 / 2.4) - 0.055
    return wp.uint8(255.0 * y + 0.5)


@wp.kernel(module=MODULE)
def _find(
    # Scene:
    capsules: Capsules,
    view: View,
    # Out:
    hit_out: wp.array(dtype=wp.int32),
):
    pixel = wp.tid()
    x = float(pixel % view.width) + 0.5
    y = float(pixel // view.width) + 0.5
    _distance, hit = nearest_hit(capsules, view.eye, ray_through(view, x, y))
    hit_out[pixel] = hit


@wp.kernel(module=MODULE)
def _cast_shadow(
    # Scene:
    capsules: Capsules,
    view: View,
    # Out:
    shadow_out: wp.array2d(dtype=wp.float32),
):
    i, j = wp.tid()
    ray = ray_through(view, (float(j) + 0.5) * float(SHADOW_CELL), (float(i) + 0.5) * float(SHADOW_CELL))
    point = view.eye + (view.screen / wp.dot(ray, view.forward)) * ray
    dark = float(0.0)
    for k in range(LIGHT_SAMPLES):
        if is_dark(capsules, point, view.lights[k]):
            dark += 1.0
    shadow_out[i, j] = dark / float(LIGHT_SAMPLES)


@wp.kernel(module=MODULE)
def _smooth(
    # Scene:
    shadow: wp.array2d(dtype=wp.float32),
    # Out:
    shadow_out: wp.array2d(dtype=wp.float32),
):
    i, j = wp.tid()
    total = float(0.0)
    for di in range(-2, 3):
        for dj in range(-2, 3):
            weight = (3.0 - wp.abs(float(di))) * (3.0 - wp.abs(float(dj)))
            total += weight * shadow[wp.clamp(i + di, 0, shadow.shape[0] - 1), wp.clamp(j + dj, 0, shadow.shape[1] - 1)]
    shadow_out[i, j] = total / 81.0


@wp.kernel(module=MODULE)
def _paint(
    # Scene:
    capsules: Capsules,
    view: View,
    hit: wp.array(dtype=wp.int32),
    shadow: wp.array2d(dtype=wp.float32),
    # Out:
    picture_out: wp.array(dtype=wp.uint8),
):
    pixel = wp.tid()
    column = pixel % view.width
    row = pixel // view.width
    own = hit[pixel]
    empty = bool(True)
    inside = bool(True)
    for dy in range(-1, 2):
        for dx in range(-1, 2):
            beside = wp.clamp(column + dx, 0, view.width - 1)
            beyond = wp.clamp(row + dy, 0, view.height - 1)
            other = hit[beyond * view.width + beside]
            if other >= 0:
                empty = False
            if other < 0 or wp.abs(other - own) > 1:
                inside = False
    screen = screen_color(view, shadow, float(column) + 0.5, float(row) + 0.5)
    side = SAMPLES
    if inside:
        side = SAMPLES_INSIDE
    if empty:
        side = 0
    rays = _SampleRays()
    nearest = _SampleDistances(NO_HIT)
    hits = _SampleHits(-1)
    count = side * side
    for k in range(count):
        x = float(column) + (float(k % side) + 0.5) / float(side)
        y = float(row) + (float(k // side) + 0.5) / float(side)
        rays[k] = ray_through(view, x, y)
    # One walk through the tree for all of them: its boxes are wider by a pixel.
    if not empty:
        index = int(0)
        farthest = float(NO_HIT)
        query = wp.bvh_query_ray(capsules.bvh, view.eye, ray_through(view, float(column) + 0.5, float(row) + 0.5))
        while wp.bvh_query_next(query, index, farthest):
            start, end, radius = capsules.start[index], capsules.end[index], capsules.radius[index]
            farthest = float(0.0)
            for k in range(count):
                t = capsule_hit(view.eye, rays[k], start, end, radius)
                if t > 0.0 and t < nearest[k]:
                    nearest[k] = t
                    hits[k] = index
                farthest = wp.max(farthest, nearest[k])
    color = wp.vec3(0.0)
    for k in range(count):
        if hits[k] < 0:
            color += screen
        else:
            light = view.lights[k * LIGHT_SAMPLES // count]
            color += surface_color(capsules, view, hits[k], view.eye + nearest[k] * rays[k], rays[k], light)
    if empty:
        color = screen
    else:
        color /= float(count)
    for channel in range(3):
        picture_out[3 * pixel + channel] = encoded(color[channel])


def cast(capsules: Any, view: Any, picture_out: wp.array) -> None:
    """Draws capsules.

    capsules, view: the structs. picture_out: sRGB, row by row from the upper left corner, shape [3 width height]; its
    device is the one that draws.
    """
    device = picture_out.device
    pixels = view.width * view.height
    hit = wp.empty(pixels, dtype=wp.int32, device=device)
    grid = (-(-view.height // SHADOW_CELL), -(-view.width // SHADOW_CELL))
    shadow, smoothed = (wp.empty(grid, dtype=wp.float32, device=device) for _ in range(2))
    wp.launch(_find, pixels, inputs=[capsules, view], outputs=[hit], device=device)
    wp.launch(_cast_shadow, grid, inputs=[capsules, view], outputs=[shadow], device=device)
    for before, after in ((shadow, smoothed), (smoothed, shadow)):
        wp.launch(_smooth, grid, inputs=[before], outputs=[after], device=device)
    wp.launch(_paint, pixels, inputs=[capsules, view, hit, shadow], outputs=[picture_out], device=device)
