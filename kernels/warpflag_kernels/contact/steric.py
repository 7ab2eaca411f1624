"""The steric law and where two segments, or a node and the body, are closest.

The paper's truncated Lennard-Jones force, F(r) = F_0 [2 (sigma/r)^13 - (sigma/r)^7] below 2^(1/6) sigma, r the
minimal distance of the two centre lines (for the body: of the node from the surface). Below 0.7 sigma it continues
along its tangent there, so that a deep overlap still pushes back with a finite force.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.native import native
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import structs
from warpflag_kernels.contact.constants import CUTOFF, LINEAR_BELOW, PARALLEL

# Centre lines closer than this have no direction of their own [steric diameters]: the difference of two float32
# positions of a few um is known to some 1e-6 um, a fortieth of this (4e-5 um).
COINCIDENT = 1.0e-3
_SLOPE_THERE = 26.0 * LINEAR_BELOW**-14 - 7.0 * LINEAR_BELOW**-8  # -dF/dr at LINEAR_BELOW in units of F_0/sigma


def law_code(p: Precision) -> str:
    """C++ that defines law(r, strength, diameter, force, stiffness): the one place of the steric force."""
    return native(__file__, "steric_law", p, LINEAR=LINEAR_BELOW, CUTOFF=CUTOFF, SLOPE=_SLOPE_THERE)


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of contact: the force law, the closest points of two segments, a node beside the body."""
    real, vec3 = p.real, p.vec3
    Model, Pose = structs(p).Model, structs(p).Pose
    parallel, touching = wp.constant(real(PARALLEL)), wp.constant(real(COINCIDENT))
    module = p.module("steric_functions")
    vec2 = wp.types.vector(2, real)

    @wp.func_native(f"{law_code(p)} {p.c_name} f, k; law(r, strength, diameter, f, k); return {{f, k}};")
    def steric_law(r: real, strength: real, diameter: real) -> vec2:
        """Repulsion F [pN] and stiffness -dF/dr [pN/um] at distance r; r may be negative (a node below the surface)."""
        ...

    @wp.func_native(f"{law_code(p)} {p.c_name} f, k; law(r, strength, diameter, f, k); return f;")
    def steric_force(r: real, strength: real, diameter: real) -> real:
        """Repulsion at distance r [pN]."""
        ...

    @wp.func(module=module)
    def closest_parameters(p1: vec3, d1: vec3, p2: vec3, d2: vec3):
        """Parameters in [0, 1] of the closest points of segments p1 + s d1 and p2 + t d2."""
        zero, one = real(0.0), real(1.0)
        r = p1 - p2
        a = wp.dot(d1, d1)
        e = wp.dot(d2, d2)
        f = wp.dot(d2, r)
        c = wp.dot(d1, r)
        b = wp.dot(d1, d2)
        # Through the cross product: a e - b^2 would lose the digits of nearly parallel segments.
        n = wp.cross(d1, d2)
        nn = wp.dot(n, n)
        s = real(0.5)  # parallel: any point will do, the middle loads both ends alike
        if nn > parallel * a * e:
            s = wp.clamp(wp.dot(wp.cross(d2, r), n) / nn, zero, one)
        t = (b * s + f) / e
        if t < zero:
            t = zero
            s = wp.clamp(-c / a, zero, one)
        elif t > one:
            t = one
            s = wp.clamp((b - c) / a, zero, one)
        return vec2(s, t)

    @wp.func(module=module)
    def nearest(p1: vec3, q1: vec3, p2: vec3, q2: vec3):
        """Parameters of the closest points of segments p1 q1 and p2 q2, and the vector to the first from the second."""
        st = closest_parameters(p1, q1 - p1, p2, q2 - p2)
        gap = p1 + st[0] * (q1 - p1) - (p2 + st[1] * (q2 - p2))
        return st[0], st[1], gap

    @wp.func(module=module)
    def direction(gap: vec3, r: real, d1: vec3, d2: vec3, diameter: real):
        """Direction of the force on the first of two segments along d1 and d2; gap: vector of length r."""
        # Centre lines that touch exactly have no direction: they are pushed apart across both.
        normal = gap / r
        if r <= touching * diameter:
            normal = wp.normalize(wp.cross(d1, d2))  # changes sign with the side
        return normal

    @wp.func(module=module)
    def off_axis(model: Model, pose: Pose, e: wp.int32, c: wp.int32):
        """Vector from the nearest point of the body's axis to node e [um]."""
        axis, half = pose.body_axis[c], model.body.half_length[c]
        return pose.position[e] - wp.clamp(wp.dot(pose.position[e], axis), -half, half) * axis

    return SimpleNamespace(
        steric_force=steric_force,
        steric_law=steric_law,
        closest_parameters=closest_parameters,
        nearest=nearest,
        direction=direction,
        off_axis=off_axis,
        vec2=vec2,
    )
