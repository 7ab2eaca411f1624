"""The linear system of an implicit step, bodies and flagella together: factors and solutions."""

from typing import Any

from warpflag_kernels.base.types import DeviceModel, DeviceState
from warpflag_kernels.implicit import block_band, body_coupling


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
    """From D^-1 times velocities (of the bodies: plain velocities) to the increment they cause; in place of them."""
    block_band.solve(model, state, band, x)
    body_coupling.solve(model, state, band, x)
