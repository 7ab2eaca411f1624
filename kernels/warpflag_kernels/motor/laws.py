"""Motors whose torque depends on their rate or on time, or whose rate is prescribed.

The rate Omega of a motor is that of its tripod about the motor axis m relative to the body. With the sense of rotation
that its drive asks for counted positive, its torque is

    T = |drive| T_0                        for Omega below the knee,
    T = |drive| (T_0 - slope (Omega - knee)) above it, and nothing beyond the rate without load.

The drive is 1 forward and -1 in reverse, and goes from one to the other along a ramp; each sense has its own curve.

The torque sets the rate at once: Omega = mu (T + Q) - m . w, with the tripod's mobility mu, the torque Q of the hook,
and the angular velocity of the body w, on which all motors react,

    w = w_0 - R sum_k T_k m_k,     w_0: without the motors, R: the body's rotational mobility.

The slope is a thousand times the drag of the tripod, so torques are found in closed form: given w, every motor by
itself from a curve of straight pieces; w from the three linear equations that remain, repeated while some motor changes
its piece. That is Newton's method on a monotone map of straight pieces, and it ends in the exact solution.

Within an implicit step the torque is a number, `State.motor.within_step`, which `implicit/motor_solve.py` finds.
"""

import functools
from enum import IntEnum
from types import SimpleNamespace

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.term import Term
from warpflag_kernels.base.types import structs
from warpflag_kernels.fluid import body

# Newton steps for the body's angular velocity. A tripod has so little drag that the body's rotation hardly changes its
# motor's torque: two steps converge, a third is needed where a motor changes its piece.
MOTOR_ITERATIONS = 8
# A corner of a drive that is this near [s] has been reached: far above the round-off of a time of seconds, far below
# the shortest step.
AT_ONCE = 1.0e-13


class Law(IntEnum):
    """Kinds of laws. `MotorLaw.curve` holds three numbers in each sense.

    STRAIGHT: torque up to the knee [pN um], knee [rad/s], slope above it [pN um s].
    PRESCRIBED: none of them; the rate is given.
    """

    STRAIGHT = 0
    PRESCRIBED = 1


@functools.cache
def curves(p: Precision) -> SimpleNamespace:
    """Device functions of the law of one motor: its drive at a time, its curve, and what it settles to."""
    real, vec3 = p.real, p.vec3
    Model = structs(p).Model
    module = p.module("motor_curves")
    zero = wp.constant(real(0.0))
    one = wp.constant(real(1.0))
    at_once = wp.constant(wp.float64(AT_ONCE))
    prescribed = wp.constant(wp.int32(Law.PRESCRIBED))

    @wp.func(module=module)
    def drive_at(model: Model, k: wp.int32, time: wp.float64):
        """Drive of motor k at a time: linear between the corners of its table, constant outside."""
        law = model.motor_law[0]
        low = law.first_switch[k]
        high = law.first_switch[k + 1] - 1
        if time <= law.switch_time[low]:
            return law.switch_drive[low]
        if time >= law.switch_time[high]:
            return law.switch_drive[high]
        while high - low > 1:
            middle = (low + high) / 2
            if law.switch_time[middle] <= time:
                low = middle
            else:
                high = middle
        span = law.switch_time[high] - law.switch_time[low]
        share = real((time - law.switch_time[low]) / span)
        return law.switch_drive[low] + share * (law.switch_drive[high] - law.switch_drive[low])

    @wp.func(module=module)
    def next_corner(model: Model, c: wp.int32, time: wp.float64, target: wp.float64):
        """Time [s] of the first corner of a drive in cell c after `time`, or `target` if that is before it."""
        law = model.motor_law[0]
        found = target
        after = time + at_once
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            low = law.first_switch[k]
            high = law.first_switch[k + 1]
            while low < high:  # the first corner after that time
                middle = (low + high) / 2
                if law.switch_time[middle] <= after:
                    low = middle + 1
                else:
                    high = middle
            if low < law.first_switch[k + 1]:
                found = wp.min(found, law.switch_time[low])
            k += 1
        return found

    @wp.func(module=module)
    def sense(model: Model, k: wp.int32, drive: real):
        """Sense in which the drive turns motor k, 1 or -1, and its curve there, scaled by the drive."""
        curve = model.motor_law[0].curve[2 * k]
        turns = one
        if drive < zero:
            curve = model.motor_law[0].curve[2 * k + 1]
            turns = -one
        strength = wp.abs(drive)
        if curve[0] < zero:
            turns = -turns
        return turns, vec3(strength * wp.abs(curve[0]), curve[1], strength * curve[2])

    @wp.func(module=module)
    def settled(model: Model, k: wp.int32, drive: real, mobility: real, passive_rate: real):
        """The torque of motor k that obeys its law.

        Args:
            drive: of the motor, from 1 to -1.
            mobility: mu, change of the rate Omega by the torque [1/(pN um s)].
            passive_rate: Omega without the motor's torque [rad/s], so that Omega = passive_rate + mobility T(Omega).

        Returns:
            the torque [pN um]; how much it falls with the passive rate [pN um s]; and the slope of the piece of the
            curve that the motor is on [pN um s], -1 for a prescribed rate.
        """
        if model.motor_law[0].kind[k] == prescribed:
            return (drive * model.motor_law[0].rate[k] - passive_rate) / mobility, one / mobility, -one
        turns, curve = sense(model, k, drive)
        own = turns * passive_rate
        knee = curve[1]
        if own <= knee - mobility * curve[0]:
            return turns * curve[0], zero, zero
        slope = curve[2]
        if slope > zero and own < knee + curve[0] / slope:
            softened = one / (one + slope * mobility)
            return turns * (softened * (curve[0] - slope * (own - knee))), softened * slope, slope
        return zero, zero, zero

    @wp.func(module=module)
    def twist_bound(model: Model, c: wp.int32):
        """Gershgorin's bound on the relaxation rates of twist in cell c, tripods held back by no motor [1/s]."""
        bound = wp.float64(0.0)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            rigidity = model.rod.hook_rigidity[k] + model.rod.twist_rigidity[k]
            rate = real(2.0) * model.drag.spin_mobility[k] * rigidity / model.rod.segment_length[k]
            bound = wp.max(bound, wp.float64(rate))
            k += 1
        return bound

    return SimpleNamespace(drive_at=drive_at, next_corner=next_corner, settled=settled, twist_bound=twist_bound)


@functools.cache
def _functions(p: Precision) -> SimpleNamespace:
    """Device function `settle`: the torques of all motors of a cell at one moment."""
    real, vec3, mat33 = p.real, p.vec3, p.mat33
    Model, State = structs(p).Model, structs(p).State
    law, respond = curves(p), body.mobility(p).respond
    drive_at, settled = law.drive_at, law.settled
    most = wp.constant(MOTOR_ITERATIONS)
    zero = wp.constant(real(0.0))

    @wp.func(module=p.module("motor_law_functions"))
    def settle(model: Model, state: State, c: wp.int32):
        begin = model.first_flagellum[c]
        end = model.first_flagellum[c + 1]
        total = vec3(zero)
        k = begin
        while k < end:
            total += state.flagellum_torque[k]
            k += 1
        no_force = vec3(zero)
        force = no_force
        if state.surface_force.shape[0] > 0:
            total += state.surface_torque[c]
            force = state.surface_force[c]
            k = begin
            while k < end:
                force += state.flagellum_force[k]
                k += 1
        _v, free = respond(model, state, c, force, total)
        spin = free
        iteration = int(0)
        while iteration <= most:
            changed = bool(iteration == 0)
            reaction = vec3(zero)
            stiffness = mat33(zero)
            k = begin
            while k < end:
                first = model.first_node[k]
                m = state.pose.tangent[first]
                mobility = model.drag.spin_mobility[k]
                passive_rate = mobility * state.spin_torque[first] - wp.dot(m, spin)
                drive = drive_at(model, k, state.time[c])
                torque, softness, slope = settled(model, k, drive, mobility, passive_rate)
                if slope != state.motor[0].slope[k]:
                    changed = True
                state.motor[0].slope[k] = slope
                state.motor[0].torque[k] = torque
                reaction += torque * m
                stiffness += softness * wp.outer(m, m)
                k += 1
            if not changed or iteration == most:
                iteration = most + 1
            else:
                _v, slowed = respond(model, state, c, no_force, reaction)
                jacobian = wp.identity(3, dtype=real)
                for column in range(3):
                    axis = vec3(stiffness[0, column], stiffness[1, column], stiffness[2, column])
                    _v, answer = respond(model, state, c, no_force, axis)
                    for row in range(3):
                        jacobian[row, column] = jacobian[row, column] + answer[row]
                spin = spin - wp.inverse(jacobian) * (spin - free + slowed)
                iteration += 1
        k = begin
        while k < end:
            first = model.first_node[k]
            torque = state.motor[0].torque[k]
            state.spin_torque[first] = state.spin_torque[first] + torque
            state.flagellum_torque[k] = state.flagellum_torque[k] - torque * state.pose.tangent[first]
            k += 1

    return SimpleNamespace(settle=settle)


@functools.cache
def _functions_within_step(p: Precision) -> SimpleNamespace:
    """Device functions of the motor as a given torque, `State.motor.within_step`."""
    real, vec3, Model, State = p.real, p.vec3, structs(p).Model, structs(p).State
    module = p.module("held_motor_functions")

    @wp.func(module=module)
    def on_spin(model: Model, state: State, e: wp.int32, k: wp.int32, torque: real):
        if e == model.first_node[k]:
            return torque + state.motor[0].within_step[k]
        return torque

    @wp.func(module=module)
    def on_body(model: Model, state: State, k: wp.int32, force: vec3, torque: vec3):
        return force, torque - state.motor[0].within_step[k] * state.pose.tangent[model.first_node[k]]

    return SimpleNamespace(on_spin=on_spin, on_body=on_body)


MOTOR_LAW = Term(
    "motor law",
    functions=_functions,
    within_step=Term("motor within a step", functions=_functions_within_step, timed=True),
    timed=True,
)
