"""The mean drift of an implicit step, by the change of the mobility over the step before.

A step moves the cell by x = A (M F + v) dt, A = (1 + theta dt M H)^-1. Stiff modes follow the soft ones within it, and
the mean drift that keeps exp(-E/kT) is then not kT div M, which holds where they are resolved, but

    A u,    u_i = kT sum_jk A_jk d_j M_ik.

For the pair sum they differ much: its divergence is zero, but that of the mobility of filaments that keep their
lengths is not, and without it two filaments that nothing but the flow couples would be near each other twice as often
as they are in equilibrium, at any step in which a mode is stiff.

With g a random force that is correlated with the thermal velocities v as <v g^T> = kT/dt, the displacement has
<x g^T> = A kT, so

    u = < [M(q + x) - M(q)] g >.

g is the inverse root of the part of M that v was drawn with, on the same deviates xi,

    g = (kT/2 dt)^1/2 R^-1/2 xi,

which Lanczos' process has in the same space: no correlation with what S has beyond R is needed, as R alone is positive.
Without a pair sum the local mobility takes its place. g and M(q) g are kept from the last step; in the present one g is
a force beside all others, and M(q) g is taken off. So neither needs a product of its own: R g is known in the Krylov
space. With flow round the body, P and N_b of `body_noise`, the body's part of g is (kT/2 dt)^1/2 N_b^-1/2 xi_b - P^T g.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import random_numbers
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body as body_stage
from warpflag_kernels.fluid import lanczos_space
from warpflag_kernels.fluid import noise as noise_stage

CARRIED = ("force", "on_body", "velocity", "of_body")
"""Arrays that carry over from one step to the next, and into checkpoints."""


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Drift`: the random force g of a step, and M g where it was drawn."""
    vec3, vec6 = p.vec3, wp.types.vector(6, p.real)

    @wp.struct
    class Drift:
        force: wp.array(dtype=vec3)  # [E] [pN]
        on_body: wp.array(dtype=vec6)  # [C] [pN] and [pN um]
        velocity: wp.array(dtype=vec3)  # [E] [um/s]
        of_body: wp.array(dtype=vec6)  # [C] [um/s] and [rad/s]

    return Drift


def allocate(model: DeviceModel) -> Any:
    """The struct `Drift`, zero: the first step has no drift."""
    p, device, d = model.precision, model.device, struct(model.precision)()
    d.force, d.velocity = (wp.zeros(model.element_count, dtype=p.vec3, device=device) for _ in range(2))
    vec6 = wp.types.vector(6, p.real)
    d.on_body, d.of_body = (wp.zeros(model.cell_count, dtype=vec6, device=device) for _ in range(2))
    return d


@functools.cache
def _kernels(p: Precision, pairs: bool, free: bool, shell: bool) -> SimpleNamespace:
    real, vec3, vec4, vec6 = p.real, p.vec3, p.vec4, wp.types.vector(6, p.real)
    Model, State, Drift = structs(p).Model, structs(p).State, struct(p)
    Noise, Lanczos = noise_stage.struct(p), lanczos_space.struct(p)
    f = noise_stage.functions(p, pairs)
    self_mobility, node_tangent, axial_root = f.self_mobility, f.node_tangent, f.axial_root
    shell_product = f.shell_product
    normals, respond = random_numbers.functions(p).normals, body_stage.mobility(p).respond
    most, zero = wp.constant(lanczos_space.MOST_PRODUCTS), wp.constant(real(0.0))
    for_node, for_shift, for_turn = (
        wp.constant(x) for x in (random_numbers.FOR_NODE, random_numbers.FOR_BODY_SHIFT, random_numbers.FOR_BODY_TURN)
    )
    module = p.module("mean_drift", "pairs" * pairs + "free" * free + "_shell" * shell)

    @wp.kernel(module=module)
    def add_forces(
        # Model:
        model: Model,
        # State:
        drift: Drift,
        # Out:
        state: State,
    ):
        """g of the last step beside the other forces on nodes."""
        e = wp.tid()
        if state.active[model.cell_of[e]] == 0:
            return
        if wp.static(free) or e > model.first_node[model.flagellum_of[e]]:
            state.force[e] = state.force[e] + drift.force[e]

    @wp.kernel(module=module)
    def add_velocities(
        # Model:
        model: Model,
        # State:
        drift: Drift,
        # Out:
        state: State,
        noise: Noise,
    ):
        """g on bodies, and minus M g where it was drawn."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        if e > model.first_node[k]:
            v = drift.velocity[e]
            noise.node[e] = noise.node[e] - vec4(v[0], v[1], v[2], zero)
        elif k == model.first_flagellum[c]:
            noise.body[c] = noise.body[c] - drift.of_body[c]
            if wp.static(not free):
                g = drift.on_body[c]
                u, w = respond(model, state, c, vec3(g[0], g[1], g[2]), vec3(g[3], g[4], g[5]))
                state.body_velocity[c] = state.body_velocity[c] + u
                state.body_spin[c] = state.body_spin[c] + w

    @wp.func(module=module)
    def inverse_root(axis: vec3, along: real, across: real, xi: vec3):
        """The inverse root of an axially symmetric mobility on a vector; zero where there is no mobility."""
        part = wp.dot(axis, xi) * axis
        rest = xi - part
        found = vec3(zero)
        if along > zero:
            found += part / wp.sqrt(along)
        if across > zero:
            found += rest / wp.sqrt(across)
        return found

    @wp.func(module=module)
    def in_space(model: Model, z: Lanczos, c: wp.int32, e: wp.int32):
        """R^-1/2 and R R^-1/2 of the deviates of node e, in the Krylov space."""
        count = model.cell_of.shape[0]
        n = z.products[c]
        at = c * most
        g = vec3(zero)
        moved = vec3(zero)
        for j in range(n):
            weight = z.alpha[at + j] * z.inverse[at + j]
            if j > 0:
                weight += z.beta[at + j - 1] * z.inverse[at + j - 1]
            if j + 1 < n:
                weight += z.beta[at + j] * z.inverse[at + j + 1]
            b = z.basis[j * count + e]
            g += real(z.inverse[at + j]) * b
            moved += real(weight) * b
        # What is beyond the space was left with its own length.
        moved += real(z.inverse[at + n - 1]) * z.basis[n * count + e]
        return real(z.size[c]) * g, real(z.size[c]) * moved

    @wp.kernel(module=module)
    def remember(
        # Model:
        model: Model,
        # State:
        noise: Noise,
        z: Lanczos,
        step: wp.array(dtype=wp.float64),
        steps: wp.array(dtype=wp.int32),
        # Out:
        state: State,
        drift: Drift,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        first = model.first_node[k]
        scale = real(wp.sqrt(wp.float64(0.5) * noise.energy[c] / step[c]))
        g = vec3(zero)
        v = vec3(zero)
        own = self_mobility(model, c, k)
        if wp.static(pairs) and (wp.static(free) or e > first):
            g, v = in_space(model, z, c, e)
        if e > first:
            t = node_tangent(model, state, e, k)
            along = model.drag.mobility_along[e]
            across = model.drag.mobility_across[e]
            if wp.static(not pairs):
                xi = normals(noise.seed[c], e - model.first_node[model.first_flagellum[c]], steps[c], for_node)
                g = inverse_root(t, along, across, vec3(xi[0], xi[1], xi[2]))
            part = wp.dot(t, g) * t
            v += (along - own) * part + (across - own) * (g - part)
            g = scale * g
            v = scale * v
            if wp.static(shell):
                v += real(0.5) * noise.carried[e]
        elif wp.static(free):
            t = state.pose.tangent[first + 1]
            along = model.body.mobility_along[c]
            across = model.body.mobility_across[c]
            if wp.static(not pairs):
                xi = normals(noise.seed[c], 0, steps[c], for_shift)
                g = inverse_root(t, along, across, vec3(xi[0], xi[1], xi[2]))
            part = wp.dot(t, g) * t
            v += (along - own) * part + (across - own) * (g - part)
            g = scale * g
            v = scale * v
            drift.of_body[c] = vec6(v[0], v[1], v[2], zero, zero, zero)
        drift.force[e] = g
        drift.velocity[e] = v
        state.force[e] = g

    @wp.kernel(module=module)
    def remember_bodies(
        # Model:
        model: Model,
        # State:
        state: State,
        noise: Noise,
        step: wp.array(dtype=wp.float64),
        steps: wp.array(dtype=wp.int32),
        # Out:
        drift: Drift,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        scale = real(wp.sqrt(wp.float64(0.5) * noise.energy[c] / step[c]))
        a = normals(noise.seed[c], 0, steps[c], for_shift)
        b = normals(noise.seed[c], 0, steps[c], for_turn)
        if wp.static(shell):
            force, torque = shell_product(noise.body_inverse, state, c, a, b)
            force = scale * force - state.surface_force[c]
            torque = scale * torque - state.surface_torque[c]
            u, w = shell_product(noise.body_root, state, c, a, b)
            u = scale * u
            w = scale * w
        else:
            axis = state.pose.body_axis[c]
            m = model.body
            shift = vec3(a[0], a[1], a[2])
            turn = vec3(b[0], b[1], b[2])
            force = scale * inverse_root(axis, m.mobility_along[c], m.mobility_across[c], shift)
            torque = scale * inverse_root(axis, m.spin_mobility[c], m.tumble_mobility[c], turn)
            u = scale * axial_root(axis, m.mobility_along[c], m.mobility_across[c], shift)
            w = scale * axial_root(axis, m.spin_mobility[c], m.tumble_mobility[c], turn)
        drift.on_body[c] = vec6(force[0], force[1], force[2], torque[0], torque[1], torque[2])
        drift.of_body[c] = vec6(u[0], u[1], u[2], w[0], w[1], w[2])

    return SimpleNamespace(
        add_forces=add_forces, add_velocities=add_velocities, remember=remember, remember_bodies=remember_bodies
    )


def _kernels_of(model: DeviceModel) -> SimpleNamespace:
    switches = model.switches
    return _kernels(model.precision, switches.pairs != "none", switches.has("free end"), switches.flows.body)


def add_forces(model: DeviceModel, state: DeviceState, drift: Any) -> None:
    """Adds the random force of the last step to the forces on nodes, before those on the body are summed."""
    inputs = [model.data, drift, state.data]
    wp.launch(_kernels_of(model).add_forces, model.element_count, inputs=inputs, device=model.device)


def add_velocities(model: DeviceModel, state: DeviceState, drift: Any, noise: Any) -> None:
    """Moves bodies by the random force of the last step, and takes from the thermal velocities those that it caused
    there; after the body's motion, before that of the nodes."""
    inputs = [model.data, drift, state.data, noise]
    wp.launch(_kernels_of(model).add_velocities, model.element_count, inputs=inputs, device=model.device)


def remember(
    model: DeviceModel, state: DeviceState, control: Any, noise: Any, lanczos: Any, shell: Any, drift: Any
) -> None:
    """The random force of this step and the velocities that it causes here, for the next one.

    Args:
        model, state: of the batch; forces of `state` are overwritten.
        control: struct `Control`.
        noise: struct `Noise`, drawn for this step.
        lanczos: struct `Lanczos` after the draw of this step; without arrays where there is no pair sum.
        shell: struct `Shell` in single precision that has the nodes' positions; None: that of the state is filled.
        drift: struct `Drift`.
    """
    kernels, device = _kernels_of(model), model.device
    inputs = [model.data, noise, lanczos, control.step, control.steps, state.data, drift]
    wp.launch(kernels.remember, model.element_count, inputs=inputs, device=device)
    if model.switches.has("free end"):
        return
    if model.switches.flows.body:
        body_stage.obstruct(model, state, shell)
    inputs = [model.data, state.data, noise, control.step, control.steps, drift]
    wp.launch(kernels.remember_bodies, model.cell_count, inputs=inputs, device=device)
