"""Defect correction of an implicit step: the pair sum, which the matrix leaves out, taken into account after all.

With rho the residual of the full equations at e, F the contact forces beyond those in V,

    rho = g [V - w delta/dt] + g M (B F - H e) - e/dt,      e <- e + z + Y dF,     z = P rho

z changes the gaps, and the contact law answers with dF. One sweep squares the factor by which the flows outside the
matrix are wrong, and with it the range of flows for which stepping is stable.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import banded, body, chain, compliance, contact_law, contacts, hessian, pair_sum
from warpflag_kernels import flow as flow_stage
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs


@functools.cache
def _kernels(p: Precision, bearing_torque: bool, touching: bool, pairs: str, form: str, lanes: int) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State, Stiffness = structs(p).Model, structs(p).State, hessian.struct(p)
    Increment, Band, vec6 = chain.types(p).Increment, banded.types(p).Band, banded.types(p).vec6
    Contacts, Law = contacts.struct(p), compliance.struct(p)
    drag = banded.functions(p).drag
    segment_loads, body_load = contacts.functions(p).segment_loads, contacts.functions(p).body_load
    Flow, flows = flow_stage.struct(p), flow_stage.functions(p, pairs, form, lanes)
    load, spread, flow_at, places_end = flows.load, flows.spread, flows.flow_at, flows.places_end
    variant = "_".join([*["bearing"] * bearing_torque, *["touching"] * touching, pairs, form, str(lanes)])
    module = p.module("correction", variant)

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
        contacts_in: Contacts,
        law: Law,
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
        if wp.static(touching):
            _before, force = segment_loads(contacts_in, law.load, e)
            if e + 1 < model.first_node[k + 1]:
                on_first, _after = segment_loads(contacts_in, law.load, e + 1)
                force += on_first
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
        # State:
        contacts_in: Contacts,
        law: Law,
        # Out:
        state: State,
    ):
        k = wp.tid()
        first = model.first_node[k]
        if state.active[model.cell_of[first]] == 0:
            return
        force = state.force[first]
        torque = wp.cross(state.position[first], force)
        if wp.static(touching):
            load = body_load(model, state, contacts_in, law.load, k, force)
            force = vec3(load[0], load[1], load[2])
            torque = vec3(load[3], load[4], load[5])
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
        if e > model.first_node[model.flagellum_of[e]] and state.active[model.cell_of[e]] != 0:
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
    def residual(
        # Model:
        model: Model,
        # State:
        state: State,
        flow: Flow,
        band: Band,
        law: Law,
        drive: Increment,
        x: Increment,
        # Out:
        rho: Increment,
    ):
        e, lane = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        gain = real(law.gain[c])
        inv_dt = real(wp.float64(1.0) / band.step[c])
        d = drive.node[e]
        y = x.node[e]
        spin = d[3] + gain * model.spin_mobility[k] * state.spin_torque[e] - inv_dt * y[3]
        v = vec3(real(0.0))
        if e > model.first_node[k]:
            v = vec3(d[0], d[1], d[2]) - inv_dt * vec3(y[0], y[1], y[2])
            if wp.static(pairs != "none"):
                v += gain * flow_at(model, flow, e, k, c, places_end(model, c), lane)
            v = drag(model, band, e, v)
            v += gain * state.force[e]
        elif lane == 0 and k == model.first_flagellum[c]:
            u = state.body_velocity[c]
            w = state.body_spin[c]
            rate = vec6(u[0], u[1], u[2], w[0], w[1], w[2])
            rho.body[c] = drive.body[c] + gain * rate - inv_dt * x.body[c]
        if lane == 0:
            rho.node[e] = vec4(v[0], v[1], v[2], spin / model.spin_mobility[k])

    @wp.kernel(module=module)
    def add(
        # Model:
        model: Model,
        # State:
        state: State,
        change: Increment,
        # Out:
        x: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        x.node[e] = x.node[e] + change.node[e]
        if e == model.first_node[model.first_flagellum[c]]:
            x.body[c] = x.body[c] + change.body[c]

    return SimpleNamespace(
        joint_changes=joint_changes,
        gather_changes=gather_changes,
        sum_flagellum=sum_flagellum,
        load_nodes=load_nodes,
        add_flows=add_flows,
        residual=residual,
        add=add,
    )


def correct(
    model: DeviceModel,
    state: DeviceState,
    stiffness: Any,
    band: Any,
    contacts_in: Any,
    flow: Any,
    law: Any,
    drive: Any,
    x: Any,
    rho: Any,
    scratch: Any,
) -> None:
    """One sweep of defect correction of the increment x, in place.

    Args:
        drive: g [V - w delta/dt], velocities.
        rho, scratch: increments to work in; the forces of `state` are overwritten.
    """
    touching = model.switches.steric or model.switches.body_contact
    defect(model, state, stiffness, band, flow, law, drive, x, rho, contacts_in if touching else None)
    banded.solve(model, state, band, rho)
    change = rho
    if touching:
        change = scratch
        contact_law.solve(model, state, contacts_in, band, flow, rho, law, change)
    kernels = _kernels_of(model, touching)
    wp.launch(kernels.add, model.element_count, inputs=[model.data, state.data, change, x], device=model.device)


def defect(
    model: DeviceModel,
    state: DeviceState,
    stiffness: Any,
    band: Any,
    flow: Any,
    law: Any,
    drive: Any,
    x: Any,
    rho: Any,
    contacts_in: Any = None,
) -> None:
    """D^-1 times the residual of the full equations at x, into rho; without contact forces where there is no list."""
    touching = contacts_in is not None
    kernels, device = _kernels_of(model, touching), model.device
    listed = contacts_in if touching else contacts.struct(model.precision)()
    wp.launch(kernels.joint_changes, model.element_count, inputs=[model.data, stiffness, x, state.data], device=device)
    inputs = [model.data, stiffness, listed, law, x, state.data]
    wp.launch(kernels.gather_changes, model.element_count, inputs=inputs, device=device)
    inputs = [model.data, listed, law, state.data]
    wp.launch(kernels.sum_flagellum, model.flagellum_count, inputs=inputs, device=device)
    body.move_bodies(model, state)
    if model.switches.pairs != "none":
        inputs = [model.data, state.data, flow]
        wp.launch(kernels.load_nodes, model.element_count, inputs=inputs, device=device)
        if flow_stage.form_of(model) != "gathered":
            wp.launch(kernels.add_flows, model.cell_count, inputs=inputs, device=device)
    inputs = [model.data, state.data, flow, band, law, drive, x, rho]
    wp.launch(kernels.residual, (model.element_count, _lanes(model)), inputs=inputs, device=device)


def _kernels_of(model: DeviceModel, touching: bool) -> SimpleNamespace:
    switches, form = model.switches, flow_stage.form_of(model)
    return _kernels(model.precision, switches.bearing_torque, touching, switches.pairs, form, _lanes(model))


def _lanes(model: DeviceModel) -> int:
    return pair_sum.WARP if model.threads_cooperate and model.switches.pairs != "none" else 1
