"""Comoving chart: from increments since the start of a step to a state, and from velocities back to increment rates.

A node moves as r = r_0 + Q (d + x): d is its offset from the anchor at the start of the step, x its increment and
Q = exp(t W) the rotation of its flagellum at the angular velocity W fitted to the velocities at the start. Directors
follow the tangent by the minimal rotation inside that rotating frame and then turn by the spin increment. The
rotation of a helix about its axis, most of its motion, is thus represented exactly, and the increments stay small and
smooth; with W = 0 they are plain displacements. The rates are exact for any W: the chart costs no order of accuracy.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.rod import rotations

vec6d = wp.types.vector(6, wp.float64)


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Chart`: the pose at the start of the step, and the increments and rates since."""
    vec3, vec4, mat33, Pose = p.vec3, p.vec4, p.mat33, structs(p).Pose

    @wp.struct
    class Chart:
        base: Pose  # at the start of the step; without lengths and body axis
        flagellum_spin: wp.array(dtype=vec3)  # [K], W [rad/s]
        # At the present pose.
        elapsed: wp.array(dtype=wp.float64)  # [C], time since the start of the step [s]
        commit: wp.array(dtype=wp.int32)  # [C], 1: the present pose becomes the start of the next step
        at_start: wp.array(dtype=wp.int32)  # [C], 1: the present pose is the start of a step (its increments vanish)
        flagellum_turn: wp.array(dtype=mat33)  # [K], Q
        increment: wp.array(dtype=vec4)  # [E], node x [um] and spin [rad]
        rate: wp.array(dtype=vec4)  # [E] [um/s, rad/s]
        body_increment: wp.array(dtype=vec6d)  # [C], translation [um] and rotation vector [rad]
        body_rate: wp.array(dtype=vec6d)  # [C]
        # Accumulated angles.
        motor_angle: wp.array(dtype=wp.float64)  # [K], tripod about m relative to the body [rad]
        body_angle: wp.array(dtype=wp.float64)  # [C], body about its axis e_b3 [rad]

    return Chart


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `Chart`, zero."""
    p, device = model.precision, model.device
    cells, flagella, elements = model.cell_count, model.flagellum_count, model.element_count

    def zeros(count: int, dtype: Any) -> wp.array:
        return wp.zeros(count, dtype=dtype, device=device)

    chart = struct(p)()
    for name in ("position", "tangent", "director"):
        setattr(chart.base, name, zeros(elements, p.vec3))
    chart.base.body_position, chart.base.body_orientation = zeros(cells, wp.vec3d), zeros(cells, wp.quatd)
    chart.flagellum_spin, chart.flagellum_turn = zeros(flagella, p.vec3), zeros(flagella, p.mat33)
    chart.elapsed = zeros(cells, wp.float64)
    chart.commit, chart.at_start = zeros(cells, wp.int32), zeros(cells, wp.int32)
    chart.increment, chart.rate = zeros(elements, p.vec4), zeros(elements, p.vec4)
    chart.body_increment, chart.body_rate = zeros(cells, vec6d), zeros(cells, vec6d)
    chart.motor_angle, chart.body_angle = zeros(flagella, wp.float64), zeros(cells, wp.float64)
    return chart


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions: the rate of the increment of one element, and of one body."""
    real, vec4 = p.real, p.vec4
    Model, State, Chart = structs(p).Model, structs(p).State, struct(p)
    transport_spin = rotations.functions(p).transport_spin
    module = p.module("chart_functions")

    @wp.func(module=module)
    def find_rate(model: Model, state: State, chart: Chart, e: wp.int32, k: wp.int32, c: wp.int32):
        first = model.first_node[k]
        t = state.pose.tangent[e]
        base = chart.base.tangent[e]
        spin = model.drag.spin_mobility[k] * state.spin_torque[e]
        if e == first:
            spin -= transport_spin(base, t, wp.cross(state.body_spin[c], t))
            chart.rate[e] = vec4(real(0.0), real(0.0), real(0.0), spin)
            return
        back = wp.transpose(chart.flagellum_turn[k])
        omega = chart.flagellum_spin[k]
        offset = state.pose.position[e] - state.pose.position[first]
        x_rate = back * (state.velocity[e] - state.velocity[first] - wp.cross(omega, offset))
        relative = state.velocity[e] - state.velocity[e - 1]
        t_rate = (relative - wp.dot(relative, t) * t) / state.pose.length[e] - wp.cross(omega, t)
        spin -= wp.dot(omega, t) + transport_spin(base, back * t, back * t_rate)
        chart.rate[e] = vec4(x_rate[0], x_rate[1], x_rate[2], spin)

    @wp.func(module=module)
    def find_body_rate(state: State, chart: Chart, c: wp.int32):
        b = chart.body_increment[c]
        w = wp.vec3d(b[3], b[4], b[5])
        v = wp.vec3d(state.body_velocity[c])
        omega = wp.vec3d(state.body_spin[c])
        # Rate of the rotation vector: inverse of the exponential's differential.
        angle = wp.length(w)
        scale = wp.float64(1.0) / wp.float64(12.0)
        if angle > wp.float64(1.0e-2):
            half = wp.float64(0.5) * angle
            scale = (wp.float64(1.0) - half * wp.cos(half) / wp.sin(half)) / (angle * angle)
        wxo = wp.cross(w, omega)
        w_rate = omega - wp.float64(0.5) * wxo + scale * wp.cross(w, wxo)
        chart.body_rate[c] = vec6d(v[0], v[1], v[2], w_rate[0], w_rate[1], w_rate[2])

    return SimpleNamespace(find_rate=find_rate, find_body_rate=find_body_rate)


@functools.cache
def turns(p: Precision) -> SimpleNamespace:
    """Device functions: how far a motor and a body have turned from one pose to another."""
    Model, Pose, vec3 = structs(p).Model, structs(p).Pose, p.vec3
    module = p.module("turns")

    @wp.func(module=module)
    def motor_turn(model: Model, start: Pose, end: Pose, e: wp.int32, k: wp.int32, c: wp.int32):
        """Turn of the tripod e of motor k between two poses, seen from the body [rad]."""
        old = wp.quat_rotate_inv(start.body_orientation[c], wp.vec3d(start.director[e]))
        new = wp.quat_rotate_inv(end.body_orientation[c], wp.vec3d(end.director[e]))
        axis = wp.vec3d(model.motor.axis[k])
        return wp.atan2(wp.dot(axis, wp.cross(old, new)), wp.dot(old, new))

    @wp.func(module=module)
    def body_turn(increment: vec6d, axis: vec3):
        """Turn of a body about its axis in an increment [rad]."""
        return wp.dot(wp.vec3d(increment[3], increment[4], increment[5]), wp.vec3d(axis))

    return SimpleNamespace(motor_turn=motor_turn, body_turn=body_turn)


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Model, State, Chart = structs(p).Model, structs(p).State, struct(p)
    motor_turn, body_turn = turns(p).motor_turn, turns(p).body_turn
    find_rate, find_body_rate = functions(p).find_rate, functions(p).find_body_rate
    module = p.module("chart")

    @wp.kernel(module=module)
    def commit_elements(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        chart: Chart,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0 or chart.commit[c] == 0:
            return
        k = model.flagellum_of[e]
        director = state.pose.director[e]
        if e == model.first_node[k]:
            chart.motor_angle[k] += motor_turn(model, chart.base, state.pose, e, k, c)
        chart.base.position[e] = state.pose.position[e]
        chart.base.tangent[e] = state.pose.tangent[e]
        chart.base.director[e] = director

    @wp.kernel(module=module)
    def commit_bodies(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        chart: Chart,
    ):
        c = wp.tid()
        if state.active[c] == 0 or chart.commit[c] == 0:
            return
        chart.body_angle[c] += body_turn(chart.body_increment[c], state.pose.body_axis[c])
        chart.base.body_position[c] = state.pose.body_position[c]
        chart.base.body_orientation[c] = state.pose.body_orientation[c]
        chart.body_increment[c] = vec6d(wp.float64(0.0))

    @wp.kernel(module=module)
    def fit_spin(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        chart: Chart,
    ):
        k = wp.tid()
        first = model.first_node[k]
        c = model.cell_of[first]
        if state.active[c] == 0 or chart.at_start[c] == 0:
            return
        # Least squares over node velocities relative to the anchor. Spins have a small weight: it keeps
        # the system regular for a straight rod, while spins that only relax do not distort the fit.
        weight = real(0.01) * model.rod.segment_length[k] * model.rod.segment_length[k]
        matrix = mat33(real(0.0))
        moment = vec3(real(0.0))
        identity = wp.identity(3, dtype=real)
        e = first + 1
        while e < model.first_node[k + 1]:
            d = state.pose.position[e] - state.pose.position[first]
            t = state.pose.tangent[e]
            spin = model.drag.spin_mobility[k] * state.spin_torque[e]
            matrix += wp.dot(d, d) * identity - wp.outer(d, d) + weight * wp.outer(t, t)
            moment += wp.cross(d, state.velocity[e] - state.velocity[first]) + (weight * spin) * t
            e += 1
        chart.flagellum_spin[k] = wp.inverse(matrix) * moment
        chart.flagellum_turn[k] = identity

    @wp.kernel(module=module)
    def rates(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        chart: Chart,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] != 0:
            find_rate(model, state, chart, e, model.flagellum_of[e], c)

    @wp.kernel(module=module)
    def body_rates(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        chart: Chart,
    ):
        c = wp.tid()
        if state.active[c] != 0:
            find_body_rate(state, chart, c)

    @wp.kernel(module=module)
    def rates_by_cells(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        chart: Chart,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        e = model.first_node[model.first_flagellum[c]]
        end = model.first_node[model.first_flagellum[c + 1]]
        while e < end:
            find_rate(model, state, chart, e, model.flagellum_of[e], c)
            e += 1
        find_body_rate(state, chart, c)

    return SimpleNamespace(
        commit_elements=commit_elements,
        commit_bodies=commit_bodies,
        fit_spin=fit_spin,
        rates=rates,
        body_rates=body_rates,
        rates_by_cells=rates_by_cells,
    )


def commit(model: DeviceModel, state: DeviceState, chart: Any) -> None:
    """The present pose becomes the start of the next step, in cells where `commit` is set."""
    kernels = _kernels(model.precision)
    inputs = [model.data, state.data, chart]
    wp.launch(kernels.commit_elements, model.element_count, inputs=inputs, device=model.device)
    wp.launch(kernels.commit_bodies, model.cell_count, inputs=inputs, device=model.device)


def fit_flagellum_spin(model: DeviceModel, state: DeviceState, chart: Any) -> None:
    """Angular velocity W of every flagellum [rad/s] at the start of a step, into `flagellum_spin`."""
    kernel = _kernels(model.precision).fit_spin
    wp.launch(kernel, model.flagellum_count, inputs=[model.data, state.data, chart], device=model.device)


def increment_rates(model: DeviceModel, state: DeviceState, chart: Any) -> None:
    """Rates of the increments from the velocities, into `rate` and `body_rate`."""
    kernels = _kernels(model.precision)
    inputs = [model.data, state.data, chart]
    if model.plan.by_cells:
        wp.launch(kernels.rates_by_cells, model.cell_count, inputs=inputs, device=model.device)
        return
    wp.launch(kernels.rates, model.element_count, inputs=inputs, device=model.device)
    wp.launch(kernels.body_rates, model.cell_count, inputs=inputs, device=model.device)
