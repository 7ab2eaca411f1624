"""Total force on every node and torque on every segment's spin: the sum of what the terms offer.

Nothing is scattered: a node gathers from its two segments and from itself. On r_0, which belongs to the body, the
entry holds the force of the flagellum on the body at the anchor.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term, acting, combined, variant
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs


@functools.cache
def functions(p: Precision, terms: tuple[Term, ...]) -> SimpleNamespace:
    """Device function `gather`: force on one node and torque on its segment, of these terms."""
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    f = combined(p, terms)
    on_first, on_second, on_node, on_spin = f.on_first, f.on_second, f.on_node, f.on_spin

    @wp.func(module=p.module("forces_functions", variant(terms)))
    def gather(model: Model, state: State, e: wp.int32, k: wp.int32):
        force = vec3(real(0.0))
        if e + 1 < model.first_node[k + 1]:
            force = on_first(model, state, e + 1, k, force)
        if e > model.first_node[k]:
            force = on_second(model, state, e, k, force)
        state.force[e] = on_node(model, state, e, k, force)
        state.spin_torque[e] = on_spin(model, state, e, k, real(0.0))

    return SimpleNamespace(gather=gather)


@functools.cache
def _kernel(p: Precision, terms: tuple[Term, ...]):
    Model, State = structs(p).Model, structs(p).State
    gather = functions(p, terms).gather

    @wp.kernel(module=p.module("forces", variant(terms)))
    def total(
        # Model:
        model: Model,
        # Out:
        state: State,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] != 0:
            gather(model, state, e, model.flagellum_of[e])

    return total


def total_forces(model: DeviceModel, state: DeviceState, terms: tuple[Term, ...] | None = None) -> None:
    """Force on every node [pN] and torque on every spin [pN um], into `force` and `spin_torque`.

    Args:
        model, state: of the batch; what the terms' launches have evaluated is read.
        terms: those that count; default: all of the model.
    """
    p, terms = model.precision, model.terms if terms is None else terms
    kernel = _kernel(p, acting(p, terms, "on_first", "on_second", "on_node", "on_spin"))
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data], device=model.device)
