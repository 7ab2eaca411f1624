"""Node velocities: local anisotropic drag plus the Rotne-Prager pair sum.

Local (the paper's mu_t): [t t/gamma_par + (I - t t)/gamma_perp]/h per node (h/2 at the free end), t the normalised
sum of the adjacent tangents, at the last node the last segment's. Pair sum, a the pair radius:

    r > 2a:   1/(8 pi eta r) [(1 + 2a^2/3r^2) I + (1 - 2a^2/r^2) rr]
    r <= 2a:  1/(6 pi eta a) [(1 - 9r/32a) I + (3r/32a) rr]

It runs over the distinct nodes of the same flagellum, of the others, or both, as the scene says. r_0 belongs to the
body: it moves with the body and its force enters the sum as zero.
"""

import functools

import warp as wp

from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs


@functools.cache
def pair_coefficients(p: Precision):
    """Device function: 8 pi eta times the Rotne-Prager tensor as plain I + along d d, at distance r = |d|, radius a."""
    real = p.real

    @wp.func(module=p.module("mobility_functions"))
    def rotne_prager(r: real, a: real):
        if r > real(2.0) * a:
            q = a * a / (r * r)
            plain = (real(1.0) + real(2.0) / real(3.0) * q) / r
            return plain, (real(1.0) - real(2.0) * q) / (r * r * r)
        near = (real(4.0) / real(3.0) - real(0.375) * r / a) / a
        if r > real(0.0):
            return near, real(1.0) / (real(8.0) * a * a * r)
        return near, real(0.0)

    return rotne_prager


@functools.cache
def _kernel(p: Precision, pairs: str):
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    module = p.module("mobility", pairs)
    within, between = pairs in ("within", "all"), pairs in ("between", "all")

    @wp.func(module=module)
    def pair_sum(
        x: wp.array(dtype=real), f: wp.array(dtype=real), i: wp.int32, begin: wp.int32, end: wp.int32, a: real
    ):
        """Sum over nodes [begin, end) of 8 pi eta times the Rotne-Prager tensor times the force."""
        # Flat scalar loads, scalar accumulators and a while loop are what lets the compiler vectorise this.
        xi = x[3 * i]
        yi = x[3 * i + 1]
        zi = x[3 * i + 2]
        a2 = a * a
        near = real(4.0) * a2
        # The overlapping form in the same units: 8/(6a) = 4/(3a).
        inv_a = real(1.0) / a
        contact = real(4.0) / real(3.0) * inv_a
        slope = real(0.375) * inv_a * inv_a
        vx = real(0.0)
        vy = real(0.0)
        vz = real(0.0)
        j = begin
        while j < end:
            dx = xi - x[3 * j]
            dy = yi - x[3 * j + 1]
            dz = zi - x[3 * j + 2]
            fx = f[3 * j]
            fy = f[3 * j + 1]
            fz = f[3 * j + 2]
            r2 = dx * dx + dy * dy + dz * dz
            safe = wp.where(r2 > real(0.0), r2, real(1.0))
            inv_r2 = real(1.0) / safe
            inv_r = wp.sqrt(inv_r2)
            r = r2 * inv_r  # zero, not one, where two nodes coincide
            q = a2 * inv_r2
            far_i = inv_r * (real(1.0) + real(2.0) / real(3.0) * q)
            far_d = inv_r * inv_r2 * (real(1.0) - real(2.0) * q)
            near_i = contact - slope * r
            near_d = slope * inv_r / real(3.0)
            ci = wp.where(r2 > near, far_i, near_i)
            cd = wp.where(r2 > near, far_d, near_d)
            other = wp.where(j == i, real(0.0), real(1.0))
            df = other * cd * (dx * fx + dy * fy + dz * fz)
            ci = other * ci
            vx += ci * fx + df * dx
            vy += ci * fy + df * dy
            vz += ci * fz + df * dz
            j += 1
        return vec3(vx, vy, vz)

    @wp.kernel(module=module)
    def velocities(
        # Model:
        model: Model,
        # State:
        state: State,
        flat_position: wp.array(dtype=real),
        flat_force: wp.array(dtype=real),
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        begin = model.first_node[k]
        end = model.first_node[k + 1]
        if e == begin:
            state.velocity[e] = state.body_velocity[c] + wp.cross(state.body_spin[c], state.position[e])
            return
        t = state.tangent[e]
        if e + 1 < end:
            t = wp.normalize(t + state.tangent[e + 1])
        force = state.force[e]
        along = wp.dot(t, force) * t
        v = model.mobility_along[e] * along + model.mobility_across[e] * (force - along)
        if wp.static(pairs != "none"):
            a = model.pair_radius[c]
            pair = vec3(real(0.0))
            if wp.static(within and between):
                cell_begin = model.first_node[model.first_flagellum[c]]
                cell_end = model.first_node[model.first_flagellum[c + 1]]
                pair = pair_sum(flat_position, flat_force, e, cell_begin, cell_end, a)
            elif wp.static(within):
                pair = pair_sum(flat_position, flat_force, e, begin, end, a)
            else:
                cell_begin = model.first_node[model.first_flagellum[c]]
                cell_end = model.first_node[model.first_flagellum[c + 1]]
                pair = pair_sum(flat_position, flat_force, e, cell_begin, begin, a)
                pair += pair_sum(flat_position, flat_force, e, end, cell_end, a)
            v += model.pair_mobility[c] * pair
        state.velocity[e] = v

    return velocities


def node_velocities(model: DeviceModel, state: DeviceState) -> None:
    """Velocity of every node in the lab [um/s], into `velocity`; needs the forces and the body's motion."""
    kernel = _kernel(model.precision, model.switches.pairs)
    inputs = [model.data, state.data, state.flat_position, state.flat_force]
    wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)
