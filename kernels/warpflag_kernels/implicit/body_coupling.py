"""The body in an implicit step's linear system: its coupling to the flagella and a Schur complement for its motion.

r_0 and the motor axis of every flagellum move with the body, so its six unknowns (u, w) couple to the first three
elements of every flagellum. With W the band's solution for these six columns and M_b the body's mobility,

    S = 1 + dt s M_b (H_bb - H_bf W),    W = K^-1 s H_fb.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body
from warpflag_kernels.implicit import block_band, block_band_simd, cholesky
from warpflag_kernels.rod import chain_chart, hessian


@functools.cache
def functions(p: Precision, shell: bool) -> SimpleNamespace:
    """Device functions: `body_rate`, the motion of a body under a load, and `inverse6`, the inverse of a matrix.

    Args:
        p: precision.
        shell: whether bodies are shells of beads; else spheroids.
    """
    real, vec3, vec6, mat66 = p.real, p.vec3, block_band.types(p).vec6, block_band.types(p).mat66
    Model, State, respond = structs(p).Model, structs(p).State, body.mobility(p, shell).respond
    module = p.module("body_coupling_functions", "shell" * shell)

    @wp.func(module=module)
    def body_rate(model: Model, state: State, c: wp.int32, load: vec6):
        """Velocity [um/s] and angular velocity [rad/s] of a body under force [pN] and torque [pN um]."""
        u, w = respond(model, state, c, vec3(load[0], load[1], load[2]), vec3(load[3], load[4], load[5]))
        return vec6(u[0], u[1], u[2], w[0], w[1], w[2])

    @wp.func(module=module)
    def inverse6(a: mat66):
        """Inverse by Gauss-Jordan with row pivoting."""
        m = a
        inv = wp.identity(6, dtype=real)
        col = int(0)
        while col < 6:
            best = int(col)
            r = int(col) + 1
            while r < 6:
                if wp.abs(m[r, col]) > wp.abs(m[best, col]):
                    best = r
                r += 1
            j = int(0)
            while j < 6:
                swap = m[col, j]
                m[col, j] = m[best, j]
                m[best, j] = swap
                swap = inv[col, j]
                inv[col, j] = inv[best, j]
                inv[best, j] = swap
                j += 1
            scale = real(1.0) / m[col, col]
            j = int(0)
            while j < 6:
                m[col, j] = m[col, j] * scale
                inv[col, j] = inv[col, j] * scale
                j += 1
            r = int(0)
            while r < 6:
                if r != col:
                    f = m[r, col]
                    j = int(0)
                    while j < 6:
                        m[r, j] = m[r, j] - f * m[col, j]
                        inv[r, j] = inv[r, j] - f * inv[col, j]
                        j += 1
                r += 1
            col += 1
        return inv

    return SimpleNamespace(body_rate=body_rate, inverse6=inverse6)


@functools.cache
def _kernels(p: Precision, bearing_torque: bool, shell: bool) -> SimpleNamespace:
    real, vec3, t = p.real, p.vec3, block_band.types(p)
    mat46, mat66, vec6, Band = t.mat46, t.mat66, t.vec6, t.Band
    Model, State, Stiffness = structs(p).Model, structs(p).State, hessian.struct(p)
    Increment, body_rate = chain_chart.types(p).Increment, functions(p, shell).body_rate
    inverse6 = functions(p, shell).inverse6
    solve_column, solve_columns = cholesky.functions(p).solve_column, block_band_simd.functions(p).columns
    follow, solve_cell = block_band.functions(p).follow, block_band.functions(p).solve_cell
    module = p.module("body_coupling", "_".join([*["bearing"] * bearing_torque, *["shell"] * shell]))

    @wp.kernel(module=module)
    def couple_body(
        # Model:
        model: Model,
        # State:
        state: State,
        stiffness: Stiffness,
        # Out:
        band: Band,
    ):
        k = wp.tid()
        e0 = model.first_node[k]
        c = model.cell_of[e0]
        if state.active[c] == 0:
            return
        e1 = e0 + 1
        m = state.pose.tangent[e0]
        y = state.pose.position[e0]
        bearing = real(wp.static(1.0 if bearing_torque else 0.0))
        to0 = mat46(real(0.0))
        to1 = mat46(real(0.0))
        to2 = mat46(real(0.0))
        from0 = mat46(real(0.0))
        from1 = mat46(real(0.0))
        shared = mat66(real(0.0))
        b = int(0)
        while b < 6:
            u = vec3(real(0.0))
            w = vec3(real(0.0))
            if b < 3:
                u[b] = real(1.0)
            else:
                w[b - 3] = real(1.0)
            d0 = wp.cross(w, m)
            d1 = -(u + wp.cross(w, y))
            # Gradients of segments 0, 1, 2 and torques on spins 0, 1, 2 when the body moves.
            g0 = stiffness.ee[e0] * d0 + wp.transpose(stiffness.fe[e0]) * d1
            hook = stiffness.fe[e0] * d0
            own = (stiffness.ff[e0] + stiffness.ee[e1] + stiffness.stretch[e1]) * d1
            g1 = own + hook
            g2 = stiffness.fe[e1] * d1
            hook_first = wp.dot(stiffness.e_first[e0], d0)
            hook_second = wp.dot(stiffness.e_second[e0], d0)
            first = wp.dot(stiffness.f_first[e0], d1)
            second = wp.dot(stiffness.f_second[e0] + stiffness.e_first[e1], d1)
            to0[3, b] = hook_first + first
            to1[3, b] = hook_second + second
            to2[3, b] = wp.dot(stiffness.e_second[e1], d1)
            from0[3, b] = bearing * hook_first + first
            from1[3, b] = bearing * hook_second + second
            torque = bearing * wp.cross(m, g0) - wp.cross(y, g1)
            i = int(0)
            while i < 3:
                to1[i, b] = g1[i] - g2[i]
                to2[i, b] = g2[i]
                from1[i, b] = own[i] + bearing * hook[i] - g2[i]
                shared[i, b] = -g1[i]
                shared[3 + i, b] = torque[i]
                i += 1
            b += 1
        band.to_body[3 * k] = to0
        band.to_body[3 * k + 1] = to1
        band.to_body[3 * k + 2] = to2
        band.from_body[3 * k] = from0
        band.from_body[3 * k + 1] = from1
        band.from_body[3 * k + 2] = to2
        band.body_block[k] = shared

    @wp.func(module=module)
    def take_share(model: Model, band: Band, k: wp.int32, column: wp.int32):
        """The share of flagellum k in a column of H_bf W."""
        first = model.first_node[k]
        shared = vec6(real(0.0))
        for j in range(3):
            shared += wp.transpose(band.from_body[3 * k + j]) * band.body_columns[6 * (first + j) + column]
        for row in range(6):
            band.body_block[k][row, column] -= shared[row]

    @wp.kernel(module=module)
    def body_columns(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        band: Band,
    ):
        thread = wp.tid()
        k = thread / 6
        column = thread % 6
        first = model.first_node[k]
        end = model.first_node[k + 1]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        s = real(band.weight[c])
        solve_column(
            first, end, band.diagonal, band.lower1, band.lower2, s, band.to_body, 3 * k, column, band.body_columns
        )
        take_share(model, band, k, column)

    @wp.kernel(module=module)
    def body_columns_of_groups(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        band: Band,
    ):
        g = wp.tid()
        k = band.groups.first[g]
        end = k + band.groups.count[g]
        c = model.cell_of[model.first_node[k]]
        if state.active[c] == 0:
            return
        solve_columns(
            band.groups, band.factors, g, model.first_node, real(band.weight[c]), band.to_body, band.body_columns
        )
        while k < end:
            for column in range(6):
                take_share(model, band, k, column)
            k += 1

    @wp.kernel(module=module)
    def factorise_bodies(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        band: Band,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        total = mat66(real(0.0))
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            total += band.body_block[k]
            k += 1
        scale = real(band.step[c] * band.weight[c])
        system = mat66(real(0.0))
        b = int(0)
        while b < 6:
            column = vec6(total[0, b], total[1, b], total[2, b], total[3, b], total[4, b], total[5, b])
            v = body_rate(model, state, c, column)
            i = int(0)
            while i < 6:
                system[i, b] = scale * v[i]
                i += 1
            system[b, b] = system[b, b] + real(1.0)
            b += 1
        band.body_inverse[c] = inverse6(system)

    @wp.func(module=module)
    def solve_body(model: Model, state: State, band: Band, c: wp.int32, x: Increment):
        """Motion of the body of cell c from the solutions with the body at rest, in place of its velocities."""
        back = vec6(real(0.0))
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            e = model.first_node[k]
            for j in range(3):
                back += wp.transpose(band.from_body[3 * k + j]) * x.node[e + j]
            k += 1
        rate = x.body[c] - real(band.weight[c]) * body_rate(model, state, c, back)
        x.body[c] = real(band.step[c]) * (band.body_inverse[c] * rate)

    @wp.kernel(module=module)
    def solve_bodies(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        # Out:
        x: Increment,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            solve_body(model, state, band, c, x)

    @wp.kernel(module=module)
    def follow_bodies(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        # Out:
        x: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] != 0:
            x.node[e] = follow(band, e, x.node[e], x.body[c])

    @wp.kernel(module=module)
    def solve_cells(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        band: Band,  # its work space
        x: Increment,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        solve_cell(model, band, c, x)
        solve_body(model, state, band, c, x)
        moved = x.body[c]
        e = model.first_node[model.first_flagellum[c]]
        while e < model.first_node[model.first_flagellum[c + 1]]:
            x.node[e] = follow(band, e, x.node[e], moved)
            e += 1

    return SimpleNamespace(
        couple_body=couple_body,
        body_columns=body_columns,
        body_columns_of_groups=body_columns_of_groups,
        factorise_bodies=factorise_bodies,
        solve_bodies=solve_bodies,
        follow_bodies=follow_bodies,
        solve_cells=solve_cells,
    )


def _kernels_of(model: DeviceModel) -> SimpleNamespace:
    return _kernels(model.precision, model.switches.has("bearing"), model.switches.flows.body)


def couple(model: DeviceModel, state: DeviceState, stiffness: Any, band: Any) -> None:
    """Blocks between the body and the first elements of every flagellum."""
    inputs = [model.data, state.data, stiffness, band]
    wp.launch(_kernels_of(model).couple_body, model.flagellum_count, inputs=inputs, device=model.device)


def factorise(model: DeviceModel, state: DeviceState, band: Any) -> None:
    """The Schur complement of every body and its inverse; needs the factors of the flagella."""
    kernels, inputs, device = _kernels_of(model), [model.data, state.data, band], model.device
    if model.plan.chains == "simd":
        wp.launch(kernels.body_columns_of_groups, len(band.groups.first), inputs=inputs, device=device)
    else:
        wp.launch(kernels.body_columns, model.flagellum_count * 6, inputs=inputs, device=device)
    wp.launch(kernels.factorise_bodies, model.cell_count, inputs=inputs, device=device)


def solve(model: DeviceModel, state: DeviceState, band: Any, x: Any) -> None:
    """Flagella and bodies together: from right-hand sides to the solution, in place."""
    kernels, inputs = _kernels_of(model), [model.data, state.data, band, x]
    if model.plan.by_cells and model.plan.chains == "simd":
        wp.launch(kernels.solve_cells, model.cell_count, inputs=inputs, device=model.device)
        return
    block_band.solve(model, state, band, x)
    wp.launch(kernels.solve_bodies, model.cell_count, inputs=inputs, device=model.device)
    wp.launch(kernels.follow_bodies, model.element_count, inputs=inputs, device=model.device)
