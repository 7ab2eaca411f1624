"""Motors in an implicit step: the torques that obey the law of each motor at the rate that the step gives it.

The law is not linearised across a step, because it has kinks: a motor whose slope is taken from one side of the knee
leaps to the other side within a step, where the hook is stiff, and back in the next. Torques are found in their own
space, as contact forces are. Both iterations of a step evaluate the velocities with the torques known so far and solve
with the same matrix, in which torques are constant. Changes of the torques then change the rates by

    Omega_k = Omega_k^0 + sum_j G_kj (T_j - T_j^0),     Omega: rate at the collocation point, (w delta + e/g)/dt,

and every T_k lies on its curve, which is linear piece by piece. A unit torque on each tripod with the bodies at rest is
one solution along all flagella at once, t; motors are coupled through the six unknowns of their body alone. Given its
motion every motor's torque is found by itself in closed form, and Newton's method finds the motion (`motor/laws.py`
does the same at one moment, with the tripod's drag in place of the step's matrix).

**With thermal noise** the rate of a step scatters by far more than a curve is wide, so a curve has no meaning for it. A
motor then follows its curve by its rate averaged over a time tau, tau dA/dt = Omega - A, taken implicitly: with s =
dt/(tau + dt) its curve sees s Omega + (1 - s) A. A prescribed rate is kept in every step, noise or not.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body
from warpflag_kernels.implicit import block_band, body_coupling, collocation
from warpflag_kernels.motor import laws
from warpflag_kernels.rod import chain_chart


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `MotorSolve`: the response of a step to torques. Per flagellum [K] unless said otherwise."""
    real, vec6, Increment = p.real, chain_chart.types(p).vec6, chain_chart.types(p).Increment

    @wp.struct
    class MotorSolve:
        answer: Increment  # t: of all tripods to unit torques, the bodies at rest
        on_body: wp.array(dtype=vec6)  # motion of the body that a unit torque causes
        by_body: wp.array(dtype=vec6)  # turn of the tripod against the body, over the motion of the body
        free_rate: wp.array(dtype=real)  # Omega^0 [rad/s]
        change: wp.array(dtype=real)  # T - T^0 [pN um]
        moved: wp.array(dtype=vec6)  # [C], motion of the body that all changes cause
        # Only with thermal noise.
        time: wp.array(dtype=wp.float64)  # [C], tau [s]
        average: wp.array(dtype=real)  # A [rad/s]

    return MotorSolve


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `MotorSolve`, zero; none where torques are constant."""
    p, m = model.precision, struct(model.precision)()
    if model.switches.has("motor law"):
        vec6 = chain_chart.types(p).vec6
        flagella, device = model.flagellum_count, model.device
        m.answer = chain_chart.allocate(model)
        m.on_body, m.by_body = (wp.zeros(flagella, dtype=vec6, device=device) for _ in range(2))
        m.free_rate, m.change = (wp.zeros(flagella, dtype=p.real, device=device) for _ in range(2))
        m.moved = wp.zeros(model.cell_count, dtype=vec6, device=device)
        if model.switches.noise:
            m.time = wp.zeros(model.cell_count, dtype=wp.float64, device=device)
            m.average = wp.zeros(flagella, dtype=p.real, device=device)
    return m


@functools.cache
def _kernels(p: Precision, averaged: bool, shell: bool) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State, Implicit, MotorSolve = structs(p).Model, structs(p).State, collocation.struct(p), struct(p)
    Band, vec6 = block_band.types(p).Band, block_band.types(p).vec6
    Increment, law, respond = chain_chart.types(p).Increment, laws.curves(p), body.mobility(p, shell).respond
    drive_at, settled = law.drive_at, law.settled
    body_rate, inverse6 = body_coupling.functions(p, shell).body_rate, body_coupling.functions(p, shell).inverse6
    follow = block_band.functions(p).follow
    most, prescribed = wp.constant(laws.MOTOR_ITERATIONS), wp.constant(wp.int32(laws.Law.PRESCRIBED))
    one, zero = wp.constant(real(1.0)), wp.constant(real(0.0))
    module = p.module("motor_solve", "_".join([*["averaged"] * averaged, *["shell"] * shell]))

    @wp.func(module=module)
    def share_of(band: Band, motors: MotorSolve, c: wp.int32):
        """Share s of a step's own rate in the average of cell c."""
        return real(band.step[c] / (motors.time[c] + band.step[c]))

    @wp.func(module=module)
    def law_of(
        model: Model,
        band: Band,
        motors: MotorSolve,
        k: wp.int32,
        c: wp.int32,
        drive: real,
        mobility: real,
        passive_rate: real,
    ):
        """`settled` of motor k, by its average rate if the law asks for that."""
        share = one
        known = zero
        if model.motor_law[0].kind[k] != prescribed:
            share = share_of(band, motors, c)
            known = (one - share) * motors.average[k]
        torque, softness, slope = settled(model, k, drive, share * mobility, share * passive_rate + known)
        return torque, share * softness, slope

    @wp.kernel(module=module)
    def load_tripods(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        motors: MotorSolve,
    ):
        e = wp.tid()
        if state.active[model.cell_of[e]] == 0:
            return
        unit = vec4(real(0.0))
        if e == model.first_node[model.flagellum_of[e]]:
            unit[3] = real(1.0)
        motors.answer.node[e] = unit

    @wp.kernel(module=module)
    def couple(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        # Out:
        motors: MotorSolve,
    ):
        k = wp.tid()
        first = model.first_node[k]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        m = state.pose.tangent[first]
        back = vec6(real(0.0))
        for j in range(3):
            back += wp.transpose(band.from_body[3 * k + j]) * motors.answer.node[first + j]
        u, w = respond(model, state, c, vec3(real(0.0)), -m)
        rate = vec6(u[0], u[1], u[2], w[0], w[1], w[2]) - real(band.weight[c]) * body_rate(model, state, c, back)
        motors.on_body[k] = real(band.step[c]) * (band.body_inverse[c] * rate)
        turn = vec6(real(0.0), real(0.0), real(0.0), m[0], m[1], m[2])
        for column in range(6):
            turn[column] = turn[column] + band.body_columns[6 * first + column][3]
        motors.by_body[k] = -turn

    @wp.kernel(module=module)
    def find_torques(
        # Model:
        model: Model,
        # State:
        imp: Implicit,
        band: Band,
        gain: wp.array(dtype=wp.float64),
        last: Increment,
        found: Increment,
        weight: wp.array(dtype=wp.float64),
        x: Increment,
        # Out:
        state: State,
        motors: MotorSolve,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        g = real(gain[c])
        per_step = real(wp.float64(1.0) / band.step[c])
        ratio = real(imp.ratio[c])
        begin = model.first_flagellum[c]
        end = model.first_flagellum[c + 1]
        part = real(weight[c])
        before = ratio * last.body[c] + (part * found.body[c] + x.body[c]) / g
        spin = vec3(before[3], before[4], before[5])
        k = begin
        while k < end:
            first = model.first_node[k]
            turned = ratio * last.node[first][3] + (part * found.node[first][3] + x.node[first][3]) / g
            motors.free_rate[k] = per_step * (turned - wp.dot(state.pose.tangent[first], spin))
            k += 1
        moved = vec6(real(0.0))  # motion of the body that the changes of torque cause, over g
        iteration = int(0)
        while iteration <= most:
            changed = bool(iteration == 0)
            remaining = moved
            jacobian = wp.identity(6, dtype=real)
            k = begin
            while k < end:
                mobility = per_step * motors.answer.node[model.first_node[k]][3]
                free = motors.free_rate[k] + per_step * wp.dot(motors.by_body[k], moved)
                passive_rate = free - mobility * state.motor[0].within_step[k]
                drive = drive_at(model, k, state.time[c])
                if wp.static(averaged):
                    torque, softness, slope = law_of(model, band, motors, k, c, drive, mobility, passive_rate)
                else:
                    torque, softness, slope = settled(model, k, drive, mobility, passive_rate)
                if slope != state.motor[0].slope[k]:
                    changed = True
                state.motor[0].slope[k] = slope
                motors.change[k] = torque - state.motor[0].within_step[k]
                remaining -= motors.change[k] * motors.on_body[k]
                jacobian += wp.outer(motors.on_body[k], (softness * per_step) * motors.by_body[k])
                k += 1
            if not changed or iteration == most:
                iteration = most + 1
            else:
                moved -= inverse6(jacobian) * remaining
                iteration += 1
        motors.moved[c] = g * moved
        k = begin
        while k < end:
            state.motor[0].within_step[k] = state.motor[0].within_step[k] + motors.change[k]
            state.motor[0].torque[k] = state.motor[0].within_step[k]
            k += 1

    @wp.kernel(module=module)
    def add_changes(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        gain: wp.array(dtype=wp.float64),
        motors: MotorSolve,
        # Out:
        x: Increment,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        own = x.node[e] + (real(gain[c]) * motors.change[k]) * motors.answer.node[e]
        x.node[e] = follow(band, e, own, motors.moved[c])
        if e == model.first_node[model.first_flagellum[c]]:
            x.body[c] = x.body[c] + motors.moved[c]

    kernels = SimpleNamespace(
        load_tripods=load_tripods, couple=couple, find_torques=find_torques, add_changes=add_changes
    )
    if averaged:

        @wp.kernel(module=module)
        def average(
            # Model:
            model: Model,
            # State:
            state: State,
            band: Band,
            x: Increment,
            # Out:
            motors: MotorSolve,
        ):
            k = wp.tid()
            first = model.first_node[k]
            c = model.cell_of[first]
            if state.active[c] == 0:
                return
            b = x.body[c]
            turned = x.node[first][3] - wp.dot(state.pose.tangent[first], vec3(b[3], b[4], b[5]))
            share = share_of(band, motors, c)
            rate = turned / real(band.step[c])
            motors.average[k] = share * rate + (one - share) * motors.average[k]

        kernels.average = average
    return kernels


def prepare(model: DeviceModel, state: DeviceState, band: Any, motors: Any) -> None:
    """Response of a step to unit torques of the motors, from the factors of its matrix, into `motors`."""
    kernels, device = _kernels(model.precision, model.switches.noise, model.switches.flows.body), model.device
    inputs = [model.data, state.data, motors]
    wp.launch(kernels.load_tripods, model.element_count, inputs=inputs, device=device)
    block_band.solve(model, state, band, motors.answer)
    wp.launch(kernels.couple, model.flagellum_count, inputs=[model.data, state.data, band, motors], device=device)


def solve(
    model: DeviceModel,
    state: DeviceState,
    data: Any,
    band: Any,
    gain: Any,
    motors: Any,
    last: Any,
    found: Any,
    weight: Any,
    x: Any,
) -> None:
    """Puts every motor on its law: sets the torques, `State.motor.within_step`, and adds their effect to an increment.

    Args:
        model, state: of the batch, with the pose that x is an increment of, at the time of the collocation point.
        data, band, gain, motors: structs `Implicit` and `Band`, g, and struct `MotorSolve` from `prepare`.
        last, found: the last increment, and what has been found of this one, both at the present pose.
        weight: share of `found` that counts, shape [cell_count].
        x: increment that an iteration has found with the torques as they were; changed in place.
    """
    kernels, device = _kernels(model.precision, model.switches.noise, model.switches.flows.body), model.device
    inputs = [model.data, data, band, gain, last, found, weight, x, state.data, motors]
    wp.launch(kernels.find_torques, model.cell_count, inputs=inputs, device=device)
    inputs = [model.data, state.data, band, gain, motors, x]
    wp.launch(kernels.add_changes, model.element_count, inputs=inputs, device=device)


def average_rates(model: DeviceModel, state: DeviceState, band: Any, motors: Any, x: Any) -> None:
    """The average rates after a step, whose whole increment is x; only with thermal noise."""
    kernel, inputs = (
        _kernels(model.precision, True, model.switches.flows.body).average,
        [model.data, state.data, band, x, motors],
    )
    wp.launch(kernel, model.flagellum_count, inputs=inputs, device=model.device)
