"""Strains of joints at the end of a step: what a linear step misses of them, and forces that set it right.

A linear step takes the strains w to w + J x, with the gradients J at its start. At the pose to which x leads they
differ from that: segments turn by the arctangent of what x turns them by, and rotations about several axes do not add
up. That is of second order in x, but the same modes that a step leaves in equilibrium, as stiff ones are, carry it in
every step: without more, bends of a helix of 6 um are 1 % too cold at 1e-5 s, those of a straight filament of 6 um 5 %.
So the forces of a step are those of its end,

    x = x_linear - (1/dt + M H)^-1 M J^T k [w(q + x) - w - J x],

J as it was at the start, by some iterations from x_linear on. They solve with the matrix of the step, which leaves out
the flow: what it would change is a small share of a small force. Forces come in pairs, so nothing is pushed as a whole.

The axes of joints without rest curvature are free to turn under their bends (`strain_gradients`): strains of these are
compared in axes that have not turned.

J stays that of the start: the next step has what the turn of segments changes of these forces (`turned_forces`).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body
from warpflag_kernels.implicit import linearised
from warpflag_kernels.rod import chain_chart, forces, reconstruction, rotations
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.thermal import additive_chart, closing, strain_gradients

# Each iteration leaves a share of the error about as large as the angle by which segments turn in the step. Of a helix
# of 1.2 um at 1e-5 s one leaves bends 0.8 % too warm, two 0.03 %.
STRAIN_ITERATIONS = 2


@functools.cache
def _kernels(p: Precision, shell: bool) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State, Chart = structs(p).Model, structs(p).State, chart_stage.struct(p)
    Strains = strain_gradients.struct(p)
    Increment, vec6 = chain_chart.types(p).Increment, chain_chart.types(p).vec6
    displacement = chain_chart.displacement(p)
    f, r = strain_gradients.functions(p), rotations.functions(p)
    joint_stiffness, joined, joint_strain, sine_cosine = f.joint_stiffness, f.joined, r.joint_strain, r.sine_cosine
    respond = body.mobility(p, shell).respond
    zero, half = wp.constant(real(0.0)), wp.constant(real(0.5))
    module = p.module("end_strains", "shell" * shell)

    @wp.func(module=module)
    def strain(state: State, i: wp.int32):
        """Strains of the joint after segment i."""
        pose = state.pose
        return joint_strain(pose.tangent[i], pose.tangent[i + 1], pose.director[i], pose.director[i + 1])

    @wp.kernel(module=module)
    def missed(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        strains: Strains,
        x: Increment,
        # Out:
        state: State,
    ):
        """J^T k of what the strains at the end, the pose of `state`, are beyond the linear step x."""
        i = wp.tid()
        c = model.cell_of[i]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[i]
        first = model.first_node[k]
        here = displacement(model, chart.base.position, x, i, k)
        b = x.body[c]
        e = wp.cross(vec3(b[3], b[4], b[5]), chart.base.tangent[i])  # of the tripod's unit vector
        if i > first:
            e = here - displacement(model, chart.base.position, x, i - 1, k)
            t = chart.base.tangent[i]
            before = wp.length(chart.base.position[i] - chart.base.position[i - 1])
            longer = state.pose.length[i] - before - wp.dot(t, e)
            state.stretch_change[i] = (model.rod.stretching_stiffness[k] / model.rod.segment_length[k] * longer) * t
        if not joined(model, i, k):
            return
        f = displacement(model, chart.base.position, x, i + 1, k) - here
        one = x.node[i][3]
        two = x.node[i + 1][3]
        w = strain(state, i)
        rest = model.rod.rest_strain[i]
        if i > first and rest[0] == zero and rest[1] == zero:
            s, cosine = sine_cosine(half * (one + two))
            w = vec3(cosine * w[0] - s * w[1], s * w[0] + cosine * w[1], w[2])
        w -= strains.value[i] + strains.by_first[i] * e + strains.by_second[i] * f
        w -= one * strains.by_first_spin[i] + two * strains.by_second_spin[i]
        m = wp.cw_mul(joint_stiffness(model, i, k), w)
        if i == first:
            m = vec3(zero, zero, m[2])  # the hook's bends are soft: for them the linear step is exact enough
        state.joint_before[i] = wp.transpose(strains.by_first[i]) * m
        state.joint_after[i] = wp.transpose(strains.by_second[i]) * m
        state.joint_spin_before[i] = wp.dot(m, strains.by_first_spin[i])
        state.joint_spin_after[i] = wp.dot(m, strains.by_second_spin[i])

    @wp.kernel(module=module)
    def right_hand_side(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        y: Increment,
    ):
        """Minus the forces and torques; of the bodies, minus the velocities that these cause."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        g = state.force[e]
        if e == model.first_node[k]:
            g = vec3(zero)
            if k == model.first_flagellum[c]:
                force = vec3(zero)
                torque = vec3(zero)
                while k < model.first_flagellum[c + 1]:
                    force += state.flagellum_force[k]
                    torque += state.flagellum_torque[k]
                    k += 1
                u, w = respond(model, state, c, force, torque)
                y.body[c] = -vec6(u[0], u[1], u[2], w[0], w[1], w[2])
        y.node[e] = -vec4(g[0], g[1], g[2], state.spin_torque[e])

    return SimpleNamespace(missed=missed, right_hand_side=right_hand_side)


def _kernels_of(model: DeviceModel) -> SimpleNamespace:
    return _kernels(model.precision, model.switches.flows.body)


def correct(
    model: DeviceModel, state: DeviceState, chart: Any, strains: Any, band: Any, work: Any, room: Any, x: Any
) -> None:
    """From the increment of the linear step to that with the strains of its end; the pose is left at the start.

    Args:
        model, state: of the batch; forces of `state` are overwritten.
        chart: struct `Chart`, with the start.
        strains: struct `Strains`, of the start.
        band: struct `Band`, factorised.
        work: struct `Additive`.
        room: two structs `Increment`, room for intermediate results.
        x: struct `Increment`.
    """
    kernels, device, elements = _kernels_of(model), model.device, model.element_count
    linear, y = room
    wp.copy(linear.node, x.node)
    wp.copy(linear.body, x.body)
    terms = linearised.linearised_terms(model)
    for _ in range(STRAIN_ITERATIONS):
        additive_chart.retract(model, state, chart, x, work)
        inputs = [model.data, chart, strains, x, state.data]
        wp.launch(kernels.missed, elements, inputs=inputs, device=device)
        reconstruction.go_back(model, state, chart)
        forces.total_forces(model, state, terms)
        body.sum_flagella(model, state, terms)
        wp.launch(kernels.right_hand_side, elements, inputs=[model.data, state.data, y], device=device)
        linearised.solve(model, state, band, y)
        closing.set_difference(model, state, linear, y, x)
