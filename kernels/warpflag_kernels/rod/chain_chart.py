"""Chain chart of implicit stepping: increments applied as a rotation and a stretch of every segment in turn.

An increment x of the nodes and phi of the spins turns segment i by Om = (t x dx)/l + phi t and stretches it by
t.dx/l, dx the difference of its nodes' increments; the segments are chained again from the anchor. So a node that
turns by an angle about its neighbour gets no spurious strain of half the angle squared, which with plain displacements
would load the stiff stretch. Vector transport takes other increments along into the tangent space of the new pose.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import simd
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.rod import chain_chart_simd, rotations


@functools.cache
def types(p: Precision) -> SimpleNamespace:
    """The struct `Increment`, a tangent vector at a pose, and the type of its body part."""
    vec4, vec6 = p.vec4, wp.types.vector(6, p.real)

    @wp.struct
    class Increment:
        node: wp.array(dtype=vec4)  # [E], displacement in the lab [um] and spin [rad]
        body: wp.array(dtype=vec6)  # [C], translation [um] and rotation vector [rad]

    return SimpleNamespace(Increment=Increment, vec6=vec6)


@functools.cache
def displacement(p: Precision) -> Any:
    """Device function: the displacement of node e of flagellum k under an increment [um].

    Its argument `position` holds the nodes relative to the body's centre [um], shape [E]; r_0 moves with the body.
    """
    vec3, Model, Increment = p.vec3, structs(p).Model, types(p).Increment

    @wp.func(module=p.module("displacement"))
    def of_node(model: Model, position: wp.array(dtype=vec3), x: Increment, e: wp.int32, k: wp.int32):
        if e == model.first_node[k]:
            b = x.body[model.cell_of[e]]
            return vec3(b[0], b[1], b[2]) + wp.cross(vec3(b[3], b[4], b[5]), position[e])
        n = x.node[e]
        return vec3(n[0], n[1], n[2])

    return of_node


def allocate(model: DeviceModel) -> Any:
    """An increment of zero, struct `Increment`."""
    t = types(model.precision)
    x = t.Increment()
    x.node = wp.zeros(model.element_count, dtype=model.precision.vec4, device=model.device)
    x.body = wp.zeros(model.cell_count, dtype=t.vec6, device=model.device)
    return x


@functools.cache
def _kernels(p: Precision, transporting: bool) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Increment, vec6 = types(p).Increment, types(p).vec6
    Model, State, Pose = structs(p).Model, structs(p).State, structs(p).Pose
    f, fd = rotations.functions(p), rotations.functions(p.double)
    transport, turn, perpendicular_unit = f.transport, f.turn, f.perpendicular_unit
    rotation_vector_quat, rotation_vector_quatd = f.rotation_vector_quat, fd.rotation_vector_quat
    attached, body_axis = f.attached, f.body_axis
    Groups, chain_rows = simd.struct(), chain_chart_simd.rows(p, transporting, Increment)
    module = p.module("chain", "transporting" if transporting else "")

    @wp.func(module=module)
    def node_part(x: vec4):
        return vec3(x[0], x[1], x[2])

    @wp.func(module=module)
    def anchor_part(b: vec6, y: vec3):
        """Increment of a point y of the body."""
        return vec3(b[0], b[1], b[2]) + wp.cross(vec3(b[3], b[4], b[5]), y)

    @wp.func(module=module)
    def retract_body(start: Pose, s: wp.float64, x: Increment, c: wp.int32, end: Pose):
        b = x.body[c]
        u = s * wp.vec3d(wp.float64(b[0]), wp.float64(b[1]), wp.float64(b[2]))
        w = s * wp.vec3d(wp.float64(b[3]), wp.float64(b[4]), wp.float64(b[5]))
        orientation = wp.normalize(rotation_vector_quatd(w) * start.body_orientation[c])
        end.body_position[c] = start.body_position[c] + u
        end.body_orientation[c] = orientation
        end.body_axis[c] = body_axis(orientation)

    @wp.kernel(module=module)
    def retract_bodies(
        # State:
        state: State,
        start: Pose,
        scale: wp.array(dtype=wp.float64),
        x: Increment,
        # Out:
        end: Pose,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            retract_body(start, scale[c], x, c, end)

    @wp.func(module=module)
    def retract_tripod(model: Model, start: Pose, s: real, x: Increment, k: wp.int32, c: wp.int32, end: Pose):
        """The first element of flagellum k; returns where its anchor is."""
        first = model.first_node[k]
        orientation = end.body_orientation[c]
        y = attached(orientation, model.motor.anchor[k])
        m = attached(orientation, model.motor.axis[k])
        director = turn(transport(start.director[first], start.tangent[first], m), m, s * x.node[first][3])
        end.position[first] = y
        end.tangent[first] = m
        end.director[first] = perpendicular_unit(director, m)
        end.length[first] = real(1.0)
        return y

    @wp.kernel(module=module)
    def retract_flagella(
        # Model:
        model: Model,
        # State:
        state: State,
        start: Pose,
        scale: wp.array(dtype=wp.float64),
        x: Increment,
        a: Increment,
        b: Increment,
        # Out:
        end: Pose,
        a_out: Increment,
        b_out: Increment,
    ):
        k = wp.tid()
        first = model.first_node[k]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        s = real(scale[c])
        y_old = start.position[first]
        y = retract_tripod(model, start, s, x, k, c, end)
        x_before = s * anchor_part(x.body[c], y_old)
        a_before = vec3(real(0.0))
        b_before = vec3(real(0.0))
        a_new = vec3(real(0.0))
        b_new = vec3(real(0.0))
        if wp.static(transporting):
            a_before = anchor_part(a.body[c], y_old)
            b_before = anchor_part(b.body[c], y_old)
            a_new = anchor_part(a.body[c], y)
            b_new = anchor_part(b.body[c], y)
            a_out.node[first] = a.node[first]
            b_out.node[first] = b.node[first]
        e = first + 1
        while e < model.first_node[k + 1]:
            segment = start.position[e] - y_old
            y_old = start.position[e]
            length = wp.length(segment)
            t = segment / length
            xe = s * x.node[e]
            x_here = node_part(xe)
            d = (x_here - x_before) / length
            x_before = x_here
            rotation = wp.quat_to_matrix(rotation_vector_quat(wp.cross(t, d) + xe[3] * t))
            stretch = real(1.0) + wp.dot(t, d)
            t_new = wp.normalize(rotation * t)
            y += (stretch * length) * t_new
            end.position[e] = y
            end.tangent[e] = t_new
            end.length[e] = wp.abs(stretch * length)
            end.director[e] = perpendicular_unit(rotation * start.director[e], t_new)
            if wp.static(transporting):
                a_here = a.node[e]
                b_here = b.node[e]
                a_new += rotation * (node_part(a_here) - a_before)
                b_new += rotation * (node_part(b_here) - b_before)
                a_before = node_part(a_here)
                b_before = node_part(b_here)
                a_out.node[e] = vec4(a_new[0], a_new[1], a_new[2], a_here[3])
                b_out.node[e] = vec4(b_new[0], b_new[1], b_new[2], b_here[3])
            e += 1
        if wp.static(transporting) and k == model.first_flagellum[c]:
            a_out.body[c] = a.body[c]
            b_out.body[c] = b.body[c]

    @wp.func(module=module)
    def retract_group(
        groups: Groups, g: wp.int32, model: Model, start: Pose, s: real, x: Increment, a: Increment, b: Increment,
        c: wp.int32, end: Pose, a_out: Increment, b_out: Increment,
    ):  # fmt: skip
        """Group g of cell c: flagella in the lanes of a vector register."""
        chain_rows(groups, g, model.first_node, c, model, start, s, x, a, b, end, a_out, b_out)
        k = groups.first[g]
        k_end = k + groups.count[g]
        while k < k_end:
            retract_tripod(model, start, s, x, k, c, end)
            if wp.static(transporting):
                first = model.first_node[k]
                a_out.node[first] = a.node[first]
                b_out.node[first] = b.node[first]
            k += 1

    @wp.kernel(module=module)
    def retract_cells(
        # Model:
        groups: Groups,
        model: Model,
        # State:
        state: State,
        start: Pose,
        scale: wp.array(dtype=wp.float64),
        x: Increment,
        a: Increment,
        b: Increment,
        # Out:
        end: Pose,
        a_out: Increment,
        b_out: Increment,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        retract_body(start, scale[c], x, c, end)
        g = groups.first_group[c]
        while g < groups.first_group[c + 1]:
            retract_group(groups, g, model, start, real(scale[c]), x, a, b, c, end, a_out, b_out)
            g += 1
        if wp.static(transporting):
            a_out.body[c] = a.body[c]
            b_out.body[c] = b.body[c]

    return SimpleNamespace(
        retract_bodies=retract_bodies, retract_flagella=retract_flagella, retract_cells=retract_cells
    )


def retract(
    model: DeviceModel,
    state: DeviceState,
    start: Any,
    scale: wp.array,
    x: Any,
    end: Any,
    transported: tuple[Any, Any, Any, Any] | None = None,
) -> None:
    """The pose `end` reached from `start` by the increment scale * x, and two increments transported along.

    Args:
        model, state: of the batch; the state says which cells are active.
        start, end: struct `Pose`; may be one and the same.
        scale: shape [cell_count].
        x: struct `Increment`.
        transported: increments a, b at `start` and where they go: (a, b, a_out, b_out), all four different. None: just
            the pose.
    """
    kernels = _kernels(model.precision, transported is not None)
    a, b, a_out, b_out = transported or (x, x, x, x)
    inputs = [model.data, state.data, start, scale, x, a, b, end, a_out, b_out]
    if model.plan.chains == "simd":
        wp.launch(kernels.retract_cells, model.cell_count, inputs=[model.groups, *inputs], device=model.device)
        return
    bodies = [state.data, start, scale, x, end]
    wp.launch(kernels.retract_bodies, model.cell_count, inputs=bodies, device=model.device)
    wp.launch(kernels.retract_flagella, model.flagellum_count, inputs=inputs, device=model.device)
