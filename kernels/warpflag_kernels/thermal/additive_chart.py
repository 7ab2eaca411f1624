"""The chart of thermal steps: nodes are displaced as they are, and inner forces give segments back their lengths.

Displacements that are chained as rotations from the anchor on, as in `chain_chart`, rectify noise: each segment turns
by a random angle Om and loses Om^2/2 of its mean length toward the anchor, without a reaction, and a passive helix then
swims, at 30 to 270 um/s, while all energies look right. So node i moves from r_i to r_i + x_i. That alone would stretch
a segment that turns by Om by Om^2/2; its length is brought to what the linear step means it to be,

    l (1 + t.(x_i - x_(i-1))/l),

by tensions between its two nodes, which the local mobility D turns into displacements: D_i (L_i t_i - L_(i+1) t_(i+1)),
a tridiagonal system along every flagellum, by Newton's method. Tensions come in pairs, so nothing is pushed as a whole;
that of the first segment acts on the body, too.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body as body_stage
from warpflag_kernels.fluid import noise as noise_stage
from warpflag_kernels.motor import laws
from warpflag_kernels.rod import chain_chart, rotations
from warpflag_kernels.rod import comoving_chart as chart_stage
from warpflag_kernels.rod.comoving_chart import vec6d

# Newton iterations. Each leaves the square of the relative error. Between two of them the body moves by its flagella's
# pull; it yields six times less than a node, so after four 0.5 % of the body's part of the length error remain.
LENGTH_ITERATIONS = 4


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Additive`: work space."""
    real, vec3 = p.real, p.vec3

    @wp.struct
    class Additive:
        node: wp.array(dtype=vec3)  # [E], relative to the body's centre at the start of the step [um]
        length: wp.array(dtype=real)  # [E], that the segment shall have [um]
        ratio: wp.array(dtype=real)  # [E], of the elimination along a flagellum
        tension: wp.array(dtype=real)  # [E], times the step [pN s]
        owed: wp.array(dtype=real)  # [E], sum of the tensions of a step, which the next one takes back [pN s]
        pull: wp.array(dtype=vec3)  # [K], on the anchor, times the step [pN s]

    return Additive


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `Additive`, zero."""
    p, a = model.precision, struct(model.precision)()
    a.node = wp.zeros(model.element_count, dtype=p.vec3, device=model.device)
    for name in ("length", "ratio", "tension", "owed"):
        setattr(a, name, wp.zeros(model.element_count, dtype=p.real, device=model.device))
    a.pull = wp.zeros(model.flagellum_count, dtype=p.vec3, device=model.device)
    return a


@functools.cache
def _kernels(p: Precision, free: bool, motor_law: bool) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, State, Chart = structs(p).Model, structs(p).State, chart_stage.struct(p)
    Increment, Additive, Noise = chain_chart.types(p).Increment, struct(p), noise_stage.struct(p)
    vec6 = chain_chart.types(p).vec6
    f, fd = rotations.functions(p), rotations.functions(p.double)
    transport, turn, perpendicular_unit = f.transport, f.turn, f.perpendicular_unit
    attached, body_axis, rotation_vector_quatd = f.attached, f.body_axis, fd.rotation_vector_quat
    respond, prescribed = body_stage.mobility(p).respond, wp.constant(wp.int32(laws.Law.PRESCRIBED))
    module = p.module("additive_chart", "free" * free + "motor_law" * motor_law)

    @wp.kernel(module=module)
    def move_bodies(
        # Model:
        model: Model,
        # State:
        x: Increment,
        # Out:
        state: State,
        chart: Chart,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        b = x.body[c]
        u = wp.vec3d(wp.float64(b[0]), wp.float64(b[1]), wp.float64(b[2]))
        w = wp.vec3d(wp.float64(b[3]), wp.float64(b[4]), wp.float64(b[5]))
        state.pose.body_position[c] = chart.base.body_position[c] + u
        state.pose.body_orientation[c] = wp.normalize(rotation_vector_quatd(w) * chart.base.body_orientation[c])
        chart.body_increment[c] = vec6d(u[0], u[1], u[2], w[0], w[1], w[2])

    @wp.kernel(module=module)
    def displace(
        # Model:
        model: Model,
        # State:
        state: State,
        chart: Chart,
        x: Increment,
        # Out:
        a: Additive,
    ):
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        first = model.first_node[model.flagellum_of[e]]
        if e == first:
            return
        n = x.node[e]
        here = vec3(n[0], n[1], n[2])
        n = x.node[e - 1]
        before = vec3(n[0], n[1], n[2])
        position = chart.base.position[e]
        segment = position - chart.base.position[e - 1]
        if e - 1 == first:
            b = x.body[c]
            before = vec3(b[0], b[1], b[2]) + wp.cross(vec3(b[3], b[4], b[5]), chart.base.position[first])
        a.node[e] = position + here
        a.owed[e] = real(0.0)
        a.length[e] = wp.length(segment) + wp.dot(chart.base.tangent[e], here - before)

    @wp.func(module=module)
    def respond_node(model: Model, chart: Chart, e: wp.int32, k: wp.int32, force: vec3):
        """Displacement of node e by a force times the step [pN s], with the local mobility at the start [um]."""
        t = chart.base.tangent[e]
        if e + 1 < model.first_node[k + 1]:
            t = wp.normalize(t + chart.base.tangent[e + 1])
        along = wp.dot(t, force) * t
        return model.drag.mobility_along[e] * along + model.drag.mobility_across[e] * (force - along)

    @wp.func(module=module)
    def anchor_of(model: Model, state: State, chart: Chart, k: wp.int32, c: wp.int32):
        """Position of the anchor of flagellum k relative to the body's centre at the start of the step [um]."""
        shift = vec3(state.pose.body_position[c] - chart.base.body_position[c])
        return shift + attached(state.pose.body_orientation[c], model.motor.anchor[k])

    @wp.kernel(module=module)
    def restore(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        # Out:
        state: State,
        a: Additive,
    ):
        """One Newton iteration for the tensions of a flagellum, its anchor at rest or r_0 a free end; tangents are left
        in the pose."""
        k = wp.tid()
        first = model.first_node[k]
        end = model.first_node[k + 1]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        zero = real(0.0)
        before = anchor_of(model, state, chart, k, c)
        moved_before = vec3(zero)  # D_(e-1) t_(e-1)
        ratio = zero
        known = zero
        e = first + 1
        while e < end:
            segment = a.node[e] - before
            before = a.node[e]
            length = wp.length(segment)
            t = segment / length
            state.pose.tangent[e] = t
            moved = respond_node(model, chart, e, k, t)
            diagonal = wp.dot(t, moved)
            beside = zero
            if wp.static(free) and e == first + 1:
                own = chart.base.tangent[e]
                part = wp.dot(own, t) * own
                moved_end = model.body.mobility_along[c] * part + model.body.mobility_across[c] * (t - part)
                diagonal += wp.dot(t, moved_end)
            if e > first + 1:
                diagonal += wp.dot(t, respond_node(model, chart, e - 1, k, t))
                beside = -wp.dot(t, moved_before)  # to the tension before
            # The matrix is symmetric: the entry to the tension after this one is that of the next row.
            pivot = diagonal - beside * ratio
            value = (a.length[e] - length - beside * known) / pivot
            after = zero
            if e + 1 < end:
                next_t = wp.normalize(a.node[e + 1] - a.node[e])
                after = -wp.dot(next_t, moved)
            ratio = after / pivot
            known = value
            a.ratio[e] = ratio
            a.tension[e] = value
            moved_before = moved
            e += 1
        e = end - 1
        later = zero
        pushed = vec3(zero)  # by the segment after: -L t
        while e > first:
            tension = a.tension[e] - a.ratio[e] * later
            a.owed[e] = a.owed[e] + tension
            own = tension * state.pose.tangent[e]
            a.node[e] = a.node[e] + respond_node(model, chart, e, k, own + pushed)
            pushed = -own
            later = tension
            e -= 1
        a.pull[k] = pushed

    @wp.kernel(module=module)
    def pull_bodies(
        # Model:
        model: Model,
        # State:
        a: Additive,
        # Out:
        state: State,
        chart: Chart,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        force = vec3(real(0.0))
        torque = vec3(real(0.0))
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            force += a.pull[k]
            torque += wp.cross(attached(state.pose.body_orientation[c], model.motor.anchor[k]), a.pull[k])
            k += 1
        u, w = respond(model, state, c, force, torque)
        ud = wp.vec3d(u)
        wd = wp.vec3d(w)
        state.pose.body_position[c] = state.pose.body_position[c] + ud
        state.pose.body_orientation[c] = wp.normalize(rotation_vector_quatd(wd) * state.pose.body_orientation[c])
        chart.body_increment[c] = chart.body_increment[c] + vec6d(ud[0], ud[1], ud[2], wd[0], wd[1], wd[2])

    @wp.kernel(module=module)
    def give_back(
        # Model:
        model: Model,
        # State:
        state: State,
        chart: Chart,
        a: Additive,
        step: wp.array(dtype=wp.float64),
        # Out:
        noise: Noise,
    ):
        """Takes the last step's tensions back, as velocities of nodes and bodies."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        first = model.first_node[k]
        if e > first:
            force = -a.owed[e] * chart.base.tangent[e]
            if e + 1 < model.first_node[k + 1]:
                force += a.owed[e + 1] * chart.base.tangent[e + 1]
            v = respond_node(model, chart, e, k, force) / real(step[c])
            noise.node[e] = noise.node[e] + vec4(v[0], v[1], v[2], real(0.0))
        elif k == model.first_flagellum[c]:
            push = vec3(real(0.0))
            torque = vec3(real(0.0))
            while k < model.first_flagellum[c + 1]:
                first = model.first_node[k]
                one = a.owed[first + 1] * chart.base.tangent[first + 1]
                push += one
                torque += wp.cross(chart.base.position[first], one)
                k += 1
            u, w = respond(model, state, c, push, torque)
            scale = real(1.0) / real(step[c])
            noise.body[c] = noise.body[c] + scale * vec6(u[0], u[1], u[2], w[0], w[1], w[2])

    @wp.kernel(module=module)
    def frames(
        # Model:
        model: Model,
        # State:
        chart: Chart,
        x: Increment,
        a: Additive,
        # Out:
        state: State,
    ):
        """Positions relative to the body's new centre, tangents, lengths and directors."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[e]
        first = model.first_node[k]
        shift = vec3(state.pose.body_position[c] - chart.base.body_position[c])
        orientation = state.pose.body_orientation[c]
        t = attached(orientation, model.motor.axis[k])
        y = attached(orientation, model.motor.anchor[k])
        length = real(1.0)
        if e > first:
            before = y
            y = a.node[e] - shift
            if e > first + 1:
                before = a.node[e - 1] - shift
            length = wp.length(y - before)
            t = (y - before) / length
        elif k == model.first_flagellum[c]:
            state.pose.body_axis[c] = body_axis(orientation)
        spin = x.node[e][3]
        carried = transport(chart.base.director[e], chart.base.tangent[e], t)
        if wp.static(motor_law) and e == first and model.motor_law[0].kind[k] == prescribed:
            # The tripod keeps to its rate against the body as it has turned in the end.
            turned = orientation * wp.quat_inverse(chart.base.body_orientation[c])
            carried = vec3(wp.quat_rotate(turned, wp.vec3d(chart.base.director[e])))
            b = x.body[c]
            spin -= wp.dot(chart.base.tangent[e], vec3(b[3], b[4], b[5]))
        state.pose.position[e] = y
        state.pose.tangent[e] = t
        state.pose.length[e] = length
        state.pose.director[e] = perpendicular_unit(turn(carried, t, spin), t)

    @wp.kernel(module=module)
    def tell(
        # Model:
        model: Model,
        # State:
        state: State,
        x: Increment,
        # Out:
        chart: Chart,
    ):
        """Sets what the guards read: that the step is complete, and how far every motor has turned."""
        k = wp.tid()
        first = model.first_node[k]
        c = model.cell_of[first]
        if state.active[c] == 0:
            return
        chart.increment[first] = vec4(real(0.0), real(0.0), real(0.0), x.node[first][3])
        chart.commit[c] = 1

    return SimpleNamespace(
        move_bodies=move_bodies,
        displace=displace,
        restore=restore,
        pull_bodies=pull_bodies,
        give_back=give_back,
        frames=frames,
        tell=tell,
    )


def _kernels_of(model: DeviceModel) -> SimpleNamespace:
    return _kernels(model.precision, model.switches.has("free end"), model.switches.has("motor law"))


def give_back(model: DeviceModel, state: DeviceState, chart: Any, work: Any, step: Any, noise: Any) -> None:
    """Takes the tensions back by which the last step restored lengths: adds their velocities to the thermal ones.

    Args:
        model, state: of the batch, at the start of the step.
        chart: struct `Chart`, with the start.
        work: struct `Additive`.
        step: length of the step that begins [s], shape [cell_count].
        noise: struct `Noise`, drawn.
    """
    kernel = _kernels_of(model).give_back
    inputs = [model.data, state.data, chart, work, step, noise]
    wp.launch(kernel, model.element_count, inputs=inputs, device=model.device)


def retract(model: DeviceModel, state: DeviceState, chart: Any, x: Any, work: Any, restoring: bool = True) -> None:
    """The pose that an increment leads to from the start of the step, into the pose of `state`; the step is complete.

    Args:
        model, state: of the batch; the body axes of `state` are those of the start.
        chart: struct `Chart`, with the start.
        x: the increment, struct `Increment`.
        work: struct `Additive`.
        restoring: whether lengths are restored.
    """
    free = model.switches.has("free end")
    kernels, device, cells = _kernels_of(model), model.device, model.cell_count
    flagella, elements = model.flagellum_count, model.element_count
    wp.launch(kernels.move_bodies, cells, inputs=[model.data, x, state.data, chart], device=device)
    wp.launch(kernels.displace, elements, inputs=[model.data, state.data, chart, x, work], device=device)
    for iteration in range(LENGTH_ITERATIONS if restoring else 0):
        wp.launch(kernels.restore, flagella, inputs=[model.data, chart, state.data, work], device=device)
        if free or iteration + 1 < LENGTH_ITERATIONS:
            wp.launch(kernels.pull_bodies, cells, inputs=[model.data, work, state.data, chart], device=device)
    wp.launch(kernels.frames, elements, inputs=[model.data, chart, x, work, state.data], device=device)
    wp.launch(kernels.tell, flagella, inputs=[model.data, state.data, x, chart], device=device)
