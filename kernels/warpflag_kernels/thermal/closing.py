"""Contacts of a step that is solved with the full mobility: the exact law at the gaps to which the whole step leads.

Where a step begins, nearly parallel segments have their closest points anywhere, and thermal motion turns them by as
much as a contact is wide: a force at the old points keeps other points no longer apart. So closest points, normals and
gaps are found anew in the pose that the step leads to, and contact forces from there, on the increment without any.

The contact solve answers forces with P g M B, the matrix of the step for P. GMRES then solves with the full mobility,
and the gaps move on, most where a contact is stiff over the step. So forces are found once more where that leads, on
the increment less what they did, and GMRES solves for what their change does, in cells that have a contact.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import contact_list, search
from warpflag_kernels.implicit import delassus
from warpflag_kernels.implicit import stability as stability_stage
from warpflag_kernels.rod import chain_chart, reconstruction
from warpflag_kernels.thermal import additive_chart


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real = p.real
    Model, State, Stability = structs(p).Model, structs(p).State, stability_stage.struct(p)
    Contacts, Law, Increment = contact_list.struct(p), delassus.struct(p), chain_chart.types(p).Increment
    gap_change = contact_list.functions(p).gap_change
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
        """From gaps where x leads to those that a linear step from the start has, and no force acts yet."""
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

    return SimpleNamespace(mark=mark, take_back=take_back, look=look, difference=set_difference, add=add)


def mark(model: DeviceModel, state: DeviceState, contacts: Any, law: Any, stability: Any, anew: bool) -> None:
    """`strong` tells of cells with contact forces."""
    kernels, device = _kernels(model.precision), model.device
    inputs = [model.data, state.data, contacts, law, anew, stability]
    wp.launch(kernels.mark, model.cell_count, inputs=inputs, device=device)
    wp.launch(kernels.look, 1, inputs=[stability], device=device)


def renew(model: DeviceModel, state: DeviceState, chart: Any, x: Any, work: Any, contacts: Any, law: Any) -> None:
    """Closest points, normals and gaps of the contacts where the increment x leads; the pose is left at the start."""
    kernels, device = _kernels(model.precision), model.device
    additive_chart.retract(model, state, chart, x, work)
    search.renew(model, state, state.data.pose, contacts)
    reconstruction.go_back(model, state, chart)
    inputs = [model.data, state.data, x, contacts, law]
    wp.launch(kernels.take_back, model.cell_count, inputs=inputs, device=device)


def set_difference(model: DeviceModel, state: DeviceState, x: Any, y: Any, out: Any) -> None:
    """x - y into out, structs `Increment`."""
    inputs = [model.data, state.data, x, y, out]
    wp.launch(_kernels(model.precision).difference, model.element_count, inputs=inputs, device=model.device)


def add(model: DeviceModel, chosen: Any, x: Any, out: Any) -> None:
    """Adds x to out, structs `Increment`, in the chosen cells."""
    inputs = [model.data, chosen, x, out]
    wp.launch(_kernels(model.precision).add, model.element_count, inputs=inputs, device=model.device)
