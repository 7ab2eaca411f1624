"""The contact law in the space of gaps: gap = free + W F(gap), F the steric force law, solved by Newton.

W, the compliance, says how a unit force at one contact opens another. Only closed contacts, whose stiffness is not
zero, need a factorisation; open ones follow.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels import chain, contacts, steric
from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

GROUP = 8  # columns that travel together: a vector register of float64
NEWTON_ITERATIONS = 60
HALVINGS = 8


@functools.cache
def types(p: Precision) -> SimpleNamespace:
    """Block types of a group of columns, and the struct `Response`."""
    real = p.real
    mat4g = wp.types.matrix((4, GROUP), real)
    mat6g = wp.types.matrix((6, GROUP), real)

    @wp.struct
    class Response:
        first_column: wp.array(dtype=wp.int32)  # [C + 1], of a cell's groups in `columns`
        columns: wp.array(dtype=mat4g)  # [sum of groups * elements per cell]
        body_columns: wp.array(dtype=mat6g)  # [groups]
        first_entry: wp.array(dtype=wp.int32)  # [C], of a cell's matrices
        compliance: wp.array(dtype=real)  # W [um/pN]
        factor: wp.array(dtype=real)  # of the closed contacts
        closed: wp.array(dtype=wp.int32)  # [capacity], their indices
        free_gap: wp.array(dtype=real)  # [capacity], gap without contact forces
        solved_gap: wp.array(dtype=real)  # [capacity]
        residual: wp.array(dtype=real)  # [capacity]
        change: wp.array(dtype=real)  # [capacity]
        force: wp.array(dtype=real)  # [capacity] [pN]
        total_force: wp.array(dtype=real)  # [capacity], corrections included [pN]
        closed_count: wp.array(dtype=wp.int32)  # [C], rows of `factor`
        gain: wp.array(dtype=wp.float64)  # [C], g
        failed: wp.array(dtype=wp.int32)  # [C], 1: the contact law was not solved

    return SimpleNamespace(mat4g=mat4g, mat6g=mat6g, Response=Response)


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real = p.real
    Model, State, Response = structs(p).Model, structs(p).State, types(p).Response
    Contacts, Increment = contacts.struct(p), chain.types(p).Increment
    steric_force, steric_stiffness = steric.functions(p).steric_force, steric.functions(p).steric_stiffness
    gap_change = contacts.functions(p).gap_change
    iterations, halvings = wp.constant(NEWTON_ITERATIONS), wp.constant(HALVINGS)
    infinite = wp.constant(real(3.0e38))
    module = p.module("gaps")

    @wp.func(module=module)
    def row_product(a: wp.array(dtype=real), i: wp.int32, b: wp.array(dtype=real), j: wp.int32, count: wp.int32):
        """Sum of a[i + m] b[j + m] over m < count; flat arrays and a while loop, so that it vectorises."""
        total = real(0.0)
        m = int(0)
        while m < count:
            total += a[i + m] * b[j + m]
            m += 1
        return total

    @wp.func(module=module)
    def evaluate(response: Response, strength: real, diameter: real, first: wp.int32, entry: wp.int32, count: wp.int32):
        """Forces and residuals at the solved gaps; the largest residual."""
        i = int(0)
        while i < count:
            response.force[first + i] = steric_force(response.solved_gap[first + i], strength, diameter)
            i += 1
        worst = real(0.0)
        i = int(0)
        while i < count:
            r = response.solved_gap[first + i] - response.free_gap[first + i]
            r -= row_product(response.compliance, entry + i * count, response.force, first, count)
            response.residual[first + i] = r
            if not wp.isfinite(r):
                r = infinite  # a maximum would pass over what is not a number
            worst = wp.max(worst, wp.abs(r))
            i += 1
        return worst

    @wp.func(module=module)
    def factorise_closed(
        response: Response, strength: real, diameter: real, first: wp.int32, entry: wp.int32, count: wp.int32
    ):
        """Factors L U of (1/k + W) over the closed contacts, k the contact stiffness; how many they are.

        W lacks symmetry by as much as the flows of the pair sum, since the matrix behind P leaves them out: a
        Cholesky factor of one half of it fails in a crowd. Rows of L, then columns of U, one after another without
        gaps; L has a unit diagonal, U the inverses of its own.
        """
        closed = int(0)
        i = int(0)
        while i < count:
            if steric_stiffness(response.solved_gap[first + i], strength, diameter) > real(0.0):
                response.closed[first + closed] = i
                closed += 1
            i += 1
        upper = entry + closed * (closed - 1) / 2
        i = int(0)
        while i < closed:
            a = response.closed[first + i]
            row = entry + i * (i - 1) / 2
            column = upper + i * (i + 1) / 2
            j = int(0)
            while j < i:
                b = response.closed[first + j]
                before = row_product(response.factor, row, response.factor, upper + j * (j + 1) / 2, j)
                pivot = response.factor[upper + j * (j + 1) / 2 + j]
                response.factor[row + j] = (response.compliance[entry + a * count + b] - before) * pivot
                before = row_product(response.factor, entry + j * (j - 1) / 2, response.factor, column, j)
                response.factor[column + j] = response.compliance[entry + b * count + a] - before
                j += 1
            value = response.compliance[entry + a * count + a]
            value += real(1.0) / steric_stiffness(response.solved_gap[first + a], strength, diameter)
            value -= row_product(response.factor, row, response.factor, column, i)
            response.factor[column + i] = real(1.0) / value
            i += 1
        return closed

    @wp.func(module=module)
    def solve_closed(response: Response, first: wp.int32, entry: wp.int32, count: wp.int32, closed: wp.int32):
        """Solves with those factors; right-hand side and solution in `change`."""
        i = int(0)
        while i < closed:
            row = entry + i * (i - 1) / 2
            response.change[first + i] -= row_product(response.factor, row, response.change, first, i)
            i += 1
        i = closed - 1
        while i >= 0:
            column = entry + closed * (closed - 1) / 2 + i * (i + 1) / 2
            value = response.change[first + i] * response.factor[column + i]
            response.change[first + i] = value
            j = int(0)
            while j < i:
                response.change[first + j] -= response.factor[column + j] * value
                j += 1
            i -= 1

    @wp.kernel(module=module)
    def free_gaps(
        # State:
        state: State,
        contacts_in: Contacts,
        # Out:
        response: Response,
    ):
        c, index = wp.tid()
        count = contacts_in.count[c]
        if state.active[c] == 0 or index >= count:
            return
        first = contacts_in.first[c]
        row = response.first_entry[c] + index * count
        caused = row_product(response.compliance, row, response.force, first, count)
        response.free_gap[first + index] = contacts_in.gap[first + index] - caused

    @wp.kernel(module=module)
    def solve_gaps(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        accuracy: real,
        # Out:
        response: Response,
    ):
        c = wp.tid()
        count = contacts_in.count[c]
        if state.active[c] == 0 or count == 0:
            return
        first = contacts_in.first[c]
        entry = response.first_entry[c]
        strength = model.steric_strength[c]
        diameter = model.steric_diameter[c]
        tolerance = accuracy * diameter
        i = int(0)
        while i < count:
            response.solved_gap[first + i] = contacts_in.gap[first + i]
            i += 1
        worst = evaluate(response, strength, diameter, first, entry, count)
        iteration = int(0)
        closed = response.closed_count[c]  # -1: no factor yet of these contacts
        stalled = closed < 0
        while worst > tolerance and iteration < iterations:
            # An old factor serves as long as it brings the residual down quickly.
            if stalled:
                closed = factorise_closed(response, strength, diameter, first, entry, count)
            i = int(0)
            while i < closed:
                response.change[first + i] = -response.residual[first + response.closed[first + i]]
                i += 1
            solve_closed(response, first, entry, count, closed)
            # Change of every gap: -residual - W lambda, lambda spread over all contacts.
            i = int(0)
            while i < count:
                response.force[first + i] = real(0.0)
                i += 1
            i = int(0)
            while i < closed:
                response.force[first + response.closed[first + i]] = response.change[first + i]
                i += 1
            i = int(0)
            while i < count:
                row = entry + i * count
                value = response.residual[first + i]
                value += row_product(response.compliance, row, response.force, first, count)
                response.change[first + i] = -value
                response.solved_gap[first + i] -= value
                i += 1
            before = worst
            worst = evaluate(response, strength, diameter, first, entry, count)
            halving = int(0)
            scale = real(1.0)
            while not (worst < before) and halving < halvings and worst > tolerance:
                scale = real(0.5) * scale
                i = int(0)
                while i < count:
                    response.solved_gap[first + i] -= scale * response.change[first + i]
                    i += 1
                worst = evaluate(response, strength, diameter, first, entry, count)
                halving += 1
            stalled = worst > real(0.3) * before
            iteration += 1
        if not (worst <= tolerance):
            response.failed[c] = 1
        if closed < 0:
            closed = factorise_closed(response, strength, diameter, first, entry, count)
        response.closed_count[c] = closed
        i = int(0)
        while i < count:
            response.total_force[first + i] = response.force[first + i]
            i += 1

    @wp.kernel(module=module)
    def yield_closed(
        # Model:
        model: Model,
        # State:
        state: State,
        contacts_in: Contacts,
        x: Increment,
        # Out:
        response: Response,
    ):
        c = wp.tid()
        count = contacts_in.count[c]
        if state.active[c] == 0 or count == 0:
            return
        first = contacts_in.first[c]
        entry = response.first_entry[c]
        closed = response.closed_count[c]
        i = int(0)
        while i < closed:
            a = first + response.closed[first + i]
            response.change[first + i] = -gap_change(model, state, contacts_in, a, x)
            i += 1
        solve_closed(response, first, entry, count, closed)
        i = int(0)
        while i < count:
            response.force[first + i] = real(0.0)
            i += 1
        i = int(0)
        while i < closed:
            a = first + response.closed[first + i]
            response.force[a] = response.change[first + i]
            response.total_force[a] += response.change[first + i]
            i += 1

    return SimpleNamespace(free_gaps=free_gaps, solve_gaps=solve_gaps, yield_closed=yield_closed)


def solve_gaps(model: DeviceModel, state: DeviceState, contacts_in: Any, response: Any, accuracy: float) -> None:
    """Gaps and forces from the free gaps and the compliance; `failed` tells of a cell without a solution.

    Args:
        accuracy: of a gap, in units of sigma.
    """
    inputs = [model.data, state.data, contacts_in, accuracy, response]
    wp.launch(_kernels(model.precision).solve_gaps, model.cell_count, inputs=inputs, device=model.device)


def free_gaps(model: DeviceModel, state: DeviceState, contacts_in: Any, response: Any, most: int) -> None:
    """What the listed gaps would be without the present contact forces; `most` contacts per cell at most."""
    inputs = [state.data, contacts_in, response]
    kernel = _kernels(model.precision).free_gaps
    wp.launch(kernel, (model.cell_count, most), inputs=inputs, device=model.device)


def yield_closed(model: DeviceModel, state: DeviceState, contacts_in: Any, response: Any, change: Any) -> None:
    """How the forces of closed contacts answer to a small change of the increment, linearly, into `force`."""
    inputs = [model.data, state.data, contacts_in, change, response]
    wp.launch(_kernels(model.precision).yield_closed, model.cell_count, inputs=inputs, device=model.device)
