"""The linear system of an implicit step: one block band per flagellum, one 6 x 6 block per body.

    K = D^-1/dt + s H,      K y = D^-1 v,     s = weight of the stiffness

D is the local mobility, H the elastic Hessian. Unknowns of element i are (node increment, spin increment), so a joint
couples elements i, i + 1, i + 2: K is symmetric and block pentadiagonal with 4 x 4 blocks, and is factorised as
C C^T along the flagellum (block Cholesky; an inverse by cofactors in its place loses all digits on fine meshes). The
rows of r_0, which moves with the body, are unit rows; its coupling goes through the six unknowns of the body (u, w)
and a Schur complement:

    S = 1 + dt s M_b (H_bb - H_bf W),    W = K^-1 s H_fb
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import simd
from warpflag_kernels.base.types import DeviceModel, DeviceState, Precision, structs
from warpflag_kernels.implicit import block_band_simd, cholesky
from warpflag_kernels.rod import chain_chart, hessian


@functools.cache
def types(p: Precision) -> SimpleNamespace:
    """Block types, and the struct `Band`."""
    real = p.real
    mat44 = wp.types.matrix((4, 4), real)
    mat46 = wp.types.matrix((4, 6), real)
    mat66 = wp.types.matrix((6, 6), real)
    Groups, Factors = simd.struct(), block_band_simd.struct(p)

    @wp.struct
    class Band:
        # Per cell [C], set by the stepper.
        step: wp.array(dtype=wp.float64)  # dt [s]
        weight: wp.array(dtype=wp.float64)  # s
        # Blocks of row i [E]: to i, i - 1, i - 2; replaced by C_ii^-1, C_(i,i-1), C_(i,i-2) unless in `factors`.
        diagonal: wp.array(dtype=mat44)
        lower1: wp.array(dtype=mat44)
        lower2: wp.array(dtype=mat44)
        # D^-1 of a node [E]: the tangent there, drag across it and what more there is along it [pN s/um].
        tangent: wp.array(dtype=p.vec3)
        drag_across: wp.array(dtype=real)
        drag_excess: wp.array(dtype=real)
        # Coupling to the body.
        to_body: wp.array(dtype=mat46)  # [K * 3]: H_fb of elements 0, 1, 2
        from_body: wp.array(dtype=mat46)  # [K * 3]: H_bf^T; differs without the bearing torque
        body_block: wp.array(dtype=mat66)  # [K]: the flagellum's share of H_bb - H_bf W
        body_columns: wp.array(dtype=p.vec4)  # [E * 6]: W, column after column of an element
        body_inverse: wp.array(dtype=mat66)  # [C]: S^-1
        singular: wp.array(dtype=wp.int32)  # [C], 1: a pivot was not positive
        # Flagella side by side.
        groups: Groups
        factors: Factors

    return SimpleNamespace(mat44=mat44, mat46=mat46, mat66=mat66, vec6=wp.types.vector(6, real), Band=Band)


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of the band: the body's mobility, and the solution along one flagellum."""
    vec3, vec4, vec6 = p.vec3, p.vec4, types(p).vec6
    Model, State, Band, Increment = structs(p).Model, structs(p).State, types(p).Band, chain_chart.types(p).Increment
    solve, solve_group = cholesky.functions(p).solve, block_band_simd.functions(p).solve

    @wp.func(module=p.module("banded_functions"))
    def body_mobility(model: Model, state: State, c: wp.int32, force: vec3, torque: vec3):
        """Velocity (u, w) of a body under a force and a torque."""
        axis = state.body_axis[c]
        force_along = wp.dot(axis, force) * axis
        torque_along = wp.dot(axis, torque) * axis
        u = model.body_mobility_along[c] * force_along + model.body_mobility_across[c] * (force - force_along)
        w = model.body_spin_mobility[c] * torque_along + model.body_tumble_mobility[c] * (torque - torque_along)
        return vec6(u[0], u[1], u[2], w[0], w[1], w[2])

    @wp.func(module=p.module("banded_functions"))
    def drag(band: Band, e: wp.int32, v: vec3):
        """D^-1 v of node e [pN]."""
        t = band.tangent[e]
        return band.drag_across[e] * v + (band.drag_excess[e] * wp.dot(t, v)) * t

    @wp.func(module=p.module("banded_functions"))
    def solve_flagellum(model: Model, band: Band, k: wp.int32, x: Increment):
        """Solves with the factors of flagellum k, the body at rest; in place."""
        solve(model.first_node[k], model.first_node[k + 1], band.diagonal, band.lower1, band.lower2, x.node)

    @wp.func(module=p.module("banded_functions"))
    def solve_cell(model: Model, band: Band, c: wp.int32, x: Increment):
        """The same for every flagellum of cell c, side by side."""
        g = band.groups.first_group[c]
        while g < band.groups.first_group[c + 1]:
            solve_group(band.groups, band.factors, g, model.first_node, x.node)
            g += 1

    @wp.func(module=p.module("banded_functions"))
    def follow(band: Band, e: wp.int32, y: vec4, body: vec6):
        """Element e of a solution, from the one with the body at rest and the increment of the body."""
        for column in range(6):
            y -= body[column] * band.body_columns[6 * e + column]
        return y

    return SimpleNamespace(
        body_mobility=body_mobility, drag=drag, solve_flagellum=solve_flagellum, solve_cell=solve_cell, follow=follow
    )


@functools.cache
def _kernels(p: Precision, bearing_torque: bool) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Increment = chain_chart.types(p).Increment
    t = types(p)
    mat44, mat46, mat66, vec6, Band = t.mat44, t.mat46, t.mat66, t.vec6, t.Band
    Model, State, Stiffness = structs(p).Model, structs(p).State, hessian.struct(p)
    body_mobility, solve_flagellum = functions(p).body_mobility, functions(p).solve_flagellum
    factorise_along, solve_column = cholesky.functions(p).factorise, cholesky.functions(p).solve_column
    follow, of_group = functions(p).follow, block_band_simd.functions(p)
    factorise_group, solve_columns, solve_group = of_group.factorise, of_group.columns, of_group.solve
    module = p.module("banded", "bearing" if bearing_torque else "")

    @wp.func(module=module)
    def block(xx: p.mat33, x_spin: vec3, spin_x: vec3, spin: real):
        return mat44(
            xx[0, 0], xx[0, 1], xx[0, 2], x_spin[0],
            xx[1, 0], xx[1, 1], xx[1, 2], x_spin[1],
            xx[2, 0], xx[2, 1], xx[2, 2], x_spin[2],
            spin_x[0], spin_x[1], spin_x[2], spin,
        )  # fmt: skip

    @wp.kernel(module=module)
    def assemble(
        # Model:
        model: Model,
        # State:
        state: State,
        stiffness: Stiffness,
        # Out:
        band: Band,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        first = model.first_node[k]
        last = model.first_node[k + 1] - 1
        s = real(band.weight[c])
        inv_dt = real(wp.float64(1.0) / band.step[c])
        identity = wp.identity(3, dtype=real)
        zero3 = vec3(real(0.0))
        spin_drag = inv_dt / model.spin_mobility[k]
        if e == first:
            band.diagonal[e] = block(identity, zero3, zero3, spin_drag + s * stiffness.spins[e][0])
            return
        t = state.tangent[e]
        if e < last:
            t = wp.normalize(t + state.tangent[e + 1])
        band.tangent[e] = t
        across = real(1.0) / model.mobility_across[e]
        excess = real(1.0) / model.mobility_along[e] - across
        band.drag_across[e] = across
        band.drag_excess[e] = excess
        b = e - 1  # the joint before: this segment is its f
        drag = (inv_dt * across) * identity + (inv_dt * excess) * wp.outer(t, t)
        xx = stiffness.ff[b] + stiffness.stretch[e]
        x_spin = stiffness.f_second[b]
        spin = stiffness.spins[b][2]
        # To element e - 1.
        lower_xx = stiffness.fe[b] - stiffness.ff[b] - stiffness.stretch[e]
        lower_x_spin = stiffness.f_first[b]
        lower_spin_x = stiffness.e_second[b] - stiffness.f_second[b]
        lower_spin = stiffness.spins[b][1]
        if e < last:
            xx += stiffness.ee[e] - stiffness.fe[e] - wp.transpose(stiffness.fe[e]) + stiffness.ff[e]
            xx += stiffness.stretch[e + 1]
            x_spin += stiffness.e_first[e] - stiffness.f_first[e]
            spin += stiffness.spins[e][0]
            lower_xx += stiffness.fe[e] - stiffness.ee[e]
            lower_spin_x -= stiffness.e_first[e]
            if e + 1 < last:
                xx += stiffness.ee[e + 1]
        if e == first + 1:
            lower_xx = identity * real(0.0)  # r_0 moves with the body
            lower_spin_x = zero3
        band.diagonal[e] = block(drag + s * xx, s * x_spin, s * x_spin, spin_drag + s * spin)
        band.lower1[e] = s * block(lower_xx, lower_x_spin, lower_spin_x, lower_spin)
        if e > first + 2:
            band.lower2[e] = s * block(-stiffness.fe[b], zero3, -stiffness.e_second[b], real(0.0))
        else:
            band.lower2[e] = mat44(real(0.0))

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
        m = state.tangent[e0]
        y = state.position[e0]
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

    @wp.kernel(module=module)
    def factorise(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        band: Band,
    ):
        k = wp.tid()
        first = model.first_node[k]
        end = model.first_node[k + 1]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        if not factorise_along(first, end, band.diagonal, band.lower1, band.lower2):
            band.singular[c] = 1

    @wp.kernel(module=module)
    def factorise_groups(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        band: Band,
    ):
        g = wp.tid()
        c = model.cell_of[model.first_node[band.groups.first[g]]]
        if state.active[c] != 0:
            factorise_group(
                band.groups, band.factors, g, model.first_node,
                band.diagonal, band.lower1, band.lower2, band.singular, c,
            )  # fmt: skip

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
            v = body_mobility(
                model,
                state,
                c,
                vec3(total[0, b], total[1, b], total[2, b]),
                vec3(total[3, b], total[4, b], total[5, b]),
            )
            i = int(0)
            while i < 6:
                system[i, b] = scale * v[i]
                i += 1
            system[b, b] = system[b, b] + real(1.0)
            b += 1
        band.body_inverse[c] = inverse6(system)

    @wp.kernel(module=module)
    def solve_flagella(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        # Out:
        x: Increment,
    ):
        k = wp.tid()
        if state.active[model.cell_of[model.first_node[k]]] != 0:
            solve_flagellum(model, band, k, x)

    @wp.kernel(module=module)
    def solve_groups(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        # Out:
        x: Increment,
    ):
        g = wp.tid()
        if state.active[model.cell_of[model.first_node[band.groups.first[g]]]] != 0:
            solve_group(band.groups, band.factors, g, model.first_node, x.node)

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
        if state.active[c] == 0:
            return
        back = vec6(real(0.0))
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            e = model.first_node[k]
            for j in range(3):
                back += wp.transpose(band.from_body[3 * k + j]) * x.node[e + j]
            k += 1
        v = body_mobility(model, state, c, vec3(back[0], back[1], back[2]), vec3(back[3], back[4], back[5]))
        rate = x.body[c] - real(band.weight[c]) * v
        x.body[c] = real(band.step[c]) * (band.body_inverse[c] * rate)

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

    return SimpleNamespace(
        solve_flagella=solve_flagella,
        solve_groups=solve_groups,
        solve_bodies=solve_bodies,
        follow_bodies=follow_bodies,
        assemble=assemble,
        couple_body=couple_body,
        factorise=factorise,
        factorise_groups=factorise_groups,
        body_columns=body_columns,
        body_columns_of_groups=body_columns_of_groups,
        factorise_bodies=factorise_bodies,
    )


def _kernels_for(model: DeviceModel) -> SimpleNamespace:
    return _kernels(model.precision, model.switches.bearing_torque)


def factorise(model: DeviceModel, state: DeviceState, stiffness: Any, band: Any) -> None:
    """Assembles and factorises the system of every flagellum and body; `singular` tells of a failed pivot."""
    kernels, device = _kernels_for(model), model.device
    inputs = [model.data, state.data, stiffness, band]
    wp.launch(kernels.assemble, model.element_count, inputs=inputs, device=device)
    wp.launch(kernels.couple_body, model.flagellum_count, inputs=inputs, device=device)
    inputs = [model.data, state.data, band]
    if model.one_thread_per_cell:
        groups = len(band.groups.first)
        wp.launch(kernels.factorise_groups, groups, inputs=inputs, device=device)
        wp.launch(kernels.body_columns_of_groups, groups, inputs=inputs, device=device)
    else:
        wp.launch(kernels.factorise, model.flagellum_count, inputs=inputs, device=device)
        wp.launch(kernels.body_columns, model.flagellum_count * 6, inputs=inputs, device=device)
    wp.launch(kernels.factorise_bodies, model.cell_count, inputs=inputs, device=device)


def solve(model: DeviceModel, state: DeviceState, band: Any, x: Any) -> None:
    """P: from D^-1 times velocities (of the bodies: plain velocities) to the increment they cause; in place."""
    kernels = _kernels_for(model)
    inputs, device = [model.data, state.data, band, x], model.device
    if model.one_thread_per_cell:
        wp.launch(kernels.solve_groups, len(band.groups.first), inputs=inputs, device=device)
    else:
        wp.launch(kernels.solve_flagella, model.flagellum_count, inputs=inputs, device=device)
    wp.launch(kernels.solve_bodies, model.cell_count, inputs=inputs, device=device)
    wp.launch(kernels.follow_bodies, model.element_count, inputs=inputs, device=device)
