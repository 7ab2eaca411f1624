"""Rotations, minimal rotations between tangents, and the strains of a joint: device functions shared by the stages."""

import functools
import math
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision

# atan x = x + x^3 P(x^2) for |x| < tan(pi/8): coefficients of the minimax polynomial P, relative error 4e-17.
_ARCTANGENT = (
    -0.3333333333333015, 0.19999999999088933, -0.14285714195260032, 0.11111106653551665, -0.09090782411894727,
    0.07690068294887187, -0.0664112115510828, 0.056925388380342015, -0.04359094867624417, 0.02125983999894584,
)  # fmt: skip


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of one precision."""
    real, vec3, quat = p.real, p.vec3, p.quat
    module = p.module("frames")
    sin3, sin5, sin7, sin9, sin11, sin13 = (
        wp.constant(real((-1) ** k / math.factorial(2 * k + 1))) for k in range(1, 7)
    )
    cos2, cos4, cos6, cos8, cos10, cos12, cos14 = (
        wp.constant(real((-1) ** k / math.factorial(2 * k))) for k in range(1, 8)
    )
    atan3, atan5, atan7, atan9, atan11, atan13, atan15, atan17, atan19, atan21 = (
        wp.constant(real(x)) for x in _ARCTANGENT
    )

    @wp.func(module=module)
    def transport(v: vec3, t: vec3, u: vec3):
        """v, perpendicular to the unit vector t, transported by the minimal rotation that takes t onto u."""
        return v - (wp.dot(v, u) / (real(1.0) + wp.dot(t, u))) * (t + u)

    @wp.func(module=module)
    def transport_spin(t: vec3, u: vec3, u_rate: vec3):
        """Rate at which a frame transported from the fixed t directly onto the moving u spins about u [rad/s]."""
        return -wp.dot(wp.cross(t, u), u_rate) / (real(1.0) + wp.dot(t, u))

    @wp.func(module=module)
    def sine_cosine(x: real):
        """(sin x, cos x); by series for the small angles of a step, several times cheaper and exact to round-off."""
        if wp.abs(x) > real(0.35):
            return wp.sin(x), wp.cos(x)
        y = x * x
        s = real(1.0) + y * (sin3 + y * (sin5 + y * (sin7 + y * (sin9 + y * (sin11 + y * sin13)))))
        c = real(1.0) + y * (cos2 + y * (cos4 + y * (cos6 + y * (cos8 + y * (cos10 + y * (cos12 + y * cos14))))))
        return x * s, c

    @wp.func(module=module)
    def angle(s: real, c: real):
        """atan2(s, c); below 45 degrees by half angles and a polynomial, several times cheaper, to round-off."""
        if wp.static(p.strict) or wp.abs(s) > c:
            return wp.atan2(s, c)
        x = s / (c + wp.sqrt(s * s + c * c))
        y = x * x
        high = atan11 + y * (atan13 + y * (atan15 + y * (atan17 + y * (atan19 + y * atan21))))
        series = atan3 + y * (atan5 + y * (atan7 + y * (atan9 + y * high)))
        return real(2.0) * (x + x * y * series)

    @wp.func(module=module)
    def turn(v: vec3, axis: vec3, angle: real):
        """v, perpendicular to the unit axis, turned about it."""
        s, c = sine_cosine(angle)
        return v * c + wp.cross(axis, v) * s

    @wp.func(module=module)
    def perpendicular_unit(v: vec3, t: vec3):
        """v made a unit vector perpendicular to t: removes the round-off that a long run gathers."""
        return wp.normalize(v - wp.dot(v, t) * t)

    @wp.func(module=module)
    def twist(t: vec3, u: vec3, a1: vec3, b1: vec3):
        """(sine, cosine) of the angle from a1, transported from t onto u, to b1."""
        pa = transport(a1, t, u)
        return wp.dot(wp.cross(pa, b1), u), wp.dot(pa, b1)

    @wp.func(module=module)
    def twist_angle(t: vec3, u: vec3, a1: vec3, b1: vec3):
        """Angle from a1, transported from t onto u, to b1 [rad]."""
        s, c = twist(t, u, a1, b1)
        return angle(s, c)

    @wp.func(module=module)
    def joint_strain(t: vec3, u: vec3, a1: vec3, b1: vec3):
        """Strain h Omega of the joint between segments with tangents t, u and directors e1 = a1, b1 [rad]."""
        kb = wp.cross(t, u) * (real(2.0) / (real(1.0) + wp.dot(t, u)))
        w1 = real(0.5) * wp.dot(kb, a1 + b1)
        w2 = real(0.5) * wp.dot(kb, wp.cross(t, a1) + wp.cross(u, b1))
        return vec3(w1, w2, twist_angle(t, u, a1, b1))

    @wp.func(module=module)
    def rotation_vector_quat(w: vec3):
        """Quaternion of the rotation by |w| about w."""
        angle = wp.length(w)
        s, c = sine_cosine(real(0.5) * angle)
        scale = real(0.5)
        if angle > real(1.0e-8):
            scale = s / angle
        return quat(w[0] * scale, w[1] * scale, w[2] * scale, c)

    @wp.func(module=module)
    def rotation_vector(sine: vec3, cosine: real):
        """Rotation vector, from its direction times the sine of its angle, and the cosine [rad]."""
        s = wp.length(sine)
        scale = real(1.0)
        if s > real(1.0e-8):
            scale = wp.atan2(s, cosine) / s
        return scale * sine

    @wp.func(module=module)
    def triad_rotation(t: vec3, a: vec3, u: vec3, b: vec3):
        """Rotation vector that takes the triad of tangent t and director a onto that of u and b, below pi [rad]."""
        ta = wp.cross(t, a)
        ub = wp.cross(u, b)
        sine = real(0.5) * (wp.cross(t, u) + wp.cross(a, b) + wp.cross(ta, ub))
        return rotation_vector(sine, real(0.5) * (wp.dot(t, u) + wp.dot(a, b) + wp.dot(ta, ub) - real(1.0)))

    @wp.func(module=module)
    def quat_rotation_vector(q: quat):
        """Rotation vector of a unit quaternion, below pi [rad]."""
        half = real(2.0) * q[3]
        return rotation_vector(half * vec3(q[0], q[1], q[2]), half * q[3] - real(1.0))

    @wp.func(module=module)
    def attached(orientation: wp.quatd, v: vec3):
        """A vector that stands still in body axes, in lab axes."""
        return vec3(wp.quat_rotate(orientation, wp.vec3d(v)))

    @wp.func(module=module)
    def body_axis(orientation: wp.quatd):
        """The body's axis e_b3 in the lab."""
        return vec3(wp.quat_rotate(orientation, wp.vec3d(0.0, 0.0, 1.0)))

    return SimpleNamespace(
        transport=transport,
        transport_spin=transport_spin,
        sine_cosine=sine_cosine,
        angle=angle,
        turn=turn,
        perpendicular_unit=perpendicular_unit,
        twist=twist,
        twist_angle=twist_angle,
        joint_strain=joint_strain,
        rotation_vector_quat=rotation_vector_quat,
        triad_rotation=triad_rotation,
        quat_rotation_vector=quat_rotation_vector,
        attached=attached,
        body_axis=body_axis,
    )
