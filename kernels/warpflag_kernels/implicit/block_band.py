"""The band of an implicit step's linear system: block Cholesky factors along every flagellum.

    K = D^-1/dt + s H,      K y = D^-1 v,     s = weight of the stiffness

D is the local mobility, H the elastic Hessian. Unknowns of element i are (node increment, spin increment), so a joint
couples elements i, i + 1, i + 2: K is symmetric and block pentadiagonal with 4 x 4 blocks, and is factorised as
C C^T along the flagellum (block Cholesky; an inverse by cofactors in its place loses all digits on fine meshes). The
rows of r_0, which moves with the body, are unit rows; `body_coupling` adds the body.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import simd
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
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
        # D^-1 of a node [E]: the tangent there, drag across it, and drag along it minus that across [pN s/um].
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


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `Band`, zero."""
    p, device, t = model.precision, model.device, types(model.precision)
    cells, flagella, elements = model.cell_count, model.flagellum_count, model.element_count

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=device)

    b = t.Band()
    b.step, b.weight = zeros(cells, wp.float64), zeros(cells, wp.float64)
    b.diagonal, b.lower1, b.lower2 = (zeros(elements, t.mat44) for _ in range(3))
    b.tangent = zeros(elements, p.vec3)
    b.drag_across, b.drag_excess = zeros(elements, p.real), zeros(elements, p.real)
    b.to_body, b.from_body = zeros(3 * flagella, t.mat46), zeros(3 * flagella, t.mat46)
    b.body_block, b.body_columns = zeros(flagella, t.mat66), zeros(6 * elements, p.vec4)
    b.body_inverse, b.singular = zeros(cells, t.mat66), zeros(cells, wp.int32)
    b.groups = model.groups
    if model.plan.chains == "simd":
        b.factors = block_band_simd.build(p, model.groups)
    return b


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of the band: drag of a node, solutions along one flagellum or all of a cell."""
    vec3, vec4, vec6 = p.vec3, p.vec4, types(p).vec6
    Model, Band, Increment = structs(p).Model, types(p).Band, chain_chart.types(p).Increment
    solve, solve_group = cholesky.functions(p).solve, block_band_simd.functions(p).solve

    module = p.module("block_band_functions")

    @wp.func(module=module)
    def drag(band: Band, e: wp.int32, v: vec3):
        """D^-1 v of node e [pN]."""
        t = band.tangent[e]
        return band.drag_across[e] * v + (band.drag_excess[e] * wp.dot(t, v)) * t

    @wp.func(module=module)
    def solve_flagellum(model: Model, band: Band, k: wp.int32, x: Increment):
        """Solves with the factors of flagellum k, the body at rest; in place."""
        solve(model.first_node[k], model.first_node[k + 1], band.diagonal, band.lower1, band.lower2, x.node)

    @wp.func(module=module)
    def solve_cell(model: Model, band: Band, c: wp.int32, x: Increment):
        """The same for every flagellum of cell c, side by side."""
        g = band.groups.first_group[c]
        while g < band.groups.first_group[c + 1]:
            solve_group(band.groups, band.factors, g, model.first_node, x.node)
            g += 1

    @wp.func(module=module)
    def follow(band: Band, e: wp.int32, y: vec4, body: vec6):
        """Element e of a solution, from the one with the body at rest and the increment of the body."""
        for column in range(6):
            y -= body[column] * band.body_columns[6 * e + column]
        return y

    return SimpleNamespace(drag=drag, solve_flagellum=solve_flagellum, solve_cell=solve_cell, follow=follow)


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real, vec3, mat33, mat44, Band = p.real, p.vec3, p.mat33, types(p).mat44, types(p).Band
    Model, State, Stiffness = structs(p).Model, structs(p).State, hessian.struct(p)
    Increment, solve_flagellum = chain_chart.types(p).Increment, functions(p).solve_flagellum
    factorise_along, of_group = cholesky.functions(p).factorise, block_band_simd.functions(p)
    factorise_group, solve_group = of_group.factorise, of_group.solve
    module = p.module("block_band")

    @wp.func(module=module)
    def block(xx: mat33, x_spin: vec3, spin_x: vec3, spin: real):
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
        spin_drag = inv_dt / model.drag.spin_mobility[k]
        if e == first:
            band.diagonal[e] = block(identity, zero3, zero3, spin_drag + s * stiffness.spins[e][0])
            return
        t = state.pose.tangent[e]
        if e < last:
            t = wp.normalize(t + state.pose.tangent[e + 1])
        band.tangent[e] = t
        across = real(1.0) / model.drag.mobility_across[e]
        excess = real(1.0) / model.drag.mobility_along[e] - across
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
        # Out:
        band: Band,  # its work space
        x: Increment,
    ):
        g = wp.tid()
        if state.active[model.cell_of[model.first_node[band.groups.first[g]]]] != 0:
            solve_group(band.groups, band.factors, g, model.first_node, x.node)

    return SimpleNamespace(
        assemble=assemble,
        factorise=factorise,
        factorise_groups=factorise_groups,
        solve_flagella=solve_flagella,
        solve_groups=solve_groups,
    )


def assemble(model: DeviceModel, state: DeviceState, stiffness: Any, band: Any) -> None:
    """The blocks of every row, from the state's pose and the stiffness there."""
    inputs = [model.data, state.data, stiffness, band]
    wp.launch(_kernels(model.precision).assemble, model.element_count, inputs=inputs, device=model.device)


def factorise(model: DeviceModel, state: DeviceState, band: Any) -> None:
    """Cholesky factors of every flagellum; `singular` tells of a cell with a pivot that is not positive."""
    kernels, inputs = _kernels(model.precision), [model.data, state.data, band]
    if model.plan.chains == "simd":
        wp.launch(kernels.factorise_groups, len(band.groups.first), inputs=inputs, device=model.device)
    else:
        wp.launch(kernels.factorise, model.flagellum_count, inputs=inputs, device=model.device)


def solve(model: DeviceModel, state: DeviceState, band: Any, x: Any) -> None:
    """Solutions along every flagellum with the body at rest, in place of the right-hand sides in `x.node`."""
    kernels, inputs = _kernels(model.precision), [model.data, state.data, band, x]
    if model.plan.chains == "simd":
        wp.launch(kernels.solve_groups, len(band.groups.first), inputs=inputs, device=model.device)
    else:
        wp.launch(kernels.solve_flagella, model.flagellum_count, inputs=inputs, device=model.device)
