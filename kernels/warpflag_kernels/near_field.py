"""Flows between nearby nodes: the part of the pair sum that decides how contacts answer to forces.

Two filaments that push each other apart drag the fluid between them along, which makes the gap several times harder
to open than local drag alone would. The opposite forces of a contact cancel at a distance, so only neighbours matter:

    v_i = sum over loaded nodes j within the reach of  w(r_ij) mu(r_ij) f_j,     w = (1 - r^2/reach^2)^2

The smooth weight keeps the cancellation exact to first order. What it leaves out, the defect correction adds.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import chain, contacts, mobility
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

REACH = 0.3  # [um]
SLOTS = 48  # neighbours that a node keeps; more are left to the defect correction


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `NearField`: the tapered Rotne-Prager blocks of every node, row by row."""
    vec6 = chain.types(p).vec6

    @wp.struct
    class NearField:
        count: wp.array(dtype=wp.int32)  # [E]
        source: wp.array(dtype=wp.int32)  # [E * SLOTS]
        block: wp.array(dtype=vec6)  # [E * SLOTS], xx, xy, xz, yy, yz, zz [um/(s pN)]

    return NearField


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device function of the near field: the velocity that loads on the nodes cause."""
    real, vec3 = p.real, p.vec3
    NearField = struct(p)
    slots = wp.constant(SLOTS)

    @wp.func(module=p.module("near_field_functions"))
    def near_flow(near: NearField, load: wp.array(dtype=vec3), e: wp.int32):
        """Velocity of node e from the loads of its neighbours [um/s]."""
        v = vec3(real(0.0))
        i = e * slots
        end = i + near.count[e]
        while i < end:
            b = near.block[i]
            f = load[near.source[i]]
            v += vec3(
                b[0] * f[0] + b[1] * f[1] + b[2] * f[2],
                b[1] * f[0] + b[3] * f[1] + b[4] * f[2],
                b[2] * f[0] + b[4] * f[1] + b[5] * f[2],
            )
            i += 1
        return v

    return SimpleNamespace(near_flow=near_flow)


@functools.cache
def _kernels(p: Precision, pairs: str) -> SimpleNamespace:
    real, vec6 = p.real, chain.types(p).vec6
    Model, State = structs(p).Model, structs(p).State
    Contacts, NearField = contacts.struct(p), struct(p)
    rotne_prager = mobility.pair_coefficients(p)
    within, between = pairs in ("within", "all"), pairs in ("between", "all")
    slots, reach = wp.constant(SLOTS), wp.constant(real(REACH))
    module = p.module("near_field", pairs)

    @wp.func(module=module)
    def loaded(contacts_in: Contacts, e: wp.int32, end: wp.int32):
        """Whether contact forces can act on node e of a flagellum that ends before `end`."""
        if contacts_in.stop[e] > contacts_in.start[e] or contacts_in.head[e] >= 0:
            return True
        return e + 1 < end and (contacts_in.stop[e + 1] > contacts_in.start[e + 1] or contacts_in.head[e + 1] >= 0)

    @wp.kernel(module=module)
    def build(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        # Out:
        near: NearField,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        own = model.flagellum_of[e]
        found = int(0)
        if contacts_in.count[c] > 0 and e > model.first_node[own]:
            x = state.position[e]
            k = model.first_flagellum[c]
            while k < model.first_flagellum[c + 1]:
                j = model.first_node[k] + 1  # r_0 belongs to the body
                end = model.first_node[k + 1]
                if wp.static(not within) and k == own:
                    j = end
                if wp.static(not between) and k != own:
                    j = end
                while j < end:
                    d = x - state.position[j]
                    r = wp.length(d)
                    pressed = contacts_in.with_body[j] >= 0
                    near_enough = r < reach and loaded(contacts_in, j, end)
                    if (pressed or near_enough) and j != e and found < slots:
                        weight = real(1.0)
                        if not pressed:
                            weight = real(1.0) - r * r / (reach * reach)
                        plain, along = rotne_prager(r, model.pair_radius[c])
                        scale = weight * weight * model.pair_mobility[c]
                        plain = scale * plain
                        s = (scale * along) * d
                        near.source[e * slots + found] = j
                        near.block[e * slots + found] = vec6(
                            plain + s[0] * d[0], s[0] * d[1], s[0] * d[2], plain + s[1] * d[1], s[1] * d[2],
                            plain + s[2] * d[2],
                        )  # fmt: skip
                        found += 1
                    # Nodes move on along the chain by no more than the lengths of its segments.
                    bound = r
                    j += 1
                    while j < end and bound - state.length[j] > reach and contacts_in.with_body[j] < 0:
                        bound -= state.length[j]
                        j += 1
                k += 1
        near.count[e] = found

    return SimpleNamespace(build=build)


def build(model: DeviceModel, state: DeviceState, contacts_in: Any, near: Any) -> None:
    """The near field of the present positions, for loads on nodes that have contacts."""
    kernel = _kernels(model.precision, model.switches.pairs).build
    inputs = [model.data, state.data, contacts_in, near]
    wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)
