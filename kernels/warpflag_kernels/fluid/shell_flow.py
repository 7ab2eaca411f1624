"""Flow round the body: its surface obstructs the flow of the nodes and carries fluid along.

The body is a rigid shell of beads. With C the Rotne-Prager tensors of beads and nodes (two radii), M_c those of beads,
K the rigid motion of the beads, F forces on the nodes and F_b force and torque on the body,

    held loads    mu = M_c^-1 C F            their resultant G = K^T mu
    body          U = N_b (F_b + G)          N_b = (K^T M_c^-1 K)^-1
    loads         lambda = M_c^-1 K U - mu   nodes move with C^T lambda, too.

That is the mobility of nodes and beads under one positive definite tensor, with the beads constrained to move rigidly:
the nodes' part less C^T M_c^-1 C, a Schur complement, plus a congruence of N_b, so symmetric and positive definite
whatever the pose (docs/hydrodynamics.md). M_c^-1, M_c^-1 K and N_b are constant in body axes, to which nodes are
turned. A body that is held by a switch has an N_b without that motion: it still obstructs the flow.

These are the device functions; `body_flow` has the kernels.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.native import native
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import structs
from warpflag_kernels.fluid import shell as shell_stage


@functools.cache
def functions(p: Precision, pair: Precision, stored: bool, placed: bool = False) -> SimpleNamespace:
    """Device functions: `obstruct` and `carry` for one cell; what they are made of for one node, bead or number.

    Args:
        p: precision of the run.
        pair: precision of the beads' flows.
        stored: whether the coefficients of nodes and beads are stored.
        placed: whether `obstruct` finds the nodes' positions and the coefficients in the struct already.
    """
    real, vec3, mat33, Shell = pair.real, pair.vec3, p.mat33, shell_stage.struct(pair)
    Model, State = structs(p).Model, structs(p).State
    module = p.module("body_flow_functions", "_".join([pair.name, *["stored"] * stored, *["placed"] * placed]))
    words = {"UNEQUAL": native(__file__, "unequal_tensor", pair)}

    @wp.func_native(native(__file__, "bead_coefficients", pair, **words))
    def find_row(shell: Shell, i: wp.int32, own: wp.int32, row: wp.int32, n: wp.int32, a: real, b: real): ...

    @wp.func_native(native(__file__, "flow_at_beads", pair))
    def add_flows(shell: Shell, i: wp.int32, own: wp.int32, row: wp.int32, at: wp.int32, n: wp.int32): ...

    @wp.func_native(native(__file__, "flow_at_bead", pair, **words))
    def gather_flow(shell: Shell, j: wp.int32, begin: wp.int32, end: wp.int32, a: real, b: real) -> vec3: ...

    @wp.func_native(native(__file__, "flow_of_beads", pair))
    def flow_of_beads(shell: Shell, i: wp.int32, own: wp.int32, row: wp.int32, at: wp.int32, n: wp.int32) -> vec3: ...

    @wp.func_native(native(__file__, "flow_from_beads", pair, **words))
    def flow_from_beads(
        shell: Shell, i: wp.int32, own: wp.int32, at: wp.int32, n: wp.int32, a: real, b: real
    ) -> vec3: ...

    @wp.func_native(native(__file__, "held_loads", pair))
    def hold(shell: Shell, entry: wp.int32, at: wp.int32, n: wp.int32): ...

    @wp.func_native(native(__file__, "shell_resultant", pair))
    def resultant(shell: Shell, own: wp.int32, at: wp.int32, n: wp.int32, i: wp.int32) -> real: ...

    @wp.func_native(native(__file__, "carried_loads", pair))
    def carried_loads(
        shell: Shell, own: wp.int32, at: wp.int32, n: wp.int32, first: wp.int32, end: wp.int32, u: vec3, w: vec3
    ): ...

    @wp.func(module=module)
    def axes_of(state: State, c: wp.int32):
        """Body axes of cell c as columns."""
        q = state.pose.body_orientation[c]
        return wp.quat_to_matrix(p.quat(p.real(q[0]), p.real(q[1]), p.real(q[2]), p.real(q[3])))

    @wp.func(module=module)
    def place(state: State, shell: Shell, e: wp.int32, axes: mat33):
        """Position of node e in body axes."""
        x = wp.transpose(axes) * state.pose.position[e]
        shell.px[e] = real(x[0])
        shell.py[e] = real(x[1])
        shell.pz[e] = real(x[2])

    @wp.func(module=module)
    def pull(shell: Shell, e: wp.int32, axes: mat33, force: p.vec3):
        """Force on node e in body axes."""
        f = wp.transpose(axes) * force
        shell.fx[e] = real(f[0])
        shell.fy[e] = real(f[1])
        shell.fz[e] = real(f[2])

    @wp.func(module=module)
    def row_of(model: Model, shell: Shell, e: wp.int32, c: wp.int32):
        """Where the stored coefficients of node e of cell c begin."""
        own = e - model.first_node[model.first_flagellum[c]]
        return shell.pair[c] + own * (shell.first[c + 1] - shell.first[c])

    @wp.func(module=module)
    def find(model: Model, shell: Shell, e: wp.int32, k: wp.int32, c: wp.int32):
        """Coefficients of node e of flagellum k and all beads, from its place."""
        row, n = row_of(model, shell, e, c), shell.first[c + 1] - shell.first[c]
        find_row(shell, e, shell.own[c], row, n, real(model.pairs.radius[k]), shell.radius[c])

    @wp.func(module=module)
    def flow_at_bead(model: Model, shell: Shell, c: wp.int32, j: wp.int32):
        """Flow of all nodes of cell c at its bead j."""
        n = shell.first[c + 1] - shell.first[c]
        at = 3 * shell.first[c] + j
        bead = shell.own[c] + j
        total = vec3(real(0.0))
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            a = real(model.pairs.radius[k])
            total += gather_flow(shell, bead, model.first_node[k] + 1, model.first_node[k + 1], a, shell.radius[c])
            k += 1
        shell.flow[at] = total[0]
        shell.flow[at + n] = total[1]
        shell.flow[at + 2 * n] = total[2]

    @wp.func(module=module)
    def hold_row(shell: Shell, c: wp.int32, r: wp.int32):
        """Number r of the held loads of cell c."""
        rows = 3 * (shell.first[c + 1] - shell.first[c])
        at = 3 * shell.first[c]
        total = real(0.0)
        k = int(0)
        while k < rows:
            total += shell.inverse[shell.entry[c] + k * rows + r] * shell.flow[at + k]
            k += 1
        shell.load[at + r] = total

    @wp.func(module=module)
    def sum_loads(shell: Shell, c: wp.int32, axes: mat33):
        """Resultant G of the held loads of cell c, in lab axes."""
        n = shell.first[c + 1] - shell.first[c]
        at = 3 * shell.first[c]
        own = shell.own[c]
        f = p.vec3(p.real(0.0))
        t = p.vec3(p.real(0.0))
        for i in range(3):
            f[i] = p.real(resultant(shell, own, at, n, i))
            t[i] = p.real(resultant(shell, own, at, n, i + 3))
        f = axes * f
        t = axes * t
        shell.force[c] = vec3(real(f[0]), real(f[1]), real(f[2]))
        shell.torque[c] = vec3(real(t[0]), real(t[1]), real(t[2]))

    @wp.func(module=module)
    def hand_over(state: State, shell: Shell, c: wp.int32):
        """G to the body of cell c."""
        f = shell.force[c]
        t = shell.torque[c]
        state.surface_force[c] = p.vec3(p.real(f[0]), p.real(f[1]), p.real(f[2]))
        state.surface_torque[c] = p.vec3(p.real(t[0]), p.real(t[1]), p.real(t[2]))

    @wp.func(module=module)
    def load_rows(
        model: Model, shell: Shell, c: wp.int32, axes: mat33, velocity: p.vec3, spin: p.vec3,
        first: wp.int32, end: wp.int32,
    ):  # fmt: skip
        """Loads of cell c whose body moves, in numbers [first, end) of them."""
        resistance = p.real(1.0) / model.pairs.mobility[c]
        u = resistance * (wp.transpose(axes) * velocity)
        w = resistance * (wp.transpose(axes) * spin)
        n = shell.first[c + 1] - shell.first[c]
        at = 3 * shell.first[c]
        carried_loads(
            shell, shell.own[c], at, n, first, end, vec3(real(u[0]), real(u[1]), real(u[2])),
            vec3(real(w[0]), real(w[1]), real(w[2])),
        )  # fmt: skip

    @wp.func(module=module)
    def flow_at_node(model: Model, shell: Shell, e: wp.int32, k: wp.int32, c: wp.int32, axes: mat33):
        """Velocity of node e of flagellum k that the loads on the body cause [um/s], lab axes."""
        n = shell.first[c + 1] - shell.first[c]
        v = vec3(real(0.0))
        if wp.static(stored):
            v = flow_of_beads(shell, e, shell.own[c], row_of(model, shell, e, c), 3 * shell.first[c], n)
        else:
            a = real(model.pairs.radius[k])
            v = flow_from_beads(shell, e, shell.own[c], 3 * shell.first[c], n, a, shell.radius[c])
        return model.pairs.mobility[c] * (axes * p.vec3(p.real(v[0]), p.real(v[1]), p.real(v[2])))

    @wp.func(module=module)
    def answer(model: Model, shell: Shell, c: wp.int32):
        """Held loads of cell c from the forces on its nodes, with stored coefficients, by one thread."""
        n = shell.first[c + 1] - shell.first[c]
        at = 3 * shell.first[c]
        r = at
        while r < at + 3 * n:
            shell.flow[r] = real(0.0)
            r += 1
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            e = model.first_node[k] + 1
            while e < model.first_node[k + 1]:
                if shell.fx[e] != real(0.0) or shell.fy[e] != real(0.0) or shell.fz[e] != real(0.0):
                    add_flows(shell, e, shell.own[c], row_of(model, shell, e, c), at, n)
                e += 1
            k += 1
        hold(shell, shell.entry[c], at, n)

    @wp.func(module=module)
    def obstruct(model: Model, state: State, shell: Shell, c: wp.int32):
        """Held loads of cell c and their resultant, by one thread."""
        axes = axes_of(state, c)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            e = model.first_node[k] + 1
            while e < model.first_node[k + 1]:
                if wp.static(not placed):
                    place(state, shell, e, axes)
                    find(model, shell, e, k, c)
                pull(shell, e, axes, state.force[e])
                e += 1
            k += 1
        answer(model, shell, c)
        sum_loads(shell, c, axes)
        hand_over(state, shell, c)

    @wp.func(module=module)
    def carry(model: Model, state: State, shell: Shell, c: wp.int32):
        """Adds to the nodes of cell c the velocities that the loads on its moving body cause, by one thread."""
        axes = axes_of(state, c)
        end = 3 * (shell.first[c + 1] - shell.first[c])
        load_rows(model, shell, c, axes, state.body_velocity[c], state.body_spin[c], 0, end)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            e = model.first_node[k] + 1
            while e < model.first_node[k + 1]:
                state.velocity[e] = state.velocity[e] + flow_at_node(model, shell, e, k, c, axes)
                e += 1
            k += 1

    return SimpleNamespace(
        axes_of=axes_of, place=place, find=find, pull=pull, flow_at_bead=flow_at_bead, hold_row=hold_row,
        sum_loads=sum_loads, hand_over=hand_over, load_rows=load_rows, flow_at_node=flow_at_node, answer=answer,
        obstruct=obstruct, carry=carry,
    )  # fmt: skip
