"""Kernels of the flow round the body, whose equations are in `shell_flow`.

A CPU takes a cell in one thread, in vectors of beads, and stores the coefficients of all tensors C, since they are
used several times. A GPU has a thread for every bead and for every node, each of which computes them anew.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import shell as shell_stage
from warpflag_kernels.fluid import shell_flow


@functools.cache
def _cell_kernels(p: Precision, pair: Precision, placed: bool) -> SimpleNamespace:
    Model, State, Shell = structs(p).Model, structs(p).State, shell_stage.struct(pair)
    f = shell_flow.functions(p, pair, True, placed)
    obstruct, carry = f.obstruct, f.carry
    module = p.module("body_flow_of_cells", "_".join([pair.name, *["placed"] * placed]))

    @wp.kernel(module=module)
    def obstruct_cells(
        # Model:
        model: Model,
        # Out:
        state: State,
        shell: Shell,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            obstruct(model, state, shell, c)

    @wp.kernel(module=module)
    def carry_cells(
        # Model:
        model: Model,
        # Out:
        state: State,
        shell: Shell,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            carry(model, state, shell, c)

    return SimpleNamespace(obstruct_cells=obstruct_cells, carry_cells=carry_cells)


@functools.cache
def _kernels(p: Precision, pair: Precision) -> SimpleNamespace:
    Model, State, Shell = structs(p).Model, structs(p).State, shell_stage.struct(pair)
    f = shell_flow.functions(p, pair, False)
    axes_of, place, pull, flow_at_bead, hold_row = f.axes_of, f.place, f.pull, f.flow_at_bead, f.hold_row
    sum_loads, hand_over, load_rows, flow_at_node = f.sum_loads, f.hand_over, f.load_rows, f.flow_at_node
    module = p.module("body_flow", pair.name)

    @wp.kernel(module=module)
    def place_nodes(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        shell: Shell,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] != 0 and e > model.first_node[model.flagellum_of[e]]:
            axes = axes_of(state, c)
            place(state, shell, e, axes)
            pull(shell, e, axes, state.force[e])

    @wp.kernel(module=module)
    def bead_flows(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        shell: Shell,
    ):
        c, j = wp.tid()
        if state.active[c] != 0 and j < shell.first[c + 1] - shell.first[c]:
            flow_at_bead(model, shell, c, j)

    @wp.kernel(module=module)
    def held_loads(
        # State:
        state: State,
        # Out:
        shell: Shell,
    ):
        c, r = wp.tid()
        if state.active[c] != 0 and r < 3 * (shell.first[c + 1] - shell.first[c]):
            hold_row(shell, c, r)

    @wp.kernel(module=module)
    def resultants(
        # Out:
        state: State,
        shell: Shell,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            sum_loads(shell, c, axes_of(state, c))
            hand_over(state, shell, c)

    @wp.kernel(module=module)
    def carried_loads(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        shell: Shell,
    ):
        c, r = wp.tid()
        if state.active[c] != 0 and r < 3 * (shell.first[c + 1] - shell.first[c]):
            load_rows(model, shell, c, axes_of(state, c), state.body_velocity[c], state.body_spin[c], r, r + 1)

    @wp.kernel(module=module)
    def node_flows(
        # Model:
        model: Model,
        # State:
        shell: Shell,
        # Out:
        state: State,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        k = model.flagellum_of[e]
        if state.active[c] != 0 and e > model.first_node[k]:
            state.velocity[e] = state.velocity[e] + flow_at_node(model, shell, e, k, c, axes_of(state, c))

    return SimpleNamespace(
        place_nodes=place_nodes, bead_flows=bead_flows,
        held_loads=held_loads, resultants=resultants, carried_loads=carried_loads, node_flows=node_flows,
    )  # fmt: skip


def obstruct(model: DeviceModel, state: DeviceState, shell: Any, pair: Precision, placed: bool = False) -> None:
    """Held loads of the bodies and their resultants, from positions and forces of the nodes.

    Args:
        model, state: of the batch; the resultants go into `surface_force` [pN] and `surface_torque` [pN um].
        shell: struct `Shell`.
        pair: its precision.
        placed: whether it already has the nodes' positions, and the coefficients where they are stored.
    """
    data, cells, device = model.data, model.cell_count, model.device
    if model.plan.by_cells:
        kernel = _cell_kernels(model.precision, pair, placed).obstruct_cells
        wp.launch(kernel, cells, inputs=[data, state.data, shell], device=device)
        return
    kernels, beads = _kernels(model.precision, pair), shell_stage.most_beads(model)
    wp.launch(kernels.place_nodes, model.element_count, inputs=[data, state.data, shell], device=device)
    wp.launch(kernels.bead_flows, (cells, beads), inputs=[data, state.data, shell], device=device)
    wp.launch(kernels.held_loads, (cells, 3 * beads), inputs=[state.data, shell], device=device)
    wp.launch(kernels.resultants, cells, inputs=[state.data, shell], device=device)


def carry(model: DeviceModel, state: DeviceState, shell: Any, pair: Precision) -> None:
    """Adds to the nodes' velocities the flow that the loads on the moving bodies cause [um/s].

    Args:
        model, state: of the batch; the motion of the bodies has been found.
        shell: struct `Shell`, with the held loads of `obstruct`.
        pair: its precision.
    """
    data, cells, device = model.data, model.cell_count, model.device
    if model.plan.by_cells:
        kernel = _cell_kernels(model.precision, pair, False).carry_cells
        wp.launch(kernel, cells, inputs=[data, state.data, shell], device=device)
        return
    kernels, beads = _kernels(model.precision, pair), shell_stage.most_beads(model)
    wp.launch(kernels.carried_loads, (cells, 3 * beads), inputs=[data, state.data, shell], device=device)
    wp.launch(kernels.node_flows, model.element_count, inputs=[data, shell, state.data], device=device)
