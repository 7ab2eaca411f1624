"""Reconstruction of the pose from a chart's increments: bodies, anchors, nodes, tangents and directors."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.rod import free_end, rotations
from warpflag_kernels.rod.comoving_chart import vec6d


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of one body, the anchor of one flagellum, one node, one segment."""
    real, vec3 = p.real, p.vec3
    Model, State, Chart = structs(p).Model, structs(p).State, chart_stage.struct(p)
    f, fd = rotations.functions(p), rotations.functions(p.double)
    transport, turn, perpendicular_unit = f.transport, f.turn, f.perpendicular_unit
    attached, body_axis = f.attached, f.body_axis
    rotation_vector_quat, rotation_vector_quatd = f.rotation_vector_quat, fd.rotation_vector_quat
    module = p.module("reconstruction_functions")

    @wp.func(module=module)
    def reconstruct_body(model: Model, chart: Chart, state: State, c: wp.int32):
        b = chart.body_increment[c]
        turned = rotation_vector_quatd(wp.vec3d(b[3], b[4], b[5])) * chart.base.body_orientation[c]
        orientation = wp.normalize(turned)
        state.pose.body_position[c] = chart.base.body_position[c] + wp.vec3d(b[0], b[1], b[2])
        state.pose.body_orientation[c] = orientation
        state.pose.body_axis[c] = body_axis(orientation)

    @wp.func(module=module)
    def reconstruct_anchor(model: Model, chart: Chart, state: State, k: wp.int32, c: wp.int32):
        """Anchor and motor axis of flagellum k, and the rotation of its chart."""
        first = model.first_node[k]
        orientation = state.pose.body_orientation[c]
        state.pose.position[first] = attached(orientation, model.motor.anchor[k])
        state.pose.tangent[first] = attached(orientation, model.motor.axis[k])
        turned = rotation_vector_quat(real(chart.elapsed[c]) * chart.flagellum_spin[k])
        chart.flagellum_turn[k] = wp.quat_to_matrix(turned)

    @wp.func(module=module)
    def reconstruct_node(model: Model, chart: Chart, state: State, e: wp.int32, k: wp.int32):
        first = model.first_node[k]
        if e == first:
            return
        x = chart.increment[e]
        offset = chart.base.position[e] - chart.base.position[first] + vec3(x[0], x[1], x[2])
        state.pose.position[e] = state.pose.position[first] + chart.flagellum_turn[k] * offset

    @wp.func(module=module)
    def reconstruct_frame(model: Model, chart: Chart, state: State, e: wp.int32, k: wp.int32):
        """Segment and director at node e, from its nodes."""
        base_tangent = chart.base.tangent[e]
        base_director = chart.base.director[e]
        tangent = state.pose.tangent[e]
        if e > model.first_node[k]:
            segment = state.pose.position[e] - state.pose.position[e - 1]
            length = wp.length(segment)
            tangent = segment / length
            state.pose.length[e] = length
            state.pose.tangent[e] = tangent
            base_tangent = chart.flagellum_turn[k] * base_tangent
            base_director = chart.flagellum_turn[k] * base_director
        director = turn(transport(base_director, base_tangent, tangent), tangent, chart.increment[e][3])
        director = perpendicular_unit(director, tangent)
        state.pose.director[e] = director

    return SimpleNamespace(
        reconstruct_body=reconstruct_body,
        reconstruct_anchor=reconstruct_anchor,
        reconstruct_node=reconstruct_node,
        reconstruct_frame=reconstruct_frame,
    )


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    Model, State, Chart = structs(p).Model, structs(p).State, chart_stage.struct(p)
    f = functions(p)
    reconstruct_body, reconstruct_anchor = f.reconstruct_body, f.reconstruct_anchor
    reconstruct_node, reconstruct_frame = f.reconstruct_node, f.reconstruct_frame
    module = p.module("reconstruction")

    @wp.kernel(module=module)
    def bodies(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        # Out:
        state: State,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            reconstruct_body(model, chart, state, c)

    @wp.kernel(module=module)
    def roots(
        # Model:
        model: Model,
        # Out:
        chart: Chart,
        state: State,
    ):
        k = wp.tid()
        c = model.cell_of[model.first_node[k]]
        if state.active[c] != 0:
            reconstruct_anchor(model, chart, state, k, c)

    @wp.kernel(module=module)
    def nodes(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        # Out:
        state: State,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] != 0:
            reconstruct_node(model, chart, state, e, model.flagellum_of[e])

    @wp.kernel(module=module)
    def frames_between(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        # Out:
        state: State,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] != 0:
            reconstruct_frame(model, chart, state, e, model.flagellum_of[e])

    @wp.kernel(module=module)
    def cells(
        # Model:
        model: Model,
        # Out:
        chart: Chart,
        state: State,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        reconstruct_body(model, chart, state, c)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            reconstruct_anchor(model, chart, state, k, c)
            e = model.first_node[k]
            while e < model.first_node[k + 1]:
                reconstruct_node(model, chart, state, e, k)
                reconstruct_frame(model, chart, state, e, k)
                e += 1
            k += 1

    @wp.kernel(module=p.module("rewind"))
    def rewind(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        chart: Chart,
    ):
        """Increments of the chart vanish."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        chart.increment[e] = p.vec4(p.real(0.0))
        if e == model.first_node[model.first_flagellum[c]]:
            chart.body_increment[c] = vec6d(wp.float64(0.0))

    return SimpleNamespace(
        bodies=bodies, roots=roots, nodes=nodes, frames_between=frames_between, cells=cells, rewind=rewind
    )


def reconstruct(model: DeviceModel, state: DeviceState, chart: Any) -> None:
    """The pose of `state` from the increments of the chart, struct `Chart`; also the rotations of its flagella."""
    inputs = [model.data, chart, state.data]
    kernels = _kernels(model.precision)
    if model.plan.by_cells:
        wp.launch(kernels.cells, model.cell_count, inputs=inputs, device=model.device)
        return
    wp.launch(kernels.bodies, model.cell_count, inputs=inputs, device=model.device)
    wp.launch(kernels.roots, model.flagellum_count, inputs=inputs, device=model.device)
    wp.launch(kernels.nodes, model.element_count, inputs=inputs, device=model.device)
    wp.launch(kernels.frames_between, model.element_count, inputs=inputs, device=model.device)


def go_back(model: DeviceModel, state: DeviceState, chart: Any) -> None:
    """The pose of the start of the step, into the pose of `state`; the increments of the chart vanish."""
    kernel = _kernels(model.precision).rewind
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data, chart], device=model.device)
    reconstruct(model, state, chart)
    if model.switches.has("free end"):
        free_end.align_axes(model, state)
