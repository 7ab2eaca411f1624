"""The force terms of the model in their order: from this one list every right-hand side is built."""

from typing import Any

from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import DeviceModel, DeviceState
from warpflag_kernels.contact.pair_forces import BODY_CONTACT, STERIC, STERIC_WITH_SELF
from warpflag_kernels.motor.hook import HOOK, HOOK_THAT_STIFFENS
from warpflag_kernels.motor.laws import MOTOR_LAW
from warpflag_kernels.motor.torque import MOTOR
from warpflag_kernels.rod.elastic import BEARING, ELASTIC
from warpflag_kernels.rod.external import EXTERNAL
from warpflag_kernels.rod.free_end import FREE_END
from warpflag_kernels.rod.polymorphs import POLYMORPHS

TERMS = (
    *(MOTOR, MOTOR_LAW, POLYMORPHS, ELASTIC, BEARING, HOOK, HOOK_THAT_STIFFENS),
    *(STERIC, STERIC_WITH_SELF, BODY_CONTACT, EXTERNAL, FREE_END),
)


def terms_named(names: tuple[str, ...]) -> tuple[Term, ...]:
    """The terms of these names, in the order in which their forces are added up.

    Raises:
        ValueError: there is no term of such a name.
    """
    unknown = set(names) - {term.name for term in TERMS}
    if unknown:
        raise ValueError(f"there is no term {', '.join(sorted(unknown))}")
    return tuple(term for term in TERMS if term.name in names)


def after_step(model: DeviceModel, state: DeviceState, chart: Any, control: Any, counted: bool) -> None:
    """What terms do once a step has been accepted and committed, see `Term.after_step`."""
    for term in model.terms:
        if term.after_step is not None:
            term.after_step(model, state, chart, control, counted)
