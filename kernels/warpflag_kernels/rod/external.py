"""Forces from outside, in lab axes: uniform per length on every flagellum, and at the body's centre.

Sedimentation and the pull of a laser trap are such forces. A node carries half of the reference length of each of its
segments; the share of r_0 goes to the body through the anchor.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import structs


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of the term."""
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    module = p.module("external_functions")

    @wp.func(module=module)
    def on_node(model: Model, state: State, e: wp.int32, k: wp.int32, force: vec3):
        half = real(0.5) * model.rod.segment_length[k]
        carried = real(0.0)
        if e > model.first_node[k]:
            carried += half
        if e + 1 < model.first_node[k + 1]:
            carried += half
        return force + carried * model.external[0].force_per_length[model.cell_of[e]]

    @wp.func(module=module)
    def on_body(model: Model, state: State, k: wp.int32, force: vec3, torque: vec3):
        c = model.cell_of[model.first_node[k]]
        if k == model.first_flagellum[c]:
            return force + model.external[0].body_force[c], torque
        return force, torque

    return SimpleNamespace(on_node=on_node, on_body=on_body)


EXTERNAL = Term("external", functions=functions)
