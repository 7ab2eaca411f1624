"""Thermal velocities with flow round the body.

The mobility M of `body_flow` is a sum of two positive parts. With R the pair sum of the nodes, P the motion of nodes
and body that a moving body causes, C^T M_c^-1 K for the nodes and 1 for itself, and S the local part,

    M = S + [R - C^T M_c^-1 C] + P N_b P^T.

The bracket is the mobility of nodes beside a body that is held; Lanczos' process draws it in place of R. The root of
the last part is P N_b^1/2, N_b a constant matrix of six rows in body axes: the body moves at random and carries the
nodes along (`carry`). So fluctuation and dissipation fit exactly.

Both parts depend on the nodes' places about the body, so M has a divergence beside that of the local part. It is found
by a random finite difference (Delong, Usabiaga, Delgado-Buscalioni, Griffith & Donev, J. Chem. Phys. 140, 134110
(2014)): with W normal deviates of nodes and body,

    kT div M = < kT/d [M(q + d W/2) - M(q - d W/2)] W >,

M without S, whose divergence has a closed form (`noise`), and R, which has none. Its scatter stays bounded as steps
become short, while thermal velocities grow as the inverse root of the step: in the limit it adds nothing to them.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import random_numbers
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body, body_flow
from warpflag_kernels.fluid import noise as noise_stage
from warpflag_kernels.fluid import shell as shell_stage
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.rod import rotations

# d of the finite difference [um, rad]. It leaves d^2/8 of the third derivative: 6e-4 of the drift of a node 0.05 um
# from the body. Round-off leaves 1e-6 um/d = 1e-3 in float32.
DISPLACEMENT = 1.0e-3


@functools.cache
def _kernels(p: Precision, pair: Precision) -> SimpleNamespace:
    real, vec3, vec4, vec6 = p.real, p.vec3, p.vec4, wp.types.vector(6, p.real)
    Model, State, Noise = structs(p).Model, structs(p).State, noise_stage.struct(p)
    Chart, Shell = chart_stage.struct(p), shell_stage.struct(pair)
    normals = random_numbers.functions(p).normals
    rotation_vector_quat = rotations.functions(p.double).rotation_vector_quat
    for_node, for_shift, for_turn = (
        wp.constant(x)
        for x in (random_numbers.FOR_PROBE, random_numbers.FOR_PROBE_SHIFT, random_numbers.FOR_PROBE_TURN)
    )
    displacement = wp.constant(wp.float64(DISPLACEMENT))
    zero = wp.constant(real(0.0))
    module = p.module("body_noise", pair.name)

    @wp.kernel(module=module)
    def hold(
        # Out:
        state: State,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            state.body_velocity[c] = vec3(zero)
            state.body_spin[c] = vec3(zero)

    @wp.kernel(module=module)
    def move(
        # Model:
        model: Model,
        # State:
        noise: Noise,
        # Out:
        state: State,
        shell: Shell,
    ):
        """Bodies move at random; no held loads, and nodes at rest."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        state.velocity[e] = vec3(zero)
        if e == model.first_node[model.first_flagellum[c]]:
            b = noise.body[c]
            state.body_velocity[c] = vec3(b[0], b[1], b[2])
            state.body_spin[c] = vec3(b[3], b[4], b[5])
            at = 3 * shell.first[c]
            while at < 3 * shell.first[c + 1]:
                shell.load[at] = pair.real(0.0)
                at += 1

    @wp.kernel(module=module)
    def take(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        noise: Noise,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] != 0 and e > model.first_node[model.flagellum_of[e]]:
            v = state.velocity[e]
            noise.carried[e] = v
            noise.node[e] = noise.node[e] + vec4(v[0], v[1], v[2], zero)

    @wp.kernel(module=module)
    def probe(
        # Model:
        model: Model,
        # State:
        active: wp.array(dtype=wp.int32),
        steps: wp.array(dtype=wp.int32),
        # Out:
        noise: Noise,
    ):
        """Draws the deviates W."""
        e = wp.tid()
        c = model.cell_of[e]
        if active[c] == 0:
            return
        own = e - model.first_node[model.first_flagellum[c]]
        xi = normals(noise.seed[c], own, steps[c], for_node)
        noise.probe[e] = vec3(xi[0], xi[1], xi[2])
        if own == 0:
            xi = normals(noise.seed[c], own, steps[c], for_shift)
            noise.probe_shift[c] = vec3(xi[0], xi[1], xi[2])
            xi = normals(noise.seed[c], own, steps[c], for_turn)
            noise.probe_turn[c] = vec3(xi[0], xi[1], xi[2])

    @wp.kernel(module=module)
    def displace(
        # Model:
        model: Model,
        # State:
        noise: Noise,
        chart: Chart,
        sign: wp.float64,
        # Out:
        state: State,
    ):
        """Puts nodes and bodies at q + sign d W/2, under the forces W."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        half = wp.float64(0.5) * sign * displacement
        k = model.flagellum_of[e]
        first = model.first_node[k]
        force = noise.probe[e]
        state.pose.position[e] = chart.base.position[e] + real(half) * (force - noise.probe_shift[c])
        state.velocity[e] = vec3(zero)
        if e == first:
            force = vec3(zero)
            torque = vec3(zero)
            if k == model.first_flagellum[c]:
                force = noise.probe_shift[c]
                torque = noise.probe_turn[c]
                turned = rotation_vector_quat(half * wp.vec3d(torque)) * chart.base.body_orientation[c]
                state.pose.body_orientation[c] = wp.normalize(turned)
            state.flagellum_force[k] = force
            state.flagellum_torque[k] = torque
            force = vec3(zero)
        state.force[e] = force

    @wp.kernel(module=module)
    def take_difference(
        # Model:
        model: Model,
        # State:
        state: State,
        sign: wp.float64,
        # Out:
        noise: Noise,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        scale = real(sign * noise.energy[c] / displacement)
        k = model.flagellum_of[e]
        if e > model.first_node[k]:
            v = scale * state.velocity[e]
            noise.node[e] = noise.node[e] + vec4(v[0], v[1], v[2], zero)
        elif k == model.first_flagellum[c]:
            u = scale * state.body_velocity[c]
            w = scale * state.body_spin[c]
            noise.body[c] = noise.body[c] + vec6(u[0], u[1], u[2], w[0], w[1], w[2])

    return SimpleNamespace(
        hold=hold, move=move, take=take, probe=probe, displace=displace, take_difference=take_difference
    )


def hold_bodies(model: DeviceModel, state: DeviceState) -> None:
    """Bodies at rest, for the products of Lanczos' process."""
    kernel = _kernels(model.precision, model.plan.pair_precision).hold
    wp.launch(kernel, model.cell_count, inputs=[state.data], device=model.device)


def carry(model: DeviceModel, state: DeviceState, noise: Any, shell: Any, pair: Precision) -> None:
    """Adds to the thermal velocities of nodes the flow that the random motion of the bodies, `noise.body`, causes.

    Args:
        model, state: of the batch; velocities of `state` are overwritten.
        noise: struct `Noise`.
        shell: struct `Shell`, which has the nodes' positions.
        pair: its precision.
    """
    kernels, device, elements = _kernels(model.precision, pair), model.device, model.element_count
    wp.launch(kernels.move, elements, inputs=[model.data, noise, state.data, shell], device=device)
    body_flow.carry(model, state, shell, pair)
    wp.launch(kernels.take, elements, inputs=[model.data, state.data, noise], device=device)


def draw_probe(model: DeviceModel, state: DeviceState, noise: Any, steps: Any) -> None:
    """Draws the deviates W of a step; steps: its number in every cell, shape [cell_count]."""
    kernel = _kernels(model.precision, model.plan.pair_precision).probe
    inputs = [model.data, state.data.active, steps, noise]
    wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)


def add_divergence(model: DeviceModel, state: DeviceState, chart: Any, noise: Any) -> None:
    """Adds the random finite difference of W to the thermal velocities.

    Args:
        model, state: of the batch; forces and velocities of `state` are overwritten.
        chart: struct `Chart`, with the pose, at which the state is left.
        noise: struct `Noise`, with W.
    """
    pair = model.plan.pair_precision
    kernels, device, elements = _kernels(model.precision, pair), model.device, model.element_count
    for sign in (1.0, -1.0):
        wp.launch(kernels.displace, elements, inputs=[model.data, noise, chart, sign, state.data], device=device)
        body.move_bodies(model, state)
        body_flow.carry(model, state, state.shell, pair)
        wp.launch(kernels.take_difference, elements, inputs=[model.data, state.data, sign, noise], device=device)
    wp.launch(kernels.displace, elements, inputs=[model.data, noise, chart, 0.0, state.data], device=device)
