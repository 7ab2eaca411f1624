"""The step that keeps the Boltzmann distribution of stiff modes: linearly implicit, with a random elastic force.

    (1/dt + theta M H) x = M [F + (2 theta - 1)^1/2 f] + v,

F the forces at the start of the step, H = J^T k J and f of `strain_gradients`, v the thermal velocities of `noise`. A
mode of rate lambda, z = lambda dt, keeps the variance kT/k at any z: the noise puts in 2 z + (2 theta - 1) z^2, in
units of kT/k (1 + theta z)^-2, and that is what the step damps. With v alone a step of backward Euler would freeze
stiff modes to 1/(1 + z/2). What is not linear errs by O(kT dt), and motion that is driven by O(dt). Contacts obey the
exact law at the end of the step, as in `collocation`.

The step is fixed: one that depended on the noise drawn would prefer some realisations of it to others.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import clock, random_numbers
from warpflag_kernels.base.clock import NO_FAULT, STEP_TOLERANCE, Control
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import contact_list, steric
from warpflag_kernels.fluid import noise as noise_stage
from warpflag_kernels.implicit import block_band, delassus
from warpflag_kernels.rod import chain_chart
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.stepping.health import Fault, encode

IMPLICITNESS = 1.0  # theta of the step: 1 damps driven modes most, 1/2 would leave stiff modes ringing for ever
# Tolerance of a gap [sigma]: thermal gaps of a closed contact vary by some 0.07 sigma.
GAP_TOLERANCE = 1.0e-4


@functools.cache
def _kernels(p: Precision, explicit: bool) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State = structs(p).Model, structs(p).State
    Chart, Noise = chart_stage.struct(p), noise_stage.struct(p)
    Band, Contacts, Law = block_band.types(p).Band, contact_list.struct(p), delassus.struct(p)
    Increment, vec6 = chain_chart.types(p).Increment, chain_chart.types(p).vec6
    drag, advanced = block_band.functions(p).drag, clock.functions().advanced
    theta, gap_tolerance = wp.constant(wp.float64(IMPLICITNESS)), wp.constant(real(GAP_TOLERANCE))
    tolerance = wp.constant(wp.float64(STEP_TOLERANCE))
    no_fault = wp.constant(wp.int32(NO_FAULT))
    unsolved, crowded = (wp.constant(wp.int32(encode(kind))) for kind in (Fault.UNSOLVED, Fault.CROWDED))
    module = p.module("equilibrium", "explicit" if explicit else "")

    @wp.kernel(module=module)
    def begin(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        control: Control,
        chart: Chart,
        band: Band,
        contacts_out: Contacts,
        law: Law,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        left = control.target[c] - control.time[c]
        count = wp.max(wp.ceil(left / control.longest_step[c] - tolerance), wp.float64(1.0))
        control.step[c] = left / count
        chart.elapsed[c] = wp.float64(0.0)
        chart.at_start[c] = 0
        if wp.static(not explicit):
            band.step[c] = control.step[c]
            band.weight[c] = theta
            band.singular[c] = 0
            contacts_out.overflow[c] = 0
            law.gain[c] = theta
            law.failed[c] = 0
            law.gap_tolerance[c] = gap_tolerance * model.steric.diameter[c]

    @wp.kernel(module=module)
    def right_hand_side(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        noise: Noise,
        step: wp.array(dtype=wp.float64),
        share: real,
        # Out:
        x: Increment,
    ):
        """D^-1 times the velocities, thermal ones included (of the bodies: velocities); explicit: the increment."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        n = noise.node[e]
        spin = model.drag.spin_mobility[k] * state.spin_torque[e] + n[3]
        v = vec3(real(0.0))
        if e > model.first_node[k]:
            v = state.velocity[e] + vec3(n[0], n[1], n[2])
        elif k == model.first_flagellum[c]:
            u = state.body_velocity[c]
            w = state.body_spin[c]
            b = vec6(u[0], u[1], u[2], w[0], w[1], w[2]) + noise.body[c]
            if wp.static(explicit):
                b = share * real(step[c]) * b
            x.body[c] = b
        if wp.static(explicit):
            dt = share * real(step[c])
            x.node[e] = vec4(dt * v[0], dt * v[1], dt * v[2], dt * spin)
        else:
            if e > model.first_node[k]:
                v = drag(band, e, v)
            x.node[e] = vec4(v[0], v[1], v[2], spin / model.drag.spin_mobility[k])

    @wp.kernel(module=module)
    def decide(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        contacts_in: Contacts,
        law: Law,
        # Out:
        chart: Chart,
        control: Control,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        solved = bool(True)
        if wp.static(not explicit):
            solved = band.singular[c] == 0 and law.failed[c] == 0 and contacts_in.overflow[c] == 0
        if solved and control.fault[c] == no_fault:
            control.steps[c] += 1
            control.time[c] = advanced(control, c)
            return
        chart.commit[c] = 0
        if control.fault[c] == no_fault:
            control.fault[c] = unsolved
            if wp.static(not explicit) and contacts_in.overflow[c] != 0:
                control.fault[c] = crowded

    @wp.kernel(module=module)
    def finish(
        # Out:
        state: State,
        control: Control,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        if control.rest[c] != 0 or control.time[c] >= control.target[c] or control.fault[c] != no_fault:
            state.active[c] = 0
            wp.atomic_sub(control.unfinished, 0, 1)

    return SimpleNamespace(begin=begin, right_hand_side=right_hand_side, decide=decide, finish=finish)


@functools.cache
def _contact_kernel(p: Precision) -> Any:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Contacts, Noise = contact_list.struct(p), noise_stage.struct(p)
    normals, for_contact = random_numbers.functions(p).normals, wp.constant(random_numbers.FOR_CONTACT)
    steric_law = steric.functions(p).steric_law

    @wp.kernel(module=p.module("contact_noise"))
    def random_contacts(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        noise: Noise,
        steps: wp.array(dtype=wp.int32),
        share: real,
        acting: wp.array(dtype=real),
        # Out:
        magnitude: wp.array(dtype=real),
    ):
        """Contact forces with a random force of the contact's own stiffness."""
        c = wp.tid()
        if state.active[c] == 0:
            return
        scale = share * real(wp.sqrt(noise.energy[c]))
        i = contacts_in.first[c]
        while i < contacts_in.first[c] + contacts_in.count[c]:
            law = steric_law(contacts_in.gap[i], model.steric.strength[c], model.steric.diameter[c])
            xi = normals(noise.seed[c], i - contacts_in.first[c], steps[c], for_contact)
            magnitude[i] = acting[i] + scale * wp.sqrt(law[1]) * xi[0]
            i += 1

    return random_contacts


def begin_step(model: DeviceModel, state: DeviceState, s: Any, explicit: bool) -> None:
    """The next step of every cell and its coefficients.

    Args:
        model, state: of the batch.
        s: structs `control`, `chart`, `band`, `contacts`, `law`.
        explicit: whether the step is explicit.
    """
    kernels, device = _kernels(model.precision, explicit), model.device
    inputs = [model.data, state.data, s.control, s.chart, s.band, s.contacts, s.law]
    wp.launch(kernels.begin, model.cell_count, inputs=inputs, device=device)


def right_hand_side(
    model: DeviceModel, state: DeviceState, s: Any, noise: Any, x: Any, explicit: bool, share: float = 1.0
) -> None:
    """From velocities and thermal velocities to the right side of the linear system; explicit: to the increment, of a
    share of the step."""
    inputs = [model.data, state.data, s.band, noise, s.control.step, share, x]
    kernel = _kernels(model.precision, explicit).right_hand_side
    wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)


def random_contacts(model: DeviceModel, state: DeviceState, s: Any, noise: Any, share: float, out: Any) -> None:
    """Contact forces `law.force` plus random ones of the contacts' stiffness, into `out`."""
    inputs = [model.data, state.data, s.contacts, noise, s.control.steps, share, s.law.force, out]
    wp.launch(_contact_kernel(model.precision), model.cell_count, inputs=inputs, device=model.device)


def decide(model: DeviceModel, state: DeviceState, s: Any, explicit: bool) -> None:
    """Counts the step of every cell in which it was solved and violates no guard, and stops the others."""
    inputs = [model.data, state.data, s.band, s.contacts, s.law, s.chart, s.control]
    wp.launch(_kernels(model.precision, explicit).decide, model.cell_count, inputs=inputs, device=model.device)


def finish_step(model: DeviceModel, state: DeviceState, s: Any, explicit: bool) -> None:
    """Cells that have reached their target, or were stopped, take no further part."""
    kernel = _kernels(model.precision, explicit).finish
    wp.launch(kernel, model.cell_count, inputs=[state.data, s.control], device=model.device)
