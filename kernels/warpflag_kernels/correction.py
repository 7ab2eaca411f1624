"""Defect correction of an implicit step: the pair sum, which the matrix leaves out, taken into account after all.

With rho the residual of the full equations at e, contact forces F included,

    rho = g [V - w delta/dt] + g M (B F - H e) - e/dt,      e <- e + P_c rho

P_c answers like the factorised system with the closed contacts' stiffness in it: z = P rho changes their gaps, so
their forces change by dF with (1/k + W) dF = -B^T z, and P_c rho = z + Y dF. One sweep squares the factor by which
the flows outside the matrix are wrong, and with it the range of flows for which stepping is stable.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import banded, chain, contacts, gaps, hessian, mobility, response
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs


@functools.cache
def _kernels(p: Precision, bearing_torque: bool, touching: bool) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State, Stiffness = structs(p).Model, structs(p).State, hessian.struct(p)
    Increment, Band, vec6 = chain.types(p).Increment, banded.types(p).Band, banded.types(p).vec6
    Contacts, Response = contacts.struct(p), gaps.types(p).Response
    body_mobility = banded.functions(p).body_mobility
    variant = ("bearing" if bearing_torque else "") + ("touching" if touching else "")
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
            force = segment_change(model, state, stiffness, x, e + 1, k)
        else:
            torque = real(0.0)  # no joint after the last segment
        if e > model.first_node[k]:
            force -= segment_change(model, state, stiffness, x, e, k)
            torque -= state.joint_spin_after[e - 1]
            state.pair_force[e] = force
        state.force[e] = force
        state.spin_torque[e] = torque

    @wp.kernel(module=module)
    def add_contacts_and_move_body(
        # Model:
        model: Model,
        # Out:
        state: State,
        contacts_in: Contacts,
        response_in: Response,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        force = vec3(real(0.0))
        torque = vec3(real(0.0))
        if wp.static(touching):
            i = contacts_in.first[c]
            end = i + contacts_in.count[c]
            while i < end:
                f = response_in.total_force[i] * contacts_in.normal[i]
                if response_in.total_force[i] != real(0.0):
                    e = contacts_in.segment[i]
                    j = contacts_in.other[i]
                    s = contacts_in.at[i]
                    r = contacts_in.at_other[i]
                    state.force[e] = state.force[e] + s * f
                    state.pair_force[e] = state.pair_force[e] + s * f
                    if j < 0:
                        force -= f
                        torque -= wp.cross(state.position[e], f)
                    else:
                        state.force[j] = state.force[j] - r * f
                        state.pair_force[j] = state.pair_force[j] - r * f
                        # Shares on r_0 stay out of the pair sum: they are summed for the body below.
                        state.force[e - 1] = state.force[e - 1] + (real(1.0) - s) * f
                        if e - 1 > model.first_node[model.flagellum_of[e]]:
                            state.pair_force[e - 1] = state.pair_force[e - 1] + (real(1.0) - s) * f
                        state.force[j - 1] = state.force[j - 1] - (real(1.0) - r) * f
                        if j - 1 > model.first_node[model.flagellum_of[j]]:
                            state.pair_force[j - 1] = state.pair_force[j - 1] - (real(1.0) - r) * f
                i += 1
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            first = model.first_node[k]
            force += state.force[first]
            torque += wp.cross(state.position[first], state.force[first])
            if wp.static(bearing_torque):
                torque -= wp.cross(state.tangent[first], state.joint_before[first])
            k += 1
        v = body_mobility(model, state, c, force, torque)
        state.body_velocity[c] = vec3(v[0], v[1], v[2])
        state.body_spin[c] = vec3(v[3], v[4], v[5])

    @wp.kernel(module=module)
    def residual(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        response_in: Response,
        drive: Increment,
        x: Increment,
        # Out:
        rho: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        gain = real(response_in.gain[c])
        inv_dt = real(wp.float64(1.0) / band.step[c])
        d = drive.node[e]
        y = x.node[e]
        spin = d[3] + gain * model.spin_mobility[k] * state.spin_torque[e] - inv_dt * y[3]
        v = vec3(real(0.0))
        if e > model.first_node[k]:
            v = vec3(d[0], d[1], d[2]) + gain * state.velocity[e] - inv_dt * vec3(y[0], y[1], y[2])
            t = state.tangent[e]
            if e + 1 < model.first_node[k + 1]:
                t = wp.normalize(t + state.tangent[e + 1])
            along = wp.dot(t, v) * t
            v = along / model.mobility_along[e] + (v - along) / model.mobility_across[e]
        elif k == model.first_flagellum[c]:
            u = state.body_velocity[c]
            w = state.body_spin[c]
            rate = vec6(u[0], u[1], u[2], w[0], w[1], w[2])
            rho.body[c] = drive.body[c] + gain * rate - inv_dt * x.body[c]
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
        add_contacts_and_move_body=add_contacts_and_move_body,
        residual=residual,
        add=add,
    )


def correct(
    model: DeviceModel,
    state: DeviceState,
    stiffness: Any,
    band: Any,
    contacts_in: Any,
    response_in: Any,
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
    kernels, device = _kernels(model.precision, model.switches.bearing_torque, touching), model.device
    wp.launch(kernels.joint_changes, model.element_count, inputs=[model.data, stiffness, x, state.data], device=device)
    wp.launch(kernels.gather_changes, model.element_count, inputs=[model.data, stiffness, x, state.data], device=device)
    inputs = [model.data, state.data, contacts_in, response_in]
    wp.launch(kernels.add_contacts_and_move_body, model.cell_count, inputs=inputs, device=device)
    mobility.node_velocities(model, state)
    inputs = [model.data, state.data, band, response_in, drive, x, rho]
    wp.launch(kernels.residual, model.element_count, inputs=inputs, device=device)
    banded.solve(model, state, band, rho)
    change = rho
    if touching:
        response.yield_contacts(model, state, contacts_in, response_in, rho, scratch)
        change = scratch
    wp.launch(kernels.add, model.element_count, inputs=[model.data, state.data, change, x], device=device)
