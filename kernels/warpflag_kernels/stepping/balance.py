"""The power balance of a step: the work of motors, contacts and external forces is dissipated or stored.

A step takes the displacement x. With the energy U of the terms that store some (`Term.functions`, `energy`) and the
forces F of all others at the pose that the second iteration evaluates,

    dissipated = F x - (U after - U before).

The left side is never negative, and where the velocities V there are those of the step, it is F_all V dt, F_all the sum
of all forces. Both are asked of every step, to within what an error of the size that the step may make does against the
forces, |F_all| times that error, and the round-off of U. A strain near 1 has a round-off of eps. The energy c d^2/2 of
a strain that is d from its rest value is then uncertain by c d eps, all together by at most 2 eps sqrt(U U_1), U_1 the
energy if every d were 1. That is what is left when a cell comes to rest under tension. An unstable step gains energy
that nothing puts in, long before any value looks wrong. A term that states no energy counts as a force from outside:
none can be forgotten.

The first step after a start has no energy before it and is not judged.

Where ground states change with time, on the ramps of polymorphs, energy is put in at a pose that stands still: in a
step -m.change, joint by joint, with the mean m of the moments before and after. Stiff joints follow their ground state:
the moment before alone would count k change^2/2 too much, that after alone as much too little. Another moment between
the two changes the sum by at most |dm|.|change|/2, which is allowed, too.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels.base import clock
from warpflag_kernels.base.clock import Control
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term, combined, variant
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.rod import chain_chart, comoving_chart, polymorphs, rotations

# What a step may dissipate over the power of its velocities: 1.2 at most in sound runs. Velocities of stiff modes are
# those before the step's last correction, so they may exceed what is dissipated by far.
MOST_DISSIPATED = 2.0
# Round-off of the energy, over the bound above: strains come from some operations each.
ENERGY_ROUND_OFF = 4.0
# A violation counts as VIOLATION_WEIGHT steps that keep the balance: where more than one step in ten violates it, the
# count grows, and beyond LASTING, some twenty violations more than that, the cell is stopped.
VIOLATION_WEIGHT = 9
LASTING = 200


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Balance`."""
    vec4, vec6 = p.vec4, chain_chart.types(p).vec6

    @wp.struct
    class Balance:
        node: wp.array(dtype=vec4)  # [E], force [pN] and spin torque [pN um] of the terms that store no energy
        body: wp.array(dtype=vec6)  # [K], their force and torque on the body
        power: wp.array(dtype=wp.float64)  # [K], of all forces on all velocities [pN um/s]
        load: wp.array(dtype=wp.float64)  # [K], sum of the sizes of the nodes' forces [pN]
        work: wp.array(dtype=wp.float64)  # [K], of the terms that store no energy [pN um]
        energy: wp.array(dtype=wp.float64)  # [K], after the step [pN um]
        stored: wp.array(dtype=wp.float64)  # [C], before it [pN um]
        stored_after: wp.array(dtype=wp.float64)  # [C], after it, of all flagella [pN um]
        all_off: wp.array(dtype=wp.float64)  # [C], energy if every strain were 1 off its rest value [pN um]
        kept: wp.array(dtype=wp.int32)  # [C], 1: the step keeps the balance
        # Where ground states change, what that adds to the energy in the step.
        ramped: wp.array(dtype=wp.float64)  # [K] [pN um]
        ramped_within: wp.array(dtype=wp.float64)  # [K], to within this [pN um]
        known: wp.array(dtype=wp.int32)  # [C], 1: `stored` is that of the present state
        refused: wp.array(dtype=wp.int32)  # [C], steps that violated the balance so far
        lasting: wp.array(dtype=wp.int32)  # [C], VIOLATION_WEIGHT times these, less the steps that have kept it

    return Balance


CARRIED = ("stored", "known", "refused", "lasting")
"""Arrays that carry over from one step to the next, and into checkpoints."""


def ramps(model: DeviceModel) -> bool:
    """Whether ground states change with time."""
    return model.switches.has("polymorphs")


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `Balance`, zero."""
    p, device = model.precision, model.device
    b = struct(p)()
    b.node = wp.zeros(model.element_count, dtype=p.vec4, device=device)
    b.body = wp.zeros(model.flagellum_count, dtype=chain_chart.types(p).vec6, device=device)
    for name in ("power", "load", "work", "energy"):
        setattr(b, name, wp.zeros(model.flagellum_count, dtype=wp.float64, device=device))
    if ramps(model):
        for name in ("ramped", "ramped_within"):
            setattr(b, name, wp.zeros(model.flagellum_count, dtype=wp.float64, device=device))
    b.stored, b.stored_after = (wp.zeros(model.cell_count, dtype=wp.float64, device=device) for _ in range(2))
    b.all_off = wp.array(_energy_off(model), dtype=wp.float64, device=device)
    for name in ("known", "kept", "refused", "lasting"):
        setattr(b, name, wp.zeros(model.cell_count, dtype=wp.int32, device=device))
    return b


def _energy_off(model: DeviceModel) -> np.ndarray:
    """Energy of a cell if every strain were 1 off its rest value [pN um], shape [C]."""
    rod, first_node = model.data.rod, model.data.first_node.numpy()
    h, bend, twist, stretch = (
        x.numpy().astype(float)
        for x in (rod.segment_length, rod.bending_rigidity, rod.twist_rigidity, rod.stretching_stiffness)
    )
    segment = 0.5 * (stretch * h + (bend + twist) / h)
    return np.add.reduceat((np.diff(first_node) - 1) * segment, model.data.first_flagellum.numpy()[:-1])


@functools.cache
def _kernels(p: Precision, storing: tuple[Term, ...]) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State, Balance, vec6 = structs(p).Model, structs(p).State, struct(p), chain_chart.types(p).vec6
    Increment = chain_chart.types(p).Increment
    f = combined(p, storing)
    on_first, on_second, on_node, on_spin, on_body = f.on_first, f.on_second, f.on_node, f.on_spin, f.on_body
    energy_of = f.energy
    module = p.module("balance", variant(storing))

    @wp.kernel(module=module)
    def gather(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        balance: Balance,
    ):
        k = wp.tid()
        first = model.first_node[k]
        end = model.first_node[k + 1]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        zero = real(0.0)
        mobility = model.drag.spin_mobility[k]
        torque = state.spin_torque[first]
        power = mobility * torque * torque
        load = zero
        anchor = on_node(model, state, first, k, vec3(zero))
        # What is left of a node's force waits for the segment after it.
        left = state.force[first] - anchor
        turn = torque - on_spin(model, state, first, k, zero)
        e = first + 1
        while e < end:
            before = on_first(model, state, e, k, vec3(zero))
            after = on_second(model, state, e, k, vec3(zero))
            if e == first + 1:
                anchor += before
            d = left - before
            balance.node[e - 1] = vec4(d[0], d[1], d[2], turn)
            force = state.force[e]
            torque = state.spin_torque[e]
            power += wp.dot(force, state.velocity[e]) + mobility * torque * torque
            load += wp.length(force)
            left = force - on_node(model, state, e, k, after)
            turn = torque - on_spin(model, state, e, k, zero)
            e += 1
        balance.node[end - 1] = vec4(left[0], left[1], left[2], turn)
        stored, turned = on_body(model, state, k, anchor, wp.cross(state.pose.position[first], anchor))
        force = state.flagellum_force[k]
        torque3 = state.flagellum_torque[k]
        power += wp.dot(force, state.body_velocity[c]) + wp.dot(torque3, state.body_spin[c])
        d = force - stored
        t = torque3 - turned
        balance.body[k] = vec6(d[0], d[1], d[2], t[0], t[1], t[2])
        balance.power[k] = wp.float64(power)
        balance.load[k] = wp.float64(load)

    @wp.kernel(module=module)
    def weigh(
        # Model:
        model: Model,
        # State:
        state: State,
        total: Increment,
        # Out:
        balance: Balance,
    ):
        k = wp.tid()
        first = model.first_node[k]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        work = wp.dot(balance.body[k], total.body[c])
        energy = wp.float64(0.0)
        e = first
        while e < model.first_node[k + 1]:
            d = balance.node[e]
            x = total.node[e]
            if e > first:
                work += wp.dot(d, x)
            else:
                work += d[3] * x[3]
            energy = energy_of(model, state, e, k, energy)
            e += 1
        balance.work[k] = wp.float64(work)
        balance.energy[k] = energy

    return SimpleNamespace(gather=gather, weigh=weigh)


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions `judge`, whether a step keeps the balance, and `count`, of steps that do not."""
    Balance = struct(p)
    module = p.module("balance_functions")
    most = wp.constant(wp.float64(MOST_DISSIPATED))
    round_off = wp.constant(wp.float64(ENERGY_ROUND_OFF * 2.0 * np.finfo(p.name).eps))
    weight, lasting = wp.constant(wp.int32(VIOLATION_WEIGHT)), wp.constant(wp.int32(LASTING))

    @wp.func(module=module)
    def judge(
        first_flagellum: wp.array(dtype=wp.int32), balance: Balance, c: wp.int32, dt: wp.float64, error: wp.float64
    ):
        """Whether a step of dt, which may err by `error` [um], keeps the balance, into `kept`; sets `stored_after`."""
        zero = wp.float64(0.0)
        work = zero
        energy = zero
        power = zero
        load = zero
        stored = balance.stored[c]
        ramped_within = zero
        k = first_flagellum[c]
        while k < first_flagellum[c + 1]:
            work += balance.work[k]
            energy += balance.energy[k]
            power += balance.power[k]
            load += balance.load[k]
            if balance.ramped.shape[0] > 0:
                stored += balance.ramped[k]
                ramped_within += balance.ramped_within[k]
            k += 1
        within = ramped_within + load * error + round_off * wp.sqrt(wp.max(energy, stored) * balance.all_off[c])
        dissipated = work - (energy - stored)
        good = dissipated > -within and dissipated < most * power * dt + within
        balance.kept[c] = wp.where(good or balance.known[c] == 0, 1, 0)
        balance.stored_after[c] = energy

    @wp.func(module=module)
    def count(balance: Balance, c: wp.int32, good: wp.bool):
        """Counts a judged step; returns whether violations have gone on for too long."""
        if good:
            balance.lasting[c] = wp.max(balance.lasting[c] - 1, 0)
            return False
        balance.refused[c] += 1
        balance.lasting[c] += weight
        return balance.lasting[c] > lasting

    return SimpleNamespace(judge=judge, count=count)


def storing(model: DeviceModel) -> tuple[Term, ...]:
    """The model's terms that store energy."""
    return tuple(term for term in model.terms if hasattr(term.functions(model.precision), "energy"))


def gather(model: DeviceModel, state: DeviceState, balance: Any) -> None:
    """Stores loads and power of the present pose, at which forces and velocities have just been evaluated."""
    kernel = _kernels(model.precision, storing(model)).gather
    wp.launch(kernel, model.flagellum_count, inputs=[model.data, state.data, balance], device=model.device)


def weigh(model: DeviceModel, state: DeviceState, total: Any, balance: Any) -> None:
    """Work of the forces that `gather` has stored on a step's increment, and the energy at its end, the present pose.

    Args:
        model, state: of the batch.
        total: the whole step, struct `Increment`.
        balance: struct `Balance`.
    """
    kernel = _kernels(model.precision, storing(model)).weigh
    wp.launch(kernel, model.flagellum_count, inputs=[model.data, state.data, total, balance], device=model.device)


@functools.cache
def _ramp_kernel(p: Precision) -> Any:
    """Kernel of ground states that change."""
    real, vec3 = p.real, p.vec3
    Model, State, Balance, Chart = structs(p).Model, structs(p).State, struct(p), comoving_chart.struct(p)
    joint_strain, ground_state = rotations.functions(p).joint_strain, polymorphs.functions(p).ground_state
    advanced = clock.functions().advanced
    half = wp.constant(real(0.5))

    @wp.kernel(module=p.module("balance_ramps"))
    def add_up(
        # Model:
        model: Model,
        # State:
        state: State,
        chart: Chart,
        control: Control,
        # Out:
        balance: Balance,
    ):
        k = wp.tid()
        first = model.first_node[k]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        a = model.rod.bending_rigidity[k]
        stiffness = vec3(a, a, model.rod.twist_rigidity[k]) / model.rod.segment_length[k]
        total = wp.float64(0.0)
        within = wp.float64(0.0)
        stored = wp.float64(0.0)
        e = first + 1
        while e + 1 < model.first_node[k + 1]:
            at_start = ground_state(model, state, e, k, control.time[c])
            at_end = ground_state(model, state, e, k, advanced(control, c))
            change = at_end - at_start
            jumped = state.forms[0].flipped[e] == control.time[c]  # within the step before, which ended without that
            if jumped or wp.length_sq(change) > real(0.0):
                before = joint_strain(
                    chart.base.tangent[e], chart.base.tangent[e + 1], chart.base.director[e], chart.base.director[e + 1]
                )
                after = joint_strain(
                    state.pose.tangent[e], state.pose.tangent[e + 1], state.pose.director[e], state.pose.director[e + 1]
                )
                if jumped:
                    ended = model.polymorphs[0].rest_strain[3 * e + state.forms[0].before[e]]
                    jump = wp.cw_mul(stiffness, at_start - ended)
                    total -= wp.float64(wp.dot(jump, before - half * (ended + at_start)))
                    within += wp.float64(half * wp.dot(jump, at_start - ended))
                scaled = half * wp.cw_mul(stiffness, change)
                total -= wp.float64(wp.dot(scaled, before - at_start + after - at_end))
                d = wp.cw_mul(scaled, after - before - change)
                within += wp.float64(wp.abs(d[0]) + wp.abs(d[1]) + wp.abs(d[2]))
                evaluated = state.forms[0].rest_strain[e]
                later = wp.cw_mul(stiffness, evaluated - at_end)
                stored += wp.float64(wp.dot(later, after - half * (evaluated + at_end)))
            e += 1
        balance.ramped[k] = total
        balance.ramped_within[k] = within
        balance.energy[k] = balance.energy[k] + stored

    return add_up


def add_up_ramps(model: DeviceModel, state: DeviceState, chart: Any, control: Any, balance: Any) -> None:
    """Energy that changing ground states have put in during a step; that at its end is corrected to the final ones.

    Args:
        model, state, chart, control: of the batch; after `weigh`, before the step is judged.
        balance: struct `Balance`.
    """
    if ramps(model):
        inputs = [model.data, state.data, chart, control, balance]
        wp.launch(_ramp_kernel(model.precision), model.flagellum_count, inputs=inputs, device=model.device)
