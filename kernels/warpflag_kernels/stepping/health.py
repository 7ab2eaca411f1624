"""Guards: finite values, strain, twist and fold of every joint, crossed centre lines.

A step too long, or a load too strong, gives wrong finite numbers long before it gives NaN. So at a start, every
`interval` steps and at the end of an advance, these kernels check the state and record the first violated guard of
each cell; the stepper then stops that cell. Crossings are found by moving both segments of a near pair linearly from
the last check to this one: they have crossed if they touch at a time at which their four ends are coplanar.
"""

import functools
import math
from enum import IntEnum
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import clock
from warpflag_kernels.base.clock import Control
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact import contact_list, neighbours, search
from warpflag_kernels.contact import crossing as crossing_of
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.rod import rotations

LARGEST_STRAIN = 0.05  # of a segment; 50 pN at the default stretching stiffness
LARGEST_TWIST = 0.5 * math.pi  # per joint [rad]: beyond a quarter of a turn the discrete twist does not resolve the rod
SMALLEST_FOLD = 0.03  # of 1 + t.u: neighbours at more than 166 degrees; the curvature 2 tan(angle/2) diverges at 180
LARGEST_TURN = 2.0  # of a motor in one step [rad]: angles of a step are added up, and are ambiguous from pi on
CROSSED = 0.05  # distance at which crossing centre lines count as touching [sigma]
ELEMENT_BITS = 26  # of a fault code: room for 67 million elements


class Fault(IntEnum):
    """The kinds of faults; when several guards are violated at once, the lower value is reported."""

    NOT_FINITE = 0
    CROSSING = 1
    STRAIN = 2
    TWIST = 3
    FOLD = 4
    UNSOLVED = 5
    TURN = 6
    ACCURACY = 7
    BALANCE = 8
    UNSTABLE = 9
    CROWDED = 10
    PRESSED = 11


def encode(kind: Fault) -> int:
    """Fault code of a kind: the kind in the upper bits; the element is added in the lower ones."""
    return int(kind) << ELEMENT_BITS


def decode(code: int) -> tuple[Fault, int]:
    """Kind and element of a fault code."""
    return Fault(code >> ELEMENT_BITS), code & ((1 << ELEMENT_BITS) - 1)


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Guard`: positions at the last check, and distances moved since."""
    real, vec3 = p.real, p.vec3

    @wp.struct
    class Guard:
        interval: wp.array(dtype=wp.int32)  # [C], steps between two checks
        # Empty where nothing can cross.
        position: wp.array(dtype=vec3)  # [E], at the last check [um]
        longest: wp.array(dtype=real)  # [K], its longest segment [um]
        moved: wp.array(dtype=real)  # [K], largest displacement of a node since [um]
        strayed: wp.array(dtype=real)  # [K], the same since the last search for contacts, if the stepper searches [um]
        shifted: wp.array(dtype=real)  # [K], the same since the neighbour lists were built [um]

    return Guard


def allocate(model: DeviceModel, chart: Any) -> Any:
    """Arrays of the struct `Guard`; the start of the chart counts as checked."""
    g = struct(model.precision)()
    g.interval = wp.ones(model.cell_count, dtype=wp.int32, device=model.device)
    if model.switches.steric:
        g.position = wp.clone(chart.base.position)
        g.longest, g.moved, g.strayed, g.shifted = (
            wp.zeros(model.flagellum_count, dtype=model.precision.real, device=model.device) for _ in range(4)
        )
    return g


@functools.cache
def _kernels(p: Precision, with_self: bool) -> SimpleNamespace:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Chart, Guard = chart_stage.struct(p), struct(p)
    twist = rotations.functions(p).twist
    distance, crossed = crossing_of.functions(p).distance, crossing_of.functions(p).crossed
    near_by = neighbours.functions(p, with_self)
    candidates, candidate, first_later = near_by.candidates, near_by.candidate, near_by.first_later
    beside, middle, next_near, spacing = near_by.beside, near_by.middle, near_by.next_near, near_by.spacing
    Neighbours, skin = neighbours.struct(p), wp.constant(real(neighbours.SKIN))
    Contacts, listed_reach = contact_list.struct(p), wp.constant(real(search.REACH))
    contact_reach = wp.constant(real(neighbours.CONTACT_REACH))
    largest_strain, smallest_fold = real(LARGEST_STRAIN), real(SMALLEST_FOLD)
    touching = wp.constant(real(CROSSED))
    least_cosine = wp.constant(real(math.cos(LARGEST_TWIST)))
    advanced = clock.functions().advanced
    not_finite, crossing = encode(Fault.NOT_FINITE), encode(Fault.CROSSING)
    strained, twisted, folded = encode(Fault.STRAIN), encode(Fault.TWIST), encode(Fault.FOLD)
    turned, largest_turn = encode(Fault.TURN), real(LARGEST_TURN)
    module = p.module("health", "self" if with_self else "")

    @wp.func(module=module)
    def due(control: Control, guard: Guard, chart: Chart, c: wp.int32):
        if chart.commit[c] == 0:
            return chart.at_start[c] != 0  # a start
        ends = advanced(control, c) >= control.target[c]
        return ends or (control.steps[c] + 1) % guard.interval[c] == 0

    @wp.kernel(module=module)
    def check_elements(
        # Model:
        model: Model,
        # State:
        state: State,
        chart: Chart,
        guard: Guard,
        # Out:
        control: Control,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0 or not due(control, guard, chart, c):
            return
        k = model.flagellum_of[e]
        x = state.pose.position[e]
        director = state.pose.director[e]
        # Normalising turns a director that is not finite into zero.
        directed = wp.dot(director, director) > real(0.5)
        if not (wp.isfinite(x[0] + x[1] + x[2]) and wp.isfinite(state.spin_torque[e]) and directed):
            wp.atomic_min(control.fault, c, not_finite + e)
            return
        if e == model.first_node[k] and wp.abs(chart.increment[e][3]) > largest_turn:
            wp.atomic_min(control.fault, c, turned + e)
        strain = state.pose.length[e] / model.rod.segment_length[k] - real(1.0)
        if e > model.first_node[k] and wp.abs(strain) > largest_strain:
            wp.atomic_min(control.fault, c, strained + e)
        free_end = e == model.first_node[k] and model.rod.hook_rigidity[k] == real(0.0)
        if e + 1 < model.first_node[k + 1] and not free_end:
            t = state.pose.tangent[e]
            u = state.pose.tangent[e + 1]
            if real(1.0) + wp.dot(t, u) < smallest_fold:
                wp.atomic_min(control.fault, c, folded + e)
            _sine, cosine = twist(t, u, state.pose.director[e], state.pose.director[e + 1])
            if cosine < least_cosine:
                wp.atomic_min(control.fault, c, twisted + e)

    @wp.func(module=module)
    def met(state: State, guard: Guard, e: wp.int32, j: wp.int32, moved: real, touch: real):
        """Whether segments e and j have passed through each other since the last check.

        Args:
            moved: largest displacement of a node since [um].
            touch: distance at which segments count as touching [um].
        """
        away = middle(state, e) - middle(state, j)
        half = real(0.5) * state.pose.length[j]
        within = real(0.5) * state.pose.length[e] + half + touch
        reach = within + real(2.0) * moved
        if not (wp.dot(away, away) < reach * reach):
            return False
        # The relative displacement of two points of the segments is at most that of their ends.
        p1n, q1n, p2n, q2n = (
            state.pose.position[e - 1],
            state.pose.position[e],
            state.pose.position[j - 1],
            state.pose.position[j],
        )
        p1, q1, p2, q2 = guard.position[e - 1], guard.position[e], guard.position[j - 1], guard.position[j]
        dp1, dq1, dp2, dq2 = p1n - p1, q1n - q1, p2n - p2, q2n - q2
        parted = wp.max(wp.length_sq(dp1 - dp2), wp.length_sq(dq1 - dq2))
        parted = wp.sqrt(wp.max(parted, wp.max(wp.length_sq(dp1 - dq2), wp.length_sq(dq1 - dp2))))
        reach = within + parted
        return (
            wp.dot(away, away) < reach * reach
            and not beside(away, state.pose.tangent[e], state.pose.tangent[j], half, touch + parted)
            and distance(p1n, q1n - p1n, p2n, q2n - p2n) < touch + parted
            and crossed(p1, q1, p2, q2, p1n, q1n, p2n, q2n, touch)
        )

    @wp.func(module=module)
    def farthest(model: Model, displacements: wp.array(dtype=real), c: wp.int32):
        """The largest displacement of a node of cell c, from those of its flagella [um]."""
        longest = real(0.0)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            longest = wp.max(longest, displacements[k])
            k += 1
        return longest

    @wp.kernel(module=module)
    def check_crossings(
        # Model:
        model: Model,
        # State:
        state: State,
        chart: Chart,
        guard: Guard,
        near: Neighbours,
        listed: Contacts,
        # Out:
        control: Control,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0 or not due(control, guard, chart, c):
            return
        k = model.flagellum_of[e]
        if e == model.first_node[k]:
            return
        if wp.static(not with_self) and k + 1 == model.first_flagellum[c + 1]:
            return
        touch = touching * model.steric.diameter[c]
        if chart.commit[c] == 0:  # a start has no earlier check: no pair may touch already
            p1 = state.pose.position[e - 1]
            other = k + 1
            while other < model.first_flagellum[c + 1]:
                j = model.first_node[other] + 1
                while j < model.first_node[other + 1]:
                    p2 = state.pose.position[j - 1]
                    if distance(p1, state.pose.position[e] - p1, p2, state.pose.position[j] - p2) < touch:
                        wp.atomic_min(control.fault, c, crossing + e)
                    away = wp.length(middle(state, e) - middle(state, j)) - touch
                    j = next_near(guard.longest[other], j, away, real(0.5) * state.pose.length[e])
                other += 1
            return
        moved = farthest(model, guard.moved, c)
        # A pair that can have met between the two checks is in the list of contacts, or in the neighbour lists, if no
        # node has been too far from its position when the list was made.
        as_contact = bool(False)
        if listed.position.shape[0] > 0:
            strayed = real(2.0) * farthest(model, guard.strayed, c) + touch
            as_contact = strayed < listed_reach * model.steric.diameter[c]
        shifted = real(2.0) * farthest(model, guard.shifted, c) + touch
        as_neighbour = shifted < contact_reach * model.steric.diameter[c] + skin
        i = first_later(model, near, e)
        stop = candidates(model, near, e)
        if as_contact:
            i = listed.start[e]
            stop = listed.stop[e]
        # Else all segments later in the cell, but for those too far away.
        reach = real(0.5) * state.pose.length[e] + touch + real(2.0) * moved
        last = model.first_flagellum[c + 1]
        other = k
        following = e + 1
        end = e + 1
        if wp.static(with_self):
            following = e + spacing(model, k, c)
            end = model.first_node[k + 1]
        going = bool(True)
        while going:  # one loop for lists and all segments: the test of a pair, compiled once
            j = int(-1)
            if as_contact or as_neighbour:
                going = i < stop
                if going and as_contact:
                    j = listed.other[i]
                elif going:
                    j = candidate(model, near, e, i)
                i += 1
            elif following < end:
                j = following
                away = wp.length(middle(state, e) - middle(state, j))
                following = next_near(guard.longest[other], j, away, reach)
            else:
                other += 1
                going = other < last
                if going:
                    following = model.first_node[other] + 1
                    end = model.first_node[other + 1]
            if j >= 0 and met(state, guard, e, j, moved, touch):
                wp.atomic_min(control.fault, c, crossing + e)

    @wp.kernel(module=module)
    def measure_moves(
        # Model:
        model: Model,
        # State:
        state: State,
        near: Neighbours,
        listed: Contacts,
        # Out:
        guard: Guard,
    ):
        k = wp.tid()
        e = model.first_node[k]
        if state.active[model.cell_of[e]] == 0:
            return
        moved = real(0.0)
        shifted = real(0.0)
        longest = real(0.0)
        strayed = real(0.0)
        while e < model.first_node[k + 1]:
            if e > model.first_node[k]:
                longest = wp.max(longest, state.pose.length[e])
            x = state.pose.position[e]
            checked = guard.position[e]
            moved = wp.max(moved, wp.length_sq(x - checked))
            shifted = wp.max(shifted, wp.length_sq(x - near.position[e]))
            shifted = wp.max(shifted, wp.length_sq(checked - near.position[e]))
            if listed.position.shape[0] > 0:
                strayed = wp.max(strayed, wp.length_sq(x - listed.position[e]))
                strayed = wp.max(strayed, wp.length_sq(checked - listed.position[e]))
            e += 1
        guard.longest[k] = longest
        guard.moved[k] = wp.sqrt(moved)
        guard.shifted[k] = wp.sqrt(shifted)
        guard.strayed[k] = wp.sqrt(strayed)

    @wp.kernel(module=module)
    def remember(
        # Model:
        model: Model,
        # State:
        state: State,
        control: Control,
        chart: Chart,
        # Out:
        guard: Guard,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] != 0 and due(control, guard, chart, c):
            guard.position[e] = state.pose.position[e]

    return SimpleNamespace(
        check_elements=check_elements, check_crossings=check_crossings, measure_moves=measure_moves, remember=remember
    )


def check(model: DeviceModel, state: DeviceState, chart: Any, guard: Any, control: Control, listed: Any = None) -> None:
    """Checks every start and every completed step that is due; records the first violated guard of a cell in `fault`.

    Args:
        model, state: of the batch.
        chart, guard, control: structs `Chart`, `Guard`, `Control`.
        listed: struct `Contacts` of a search made between the last check and this one, if any.
    """
    kernels = _kernels(model.precision, model.switches.self_contact)
    inputs = [model.data, state.data, chart, guard, control]
    wp.launch(kernels.check_elements, model.element_count, inputs=inputs, device=model.device)
    if model.switches.steric:
        found = contact_list.struct(model.precision)() if listed is None else listed  # without arrays: no list
        moves = [model.data, state.data, state.neighbours, found, guard]
        wp.launch(kernels.measure_moves, model.flagellum_count, inputs=moves, device=model.device)
        inputs = [model.data, state.data, chart, guard, state.neighbours, found, control]
        wp.launch(kernels.check_crossings, model.element_count, inputs=inputs, device=model.device)


def remember(model: DeviceModel, state: DeviceState, chart: Any, guard: Any, control: Control) -> None:
    """Stores the checked positions, from which the next check moves the segments on."""
    if model.switches.steric:
        inputs = [model.data, state.data, control, chart, guard]
        kernel = _kernels(model.precision, model.switches.self_contact).remember
        wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)
