"""A free filament: no body, so that r_0 is a free end like r_N.

The program stores r_0 as the body: an anchor at the body's centre that moves by the body's mobility. For a free
filament that is the local mobility of a free end, along and across the tangent of segment 1, without rotation; this
term keeps the axis of that mobility on the tangent. The pair sum then has r_0 as a node ("free").
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of the term."""
    Model, State = structs(p).Model, structs(p).State

    @wp.func(module=p.module("free_end_functions"))
    def in_flagellum(model: Model, state: State, k: wp.int32, c: wp.int32):
        state.pose.body_axis[c] = state.pose.tangent[model.first_node[k] + 1]

    return SimpleNamespace(in_flagellum=in_flagellum)


@functools.cache
def _kernel(p: Precision):
    Model, State = structs(p).Model, structs(p).State
    in_flagellum = functions(p).in_flagellum

    @wp.kernel(module=p.module("free_end"))
    def align(
        # Model:
        model: Model,
        # Out:
        state: State,
    ):
        k = wp.tid()
        c = model.cell_of[model.first_node[k]]
        if state.active[c] != 0:
            in_flagellum(model, state, k, c)

    return align


def align_axes(model: DeviceModel, state: DeviceState) -> None:
    """The axis of the mobility of r_0 onto the tangent of segment 1, into `body_axis`."""
    kernel = _kernel(model.precision)
    wp.launch(kernel, model.flagellum_count, inputs=[model.data, state.data], device=model.device)


FREE_END = Term("free end", launch=align_axes, functions=functions)
