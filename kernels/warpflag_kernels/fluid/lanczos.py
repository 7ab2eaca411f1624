"""The random velocities of the Rotne-Prager sum R, self term included: R^1/2 z by Lanczos' process.

With V the orthonormal basis of the Krylov space of R and z, T the tridiagonal matrix of R in it,

    R^1/2 z = |z| V T^1/2 e_1        (Ando, Chow, Saad & Skolnick, J. Chem. Phys. 137, 064106 (2012)).

R is well conditioned (4 to 13 for two flagella, apart or bundled), so five products err by 5e-5 to 6e-3. A cell may ask
for a tolerance instead: products go on until the last one has changed the result by less, relative to its length. A
thread does the sums of a cell; T^1/2 is found in `lanczos_space`.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import random_numbers
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import node_velocity
from warpflag_kernels.fluid import noise as noise_stage
from warpflag_kernels.fluid.lanczos_space import MOST_PRODUCTS, root_function, struct

PRODUCTS = 5  # of R, where no tolerance is asked for
EXHAUSTED = 1.0e-6  # rest of a product over its length below which the Krylov space has no further dimension


@dataclass(frozen=True)
class Process:
    """Lanczos' process on the device.

    Attributes:
        data: the struct `Lanczos`.
        adaptive: whether some cell asks for a tolerance.
    """

    data: Any
    adaptive: bool


def allocate(model: DeviceModel, tolerances: Sequence[float]) -> Process:
    """Room for the process.

    Args:
        model: of the batch.
        tolerances: relative errors that cells ask for; 0: PRODUCTS products.
    """
    p, device, cells = model.precision, model.device, model.cell_count
    z = struct(p)()
    z.basis = wp.zeros((MOST_PRODUCTS + 1) * model.element_count, dtype=p.vec3, device=device)
    for name, count in (
        ("alpha", MOST_PRODUCTS),
        ("beta", MOST_PRODUCTS),
        ("weight", MOST_PRODUCTS),
        ("inverse", MOST_PRODUCTS),
        ("matrix", MOST_PRODUCTS**2),
        ("vectors", MOST_PRODUCTS**2),
    ):
        setattr(z, name, wp.zeros(cells * count, dtype=wp.float64, device=device))
    z.size, z.error = wp.zeros(cells, dtype=wp.float64, device=device), wp.zeros(cells, dtype=wp.float64, device=device)
    z.tolerance = wp.array(list(tolerances), dtype=wp.float64, device=device)
    z.products, z.running = (wp.zeros(cells, dtype=wp.int32, device=device) for _ in range(2))
    z.total = wp.zeros(cells, dtype=wp.int64, device=device)
    z.going = wp.ones(1, dtype=wp.int32, device=device)  # the first pass, without a cell, loads every kernel
    return Process(z, any(tolerances))


@functools.cache
def _kernels(p: Precision, free: bool) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State = structs(p).Model, structs(p).State
    Noise, Lanczos = noise_stage.struct(p), struct(p)
    normals, root = random_numbers.functions(p).normals, root_function(p)
    self_mobility = noise_stage.functions(p, True).self_mobility
    drag_velocity = node_velocity.local(p).drag_velocity
    most, fixed, for_pairs = wp.constant(MOST_PRODUCTS), wp.constant(PRODUCTS), wp.constant(random_numbers.FOR_PAIRS)
    exhausted = wp.constant(wp.float64(EXHAUSTED))
    vec6 = wp.types.vector(6, real)
    module = p.module("lanczos", "free" if free else "")

    @wp.kernel(module=module)
    def begin(
        # Model:
        model: Model,
        # State:
        state: State,
        noise: Noise,
        steps: wp.array(dtype=wp.int32),
        # Out:
        z: Lanczos,
    ):
        """z, of unit length, as the first vector of the basis."""
        c = wp.tid()
        z.running[c] = 0
        if state.active[c] == 0:
            return
        begin_node = model.first_node[model.first_flagellum[c]]
        total = wp.float64(0.0)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            e = model.first_node[k]
            if wp.static(not free):  # r_0 moves with the body
                z.basis[e] = vec3(real(0.0))
                e += 1
            while e < model.first_node[k + 1]:
                xi = normals(noise.seed[c], e - begin_node, steps[c], for_pairs)
                v = vec3(xi[0], xi[1], xi[2])
                z.basis[e] = v
                total += wp.float64(wp.dot(v, v))
                e += 1
            k += 1
        size = wp.sqrt(total)
        scale = real(wp.float64(1.0) / size)
        e = begin_node
        while e < model.first_node[model.first_flagellum[c + 1]]:
            z.basis[e] = scale * z.basis[e]
            e += 1
        z.size[c] = size
        z.products[c] = 0
        z.running[c] = 1
        z.going[0] = 1

    @wp.kernel(module=module)
    def load(
        # Model:
        model: Model,
        # State:
        z: Lanczos,
        # Out:
        state: State,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] != 0 and z.running[c] != 0:
            state.force[e] = z.basis[z.products[c] * model.cell_of.shape[0] + e]
            if wp.static(free) and e == model.first_node[model.flagellum_of[e]]:
                state.body_velocity[c] = vec3(real(0.0))  # only the flow of the others is asked for

    @wp.kernel(module=module)
    def advance(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        z: Lanczos,
    ):
        """One step of the process from the velocities of the last vector, and the root in the space so far."""
        c = wp.tid()
        if state.active[c] == 0 or z.running[c] == 0:
            return
        count = model.cell_of.shape[0]
        n = z.products[c]
        here = n * count
        begin_node = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        alpha = wp.float64(0.0)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            own = self_mobility(model, c, k)
            e = model.first_node[k]
            z.basis[here + count + e] = vec3(real(0.0))
            if wp.static(free):
                q = z.basis[here + e]
                w = state.velocity[e] + own * q
                z.basis[here + count + e] = w
                alpha += wp.float64(wp.dot(q, w))
            e += 1
            while e < model.first_node[k + 1]:
                q = z.basis[here + e]
                w = state.velocity[e] - drag_velocity(model, state, e, k) + own * q
                z.basis[here + count + e] = w
                alpha += wp.float64(wp.dot(q, w))
                e += 1
            k += 1
        beta = wp.float64(0.0)
        if n > 0:
            beta = z.beta[c * most + n - 1]
        rest = wp.float64(0.0)
        e = begin_node
        while e < end:
            w = z.basis[here + count + e] - real(alpha) * z.basis[here + e]
            if n > 0:
                w -= real(beta) * z.basis[here - count + e]
            z.basis[here + count + e] = w
            rest += wp.float64(wp.dot(w, w))
            e += 1
        rest = wp.sqrt(rest)
        z.alpha[c * most + n] = alpha
        z.beta[c * most + n] = rest
        n += 1
        z.products[c] = n
        z.total[c] += wp.int64(1)
        z.error[c] = root(z, c, n)
        enough = n == fixed
        if z.tolerance[c] > wp.float64(0.0):
            enough = (n > 1 and z.error[c] <= z.tolerance[c]) or n == most
        if enough or rest <= exhausted * alpha:
            z.running[c] = 0
            return
        scale = real(wp.float64(1.0) / rest)
        e = begin_node
        while e < end:
            z.basis[here + count + e] = scale * z.basis[here + count + e]
            e += 1

    @wp.kernel(module=module)
    def look(
        # State:
        running: wp.array(dtype=wp.int32),
        # Out:
        going: wp.array(dtype=wp.int32),
    ):
        any_running = int(0)
        for c in range(running.shape[0]):
            any_running = wp.max(any_running, running[c])
        going[0] = any_running

    @wp.kernel(module=module)
    def combine(
        # Model:
        model: Model,
        # State:
        state: State,
        z: Lanczos,
        step: wp.array(dtype=wp.float64),
        # Out:
        noise: Noise,
    ):
        """Adds (2 kT/dt)^1/2 R^1/2 z to the thermal velocities."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        count = model.cell_of.shape[0]
        total = vec3(real(0.0))
        for j in range(z.products[c]):
            total += real(z.weight[c * most + j]) * z.basis[j * count + e]
        scale = real(wp.sqrt(wp.float64(2.0) * noise.energy[c] / step[c]) * z.size[c])
        if wp.static(free) and e == model.first_node[model.flagellum_of[e]]:
            none = real(0.0)
            noise.body[c] = noise.body[c] + scale * vec6(total[0], total[1], total[2], none, none, none)
        else:
            noise.node[e] = noise.node[e] + scale * vec4(total[0], total[1], total[2], real(0.0))

    return SimpleNamespace(begin=begin, load=load, advance=advance, look=look, combine=combine)


def draw_pairs(
    model: DeviceModel,
    state: DeviceState,
    control: Any,
    noise: Any,
    process: Process,
    velocities: Callable[[DeviceModel, DeviceState], None] = node_velocity.node_velocities,
) -> None:
    """Adds the thermal velocities of the pair sum to `noise`; forces and velocities of `state` are overwritten.

    Args:
        model, state: of the batch.
        control: struct `Control`, with the step that begins and its number.
        noise: struct `Noise`, with the local part of this step's velocities.
        process: room to work in.
        velocities: finds node velocities from forces.
    """
    kernels, device, cells, z = (
        _kernels(model.precision, model.switches.has("free end")),
        model.device,
        model.cell_count,
        process.data,
    )

    def multiply() -> None:
        wp.launch(kernels.load, model.element_count, inputs=[model.data, z, state.data], device=device)
        velocities(model, state)
        wp.launch(kernels.advance, cells, inputs=[model.data, state.data, z], device=device)

    def multiply_and_look() -> None:
        multiply()
        wp.launch(kernels.look, 1, inputs=[z.running, z.going], device=device)

    wp.launch(kernels.begin, cells, inputs=[model.data, state.data, noise, control.steps, z], device=device)
    if process.adaptive:
        wp.capture_while(z.going, multiply_and_look)
    else:
        for _ in range(PRODUCTS):
            multiply()
    inputs = [model.data, state.data, z, control.step, noise]
    wp.launch(kernels.combine, model.element_count, inputs=inputs, device=device)
