"""Node velocities of the first iteration of a step: flows in single precision, from the stored pair coefficients.

The second iteration, in full precision, corrects their round-off.
"""

import functools
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import node_velocity
from warpflag_kernels.implicit import step_flow as flow_stage


@functools.cache
def _kernel(p: Precision, pairs: str) -> Any:
    Model, State, Flow = structs(p).Model, structs(p).State, flow_stage.struct(p)
    flows = flow_stage.functions(p, pairs, "stored")
    drag_velocity = node_velocity.local(p).drag_velocity
    load, spread, flow_at, slots_end = flows.load, flows.spread, flows.flow_at, flows.slots_end

    @wp.kernel(module=p.module("first_velocity", pairs))
    def cells(
        # Model:
        model: Model,
        # Out:
        flow: Flow,
        state: State,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        begin = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        e = begin
        while e < end:
            if flow.slot[e] >= 0:
                load(flow, flow.slot[e], state.force[e])
            e += 1
        stop = slots_end(model, c)
        spread(model, flow, c, stop)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            e = model.first_node[k] + 1
            while e < model.first_node[k + 1]:
                flowing = flow_at(model, flow, e, k, c, stop, 0)
                state.velocity[e] = drag_velocity(model, state, e, k) + flowing
                e += 1
            k += 1

    return cells


def serves(model: DeviceModel) -> bool:
    """Whether the coefficients of pairs are stored."""
    return model.plan.step_pairs == "stored"


def node_velocities(model: DeviceModel, state: DeviceState, flow: Any) -> None:
    """Velocity of every node but r_0 in the lab [um/s], into `velocity`; needs the forces.

    Args:
        flow: the struct `StepFlow`, built for this pose; its forces are overwritten.
    """
    kernel = _kernel(model.precision, model.switches.pairs)
    wp.launch(kernel, model.cell_count, inputs=[model.data, flow, state.data], device=model.device)
