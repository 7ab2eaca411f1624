"""Thermal velocities of a step: random ones with the covariance of the mobility, and the mean drift.

By the fluctuation-dissipation theorem a step of length dt adds the velocity (2 kT/dt)^1/2 M^1/2 xi, xi normal deviates.
M = S + R is drawn in two independent parts. R is the Rotne-Prager sum with its self term (`lanczos`). S is what the
local mobility has beyond that self term, block-diagonal in nodes, so its root has a closed form:

    S^1/2 xi = s_along^1/2 t (t.xi) + s_across^1/2 (xi - t (t.xi)),    s = mobility - 1/(6 pi eta a)

and so are the roots for spins and body. kT div M, without which the measure would not be exp(-E/kT), comes from the
local mobility alone: Rotne-Prager pairs, spins and a body whose mobility stands still in its own axes have no
divergence. At a node between segments e and f of tangents t_e, t_f and lengths l_e, l_f

    kT (mobility_along - mobility_across) [tr(G) t + G t],
    G = (1 - t t) [(1 - t_e t_e)/l_e - (1 - t_f t_f)/l_f]/|t_e + t_f|,

and 2 t/l in the bracket at the last node, -2 t/l at the r_0 of a free filament, which is stored as the body. With flow
round the body there is more, see `body_noise`.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels.base import random_numbers
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs

LEAST_ROOT = 1.0e-6  # of roots of a shell's mobility over the largest; below, the body is held in that direction


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Noise`: settings of every cell, and the thermal velocities of the present step."""
    real, vec3, vec4, vec6 = p.real, p.vec3, p.vec4, wp.types.vector(6, p.real)

    @wp.struct
    class Noise:
        energy: wp.array(dtype=wp.float64)  # [C], kT [pN um]
        seed: wp.array(dtype=wp.uint64)  # [C]
        node: wp.array(dtype=vec4)  # [E], of the node [um/s] and of the spin [rad/s]
        body: wp.array(dtype=vec6)  # [C] [um/s] and [rad/s]
        # Only with flow round the body.
        body_root: wp.array(dtype=real)  # [36 C], root of the shell's mobility in body axes, row after row
        body_inverse: wp.array(dtype=real)  # [36 C], its inverse; zero in directions without a mobility
        carried: wp.array(dtype=vec3)  # [E], flow at nodes that the random motion of the body causes [um/s]
        probe: wp.array(dtype=vec3)  # [E], deviates W of nodes, by which the divergence is found
        probe_shift: wp.array(dtype=vec3)  # [C], of the body's motion
        probe_turn: wp.array(dtype=vec3)  # [C]

    return Noise


def allocate(model: DeviceModel, energies: Any, seeds: Any) -> Any:
    """The struct `Noise`, no velocities yet.

    Args:
        model: of the batch.
        energies: kT of every cell [pN um].
        seeds: of every cell.
    """
    p, device, n = model.precision, model.device, struct(model.precision)()
    n.energy = wp.array(energies, dtype=wp.float64, device=device)
    n.seed = wp.array(seeds, dtype=wp.uint64, device=device)
    n.node = wp.zeros(model.element_count, dtype=p.vec4, device=device)
    n.body = wp.zeros(model.cell_count, dtype=wp.types.vector(6, p.real), device=device)
    if model.switches.flows.body:
        values, vectors = np.linalg.eigh(model.data.body.shell_mobility.numpy().reshape(-1, 6, 6).astype(np.float64))
        roots = np.sqrt(np.maximum(values, 0.0))[:, None, :]
        sound = roots > LEAST_ROOT * roots.max(axis=2, keepdims=True)
        inverses = np.where(sound, 1.0 / np.where(sound, roots, 1.0), 0.0)
        turned = np.swapaxes(vectors, 1, 2)
        n.body_root = wp.array(((vectors * roots) @ turned).ravel(), dtype=p.real, device=device)
        n.body_inverse = wp.array(((vectors * inverses) @ turned).ravel(), dtype=p.real, device=device)
        n.carried = wp.zeros(model.element_count, dtype=p.vec3, device=device)
        n.probe = wp.zeros(model.element_count, dtype=p.vec3, device=device)
        n.probe_shift, n.probe_turn = (wp.zeros(model.cell_count, dtype=p.vec3, device=device) for _ in range(2))
    return n


@functools.cache
def functions(p: Precision, pairs: bool) -> SimpleNamespace:
    """Device functions of the local part, with or without a pair sum: `self_mobility`, `node_tangent`, `excess_root`,
    `drift`, `axial_root`; and `shell_product` of the body."""
    real, vec3, vec4, vec6 = p.real, p.vec3, p.vec4, wp.types.vector(6, p.real)
    Model, State = structs(p).Model, structs(p).State
    four_thirds, two = wp.constant(real(4.0 / 3.0)), wp.constant(real(2.0))
    module = p.module("noise_functions", "pairs" if pairs else "")

    @wp.func(module=module)
    def self_mobility(model: Model, c: wp.int32, k: wp.int32):
        """1/(6 pi eta a), the self term of the pair sum on flagellum k of cell c [um/(s pN)]; zero without one."""
        if wp.static(pairs):
            return four_thirds * model.pairs.mobility[c] / model.pairs.radius[k]
        return real(0.0)

    @wp.func(module=module)
    def node_tangent(model: Model, state: State, e: wp.int32, k: wp.int32):
        """Tangent of the local mobility at node e."""
        t = state.pose.tangent[e]
        if e + 1 < model.first_node[k + 1]:
            t = wp.normalize(t + state.pose.tangent[e + 1])
        return t

    @wp.func(module=module)
    def excess_root(model: Model, state: State, e: wp.int32, k: wp.int32, c: wp.int32, xi: vec3):
        """S^1/2 xi at node e, not r_0 [(um/(s pN))^1/2]."""
        own = self_mobility(model, c, k)
        t = node_tangent(model, state, e, k)
        # Across, the excess may be zero by the choice of the pair radius, and round-off of either sign.
        along = wp.sqrt(wp.max(model.drag.mobility_along[e] - own, real(0.0)))
        across = wp.sqrt(wp.max(model.drag.mobility_across[e] - own, real(0.0)))
        part = wp.dot(t, xi) * t
        return along * part + across * (xi - part)

    @wp.func(module=module)
    def projector(t: vec3):
        return wp.identity(3, dtype=real) - wp.outer(t, t)

    @wp.func(module=module)
    def drift(model: Model, state: State, e: wp.int32, k: wp.int32):
        """div M at node e, not r_0 [1/(pN s)]."""
        scale = model.drag.mobility_along[e] - model.drag.mobility_across[e]
        t = state.pose.tangent[e]
        length = state.pose.length[e]
        if e + 1 == model.first_node[k + 1]:
            return (two * scale / length) * t
        u = state.pose.tangent[e + 1]
        total = wp.length(t + u)
        mean = (t + u) / total
        bracket = projector(t) * (real(1.0) / length) - projector(u) * (real(1.0) / state.pose.length[e + 1])
        g = projector(mean) * bracket * (real(1.0) / total)
        return scale * (wp.trace(g) * mean + g * mean)

    @wp.func(module=module)
    def axial_root(axis: vec3, along: real, across: real, xi: vec3):
        """Root of an axially symmetric mobility on a vector."""
        part = wp.dot(axis, xi) * axis
        return wp.sqrt(along) * part + wp.sqrt(across) * (xi - part)

    @wp.func(module=module)
    def shell_product(matrix: wp.array(dtype=real), state: State, c: wp.int32, a: vec4, b: vec4):
        """The 6 x 6 matrix of cell c, in body axes, times the deviates of its body: both halves, in lab axes."""
        q = state.pose.body_orientation[c]
        axes = wp.quat_to_matrix(p.quat(real(q[0]), real(q[1]), real(q[2]), real(q[3])))
        xi = vec6(a[0], a[1], a[2], b[0], b[1], b[2])
        found = vec6(real(0.0))
        for i in range(6):
            for j in range(6):
                found[i] += matrix[36 * c + 6 * i + j] * xi[j]
        return axes * vec3(found[0], found[1], found[2]), axes * vec3(found[3], found[4], found[5])

    return SimpleNamespace(
        shell_product=shell_product,
        self_mobility=self_mobility,
        node_tangent=node_tangent,
        excess_root=excess_root,
        drift=drift,
        axial_root=axial_root,
    )


@functools.cache
def _kernels(p: Precision, pairs: bool, free: bool, shell: bool, drifting: bool) -> SimpleNamespace:
    real, vec3, vec4, vec6 = p.real, p.vec3, p.vec4, wp.types.vector(6, p.real)
    Model, State, Noise = structs(p).Model, structs(p).State, struct(p)
    normals = random_numbers.functions(p).normals
    f = functions(p, pairs)
    self_mobility, excess_root, drift, root = f.self_mobility, f.excess_root, f.drift, f.axial_root
    shell_product = f.shell_product
    zero, two = wp.constant(real(0.0)), wp.constant(real(2.0))
    for_node, for_shift, for_turn = (
        wp.constant(x) for x in (random_numbers.FOR_NODE, random_numbers.FOR_BODY_SHIFT, random_numbers.FOR_BODY_TURN)
    )
    names = "pairs" * pairs + "free" * free + "_shell" * shell + "_drifting" * drifting
    module = p.module("noise", names)

    @wp.kernel(module=module)
    def elements(
        # Model:
        model: Model,
        # State:
        state: State,
        step: wp.array(dtype=wp.float64),
        steps: wp.array(dtype=wp.int32),
        # Out:
        noise: Noise,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        scale = real(wp.sqrt(wp.float64(2.0) * noise.energy[c] / step[c]))
        own = e - model.first_node[model.first_flagellum[c]]
        xi = normals(noise.seed[c], own, steps[c], for_node)
        spin = scale * wp.sqrt(model.drag.spin_mobility[k]) * xi[3]
        if wp.static(free) and e == model.first_node[k]:
            spin = zero  # there is no motor
        v = vec3(real(0.0))
        if e > model.first_node[k]:
            v = scale * excess_root(model, state, e, k, c, vec3(xi[0], xi[1], xi[2]))
            if wp.static(drifting):
                v += real(noise.energy[c]) * drift(model, state, e, k)
        noise.node[e] = vec4(v[0], v[1], v[2], spin)

    @wp.kernel(module=module)
    def bodies(
        # Model:
        model: Model,
        # State:
        state: State,
        step: wp.array(dtype=wp.float64),
        steps: wp.array(dtype=wp.int32),
        # Out:
        noise: Noise,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        scale = real(wp.sqrt(wp.float64(2.0) * noise.energy[c] / step[c]))
        a = normals(noise.seed[c], 0, steps[c], for_shift)
        b = normals(noise.seed[c], 0, steps[c], for_turn)
        if wp.static(shell):
            shift, turn = shell_product(noise.body_root, state, c, a, b)
            shift = scale * shift
            turn = scale * turn
            noise.body[c] = vec6(shift[0], shift[1], shift[2], turn[0], turn[1], turn[2])
            return
        axis = state.pose.body_axis[c]
        body = model.body
        along = body.mobility_along[c]
        across = body.mobility_across[c]
        v = vec3(zero)
        if wp.static(free):
            first = model.first_node[model.first_flagellum[c]]
            axis = state.pose.tangent[first + 1]
            if wp.static(drifting):
                v = (real(noise.energy[c]) * two * (across - along) / state.pose.length[first + 1]) * axis
            own = self_mobility(model, c, model.first_flagellum[c])
            along = wp.max(along - own, zero)
            across = wp.max(across - own, zero)
        u = v + scale * root(axis, along, across, vec3(a[0], a[1], a[2]))
        w = scale * root(axis, body.spin_mobility[c], body.tumble_mobility[c], vec3(b[0], b[1], b[2]))
        noise.body[c] = vec6(u[0], u[1], u[2], w[0], w[1], w[2])

    return SimpleNamespace(elements=elements, bodies=bodies)


def draw_local(model: DeviceModel, state: DeviceState, control: Any, noise: Any, drifting: bool = True) -> None:
    """Thermal velocities of the parts of the mobility that are local, and the drift, into `noise`.

    Args:
        model, state: of the batch.
        control: struct `Control`, with the step that begins and its number.
        noise: struct `Noise`.
        drifting: whether to add the drift kT div M, which is right for steps that resolve all modes.
    """
    switches = model.switches
    pairs, free = switches.pairs != "none", switches.has("free end")
    kernels = _kernels(model.precision, pairs, free, switches.flows.body, drifting)
    inputs = [model.data, state.data, control.step, control.steps, noise]
    wp.launch(kernels.elements, model.element_count, inputs=inputs, device=model.device)
    wp.launch(kernels.bodies, model.cell_count, inputs=inputs, device=model.device)
