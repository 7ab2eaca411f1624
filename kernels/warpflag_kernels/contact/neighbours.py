"""Verlet lists: for every segment, the near segments of other flagella, valid until a node has moved by half the skin.

With contact of a flagellum with itself the lists hold its own segments, too, from a spacing along the contour on.

The steric force, the contact search of a step and the guard against crossings all need to know which segments are
close. A list with a reach longer by the skin serves many passes: it is rebuilt only when some node of the cell has
moved by more than half the skin since. A segment with more neighbours than its list has room for tests all segments
instead; either way the result is the same, in the same order.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.native import native
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.contact.constants import OWN_SPACING

# Reach of the lists without the skin [sigma]: the cutoff 1.122 plus the margin of the search, rounded up.
CONTACT_REACH = 1.5
SKIN = 0.1  # [um]; at 6 mm/s, the fastest tips, a list serves 8 us
SLOTS = 64  # room of a list, and bits of the mask in which a search marks its contacts
# Bound on the length of a segment over that of the longest one at the last check: 1 plus twice the allowed strain.
SLACK = 1.1
TESTED_AT_ONCE = 16  # segments that a CPU tests at once: one vector of float32


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Neighbours`: a list of near segments for every segment, and where things were when it was built."""
    real, vec3 = p.real, p.vec3

    @wp.struct
    class Neighbours:
        position: wp.array(dtype=vec3)  # [E], of the nodes when the lists were built [um]
        left: wp.array(dtype=wp.int32)  # [K], 1: a node has moved by more than half the skin since
        # At the last such test, [E + TESTED_AT_ONCE]: midpoints of segments, and 0.55 times their lengths.
        x: wp.array(dtype=wp.float32)  # [um]
        y: wp.array(dtype=wp.float32)
        z: wp.array(dtype=wp.float32)
        half: wp.array(dtype=wp.float32)
        extent: wp.array(dtype=real)  # [K], of a flagellum around its middle node [um]
        stale: wp.array(dtype=wp.int32)  # [C], 1: the lists are no longer valid
        count: wp.array(dtype=wp.int32)  # [E], segments listed; -1: more than there is room for
        earlier: wp.array(dtype=wp.int32)  # [E], how many of them come before the segment
        segment: wp.array(dtype=wp.int32)  # [E * SLOTS]

    return Neighbours


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `Neighbours`, with lists that are not valid yet; none without steric forces."""
    p, near, device = model.precision, struct(model.precision)(), model.device
    if not model.switches.steric:
        return near

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=device)

    elements, flagella = model.element_count, model.flagellum_count
    near.position = wp.full(elements, p.vec3(1.0e30, 0.0, 0.0), dtype=p.vec3, device=device)  # far off: stale
    near.left, near.stale = zeros(flagella, wp.int32), zeros(model.cell_count, wp.int32)
    near.x, near.y, near.z, near.half = (zeros(elements + TESTED_AT_ONCE, wp.float32) for _ in range(4))
    near.extent = zeros(flagella, p.real)
    near.count, near.earlier = zeros(elements, wp.int32), zeros(elements, wp.int32)
    near.segment = zeros(elements * SLOTS, wp.int32)
    return near


@functools.cache
def functions(p: Precision, with_self: bool) -> SimpleNamespace:
    """Device functions: how many candidates a segment has, which they are, and how to skip those that are far."""
    real, vec3 = p.real, p.vec3
    Model, State, Neighbours = structs(p).Model, structs(p).State, struct(p)
    slots, slack = wp.constant(SLOTS), wp.constant(real(SLACK))
    own_spacing = wp.constant(real(OWN_SPACING))
    module = p.module("neighbours_functions", "self" if with_self else "")

    @wp.func(module=module)
    def spacing(model: Model, k: wp.int32, c: wp.int32):
        """Segments of flagellum k whose numbers differ by this much or more can touch."""
        return wp.max(int(own_spacing * model.steric.diameter[c] / model.rod.segment_length[k]) + 1, 2)

    @wp.func(module=module)
    def candidates(model: Model, near: Neighbours, e: wp.int32):
        """Number of segments to be tested against segment e."""
        n = near.count[e]
        if n < 0:
            c = model.cell_of[e]
            n = model.first_node[model.first_flagellum[c + 1]] - model.first_node[model.first_flagellum[c]]
        return n

    @wp.func(module=module)
    def candidate(model: Model, near: Neighbours, e: wp.int32, i: wp.int32):
        """The i-th of them, in ascending order; -1: none."""
        if near.count[e] >= 0:
            return near.segment[e * slots + i]
        j = model.first_node[model.first_flagellum[model.cell_of[e]]] + i
        k = model.flagellum_of[j]
        if wp.static(with_self):
            if j == model.first_node[k]:
                return -1
            if k == model.flagellum_of[e] and wp.abs(j - e) < spacing(model, k, model.cell_of[e]):
                return -1
        else:
            if k == model.flagellum_of[e] or j == model.first_node[k]:
                return -1
        return j

    @wp.func(module=module)
    def first_later(model: Model, near: Neighbours, e: wp.int32):
        """Index of the first candidate after the segment's own flagellum, or after the segment itself."""
        if near.count[e] >= 0:
            return near.earlier[e]
        if wp.static(with_self):
            return e + 1 - model.first_node[model.first_flagellum[model.cell_of[e]]]
        return model.first_node[model.flagellum_of[e] + 1] - model.first_node[model.first_flagellum[model.cell_of[e]]]

    @wp.func(module=module)
    def middle(state: State, e: wp.int32):
        return real(0.5) * (state.pose.position[e - 1] + state.pose.position[e])

    @wp.func(module=module)
    def next_near(longest: real, j: wp.int32, distance: real, reach: real):
        """The next segment after j that can be near: neighbouring midpoints are at most a segment's length apart.

        Args:
            longest: length of the longest segment of the flagellum of j [um].
            distance: of the midpoint of segment j [um].
            reach: how near a segment must come, its own half length not counted [um].
        """
        skipped = (distance - reach) / (slack * longest) - real(0.5)
        return j + 1 + int(wp.where(skipped > real(0.0), wp.min(skipped, real(1.0e6)), real(0.0)))  # none for NaN

    @wp.func(module=module)
    def beside(away: vec3, t: vec3, u: vec3, half_length: real, distance: real):
        """Whether a segment lies too far from the line of another to come within a distance of it.

        Args:
            away: from the midpoint of the other to its own [um].
            t, u: tangents, of the other and its own; half_length: its own [um].
        """
        along = wp.dot(away, t)
        c = wp.dot(t, u)
        sine = wp.sqrt(wp.max(real(1.0) - c * c, real(0.0)))
        clear = distance + half_length * sine
        return wp.dot(away, away) - along * along > clear * clear

    return SimpleNamespace(
        candidates=candidates,
        candidate=candidate,
        first_later=first_later,
        middle=middle,
        next_near=next_near,
        beside=beside,
        spacing=spacing,
    )


@functools.cache
def lists(p: Precision, with_self: bool) -> SimpleNamespace:
    """Device functions: whether the lists of a flagellum are outdated, the list of one segment, all of a cell."""
    real = p.real
    Model, State, Neighbours = structs(p).Model, structs(p).State, struct(p)
    middle, spacing = functions(p, with_self).middle, functions(p, with_self).spacing
    slots, skin = wp.constant(SLOTS), wp.constant(real(SKIN))
    contact_reach = wp.constant(real(CONTACT_REACH))
    # Half a length with a tenth added, for the stretch while lists are valid and for positions rounded to float32.
    half_share = wp.constant(real(0.55))
    module = p.module("neighbours_functions", "self" if with_self else "")

    @wp.func_native(native(__file__, "near_segments", p, SLOTS=SLOTS, TESTED_AT_ONCE=TESTED_AT_ONCE))
    def list_some(
        near: Neighbours,
        list: wp.int32,
        found: wp.int32,
        begin: wp.int32,
        end: wp.int32,
        x: wp.float32,
        y: wp.float32,
        z: wp.float32,
        within: wp.float32,
    ) -> int: ...

    @wp.func(module=module)
    def has_left(model: Model, state: State, near: Neighbours, k: wp.int32):
        """1: a node of flagellum k has moved by more than half the skin; else 0. Also stores midpoints of segments."""
        left = int(0)
        begin = model.first_node[k]
        end = model.first_node[k + 1]
        centre = state.pose.position[(begin + end) / 2]
        widest = real(0.0)
        e = begin
        while e < end:
            d = state.pose.position[e] - near.position[e]
            if not (real(4.0) * wp.dot(d, d) < skin * skin):  # true for NaN
                left = 1
            if e > begin:
                x = middle(state, e)
                half = half_share * state.pose.length[e]
                near.x[e] = wp.float32(x[0])
                near.y[e] = wp.float32(x[1])
                near.z[e] = wp.float32(x[2])
                near.half[e] = wp.float32(half)
                widest = wp.max(widest, wp.length(x - centre) + half)
            e += 1
        near.extent[k] = widest
        return left

    @wp.func(module=module)
    def list_near(model: Model, state: State, near: Neighbours, e: wp.int32, c: wp.int32):
        """The list of segment e of cell c."""
        own = model.flagellum_of[e]
        near.position[e] = state.pose.position[e]
        found = int(0)
        if e > model.first_node[own]:
            x = middle(state, e)
            within = contact_reach * model.steric.diameter[c] + real(0.5) * state.pose.length[e] + skin
            k = model.first_flagellum[c]
            while k < model.first_flagellum[c + 1]:
                if k == own:
                    if wp.static(with_self):
                        gap = spacing(model, k, c)
                        found = list_some(
                            near, e * slots, found, model.first_node[k] + 1, e - gap + 1,
                            wp.float32(x[0]), wp.float32(x[1]), wp.float32(x[2]), wp.float32(within),
                        )  # fmt: skip
                        near.earlier[e] = found
                        found = list_some(
                            near, e * slots, found, e + gap, model.first_node[k + 1],
                            wp.float32(x[0]), wp.float32(x[1]), wp.float32(x[2]), wp.float32(within),
                        )  # fmt: skip
                    else:
                        near.earlier[e] = found
                else:
                    begin = model.first_node[k]
                    end = model.first_node[k + 1]
                    away = x - state.pose.position[(begin + end) / 2]
                    reach = within + near.extent[k]
                    if wp.dot(away, away) < reach * reach:
                        found = list_some(
                            near, e * slots, found, begin + 1, end,
                            wp.float32(x[0]), wp.float32(x[1]), wp.float32(x[2]), wp.float32(within),
                        )  # fmt: skip
                k += 1
        near.count[e] = wp.where(found <= slots, found, -1)

    @wp.func(module=module)
    def refresh_cell(model: Model, state: State, near: Neighbours, c: wp.int32):
        """Rebuilds all lists of cell c, if one of them is no longer valid."""
        stale = int(0)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            stale = wp.max(stale, has_left(model, state, near, k))
            k += 1
        near.stale[c] = stale
        if stale == 0:
            return
        e = model.first_node[model.first_flagellum[c]]
        while e < model.first_node[model.first_flagellum[c + 1]]:
            list_near(model, state, near, e, c)
            e += 1

    return SimpleNamespace(has_left=has_left, list_near=list_near, refresh_cell=refresh_cell)


@functools.cache
def _kernels(p: Precision, with_self: bool) -> SimpleNamespace:
    Model, State, Neighbours = structs(p).Model, structs(p).State, struct(p)
    listing = lists(p, with_self)
    has_left, list_near, refresh_cell = listing.has_left, listing.list_near, listing.refresh_cell
    module = p.module("neighbours", "self" if with_self else "")

    @wp.kernel(module=module)
    def measure(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        near: Neighbours,
    ):
        k = wp.tid()
        near.left[k] = has_left(model, state, near, k)

    @wp.kernel(module=module)
    def judge(
        # Model:
        model: Model,
        # Out:
        near: Neighbours,
    ):
        c = wp.tid()
        stale = int(0)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            stale = wp.max(stale, near.left[k])
            k += 1
        near.stale[c] = stale

    @wp.kernel(module=module)
    def build(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        near: Neighbours,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if near.stale[c] != 0:
            list_near(model, state, near, e, c)

    @wp.kernel(module=module)
    def refresh_cells(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        near: Neighbours,
    ):
        refresh_cell(model, state, near, wp.tid())

    return SimpleNamespace(measure=measure, judge=judge, build=build, refresh_cells=refresh_cells)


def refresh(model: DeviceModel, state: DeviceState) -> None:
    """Makes the lists valid at the current positions: rebuilds those of cells in which a node has moved too far."""
    kernels = _kernels(model.precision, model.switches.self_contact)
    near, device = state.neighbours, model.device
    inputs = [model.data, state.data, near]
    if model.plan.by_cells:
        wp.launch(kernels.refresh_cells, model.cell_count, inputs=inputs, device=device)
        return
    wp.launch(kernels.measure, model.flagellum_count, inputs=inputs, device=device)
    wp.launch(kernels.judge, model.cell_count, inputs=[model.data, near], device=device)
    wp.launch(kernels.build, model.element_count, inputs=inputs, device=device)
