"""What elastic forces do by the turn of their segments over a step, for the next one.

A step's elastic forces are those of the strains at its end, w', on the segments as they stand at its start: J^T k (w' -
w_0), J the gradients of the strains at the start (`end_strains`). In truth they turn with the segments, and strains
and turns of a step are correlated. To first order in kT, exp(-E/kT) is kept at any step if the mean force

    -< (J' - J)^T k (w' - w_0) > = -kT sum_ja (d_j J_a) k_a dt (J A M)_aj,

J' at the end, is there, too (docs/thermal.md). Without it stiff joints have exp(-E/kT) det(J M J^T)^(1/2), which
favours shapes with much drag, in place of exp(-E/kT). So a step has this force beside its own. A single step's value
scatters by the turn of a segment times the random force of a joint, and would make bends 1.4 % too warm at 1e-5 s: it
is averaged over the last steps, in the axes of the segments. Forces come in pairs, so nothing is pushed as a whole.

Joints without rest curvature bend in axes that do not turn with their segments (`strain_gradients`): their moments are
carried back into those of the start. Bends of a hook are soft, and left out.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.rod import chain_chart, rotations
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.thermal import strain_gradients

# Steps that the average is over. Of the scatter of one step's value, 1/(2 n - 1) is left: bends are 0.02 % too warm.
AVERAGED_STEPS = 32
CARRIED = ("before", "after", "spin_before", "spin_after")
"""Arrays that carry over from one step to the next, and into checkpoints."""


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Turned`: mean gradients to be added to those of the joints' energies, in the axes of their segments,
    tangent and directors. Per element [E]."""

    @wp.struct
    class Turned:
        before: wp.array(dtype=p.vec3)  # [pN]; of the tripod with respect to its unit vector [pN um]
        after: wp.array(dtype=p.vec3)  # [pN]
        spin_before: wp.array(dtype=p.real)  # [pN um]
        spin_after: wp.array(dtype=p.real)  # [pN um]

    return Turned


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `Turned`, zero."""
    p, t = model.precision, struct(model.precision)()
    for name, dtype in zip(CARRIED, (p.vec3, p.vec3, p.real, p.real), strict=True):
        setattr(t, name, wp.zeros(model.element_count, dtype=dtype, device=model.device))
    return t


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State, Chart = structs(p).Model, structs(p).State, chart_stage.struct(p)
    Strains, Turned, Increment = strain_gradients.struct(p), struct(p), chain_chart.types(p).Increment
    f, r = strain_gradients.functions(p), rotations.functions(p)
    joint_gradients, joint_stiffness, joined = f.joint_gradients, f.joint_stiffness, f.joined
    joint_strain, sine_cosine = r.joint_strain, r.sine_cosine
    zero, half = wp.constant(real(0.0)), wp.constant(real(0.5))
    most = wp.constant(wp.int32(AVERAGED_STEPS))
    module = p.module("turned_forces")

    @wp.func(module=module)
    def stretched(model: Model, state: State, chart: Chart, i: wp.int32, k: wp.int32):
        """(J' - J)^T k (l' - h) of segment i with respect to its own vector."""
        tension = model.rod.stretching_stiffness[k] * (state.pose.length[i] / model.rod.segment_length[k] - real(1.0))
        return tension * (state.pose.tangent[i] - chart.base.tangent[i])

    @wp.func(module=module)
    def axes(state: State, i: wp.int32):
        """Tangent and directors of segment i, as rows."""
        t = state.pose.tangent[i]
        a = state.pose.director[i]
        return wp.matrix_from_rows(t, a, wp.cross(t, a))

    @wp.kernel(module=module)
    def find(
        # Model:
        model: Model,
        # State:
        state: State,
        chart: Chart,
        strains: Strains,
        x: Increment,
        steps: wp.array(dtype=wp.int32),
        # Out:
        turned: Turned,
    ):
        i = wp.tid()
        k = model.flagellum_of[i]
        c = model.cell_of[i]
        if state.active[c] == 0 or not joined(model, i, k):
            return
        first = model.first_node[k]
        on_e, on_f, spin_e, spin_f = joint_gradients(model, state.pose, i, k)
        pose = state.pose
        w = joint_strain(pose.tangent[i], pose.tangent[i + 1], pose.director[i], pose.director[i + 1])
        rest = model.rod.rest_strain[i]
        if i == first:
            w = vec3(zero, zero, w[2])
        else:
            w -= rest
        m = wp.cw_mul(joint_stiffness(model, i, k), w)
        own = m
        if i > first and rest[0] == zero and rest[1] == zero:
            s, cosine = sine_cosine(half * (x.node[i][3] + x.node[i + 1][3]))
            own = vec3(cosine * m[0] - s * m[1], s * m[0] + cosine * m[1], m[2])
        before = wp.transpose(on_e) * m - wp.transpose(strains.by_first[i]) * own
        after = wp.transpose(on_f) * m - wp.transpose(strains.by_second[i]) * own
        if i > first:
            before += stretched(model, state, chart, i, k)
        if i + 2 == model.first_node[k + 1]:  # no joint begins with the last segment
            after += stretched(model, state, chart, i + 1, k)
        spin_before = wp.dot(m, spin_e) - wp.dot(own, strains.by_first_spin[i])
        spin_after = wp.dot(m, spin_f) - wp.dot(own, strains.by_second_spin[i])
        share = real(1.0) / real(wp.min(steps[c] + 1, most))
        turned.before[i] = turned.before[i] + share * (axes(state, i) * before - turned.before[i])
        turned.after[i] = turned.after[i] + share * (axes(state, i + 1) * after - turned.after[i])
        turned.spin_before[i] = turned.spin_before[i] + share * (spin_before - turned.spin_before[i])
        turned.spin_after[i] = turned.spin_after[i] + share * (spin_after - turned.spin_after[i])

    @wp.kernel(module=module)
    def add(
        # Model:
        model: Model,
        # State:
        turned: Turned,
        # Out:
        state: State,
    ):
        i = wp.tid()
        if state.active[model.cell_of[i]] == 0 or not joined(model, i, model.flagellum_of[i]):
            return
        state.joint_before[i] = state.joint_before[i] + wp.transpose(axes(state, i)) * turned.before[i]
        state.joint_after[i] = state.joint_after[i] + wp.transpose(axes(state, i + 1)) * turned.after[i]
        state.joint_spin_before[i] = state.joint_spin_before[i] + turned.spin_before[i]
        state.joint_spin_after[i] = state.joint_spin_after[i] + turned.spin_after[i]

    return SimpleNamespace(find=find, add=add)


def find(model: DeviceModel, state: DeviceState, chart: Any, strains: Any, x: Any, steps: Any, turned: Any) -> None:
    """What the elastic forces at the end of a step do by the turn of their segments, into the average.

    Args:
        model, state: of the batch, its pose at the end of the step, lengths restored.
        chart: struct `Chart`, with the start.
        strains: struct `Strains`, of the start.
        x: the increment, struct `Increment`.
        steps: number of the step, shape [cell_count].
        turned: struct `Turned`.
    """
    inputs = [model.data, state.data, chart, strains, x, steps, turned]
    wp.launch(_kernels(model.precision).find, model.element_count, inputs=inputs, device=model.device)


def add(model: DeviceModel, state: DeviceState, turned: Any) -> None:
    """Adds what the last step left to the joints' energy gradients, which have been evaluated."""
    inputs = [model.data, turned, state.data]
    wp.launch(_kernels(model.precision).add, model.element_count, inputs=inputs, device=model.device)
