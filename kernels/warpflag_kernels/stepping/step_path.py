"""The path of a step for dense output, of any stepper, and poses on it.

It leads through the pose before the step, its start and its end: the rotation vectors of all triads and of the body,
the lengths of the segments and the body's place are quadratic in the share xi of the step,

    x(xi) = xi q_1 + xi^2 q_2,    q_2 = w/(1 + w) (x_end + w x_before),    q_1 = x_end - q_2,

w the step over the one before it, x counted from the start. So it is exact at both ends, and of second order as the
steps themselves.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import structs
from warpflag_kernels.rod import comoving_chart, rotations
from warpflag_kernels.rod.comoving_chart import vec6d
from warpflag_kernels.stepping import frame_slots


@functools.cache
def kernels(p: Precision) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State, Pose = structs(p).Model, structs(p).State, structs(p).Pose
    Chart, Dense = comoving_chart.struct(p), frame_slots.struct(p)
    f, fd = rotations.functions(p), rotations.functions(p.double)
    attached, body_axis, perpendicular_unit = f.attached, f.body_axis, f.perpendicular_unit
    rotation_vector_quat, rotation_vector_quatd = f.rotation_vector_quat, fd.rotation_vector_quat
    triad_rotation, quat_rotation_vector = f.triad_rotation, fd.quat_rotation_vector
    module = p.module("dense_output")

    @wp.func(module=module)
    def change(start: Pose, end: Pose, first: wp.int32, e: wp.int32):
        """Rotation vector of triad e between two poses [rad], and the change of its segment's length [um]."""
        w = triad_rotation(start.tangent[e], start.director[e], end.tangent[e], end.director[e])
        length = real(0.0)
        if e > first:
            length = wp.length(end.position[e] - end.position[e - 1])
            length -= wp.length(start.position[e] - start.position[e - 1])
        return vec4(w[0], w[1], w[2], length)

    @wp.func(module=module)
    def body_change(start: Pose, end: Pose, c: wp.int32):
        u = end.body_position[c] - start.body_position[c]
        w = quat_rotation_vector(end.body_orientation[c] * wp.quat_inverse(start.body_orientation[c]))
        return vec6d(u[0], u[1], u[2], w[0], w[1], w[2])

    @wp.kernel(module=module)
    def keep_path(
        # Model:
        model: Model,
        # State:
        state: State,
        chart: Chart,
        # Out:
        dense: Dense,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if dense.due[c] == 0:
            return
        k = model.flagellum_of[e]
        first = model.first_node[k]
        w = wp.float64(0.0)
        if dense.step_before[c] > wp.float64(0.0):
            w = (dense.end[c] - dense.begin[c]) / dense.step_before[c]
        mu = w / (wp.float64(1.0) + w)
        whole = change(chart.base, state.pose, first, e)
        bent = real(mu) * (whole + real(w) * change(chart.base, dense.before, first, e))
        dense.square[e] = bent
        dense.linear[e] = whole - bent
        dense.start.tangent[e] = chart.base.tangent[e]
        dense.start.director[e] = chart.base.director[e]
        if e > first:
            dense.start.length[e] = wp.length(chart.base.position[e] - chart.base.position[e - 1])
            return
        dense.start_motor_angle[k] = chart.motor_angle[k]
        if k == model.first_flagellum[c]:
            body_whole = body_change(chart.base, state.pose, c)
            body_bent = mu * (body_whole + w * body_change(chart.base, dense.before, c))
            dense.body_square[c] = body_bent
            dense.body_linear[c] = body_whole - body_bent
            dense.start_body_angle[c] = chart.body_angle[c]
            dense.start.body_position[c] = chart.base.body_position[c]
            dense.start.body_orientation[c] = chart.base.body_orientation[c]

    @wp.kernel(module=module)
    def remember(
        # Model:
        model: Model,
        # State:
        state: State,
        chart: Chart,
        # Out:
        dense: Dense,
    ):
        """The start of the step just accepted is the pose before the next one."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0 or chart.commit[c] == 0:
            return
        dense.before.position[e] = chart.base.position[e]
        dense.before.tangent[e] = chart.base.tangent[e]
        dense.before.director[e] = chart.base.director[e]
        if e == model.first_node[model.first_flagellum[c]]:
            dense.step_before[c] = dense.end[c] - dense.begin[c]
            dense.before.body_position[c] = chart.base.body_position[c]
            dense.before.body_orientation[c] = chart.base.body_orientation[c]

    @wp.func(module=module)
    def share_of(dense: Dense, c: wp.int32):
        """Share of the step at which the next frame is, 0 to 1."""
        t = dense.time[c * dense.slots + dense.taken[c]]
        share = (t - dense.begin[c]) / (dense.end[c] - dense.begin[c])
        return wp.clamp(share, wp.float64(0.0), wp.float64(1.0))

    @wp.kernel(module=module)
    def place_bodies(
        # Out:
        dense: Dense,
        pose: Pose,
    ):
        c = wp.tid()
        if dense.due[c] == 0:
            return
        share = share_of(dense, c)
        x = share * (dense.body_linear[c] + share * dense.body_square[c])
        turned = rotation_vector_quatd(wp.vec3d(x[3], x[4], x[5])) * dense.start.body_orientation[c]
        dense.body[c] = x
        pose.body_position[c] = dense.start.body_position[c] + wp.vec3d(x[0], x[1], x[2])
        pose.body_orientation[c] = wp.normalize(turned)
        pose.body_axis[c] = body_axis(pose.body_orientation[c])

    @wp.kernel(module=module)
    def place_flagella(
        # Model:
        model: Model,
        # State:
        dense: Dense,
        # Out:
        pose: Pose,
    ):
        k = wp.tid()
        e = model.first_node[k]
        c = model.cell_of[e]
        if dense.due[c] == 0:
            return
        share = real(share_of(dense, c))
        y = attached(pose.body_orientation[c], model.motor.anchor[k])
        t = attached(pose.body_orientation[c], model.motor.axis[k])
        length = real(0.0)
        while e < model.first_node[k + 1]:
            x = share * (dense.linear[e] + share * dense.square[e])
            rotation = rotation_vector_quat(vec3(x[0], x[1], x[2]))
            if e > model.first_node[k]:
                t = wp.normalize(wp.quat_rotate(rotation, dense.start.tangent[e]))
                length = dense.start.length[e] + x[3]
                pose.length[e] = length
            y += length * t
            pose.position[e] = y
            pose.tangent[e] = t
            pose.director[e] = perpendicular_unit(wp.quat_rotate(rotation, dense.start.director[e]), t)
            e += 1

    return SimpleNamespace(
        keep_path=keep_path, remember=remember, place_bodies=place_bodies, place_flagella=place_flagella
    )
