"""Rays against capsules, the rods with round ends of which a picture is made.

Lengths in um, seen from a centre near the scene: single precision is enough.
"""

import warp as wp

NO_HIT = wp.constant(1.0e9)
"""The distance of a ray that hits nothing [um]."""

MODULE = wp.get_module("warpflag_kernels.raycast")
MODULE.options.update({"enable_backward": False, "cpu_compiler_flags": "-march=native", "fast_math": False})


@wp.struct
class Capsules:
    """Rods with round ends, [N] each; linear RGB at both ends."""

    bvh: wp.uint64  # over their bounds, each wider by a pixel of the picture
    start: wp.array(dtype=wp.vec3)  # [um]
    end: wp.array(dtype=wp.vec3)  # [um]
    radius: wp.array(dtype=wp.float32)  # [um]
    color_start: wp.array(dtype=wp.vec3)
    color_end: wp.array(dtype=wp.vec3)


@wp.func
def capsule_hit(origin: wp.vec3, direction: wp.vec3, start: wp.vec3, end: wp.vec3, radius: wp.float32):
    """Distance along a ray to where it enters a capsule; NO_HIT where it doesn't."""
    # Seen from the point of the ray beside the capsule: the squares below stay small.
    shift = wp.dot(0.5 * (start + end) - origin, direction)
    from_start = origin + shift * direction - start
    axis = end - start
    axis_axis = wp.dot(axis, axis)
    axis_ray = wp.dot(axis, direction)
    axis_from = wp.dot(axis, from_start)
    ray_from = wp.dot(direction, from_start)
    a = axis_axis - axis_ray * axis_ray
    b = axis_axis * ray_from - axis_from * axis_ray
    c = axis_axis * (wp.dot(from_start, from_start) - radius * radius) - axis_from * axis_from
    along = axis_from - ray_from * axis_ray  # where the ray passes, for a ray along the axis or a sphere
    if a > 1.0e-7 * axis_axis:
        root = b * b - a * c
        if root < 0.0:
            return NO_HIT
        t = (-b - wp.sqrt(root)) / a
        along = axis_from + t * axis_ray
        if along > 0.0 and along < axis_axis:
            return shift + t
    elif axis_ray < 0.0:
        along = axis_axis
    from_cap = from_start
    if along >= axis_axis:
        from_cap = from_start - axis
    b = wp.dot(direction, from_cap)
    root = b * b - wp.dot(from_cap, from_cap) + radius * radius
    if root < 0.0:
        return NO_HIT
    return shift - b - wp.sqrt(root)


@wp.func
def nearest_hit(capsules: Capsules, origin: wp.vec3, direction: wp.vec3):
    """Distance to the first capsule on a ray and its index, or NO_HIT and -1."""
    nearest = NO_HIT
    hit = int(-1)
    index = int(0)
    query = wp.bvh_query_ray(capsules.bvh, origin, direction)
    while wp.bvh_query_next(query, index, nearest):
        t = capsule_hit(origin, direction, capsules.start[index], capsules.end[index], capsules.radius[index])
        if t > 0.0 and t < nearest:
            nearest = t
            hit = index
    return nearest, hit


@wp.func
def is_dark(capsules: Capsules, origin: wp.vec3, direction: wp.vec3):
    """Whether anything stands between a point and the light."""
    index = int(0)
    query = wp.bvh_query_ray(capsules.bvh, origin, direction)
    while wp.bvh_query_next(query, index):
        t = capsule_hit(origin, direction, capsules.start[index], capsules.end[index], capsules.radius[index])
        if t > 0.0 and t < NO_HIT:
            return True
    return False
