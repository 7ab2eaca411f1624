"""The cell body: sums the forces and torques of the flagella on it and moves by the mobility of a prolate spheroid.

With flow round the body it moves by the mobility of its shell of beads, and the flow of the nodes takes it along.

Each flagellum exerts the force at its anchor, with its torque about the body's centre, and what the terms put on
the body directly: the motor's reaction, the bearing torque, the reaction to the contact of its nodes with the surface.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term, acting, combined, variant
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body_flow


@functools.cache
def mobility(p: Precision, shell: bool | None = None) -> SimpleNamespace:
    """Device function `respond`: velocity and angular velocity of a body under a force and a torque.

    Args:
        p: precision.
        shell: whether bodies are shells of beads; None: as the model says at run time.
    """
    real, vec3, Model, State = p.real, p.vec3, structs(p).Model, structs(p).State
    module = p.module("body_mobility", {None: "", False: "spheroid", True: "shell"}[shell])

    @wp.func(module=module)
    def respond_as_shell(model: Model, state: State, c: wp.int32, force: vec3, torque: vec3):
        q = state.pose.body_orientation[c]
        axes = wp.quat_to_matrix(p.quat(real(q[0]), real(q[1]), real(q[2]), real(q[3])))
        f = wp.transpose(axes) * force
        t = wp.transpose(axes) * torque
        u = vec3(real(0.0))
        w = vec3(real(0.0))
        for i in range(3):
            for j in range(3):
                at = 36 * c + 6 * i + j
                u[i] += model.body.shell_mobility[at] * f[j] + model.body.shell_mobility[at + 3] * t[j]
                w[i] += model.body.shell_mobility[at + 18] * f[j] + model.body.shell_mobility[at + 21] * t[j]
        return axes * u, axes * w

    @wp.func(module=module)
    def respond_as_spheroid(model: Model, state: State, c: wp.int32, force: vec3, torque: vec3):
        axis = state.pose.body_axis[c]
        force_along = wp.dot(axis, force) * axis
        torque_along = wp.dot(axis, torque) * axis
        velocity = model.body.mobility_along[c] * force_along + model.body.mobility_across[c] * (force - force_along)
        spin = model.body.spin_mobility[c] * torque_along + model.body.tumble_mobility[c] * (torque - torque_along)
        return velocity, spin

    @wp.func(module=module)
    def respond_as_either(model: Model, state: State, c: wp.int32, force: vec3, torque: vec3):
        if model.body.shell_mobility.shape[0] > 0:
            u, w = respond_as_shell(model, state, c, force, torque)
            return u, w
        velocity, spin = respond_as_spheroid(model, state, c, force, torque)
        return velocity, spin

    respond = {None: respond_as_either, False: respond_as_spheroid, True: respond_as_shell}[shell]
    return SimpleNamespace(respond=respond)


@functools.cache
def functions(p: Precision, terms: tuple[Term, ...], shell: bool) -> SimpleNamespace:
    """Device functions: force and torque of one flagellum on the body, and the velocities of one body."""
    return SimpleNamespace(sum_flagellum=_sum(p, terms), move=_motion(p, shell))


@functools.cache
def _sum(p: Precision, terms: tuple[Term, ...]) -> Any:
    Model, State, on_body = structs(p).Model, structs(p).State, combined(p, terms).on_body

    @wp.func(module=p.module("body_functions", variant(terms)))
    def sum_flagellum(model: Model, state: State, k: wp.int32):
        first = model.first_node[k]
        through_anchor = state.force[first]
        arm = state.pose.position[first]
        force, torque = on_body(model, state, k, through_anchor, wp.cross(arm, through_anchor))
        state.flagellum_force[k] = force
        state.flagellum_torque[k] = torque

    return sum_flagellum


@functools.cache
def _motion(p: Precision, shell: bool) -> Any:
    real, vec3 = p.real, p.vec3
    Model, State, respond = structs(p).Model, structs(p).State, mobility(p, shell).respond

    @wp.func(module=p.module("body_motion_functions", "shell" * shell))
    def move(model: Model, state: State, c: wp.int32):
        force = vec3(real(0.0))
        torque = vec3(real(0.0))
        if wp.static(shell):
            force = state.surface_force[c]
            torque = state.surface_torque[c]
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            force += state.flagellum_force[k]
            torque += state.flagellum_torque[k]
            k += 1
        velocity, spin = respond(model, state, c, force, torque)
        state.body_velocity[c] = velocity
        state.body_spin[c] = spin

    return move


@functools.cache
def _sum_kernels(p: Precision, terms: tuple[Term, ...]) -> SimpleNamespace:
    Model, State, sum_flagellum = structs(p).Model, structs(p).State, _sum(p, terms)
    module, settle = p.module("body", variant(terms)), combined(p, terms).settle

    @wp.kernel(module=module)
    def sum_flagella(
        # Model:
        model: Model,
        # Out:
        state: State,
    ):
        k = wp.tid()
        if state.active[model.cell_of[model.first_node[k]]] != 0:
            sum_flagellum(model, state, k)

    if settle is None:
        return SimpleNamespace(sum_flagella=sum_flagella)

    @wp.kernel(module=module)
    def settle_all(
        # Model:
        model: Model,
        # Out:
        state: State,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            settle(model, state, c)

    return SimpleNamespace(sum_flagella=sum_flagella, settle=settle_all)


@functools.cache
def _motion_kernel(p: Precision, shell: bool) -> Any:
    Model, State, move = structs(p).Model, structs(p).State, _motion(p, shell)

    @wp.kernel(module=p.module("body_motion", "shell" * shell))
    def move_all(
        # Model:
        model: Model,
        # Out:
        state: State,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            move(model, state, c)

    return move_all


def _sums_of(model: DeviceModel, terms: tuple[Term, ...]) -> SimpleNamespace:
    return _sum_kernels(model.precision, acting(model.precision, terms, "on_body", "settle"))


def sum_flagella(model: DeviceModel, state: DeviceState, terms: tuple[Term, ...]) -> None:
    """Force [pN] and torque about the body's centre [pN um] of every flagellum on its body, of these terms."""
    kernel = _sums_of(model, terms).sum_flagella
    wp.launch(kernel, model.flagellum_count, inputs=[model.data, state.data], device=model.device)


def obstruct(model: DeviceModel, state: DeviceState, single: Any = None) -> None:
    """Force and torque of the nodes' flow on every body, held at rest, into `surface_force` and `surface_torque`.

    Args:
        model, state: of the batch.
        single: struct `Shell` in single precision that already has the nodes' positions, in place of the state's.
    """
    if single is not None:
        body_flow.obstruct(model, state, single, model.precision.single, placed=True)
    else:
        body_flow.obstruct(model, state, state.shell, model.plan.pair_precision)


def move_bodies(model: DeviceModel, state: DeviceState) -> None:
    """Velocity and angular velocity of every body from `flagellum_force` and `flagellum_torque`, and, with flow round
    the body, from the forces on nodes."""
    if model.switches.flows.body:
        obstruct(model, state)
    _move(model, state)


def _move(model: DeviceModel, state: DeviceState) -> None:
    kernel = _motion_kernel(model.precision, model.switches.flows.body)
    wp.launch(kernel, model.cell_count, inputs=[model.data, state.data], device=model.device)


def body_motion(
    model: DeviceModel, state: DeviceState, terms: tuple[Term, ...] | None = None, single: Any = None
) -> None:
    """Velocity [um/s] and angular velocity [rad/s] of every body, into `body_velocity` and `body_spin`.

    Args:
        model, state: of the batch.
        terms: those that count; default: all of the model.
        single: struct `Shell` in single precision that already has the nodes' positions, in place of the state's.
    """
    terms = model.terms if terms is None else terms
    sum_flagella(model, state, terms)
    motion_of_sums(model, state, terms, single)


def motion_of_sums(
    model: DeviceModel, state: DeviceState, terms: tuple[Term, ...] | None = None, single: Any = None
) -> None:
    """As `body_motion`, where force and torque of every flagellum on its body are known."""
    terms = model.terms if terms is None else terms
    if model.switches.flows.body:
        obstruct(model, state, single)
    if any(hasattr(term.functions(model.precision), "settle") for term in terms):
        kernel = _sums_of(model, terms).settle
        wp.launch(kernel, model.cell_count, inputs=[model.data, state.data], device=model.device)
    _move(model, state)
