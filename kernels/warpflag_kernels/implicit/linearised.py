"""The linearised equations of a step in full, with the pair sum that the matrix leaves out: D^-1 (1/dt + g M H) x.

What the matrix is to be judged by, see `stability`.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.types import DeviceModel, DeviceState, Precision, structs
from warpflag_kernels.fluid import body, rotne_prager
from warpflag_kernels.implicit import block_band
from warpflag_kernels.implicit import frozen_flow as flow_stage
from warpflag_kernels.rod import chain_chart, hessian


@functools.cache
def _kernels(p: Precision, bearing_torque: bool, pairs: str, form: str, lanes: int) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State, Stiffness = structs(p).Model, structs(p).State, hessian.struct(p)
    Increment, Band, vec6 = chain_chart.types(p).Increment, block_band.types(p).Band, block_band.types(p).vec6
    drag = block_band.functions(p).drag
    Flow, flows = flow_stage.struct(p), flow_stage.functions(p, pairs, form, lanes)
    load, spread, flow_at, places_end = flows.load, flows.spread, flows.flow_at, flows.places_end
    module = p.module("linearised", "_".join([*["bearing"] * bearing_torque, pairs, form, str(lanes)]))

    @wp.func(module=module)
    def moved(model: Model, state: State, x: Increment, e: wp.int32, k: wp.int32):
        """Displacement of node e under an increment; r_0 follows the body."""
        if e == model.first_node[k]:
            b = x.body[model.cell_of[e]]
            return vec3(b[0], b[1], b[2]) + wp.cross(vec3(b[3], b[4], b[5]), state.position[e])
        n = x.node[e]
        return vec3(n[0], n[1], n[2])

    @wp.kernel(module=module)
    def joint_changes(
        # Model:
        model: Model,
        # State:
        stiffness: Stiffness,
        x: Increment,
        # Out:
        state: State,
    ):
        i = wp.tid()
        c = model.cell_of[i]
        k = model.flagellum_of[i]
        if state.active[c] == 0 or i + 1 == model.first_node[k + 1]:
            return
        b = x.body[c]
        here = moved(model, state, x, i, k)
        e = wp.cross(vec3(b[3], b[4], b[5]), state.tangent[i])
        if i > model.first_node[k]:
            e = here - moved(model, state, x, i - 1, k)
        f = moved(model, state, x, i + 1, k) - here
        first = x.node[i][3]
        second = x.node[i + 1][3]
        ge = stiffness.ee[i] * e + wp.transpose(stiffness.fe[i]) * f
        gf = stiffness.fe[i] * e + stiffness.ff[i] * f
        state.joint_before[i] = ge + first * stiffness.e_first[i] + second * stiffness.e_second[i]
        state.joint_after[i] = gf + first * stiffness.f_first[i] + second * stiffness.f_second[i]
        spins = stiffness.spins[i]
        turn_first = wp.dot(stiffness.e_first[i], e) + wp.dot(stiffness.f_first[i], f)
        turn_second = wp.dot(stiffness.e_second[i], e) + wp.dot(stiffness.f_second[i], f)
        state.joint_spin_before[i] = turn_first + spins[0] * first + spins[1] * second
        state.joint_spin_after[i] = turn_second + spins[1] * first + spins[2] * second

    @wp.func(module=module)
    def segment_change(model: Model, state: State, stiffness: Stiffness, x: Increment, e: wp.int32, k: wp.int32):
        stretched = moved(model, state, x, e, k) - moved(model, state, x, e - 1, k)
        return state.joint_before[e] + state.joint_after[e - 1] + stiffness.stretch[e] * stretched

    @wp.kernel(module=module)
    def gather_changes(
        # Model:
        model: Model,
        # State:
        stiffness: Stiffness,
        x: Increment,
        # Out:
        state: State,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] == 0:
            return
        k = model.flagellum_of[e]
        force = vec3(real(0.0))
        torque = -state.joint_spin_before[e]
        if e + 1 < model.first_node[k + 1]:
            force += segment_change(model, state, stiffness, x, e + 1, k)
        else:
            torque = real(0.0)  # no joint after the last segment
        if e > model.first_node[k]:
            force -= segment_change(model, state, stiffness, x, e, k)
            torque -= state.joint_spin_after[e - 1]
        state.force[e] = force
        state.spin_torque[e] = torque

    @wp.kernel(module=module)
    def sum_flagellum(
        # Model:
        model: Model,
        # Out:
        state: State,
    ):
        k = wp.tid()
        first = model.first_node[k]
        if state.active[model.cell_of[first]] == 0:
            return
        force = state.force[first]
        torque = wp.cross(state.position[first], force)
        if wp.static(bearing_torque):
            torque -= wp.cross(state.tangent[first], state.joint_before[first])
        state.flagellum_force[k] = force
        state.flagellum_torque[k] = torque

    @wp.kernel(module=module)
    def load_nodes(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        flow: Flow,
    ):
        e = wp.tid()
        if flow.place[e] >= 0 and state.active[model.cell_of[e]] != 0:
            load(flow, flow.place[e], state.force[e])

    @wp.kernel(module=module)
    def add_flows(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        flow: Flow,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            spread(model, flow, c, places_end(model, c))

    @wp.kernel(module=module)
    def complete(
        # Model:
        model: Model,
        # State:
        state: State,
        flow: Flow,
        band: Band,
        gain: wp.array(dtype=wp.float64),
        x: Increment,
        # Out:
        out: Increment,
    ):
        e, lane = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        g = real(gain[c])
        inv_dt = real(wp.float64(1.0) / band.step[c])
        y = inv_dt * x.node[e]
        v = vec3(real(0.0))
        if e > model.first_node[k]:
            v = vec3(y[0], y[1], y[2])
            if wp.static(pairs != "none"):
                v -= g * flow_at(model, flow, e, k, c, places_end(model, c), lane)
            v = drag(band, e, v) - g * state.force[e]
        elif lane == 0 and k == model.first_flagellum[c]:
            u = state.body_velocity[c]
            w = state.body_spin[c]
            out.body[c] = inv_dt * x.body[c] - g * vec6(u[0], u[1], u[2], w[0], w[1], w[2])
        if lane == 0:
            out.node[e] = vec4(v[0], v[1], v[2], y[3] / model.spin_mobility[k] - g * state.spin_torque[e])

    return SimpleNamespace(
        joint_changes=joint_changes,
        gather_changes=gather_changes,
        sum_flagellum=sum_flagellum,
        load_nodes=load_nodes,
        add_flows=add_flows,
        complete=complete,
    )


def apply(
    model: DeviceModel, state: DeviceState, stiffness: Any, band: Any, flow: Any, gain: wp.array, x: Any, out: Any
) -> None:
    """D^-1 (1/dt + g M H) x (of the bodies: without D^-1) into out; the forces of `state` are overwritten.

    Args:
        gain: g, per cell, shape [cell_count].
    """
    kernels, device = kernels_of(model), model.device
    inputs = [model.data, stiffness, x, state.data]
    wp.launch(kernels.joint_changes, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.gather_changes, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.sum_flagellum, model.flagellum_count, inputs=[model.data, state.data], device=device)
    body.move_bodies(model, state)
    if model.switches.pairs != "none":
        inputs = [model.data, state.data, flow]
        wp.launch(kernels.load_nodes, model.element_count, inputs=inputs, device=device)
        if flow_stage.form_of(model) != "gathered":
            wp.launch(kernels.add_flows, model.cell_count, inputs=inputs, device=device)
    inputs = [model.data, state.data, flow, band, gain, x, out]
    wp.launch(kernels.complete, (model.element_count, _lanes(model)), inputs=inputs, device=device)


def kernels_of(model: DeviceModel) -> SimpleNamespace:
    """The kernels of `apply` for this model's switches."""
    switches = model.switches
    return _kernels(model.precision, switches.bearing_torque, switches.pairs, flow_stage.form_of(model), _lanes(model))


def _lanes(model: DeviceModel) -> int:
    return rotne_prager.WARP if model.threads_cooperate and model.switches.pairs != "none" else 1
