"""Steric forces: segment against segment of different flagella, node against the body surface.

The paper's truncated Lennard-Jones force, F(r) = F_0 [2 (sigma/r)^13 - (sigma/r)^7] below 2^(1/6) sigma, r the
minimal distance of the two centre lines (for the body: of the node from the surface). Below 0.7 sigma it continues
along its tangent there, so that a deep overlap still pushes back with a finite force.

Every pair of segments within the cutoff acts, so a contact near a vertex counts up to four times. A force at
parameter t of a segment acts by (1 - t) on its first and t on its second node: force and torque are conserved
exactly. Each segment sums its own pairs; both sides evaluate a pair in the same order, hence to the same bits. One
thread that does a whole cell takes every pair once for both sides instead, for the same sums in the same order.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.types import DeviceModel, DeviceState, Precision, structs
from warpflag_kernels.contact import neighbours

CUTOFF = 2.0 ** (1.0 / 6.0)  # in units of sigma
LINEAR_BELOW = 0.7
_SLOPE_THERE = 26.0 * LINEAR_BELOW**-14 - 7.0 * LINEAR_BELOW**-8  # -dF/dr in units of F_0/sigma

# The law without branches, so that loops over it can be vector code, and so that it says NaN to NaN.
_LAW = """
    const auto law = [](REAL r, REAL strength, REAL diameter, REAL& force, REAL& stiffness) {
        const REAL x = r / diameter, below = (REAL)LINEAR - x;
        const REAL y = 1 / (below > 0 ? (REAL)LINEAR : x), y2 = y * y, y6 = y2 * y2 * y2;
        const bool open = x >= (REAL)CUTOFF;
        force = open ? 0 : strength * (y6 * y * (2 * y6 - 1) + (below > 0 ? (REAL)SLOPE * below : 0));
        stiffness = open ? 0 : strength / diameter * (y6 * y2) * (26 * y6 - 7);
    };
"""


def code(p: Precision, text: str) -> str:
    """C++ in which LAW defines law(r, strength, diameter, force, stiffness), in this precision."""
    words = {"LAW": _LAW, "LINEAR": repr(LINEAR_BELOW), "CUTOFF": repr(CUTOFF), "SLOPE": repr(_SLOPE_THERE)}
    words["REAL"] = {"float64": "double", "float32": "float"}[p.name]
    for word, meaning in words.items():
        text = text.replace(word, meaning)
    return text


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions of contact: the force law and the closest points of two segments."""
    real, vec3 = p.real, p.vec3
    vec2 = wp.types.vector(2, real)

    @wp.func_native(code(p, "LAW REAL f, k; law(r, strength, diameter, f, k); return {f, k};"))
    def steric_law(r: real, strength: real, diameter: real) -> vec2:
        """Repulsion F [pN] and stiffness -dF/dr [pN/um] at distance r; r may be negative (a node below the surface)."""
        ...

    @wp.func_native(code(p, "LAW REAL f, k; law(r, strength, diameter, f, k); return f;"))
    def steric_force(r: real, strength: real, diameter: real) -> real:
        """Repulsion at distance r [pN]."""
        ...

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
    def nearest(p1: vec3, q1: vec3, p2: vec3, q2: vec3):
        """Of segments p1 q1 and p2 q2: parameters of their closest points, and the way to the first from the second."""
        st = closest_parameters(p1, q1 - p1, p2, q2 - p2)
        gap = p1 + st[0] * (q1 - p1) - (p2 + st[1] * (q2 - p2))
        return st[0], st[1], gap

    @wp.func(module=p.module("steric_functions"))
    def direction(gap: vec3, r: real, d1: vec3, d2: vec3, diameter: real):
        """Of the force on the first of two segments along d1 and d2, across a gap of length r."""
        # Centre lines that touch exactly have no direction of their own: part them across both.
        normal = gap / r
        if r <= real(1.0e-3) * diameter:
            normal = wp.normalize(wp.cross(d1, d2))  # changes sign with the side
        return normal

    return SimpleNamespace(
        steric_force=steric_force,
        steric_law=steric_law,
        closest_parameters=closest_parameters,
        nearest=nearest,
        direction=direction,
        vec2=vec2,
    )


@functools.cache
def gathers(p: Precision) -> SimpleNamespace:
    """Device functions: forces on one segment from others, on all of a cell, and of the body on one node."""
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    Neighbours = structs(p).Neighbours
    law, near_by = functions(p), neighbours.functions(p)
    steric_force, nearest, direction = law.steric_force, law.nearest, law.direction
    candidates, candidate, first_later = near_by.candidates, near_by.candidate, near_by.first_later
    cutoff = real(CUTOFF)
    module = p.module("steric_functions")

    @wp.func(module=module)
    def pairs_of(model: Model, state: State, near: Neighbours, e: wp.int32):
        """Forces on the first and second node of segment e from segments of other flagella, and the sum of |F|."""
        strength = model.steric_strength[model.cell_of[e]]
        diameter = model.steric_diameter[model.cell_of[e]]
        first = vec3(real(0.0))
        second = vec3(real(0.0))
        total = real(0.0)
        p1 = state.position[e - 1]
        q1 = state.position[e]
        middle = real(0.5) * (p1 + q1)
        reach = real(0.5) * state.length[e] + cutoff * diameter
        n = candidates(model, near, e)
        i = int(0)
        while i < n:
            j = candidate(model, near, e, i)
            i += 1
            if j >= 0:
                p2 = state.position[j - 1]
                q2 = state.position[j]
                away = middle - real(0.5) * (p2 + q2)
                within = reach + real(0.5) * state.length[j]
                if wp.dot(away, away) < within * within:
                    s = real(0.0)
                    gap = vec3(real(0.0))
                    if e < j:
                        s, _t, gap = nearest(p1, q1, p2, q2)
                    else:
                        _s, s, back = nearest(p2, q2, p1, q1)
                        gap = -back
                    r = wp.length(gap)
                    magnitude = steric_force(r, strength, diameter)
                    if magnitude > real(0.0):
                        total += magnitude
                        normal = direction(gap, r, q1 - p1, q2 - p2, diameter)
                        first += ((real(1.0) - s) * magnitude) * normal
                        second += (s * magnitude) * normal
        return first, second, total

    @wp.func(module=module)
    def pairs_of_cell(model: Model, state: State, near: Neighbours, c: wp.int32):
        """The same forces on all segments of cell c, every pair once for both."""
        strength = model.steric_strength[c]
        diameter = model.steric_diameter[c]
        begin = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        e = begin
        while e < end:
            state.steric_first[e] = vec3(real(0.0))
            state.steric_second[e] = vec3(real(0.0))
            e += 1
        e = begin + 1
        while e < end:
            p1 = state.position[e - 1]
            q1 = state.position[e]
            middle = real(0.5) * (p1 + q1)
            reach = real(0.5) * state.length[e] + cutoff * diameter
            n = candidates(model, near, e)
            i = first_later(model, near, e)
            while i < n:
                j = candidate(model, near, e, i)
                i += 1
                if j >= 0:
                    p2 = state.position[j - 1]
                    q2 = state.position[j]
                    away = middle - real(0.5) * (p2 + q2)
                    within = reach + real(0.5) * state.length[j]
                    if wp.dot(away, away) < within * within:
                        s, t, gap = nearest(p1, q1, p2, q2)
                        r = wp.length(gap)
                        magnitude = steric_force(r, strength, diameter)
                        if magnitude > real(0.0):
                            normal = direction(gap, r, q1 - p1, q2 - p2, diameter)
                            state.steric_first[e] += ((real(1.0) - s) * magnitude) * normal
                            state.steric_second[e] += (s * magnitude) * normal
                            state.steric_first[j] -= ((real(1.0) - t) * magnitude) * normal
                            state.steric_second[j] -= (t * magnitude) * normal
            e += 1

    @wp.func(module=module)
    def body_force(model: Model, state: State, e: wp.int32, c: wp.int32):
        """Force of the body of cell c on node e [pN]."""
        axis = state.body_axis[c]
        y = state.position[e]
        along = wp.clamp(wp.dot(y, axis), -model.body_half_length[c], model.body_half_length[c])
        away = y - along * axis
        square = wp.dot(away, away)
        reach = model.body_radius[c] + cutoff * model.steric_diameter[c]
        force = vec3(real(0.0))
        if square < reach * reach:  # few nodes are that near: only they pay for the root
            distance = wp.sqrt(square)
            gap = distance - model.body_radius[c]
            magnitude = steric_force(gap, model.steric_strength[c], model.steric_diameter[c])
            force = (magnitude / distance) * away
        return force

    return SimpleNamespace(pairs_of=pairs_of, pairs_of_cell=pairs_of_cell, body_force=body_force)


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real = p.real
    Model, State, Neighbours = structs(p).Model, structs(p).State, structs(p).Neighbours
    pairs_of, body_force = gathers(p).pairs_of, gathers(p).body_force

    @wp.kernel(module=p.module("steric"))
    def segments(
        # Model:
        model: Model,
        # State:
        state: State,
        near: Neighbours,
    ):
        e = wp.tid()
        if e == model.first_node[model.flagellum_of[e]] or state.active[model.cell_of[e]] == 0:
            return
        first, second, _total = pairs_of(model, state, near, e)
        state.steric_first[e] = first
        state.steric_second[e] = second

    @wp.kernel(module=p.module("steric_measure"))
    def magnitudes(
        # Model:
        model: Model,
        # State:
        state: State,
        near: Neighbours,
        # Out:
        magnitude_out: wp.array(dtype=real),
    ):
        e = wp.tid()
        total = real(0.0)
        if e > model.first_node[model.flagellum_of[e]]:
            _first, _second, total = pairs_of(model, state, near, e)
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
        state.body_contact[e] = body_force(model, state, e, c)

    return SimpleNamespace(segments=segments, magnitudes=magnitudes, body=body)


def segment_contact(model: DeviceModel, state: DeviceState) -> None:
    """Steric forces between flagella, per segment, into `steric_first` and `steric_second` [pN]."""
    neighbours.refresh(model, state)
    inputs = [model.data, state.data, state.neighbours]
    wp.launch(_kernels(model.precision).segments, model.element_count, inputs=inputs, device=model.device)


def body_contact(model: DeviceModel, state: DeviceState) -> None:
    """Contact force of the body on each node r_1..r_N, into `body_contact` [pN]."""
    kernel = _kernels(model.precision).body
    wp.launch(kernel, model.element_count, inputs=[model.data, state.data], device=model.device)


def steric_magnitudes(model: DeviceModel, state: DeviceState, magnitude_out: wp.array) -> None:
    """Sum of |F| over the pairs of each segment [pN], shape [element_count]; every pair counts at both sides."""
    neighbours.refresh(model, state)
    inputs = [model.data, state.data, state.neighbours, magnitude_out]
    wp.launch(_kernels(model.precision).magnitudes, model.element_count, inputs=inputs, device=model.device)
