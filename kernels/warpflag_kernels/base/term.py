"""A term of the forces: the device functions that it has, and the sums of those of several terms.

Every right-hand side is built from one ordered list of terms (`stepping/terms.py`): launched stage by stage, for a
whole cell in one launch, without the contacts that an implicit step solves for, or linearised. The Rotne-Prager sum and
the mobility of the body act on the total and are no terms.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import structs


def _nothing(_precision: Precision) -> SimpleNamespace:
    return SimpleNamespace()


@dataclass(frozen=True)
class Term:
    """One term of the forces.

    Attributes:
        name: for people and in the names of kernel modules.
        launch: evaluates what the device functions then read, for all cells: `launch(model, state)`. None: nothing.
        functions: of a precision, the device functions that the term has, of these:

            in_cell(model, state, near, c), in_flagellum(model, state, k, c): what `launch` does, for one cell or one
                flagellum, by one thread;
            on_first(model, state, e, k, force), on_second(model, state, e, k, force): adds the force of segment e of
                flagellum k on its first or on its second node to `force` [pN];
            on_node(model, state, e, k, force): adds a force on node e [pN]; what acts on r_0 goes to the body;
            on_spin(model, state, e, k, torque): adds a torque on segment e about its tangent [pN um];
            on_body(model, state, k, force, torque): adds what the term puts on the body beside the anchors' forces, the
                share of flagellum k, to a force [pN] and a torque about the body's centre [pN um], and returns both;
            energy(model, state, e, k, energy): adds what the term has stored at element e, its segment and the joint
                after it, to `energy` [pN um], in float64. Its forces are then minus the gradient of that. The forces of
                a term without it count as work from outside in the power balance of a step.
            settle(model, state, c): called when all else that acts on the flagella of cell c and on its body is known,
                and before the body moves: adds to `spin_torque` and `flagellum_torque` what depends on their rates.
                One term alone can have it.

        contact: whether an implicit step solves for the term's forces instead of evaluating them.
        linearised: the term whose forces are this one's first variation; its launch is
            `launch(model, state, stiffness, increment)`. None: the force does not depend on the pose, or its change is
            found with that of another term.
        stiffness: sets or adds to the second derivatives of the energy in the matrix of an implicit step,
            `stiffness(model, state, stiffness)`, in the order of the terms. None: it has none there.
        within_step: the term that stands for this one in an implicit step. None: itself.
        timed: whether its forces depend explicitly on time, `State.time`.
        after_step: changes the term's own state once a step has been accepted and committed, a part of a pass:
            `after_step(model, state, chart, control, counted)`; `counted` says whether the clocks have been advanced to
            the end of the step. None: it has no such state.
        jumps: whether that can change forces at the pose that the step has led to.
        carried: arrays of that state, by their dotted names in `DeviceState.optional`; checkpoints hold them.
    """

    name: str
    launch: Callable[..., None] | None = None
    functions: Callable[[Precision], SimpleNamespace] = _nothing
    contact: bool = False
    linearised: "Term | None" = None
    stiffness: Callable[..., None] | None = None
    within_step: "Term | None" = None
    timed: bool = False
    after_step: Callable[..., None] | None = None
    jumps: bool = False
    carried: tuple[str, ...] = ()


def variant(terms: Sequence[Term]) -> str:
    """Name of a choice of terms, for kernel modules."""
    return "_".join(term.name.replace(" ", "_") for term in terms)


def acting(p: Precision, terms: Sequence[Term], *kinds: str) -> tuple[Term, ...]:
    """Those terms that have a device function of one of these kinds: a kernel that calls no other is theirs alone."""
    return tuple(term for term in terms if any(hasattr(term.functions(p), kind) for kind in kinds))


@functools.cache
def combined(p: Precision, terms: tuple[Term, ...]) -> SimpleNamespace:
    """The device functions of `Term.functions`, each summed over several terms in their order.

    `in_cell` and `in_flagellum` are lists with one function per term that has it; `settle` is that of the one term that
    has it, or None.
    """
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    module = p.module("terms", variant(terms))
    own = [term.functions(p) for term in terms]

    def of(kind: str) -> list[Any]:
        return [getattr(functions, kind) for functions in own if hasattr(functions, kind)]

    def added(parts: list[Any], quantity: Any) -> Any:
        """One function that adds force or torque of all parts."""
        if len(parts) == 1:
            return parts[0]
        if not parts:

            @wp.func(module=module)
            def nothing(model: Model, state: State, e: wp.int32, k: wp.int32, total: quantity):
                return total

            return nothing
        earlier, last = added(parts[:-1], quantity), parts[-1]

        @wp.func(module=module)
        def both(model: Model, state: State, e: wp.int32, k: wp.int32, total: quantity):
            return last(model, state, e, k, earlier(model, state, e, k, total))

        return both

    def loaded(parts: list[Any]) -> Any:
        """One function that adds what all parts put on the body."""
        if len(parts) == 1:
            return parts[0]
        if not parts:

            @wp.func(module=module)
            def nothing(model: Model, state: State, k: wp.int32, force: vec3, torque: vec3):
                return force, torque

            return nothing
        earlier, last = loaded(parts[:-1]), parts[-1]

        @wp.func(module=module)
        def both(model: Model, state: State, k: wp.int32, force: vec3, torque: vec3):
            f, t = earlier(model, state, k, force, torque)
            f, t = last(model, state, k, f, t)
            return f, t

        return both

    return SimpleNamespace(
        on_first=added(of("on_first"), vec3),
        on_second=added(of("on_second"), vec3),
        on_node=added(of("on_node"), vec3),
        on_spin=added(of("on_spin"), real),
        on_body=loaded(of("on_body")),
        energy=added(of("energy"), wp.float64),
        in_cell=of("in_cell"),
        in_flagellum=of("in_flagellum"),
        settle=next(iter(of("settle")), None),
    )
