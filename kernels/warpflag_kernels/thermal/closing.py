"""Contacts of a step that is solved with the full mobility: the exact law at the gaps to which the whole step leads.

The closest points of nearly parallel segments lie anywhere along them, and thermal motion moves their ends by as much
as a contact is wide: a force at the closest points of the step's start does not keep them apart at its end. So closest
points, normals and gaps are found anew in the pose that the step leads to, and contact forces from these, beginning
with the increment without any.

The contact solve has P g M B for the response to forces, with the matrix of the step for P. GMRES then solves with the
full mobility, which changes the gaps, most where a contact is stiff over the step. So contact forces are found once
more at the pose to which that leads, from the increment less the response to the first ones, and GMRES solves for the
response to their change, in cells that have a contact.

A step that moves a filament sideways by as much as a contact is wide leads elsewhere than its gaps foretell, and two
filaments may end within each other's width without having crossed. `check_gaps` stops such cells.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.clock import Control
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import contact_list, search, steric
from warpflag_kernels.contact.constants import LINEAR_BELOW
from warpflag_kernels.fluid import noise as noise_stage
from warpflag_kernels.implicit import delassus
from warpflag_kernels.implicit import stability as stability_stage
from warpflag_kernels.rod import chain_chart, reconstruction
from warpflag_kernels.stepping.health import Fault, encode
from warpflag_kernels.thermal import additive_chart

# What neither noise nor motors bring about: contacts closer than 0.75 sigma, where the force is 76 F_0, with an energy
# above 30 kT.
LEAST_GAP = 0.75
LARGEST_ENERGY = 30.0


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real = p.real
    Model, State, Stability = structs(p).Model, structs(p).State, stability_stage.struct(p)
    Contacts, Law, Increment = contact_list.struct(p), delassus.struct(p), chain_chart.types(p).Increment
    Noise = noise_stage.struct(p)
    gap_change, steric_force = contact_list.functions(p).gap_change, steric.functions(p).steric_force
    least_gap, linear_below = wp.constant(real(LEAST_GAP)), wp.constant(real(LINEAR_BELOW))
    largest_energy, pressed = wp.constant(wp.float64(LARGEST_ENERGY)), wp.constant(wp.int32(encode(Fault.PRESSED)))
    module = p.module("closing")

    @wp.kernel(module=module)
    def mark(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        law: Law,
        anew: wp.bool,
        # Out:
        stability: Stability,
    ):
        """Which cells have a contact with a force."""
        c = wp.tid()
        if anew:
            stability.strong[c] = 0
        if state.active[c] == 0:
            return
        i = contacts_in.first[c]
        while i < contacts_in.first[c] + contacts_in.count[c]:
            if law.force[i] > real(0.0):
                stability.strong[c] = 1
            i += 1

    @wp.kernel(module=module)
    def take_back(
        # Model:
        model: Model,
        # State:
        state: State,
        x: Increment,
        # Out:
        contacts: Contacts,
        law: Law,
    ):
        """Takes the gaps at the pose to which x leads back to x = 0, linearly, and sets the contact forces to zero."""
        c = wp.tid()
        if state.active[c] == 0:
            return
        i = contacts.first[c]
        while i < contacts.first[c] + contacts.count[c]:
            contacts.gap[i] = contacts.gap[i] - gap_change(model, state, contacts, i, x)
            law.force[i] = real(0.0)
            i += 1

    @wp.kernel(module=module)
    def look(
        # Out:
        stability: Stability,
    ):
        found = int(0)
        for c in range(stability.strong.shape[0]):
            found = wp.max(found, stability.strong[c])
        stability.any_strong[0] = found

    @wp.kernel(module=module)
    def set_difference(
        # Model:
        model: Model,
        # State:
        state: State,
        x: Increment,
        y: Increment,
        # Out:
        out: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        out.node[e] = x.node[e] - y.node[e]
        if e == model.first_node[model.first_flagellum[c]]:
            out.body[c] = x.body[c] - y.body[c]

    @wp.kernel(module=module)
    def add(
        # Model:
        model: Model,
        # State:
        chosen: wp.array(dtype=wp.int32),
        x: Increment,
        # Out:
        out: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if chosen[c] == 0:
            return
        out.node[e] = out.node[e] + x.node[e]
        if e == model.first_node[model.first_flagellum[c]]:
            out.body[c] = out.body[c] + x.body[c]

    @wp.kernel(module=module)
    def check_gaps(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        noise: Noise,
        # Out:
        control: Control,
    ):
        c = wp.tid()
        if state.active[c] == 0 or control.steps[c] == 0:
            return
        strength = model.steric.strength[c]
        diameter = model.steric.diameter[c]
        i = contacts_in.first[c]
        while i < contacts_in.first[c] + contacts_in.count[c]:
            gap = contacts_in.gap[i]
            if gap < least_gap * diameter:
                # Of the law's steep part, F_0 sigma (sigma/r)^12/6, it is F r/12.
                energy = steric_force(gap, strength, diameter) * wp.max(gap, linear_below * diameter) / real(12.0)
                if wp.float64(energy) > largest_energy * noise.energy[c]:
                    wp.atomic_min(control.fault, c, pressed + contacts_in.segment[i])
            i += 1

    return SimpleNamespace(
        mark=mark, take_back=take_back, look=look, difference=set_difference, add=add, check_gaps=check_gaps
    )


def mark(model: DeviceModel, state: DeviceState, contacts: Any, law: Any, stability: Any, anew: bool) -> None:
    """Sets `strong` in cells with contact forces; `anew`: whether it is cleared first."""
    kernels, device = _kernels(model.precision), model.device
    inputs = [model.data, state.data, contacts, law, anew, stability]
    wp.launch(kernels.mark, model.cell_count, inputs=inputs, device=device)
    wp.launch(kernels.look, 1, inputs=[stability], device=device)


def renew(model: DeviceModel, state: DeviceState, chart: Any, x: Any, work: Any, contacts: Any, law: Any) -> None:
    """Closest points, normals and gaps of the contacts at the pose to which the increment x leads; the pose stays."""
    kernels, device = _kernels(model.precision), model.device
    additive_chart.retract(model, state, chart, x, work)
    search.renew(model, state, state.data.pose, contacts)
    reconstruction.go_back(model, state, chart)
    inputs = [model.data, state.data, x, contacts, law]
    wp.launch(kernels.take_back, model.cell_count, inputs=inputs, device=device)


def check_gaps(model: DeviceModel, state: DeviceState, contacts: Any, noise: Any, control: Any) -> None:
    """Stops cells with a contact at the start of a step, their first one excepted, that is closer than noise or motors
    can press it.

    Args:
        model, state: of the batch.
        contacts: struct `Contacts`, found at this pose.
        noise: struct `Noise`.
        control: struct `Control`.
    """
    inputs = [model.data, state.data, contacts, noise, control]
    wp.launch(_kernels(model.precision).check_gaps, model.cell_count, inputs=inputs, device=model.device)


def set_difference(model: DeviceModel, state: DeviceState, x: Any, y: Any, out: Any) -> None:
    """x - y into out, structs `Increment`."""
    inputs = [model.data, state.data, x, y, out]
    wp.launch(_kernels(model.precision).difference, model.element_count, inputs=inputs, device=model.device)


def add(model: DeviceModel, chosen: Any, x: Any, out: Any) -> None:
    """Adds x to out, structs `Increment`, in the chosen cells."""
    inputs = [model.data, chosen, x, out]
    wp.launch(_kernels(model.precision).add, model.element_count, inputs=inputs, device=model.device)
