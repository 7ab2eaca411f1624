"""Placing: the state at the increments of a chart, body first, then anchors, nodes, and the frames between them."""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.types import DeviceModel, DeviceState, Precision, structs
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.rod import rotations


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions that place one body, the root of one flagellum, one node, and one frame."""
    real, vec3 = p.real, p.vec3
    Model, State, Chart = structs(p).Model, structs(p).State, chart_stage.struct(p)
    f, fd = rotations.functions(p), rotations.functions(Precision("float64", p.strict))
    transport, turn, perpendicular_unit = f.transport, f.turn, f.perpendicular_unit
    rotation_vector_quat, rotation_vector_quatd = f.rotation_vector_quat, fd.rotation_vector_quat
    module = p.module("placing_functions")

    @wp.func(module=module)
    def place_body(model: Model, chart: Chart, state: State, c: wp.int32):
        b = chart.body_increment[c]
        turned = rotation_vector_quatd(wp.vec3d(b[3], b[4], b[5])) * chart.base_body_orientation[c]
        orientation = wp.normalize(turned)
        state.body_position[c] = chart.base_body_position[c] + wp.vec3d(b[0], b[1], b[2])
        state.body_orientation[c] = orientation
        state.body_axis[c] = vec3(wp.quat_rotate(orientation, wp.vec3d(0.0, 0.0, 1.0)))

    @wp.func(module=module)
    def place_root(model: Model, chart: Chart, state: State, k: wp.int32, c: wp.int32):
        """Anchor and motor axis of flagellum k, and the rotation of its chart."""
        first = model.first_node[k]
        orientation = state.body_orientation[c]
        state.position[first] = vec3(wp.quat_rotate(orientation, wp.vec3d(model.anchor[k])))
        state.tangent[first] = vec3(wp.quat_rotate(orientation, wp.vec3d(model.motor_axis[k])))
        turned = rotation_vector_quat(real(chart.elapsed[c]) * chart.flagellum_spin[k])
        chart.flagellum_turn[k] = wp.quat_to_matrix(turned)

    @wp.func(module=module)
    def place_node(model: Model, chart: Chart, state: State, e: wp.int32, k: wp.int32):
        first = model.first_node[k]
        if e == first:
            return
        x = chart.increment[e]
        offset = chart.base_position[e] - chart.base_position[first] + vec3(x[0], x[1], x[2])
        state.position[e] = state.position[first] + chart.flagellum_turn[k] * offset

    @wp.func(module=module)
    def place_frame(model: Model, chart: Chart, state: State, e: wp.int32, k: wp.int32):
        """Segment and director at node e, from the placed nodes."""
        base_tangent = chart.base_tangent[e]
        base_director = chart.base_director[e]
        tangent = state.tangent[e]
        if e > model.first_node[k]:
            segment = state.position[e] - state.position[e - 1]
            length = wp.length(segment)
            tangent = segment / length
            state.length[e] = length
            state.tangent[e] = tangent
            base_tangent = chart.flagellum_turn[k] * base_tangent
            base_director = chart.flagellum_turn[k] * base_director
        director = turn(transport(base_director, base_tangent, tangent), tangent, chart.increment[e][3])
        director = perpendicular_unit(director, tangent)
        state.director[e] = director

    return SimpleNamespace(place_body=place_body, place_root=place_root, place_node=place_node, place_frame=place_frame)


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    Model, State, Chart = structs(p).Model, structs(p).State, chart_stage.struct(p)
    f = functions(p)
    place_body, place_root, place_node, place_frame = f.place_body, f.place_root, f.place_node, f.place_frame
    module = p.module("placing")

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
            place_body(model, chart, state, c)

    @wp.kernel(module=module)
    def roots(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        # Out:
        state: State,
    ):
        k = wp.tid()
        c = model.cell_of[model.first_node[k]]
        if state.active[c] != 0:
            place_root(model, chart, state, k, c)

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
            place_node(model, chart, state, e, model.flagellum_of[e])

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
            place_frame(model, chart, state, e, model.flagellum_of[e])

    @wp.kernel(module=module)
    def cells(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        # Out:
        state: State,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        place_body(model, chart, state, c)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            place_root(model, chart, state, k, c)
            e = model.first_node[k]
            while e < model.first_node[k + 1]:
                place_node(model, chart, state, e, k)
                place_frame(model, chart, state, e, k)
                e += 1
            k += 1

    return SimpleNamespace(bodies=bodies, roots=roots, nodes=nodes, frames_between=frames_between, cells=cells)


def place(model: DeviceModel, state: DeviceState, chart: Any) -> None:
    """State from the chart's increments."""
    inputs = [model.data, chart, state.data]
    kernels = _kernels(model.precision)
    if model.one_thread_per_cell:
        wp.launch(kernels.cells, model.cell_count, inputs=inputs, device=model.device)
        return
    wp.launch(kernels.bodies, model.cell_count, inputs=inputs, device=model.device)
    wp.launch(kernels.roots, model.flagellum_count, inputs=inputs, device=model.device)
    wp.launch(kernels.nodes, model.element_count, inputs=inputs, device=model.device)
    wp.launch(kernels.frames_between, model.element_count, inputs=inputs, device=model.device)
