"""Steric forces: segment against segment of different flagella, node against the body surface.

The paper's truncated Lennard-Jones force, F(r) = F_0 [2 (sigma/r)^13 - (sigma/r)^7] below 2^(1/6) sigma, r the
minimal distance of the two centre lines (for the body: of the node from the surface). Below 0.7 sigma it continues
along its tangent there, so that a deep overlap still pushes back with a finite force.

Every pair of segments within the cutoff acts, so a contact near a vertex counts up to four times. A force at
parameter t of a segment acts by (1 - t) on its first and t on its second node: force and torque are conserved
exactly. Each segment sums its own pairs; both sides evaluate a pair in the same order, hence to the same bits.
"""

import functools
import math
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.types import DeviceModel, DeviceState, Precision, structs

CUTOFF = 2.0 ** (1.0 / 6.0)  # in units of sigma
LINEAR_BELOW = 0.7
_FORCE_THERE = 2.0 * LINEAR_BELOW**-13 - LINEAR_BELOW**-7  # in units of F_0
_SLOPE_THERE = 26.0 * LINEAR_BELOW**-14 - 7.0 * LINEAR_BELOW**-8  # -dF/dr in units of F_0/sigma
assert math.isclose(_FORCE_THERE, 194.3, rel_tol=1e-3)


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of contact: the force law and the closest points of two segments."""
    real, vec3 = p.real, p.vec3
    vec2 = wp.types.vector(2, real)
    cutoff = real(CUTOFF)
    linear_below, force_there, slope_there = real(LINEAR_BELOW), real(_FORCE_THERE), real(_SLOPE_THERE)

    @wp.func(module=p.module("steric_functions"))
    def steric_force(r: real, strength: real, diameter: real):
        """Repulsion at distance r [pN]; r may be negative (a node below the body surface)."""
        x = r / diameter
        if x >= cutoff:
            return real(0.0)
        if x < linear_below:
            return strength * (force_there + slope_there * (linear_below - x))
        y = real(1.0) / x
        y3 = y * y * y
        y6 = y3 * y3
        return strength * y6 * y * (real(2.0) * y6 - real(1.0))

    @wp.func(module=p.module("steric_functions"))
    def steric_stiffness(r: real, strength: real, diameter: real):
        """-dF/dr at distance r [pN/um]."""
        x = r / diameter
        if x >= cutoff:
            return real(0.0)
        if x < linear_below:
            return strength / diameter * slope_there
        y = real(1.0) / x
        y2 = y * y
        y6 = y2 * y2 * y2
        return strength / diameter * y6 * y2 * (real(26.0) * y6 - real(7.0))

    @wp.func(module=p.module("steric_functions"))
    def closest_parameters(p1: vec3, d1: vec3, p2: vec3, d2: vec3):
        """Parameters in [0, 1] of the closest points of segments p1 + s d1 and p2 + t d2."""
        zero, one = real(0.0), real(1.0)
        r = p1 - p2
        a = wp.dot(d1, d1)
        e = wp.dot(d2, d2)
        f = wp.dot(d2, r)
        c = wp.dot(d1, r)
        b = wp.dot(d1, d2)
        # Through the cross product: a e - b^2 would lose the digits of nearly parallel segments.
        n = wp.cross(d1, d2)
        nn = wp.dot(n, n)
        s = real(0.5)  # parallel: any point will do, the middle keeps the lever balanced
        if nn > real(1.0e-10) * a * e:
            s = wp.clamp(wp.dot(wp.cross(d2, r), n) / nn, zero, one)
        t = (b * s + f) / e
        if t < zero:
            t = zero
            s = wp.clamp(-c / a, zero, one)
        elif t > one:
            t = one
            s = wp.clamp((b - c) / a, zero, one)
        return vec2(s, t)

    @wp.func(module=p.module("steric_functions"))
    def next_near(length: wp.array(dtype=real), j: wp.int32, end: wp.int32, distance: real, reach: real):
        """The next segment of a chain that can be near: along it, midpoints move on by no more than the lengths.

        Args:
            distance: of the midpoint of segment j [um].
            reach: how near a segment must come, its own half length not counted [um].
        """
        bound = distance - real(0.5) * length[j]
        i = j + 1
        while i < end and bound - length[i] > reach:  # false for NaN
            bound -= length[i]
            i += 1
        return i

    return SimpleNamespace(
        next_near=next_near,
        steric_force=steric_force,
        steric_stiffness=steric_stiffness,
        closest_parameters=closest_parameters,
        vec2=vec2,
    )


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    f = functions(p)
    steric_force, closest_parameters, next_near = f.steric_force, f.closest_parameters, f.next_near
    cutoff = real(CUTOFF)

    @wp.func(module=p.module("steric"))
    def own_pairs(state: State, e: wp.int32, begin: wp.int32, end: wp.int32, strength: real, diameter: real):
        """Forces on the first and second node of segment e from segments [begin, end), and the sum of |F|."""
        first = vec3(real(0.0))
        second = vec3(real(0.0))
        total = real(0.0)
        p1 = state.position[e - 1]
        q1 = state.position[e]
        middle = real(0.5) * (p1 + q1)
        reach = real(0.5) * state.length[e] + cutoff * diameter
        j = begin
        while j < end:
            p2 = state.position[j - 1]
            q2 = state.position[j]
            away = middle - real(0.5) * (p2 + q2)
            near = reach + real(0.5) * state.length[j]
            distance = wp.length(away)
            if distance < near:
                s = real(0.0)
                gap = vec3(real(0.0))
                if e < j:
                    st = closest_parameters(p1, q1 - p1, p2, q2 - p2)
                    s = st[0]
                    gap = p1 + st[0] * (q1 - p1) - (p2 + st[1] * (q2 - p2))
                else:
                    st = closest_parameters(p2, q2 - p2, p1, q1 - p1)
                    s = st[1]
                    gap = p1 + st[1] * (q1 - p1) - (p2 + st[0] * (q2 - p2))
                r = wp.length(gap)
                magnitude = steric_force(r, strength, diameter)
                if magnitude > real(0.0):
                    total += magnitude
                    # Centre lines that touch exactly have no direction of their own: part them across both.
                    normal = gap / r
                    if r <= real(1.0e-3) * diameter:
                        normal = wp.normalize(wp.cross(q1 - p1, q2 - p2))  # changes sign with the side
                    first += ((real(1.0) - s) * magnitude) * normal
                    second += (s * magnitude) * normal
            j = next_near(state.length, j, end, distance, reach)
        return first, second, total

    @wp.func(module=p.module("steric"))
    def all_pairs(model: Model, state: State, e: wp.int32):
        """Forces on segment e from every segment of the other flagella of its cell."""
        k = model.flagellum_of[e]
        c = model.cell_of[e]
        strength = model.steric_strength[c]
        diameter = model.steric_diameter[c]
        first = vec3(real(0.0))
        second = vec3(real(0.0))
        total = real(0.0)
        other = model.first_flagellum[c]
        while other < model.first_flagellum[c + 1]:
            if other != k:
                begin = model.first_node[other] + 1
                end = model.first_node[other + 1]
                on_first, on_second, sum_of_magnitudes = own_pairs(state, e, begin, end, strength, diameter)
                first += on_first
                second += on_second
                total += sum_of_magnitudes
            other += 1
        return first, second, total

    @wp.kernel(module=p.module("steric"))
    def segments(
        # Model:
        model: Model,
        # State:
        state: State,
    ):
        e = wp.tid()
        if e == model.first_node[model.flagellum_of[e]] or state.active[model.cell_of[e]] == 0:
            return
        first, second, _total = all_pairs(model, state, e)
        state.steric_first[e] = first
        state.steric_second[e] = second

    @wp.kernel(module=p.module("steric_measure"))
    def magnitudes(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        magnitude_out: wp.array(dtype=real),
    ):
        e = wp.tid()
        total = real(0.0)
        if e > model.first_node[model.flagellum_of[e]]:
            _first, _second, total = all_pairs(model, state, e)
        magnitude_out[e] = total

    @wp.kernel(module=p.module("steric_body"))
    def body(
        # Model:
        model: Model,
        # State:
        state: State,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if e == model.first_node[model.flagellum_of[e]] or state.active[c] == 0:
            return
        axis = state.body_axis[c]
        y = state.position[e]
        along = wp.clamp(wp.dot(y, axis), -model.body_half_length[c], model.body_half_length[c])
        away = y - along * axis
        distance = wp.length(away)
        gap = distance - model.body_radius[c]
        magnitude = steric_force(gap, model.steric_strength[c], model.steric_diameter[c])
        force = vec3(real(0.0))
        if magnitude > real(0.0):
            force = (magnitude / distance) * away
        state.body_contact[e] = force

    return SimpleNamespace(segments=segments, magnitudes=magnitudes, body=body)


def segment_contact(model: DeviceModel, state: DeviceState) -> None:
    """Steric forces between flagella, per segment, into `steric_first` and `steric_second` [pN]."""
    kernel = _kernels(model.precision).segments
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data], device=model.device)


def body_contact(model: DeviceModel, state: DeviceState) -> None:
    """Contact force of the body on each node r_1..r_N, into `body_contact` [pN]."""
    kernel = _kernels(model.precision).body
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data], device=model.device)


def steric_magnitudes(model: DeviceModel, state: DeviceState, magnitude_out: wp.array) -> None:
    """Sum of |F| over the pairs of each segment [pN], shape [element_count]; every pair counts at both sides."""
    kernel = _kernels(model.precision).magnitudes
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data, magnitude_out], device=model.device)
