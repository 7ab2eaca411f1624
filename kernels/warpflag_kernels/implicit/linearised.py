"""The linearised equations of a step: the matrix with the local mobility, bodies and flagella together, factorised and
solved with; and in full, with the pair sum that the matrix leaves out, the product D^-1 (1/dt + g M H) x.

The forces of the product are the first variations of those terms that have one. The product serves to measure the
stability of a step (`stability`) and to solve with the full mobility (`krylov`).
"""

import functools
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body, node_velocity
from warpflag_kernels.implicit import block_band, body_coupling
from warpflag_kernels.rod import chain_chart, forces


@functools.cache
def _kernel(p: Precision) -> Any:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State = structs(p).Model, structs(p).State
    Increment, Band, vec6 = chain_chart.types(p).Increment, block_band.types(p).Band, block_band.types(p).vec6
    drag = block_band.functions(p).drag

    @wp.kernel(module=p.module("linearised"))
    def complete(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        gain: wp.array(dtype=wp.float64),
        x: Increment,
        # Out:
        out: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        g = real(gain[c])
        inv_dt = real(wp.float64(1.0) / band.step[c])
        y = inv_dt * x.node[e]
        v = vec3(real(0.0))
        if e > model.first_node[k]:
            v = drag(band, e, vec3(y[0], y[1], y[2]) - g * state.velocity[e])
        elif k == model.first_flagellum[c]:
            u = state.body_velocity[c]
            w = state.body_spin[c]
            out.body[c] = inv_dt * x.body[c] - g * vec6(u[0], u[1], u[2], w[0], w[1], w[2])
        out.node[e] = vec4(v[0], v[1], v[2], y[3] / model.drag.spin_mobility[k] - g * state.spin_torque[e])

    return complete


def allocate(model: DeviceModel, state: DeviceState) -> None:
    """Arrays of the struct `State` that the first variation of the forces needs beside those of the forces."""
    state.data.stretch_change = wp.zeros(model.element_count, dtype=model.precision.vec3, device=model.device)


def linearised_terms(model: DeviceModel) -> tuple[Term, ...]:
    """First variations of the model's terms, in their order."""
    return tuple(term.linearised for term in model.terms if term.linearised is not None)


def force_changes(model: DeviceModel, state: DeviceState, stiffness: Any, x: Any) -> None:
    """-H x: changes of the forces on nodes, of spin torques and of what flagella put on the body.

    Args:
        model, state: of the batch; the forces of `state` are replaced by their changes.
        stiffness: second derivatives at the state's pose, struct `Stiffness`.
        x: the increment, struct `Increment`.
    """
    terms = linearised_terms(model)
    for term in terms:
        if term.launch is not None:
            term.launch(model, state, stiffness, x)
    forces.total_forces(model, state, terms)
    body.sum_flagella(model, state, terms)


def apply(model: DeviceModel, state: DeviceState, stiffness: Any, band: Any, gain: wp.array, x: Any, out: Any) -> None:
    """D^-1 (1/dt + g M H) x (of the bodies: without D^-1) into out; forces and velocities of `state` are overwritten.

    Args:
        model, state: of the batch.
        stiffness, band: at the state's pose.
        gain: g, shape [cell_count].
        x: increment, struct `Increment`.
        out: where the product goes, struct `Increment`.
    """
    force_changes(model, state, stiffness, x)
    body.move_bodies(model, state)
    node_velocity.node_velocities(model, state)
    inputs = [model.data, state.data, band, gain, x, out]
    wp.launch(_kernel(model.precision), model.element_count, inputs=inputs, device=model.device)


def set_stiffness(model: DeviceModel, state: DeviceState, stiffness: Any) -> None:
    """Second derivatives of the energies at the state's pose, of all terms that have them, into `stiffness`."""
    for term in model.terms:
        if term.stiffness is not None:
            term.stiffness(model, state, stiffness)


def factorise(model: DeviceModel, state: DeviceState, stiffness: Any, band: Any) -> None:
    """Assembles and factorises the system of every cell; `singular` tells of a pivot that is not positive.

    Args:
        model, state: of the batch.
        stiffness: second derivatives at the state's pose, struct `Stiffness`.
        band: struct `Band`, with step and weight of every cell.
    """
    block_band.assemble(model, state, stiffness, band)
    body_coupling.couple(model, state, stiffness, band)
    block_band.factorise(model, state, band)
    body_coupling.factorise(model, state, band)


def solve(model: DeviceModel, state: DeviceState, band: Any, x: Any) -> None:
    """From D^-1 times velocities (of the bodies: velocities) to the increment that they cause, in place."""
    body_coupling.solve(model, state, band, x)
