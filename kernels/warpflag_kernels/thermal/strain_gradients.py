"""Gradients of the strains: the stiffness without prestress, and the random elastic force that goes with it.

The elastic energy is a sum of (k_s/2) (w_s - w_s^0)^2 over the strains of all joints and segments. With J the gradients
of the strains, the stiffness that is left where no strain is loaded, and the force

    H = J^T k J,        f = J^T (kT k)^1/2 xi,    xi one normal deviate for every strain,

fit together: f has the covariance kT H. An implicit step that solves with H and takes f along reproduces exp(-E/kT) for
stiff modes too (`equilibrium`). H is positive whatever the load, and exact to first order in the step.

**Straight joints.** A filament that is straight at rest spins freely, by (2 kT dt/gamma_R L)^1/2 in a step or 0.23 rad
in 1e-5 s at 1.2 um, and its bends, which do not follow, turn in the axes of its segments. Linearised, that turn
lengthens them, and bending would be too warm by its square. So joints without rest curvature have no gradients of
bending with respect to spins: their energy does not depend on spins, and at zero bend this is the same.

A hook that resists bending has the energy (k/2) s^2, s = 2 tan(beta/2) the distance of helix axis and motor axis in a
stereographic projection, which keeps angles: the gradient of s has the length q = 1/cos^2(beta/2) in both directions.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base import random_numbers
from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import noise as noise_stage
from warpflag_kernels.motor import hook
from warpflag_kernels.rod import hessian, rotations


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Strains`: strains of the joints at the start of a step, and their gradients. Per element [E]."""
    vec3, mat33 = p.vec3, p.mat33

    @wp.struct
    class Strains:
        value: wp.array(dtype=vec3)  # [rad]
        by_first: wp.array(dtype=mat33)  # rows: strains over the first vector [1/um], the tripod's unit one
        by_second: wp.array(dtype=mat33)  # over the second segment's vector [1/um]
        by_first_spin: wp.array(dtype=vec3)
        by_second_spin: wp.array(dtype=vec3)

    return Strains


def allocate(model: DeviceModel) -> Any:
    """Arrays of the struct `Strains`, zero."""
    p, s = model.precision, struct(model.precision)()
    for name in ("by_first", "by_second"):
        setattr(s, name, wp.zeros(model.element_count, dtype=p.mat33, device=model.device))
    for name in ("value", "by_first_spin", "by_second_spin"):
        setattr(s, name, wp.zeros(model.element_count, dtype=p.vec3, device=model.device))
    return s


@functools.cache
def functions(p: Precision) -> SimpleNamespace:
    """Device functions: gradients of the strains of a joint, their stiffness, and whether there is a joint."""
    real, vec3 = p.real, p.vec3
    Model, Pose = structs(p).Model, structs(p).Pose
    half, zero, one, two = (wp.constant(real(x)) for x in (0.5, 0.0, 1.0, 2.0))
    module = p.module("strain_gradients")

    @wp.func(module=module)
    def joint_gradients(model: Model, pose: Pose, i: wp.int32, k: wp.int32):
        """Gradients of the three strains w1, w2, w3 of joint i of flagellum k.

        Returns: with respect to the segment vector e, to f (rows: strains [1/um], for the tripod per unit vector), to
        the spin of e and to that of f.
        """
        t = pose.tangent[i]
        u = pose.tangent[i + 1]
        a1 = pose.director[i]
        b1 = pose.director[i + 1]
        per_e = one / pose.length[i]
        per_f = one / pose.length[i + 1]
        per_chi = one / (one + wp.dot(t, u))
        kb = wp.cross(t, u) * (two * per_chi)
        third_e = (half * per_e) * kb
        third_f = (half * per_f) * kb
        first_e = vec3(zero)
        first_f = vec3(zero)
        second_e = vec3(zero)
        second_f = vec3(zero)
        spin_e = vec3(zero, zero, -one)
        spin_f = vec3(zero, zero, one)
        if i > model.first_node[k]:  # the hook bends freely
            a2 = wp.cross(t, a1)
            b2 = wp.cross(u, b1)
            common = (t + u) * per_chi
            w1 = half * wp.dot(kb, a1 + b1)
            w2 = half * wp.dot(kb, a2 + b2)
            mean1 = (a1 + b1) * per_chi
            mean2 = (a2 + b2) * per_chi
            first_e = per_e * (wp.cross(u, mean1) - w1 * common)
            first_f = -per_f * (wp.cross(t, mean1) + w1 * common)
            second_e = per_e * (wp.cross(u, mean2) - w2 * common)
            second_f = -per_f * (wp.cross(t, mean2) + w2 * common)
            rest = model.rod.rest_strain[i]
            if rest[0] != zero or rest[1] != zero:
                spin_e = vec3(half * wp.dot(kb, a2), -half * wp.dot(kb, a1), -one)
                spin_f = vec3(half * wp.dot(kb, b2), -half * wp.dot(kb, b1), one)
        on_e = wp.matrix_from_rows(first_e, second_e, third_e)
        on_f = wp.matrix_from_rows(first_f, second_f, third_f)
        return on_e, on_f, spin_e, spin_f

    @wp.func(module=module)
    def joint_stiffness(model: Model, i: wp.int32, k: wp.int32):
        """Stiffness of the three strains of a joint [pN um]."""
        per_length = one / model.rod.segment_length[k]
        if i == model.first_node[k]:
            return vec3(zero, zero, model.rod.hook_rigidity[k] * per_length)
        bend = model.rod.bending_rigidity[k] * per_length
        return vec3(bend, bend, model.rod.twist_rigidity[k] * per_length)

    @wp.func(module=module)
    def joined(model: Model, i: wp.int32, k: wp.int32):
        """Whether something joins segment i and the next: not at the tripod of a free filament, nor at the last."""
        if i == model.first_node[k] and model.rod.hook_rigidity[k] == zero:
            return False
        return i + 1 < model.first_node[k + 1]

    return SimpleNamespace(joint_gradients=joint_gradients, joint_stiffness=joint_stiffness, joined=joined)


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    Stiffness, Noise, Strains = hessian.struct(p), noise_stage.struct(p), struct(p)
    f = functions(p)
    joint_gradients, joint_stiffness, joined = f.joint_gradients, f.joint_stiffness, f.joined
    joint_strain = rotations.functions(p).joint_strain
    normals, for_strain = random_numbers.functions(p).normals, wp.constant(random_numbers.FOR_STRAIN)
    module = p.module("strain_noise")

    @wp.kernel(module=module)
    def find(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        strains: Strains,
    ):
        i = wp.tid()
        k = model.flagellum_of[i]
        if state.active[model.cell_of[i]] == 0 or not joined(model, i, k):
            return
        on_e, on_f, spin_e, spin_f = joint_gradients(model, state.pose, i, k)
        pose = state.pose
        strains.value[i] = joint_strain(pose.tangent[i], pose.tangent[i + 1], pose.director[i], pose.director[i + 1])
        strains.by_first[i] = on_e
        strains.by_second[i] = on_f
        strains.by_first_spin[i] = spin_e
        strains.by_second_spin[i] = spin_f

    @wp.kernel(module=module)
    def stiffnesses(
        # Model:
        model: Model,
        # State:
        state: State,
        strains: Strains,
        # Out:
        stiffness: Stiffness,
    ):
        i = wp.tid()
        if state.active[model.cell_of[i]] == 0:
            return
        k = model.flagellum_of[i]
        if i > model.first_node[k]:
            t = state.pose.tangent[i]
            per_length = model.rod.stretching_stiffness[k] / model.rod.segment_length[k]
            stiffness.stretch[i] = per_length * wp.outer(t, t)
        if not joined(model, i, k):
            return
        on_e = strains.by_first[i]
        on_f = strains.by_second[i]
        spin_e = strains.by_first_spin[i]
        spin_f = strains.by_second_spin[i]
        s = joint_stiffness(model, i, k)
        loaded_e = wp.diag(s) * on_e
        loaded_f = wp.diag(s) * on_f
        stiffness.ee[i] = wp.transpose(on_e) * loaded_e
        stiffness.ff[i] = wp.transpose(on_f) * loaded_f
        stiffness.fe[i] = wp.transpose(on_f) * loaded_e
        stiffness.e_first[i] = wp.transpose(loaded_e) * spin_e
        stiffness.e_second[i] = wp.transpose(loaded_e) * spin_f
        stiffness.f_first[i] = wp.transpose(loaded_f) * spin_e
        stiffness.f_second[i] = wp.transpose(loaded_f) * spin_f
        loaded_spin = wp.cw_mul(s, spin_e)
        stiffness.spins[i] = vec3(
            wp.dot(loaded_spin, spin_e), wp.dot(loaded_spin, spin_f), wp.dot(wp.cw_mul(s, spin_f), spin_f)
        )

    @wp.kernel(module=module)
    def random_moments(
        # Model:
        model: Model,
        # State:
        strains: Strains,
        noise: Noise,
        steps: wp.array(dtype=wp.int32),
        share: real,
        # Out:
        state: State,
    ):
        """Adds random moments at every joint, and random tensions of segments, to the gradients of the joints."""
        i = wp.tid()
        c = model.cell_of[i]
        if state.active[c] == 0:
            return
        k = model.flagellum_of[i]
        last = model.first_node[k + 1] - 1
        if not joined(model, i, k):
            return
        own = i - model.first_node[model.first_flagellum[c]]
        xi = normals(noise.seed[c], own, steps[c], for_strain)
        scale = share * real(wp.sqrt(noise.energy[c]))
        s = joint_stiffness(model, i, k)
        m = scale * vec3(wp.sqrt(s[0]) * xi[0], wp.sqrt(s[1]) * xi[1], wp.sqrt(s[2]) * xi[2])
        tension = scale * wp.sqrt(model.rod.stretching_stiffness[k] / model.rod.segment_length[k])
        before = wp.transpose(strains.by_first[i]) * m
        after = wp.transpose(strains.by_second[i]) * m
        if i > model.first_node[k]:
            before += tension * xi[3] * state.pose.tangent[i]
        if i + 1 == last:  # no joint begins with the last segment
            xi = normals(noise.seed[c], own + 1, steps[c], for_strain)
            after += tension * xi[3] * state.pose.tangent[last]
        state.joint_before[i] = state.joint_before[i] + before
        state.joint_after[i] = state.joint_after[i] + after
        state.joint_spin_before[i] = state.joint_spin_before[i] + wp.dot(m, strains.by_first_spin[i])
        state.joint_spin_after[i] = state.joint_spin_after[i] + wp.dot(m, strains.by_second_spin[i])

    return SimpleNamespace(find=find, stiffnesses=stiffnesses, random_moments=random_moments)


@functools.cache
def _hook_kernels(p: Precision) -> SimpleNamespace:
    real, vec3 = p.real, p.vec3
    Model, State = structs(p).Model, structs(p).State
    Stiffness, Noise = hessian.struct(p), noise_stage.struct(p)
    joint = hook.joint(p)
    helix_axis, hook_stiffness, axis_rates = joint.helix_axis, joint.stiffness, joint.axis_rates
    normals, for_hook = random_numbers.functions(p).normals, wp.constant(random_numbers.FOR_HOOK)
    module = p.module("hook_noise")

    @wp.func(module=module)
    def conformal_factor(model: Model, state: State, k: wp.int32):
        """q of flagellum k."""
        c = wp.dot(state.pose.tangent[model.first_node[k]], helix_axis(model, state, k))
        return real(2.0) / (real(1.0) + c)

    @wp.kernel(module=module)
    def add_stiffness(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        out: Stiffness,
    ):
        k = wp.tid()
        i = model.first_node[k]
        if state.active[model.cell_of[i]] == 0:
            return
        q = conformal_factor(model, state, k)
        s = hook_stiffness(model, state, k) * q * q
        by_segment, by_spin, carried = axis_rates(model, state, k)
        out.ee[i] = out.ee[i] + s * (wp.transpose(carried) * carried)
        out.ff[i] = out.ff[i] + s * (wp.transpose(by_segment) * by_segment)
        out.fe[i] = out.fe[i] - s * (wp.transpose(by_segment) * carried)
        out.e_second[i] = out.e_second[i] - s * (wp.transpose(carried) * by_spin)
        out.f_second[i] = out.f_second[i] + s * (wp.transpose(by_segment) * by_spin)
        out.spins[i] = out.spins[i] + vec3(real(0.0), real(0.0), s * wp.dot(by_spin, by_spin))

    @wp.kernel(module=module)
    def add_random_moment(
        # Model:
        model: Model,
        # State:
        noise: Noise,
        steps: wp.array(dtype=wp.int32),
        share: real,
        # Out:
        state: State,
    ):
        k = wp.tid()
        i = model.first_node[k]
        c = model.cell_of[i]
        if state.active[c] == 0:
            return
        xi = normals(noise.seed[c], i - model.first_node[model.first_flagellum[c]], steps[c], for_hook)
        q = conformal_factor(model, state, k)
        scale = share * q * wp.sqrt(real(noise.energy[c]) * hook_stiffness(model, state, k))
        by_segment, by_spin, carried = axis_rates(model, state, k)
        m = scale * vec3(xi[0], xi[1], xi[2])
        state.joint_before[i] = state.joint_before[i] - wp.transpose(carried) * m
        state.joint_after[i] = state.joint_after[i] + wp.transpose(by_segment) * m
        state.joint_spin_after[i] = state.joint_spin_after[i] + wp.dot(m, by_spin)

    return SimpleNamespace(add_stiffness=add_stiffness, add_random_moment=add_random_moment)


def find(model: DeviceModel, state: DeviceState, strains: Any) -> None:
    """Strains of the joints of the pose and their gradients, into the struct `Strains`."""
    inputs = [model.data, state.data, strains]
    wp.launch(_kernels(model.precision).find, model.element_count, inputs=inputs, device=model.device)


def stiffness_without_prestress(model: DeviceModel, state: DeviceState, strains: Any, stiffness: Any) -> None:
    """J^T k J joint by joint and segment by segment, into `stiffness`, in place of the second derivatives.

    Args:
        model, state: of the batch.
        strains: struct `Strains`, with J at this pose.
        stiffness: struct `Stiffness`.
    """
    inputs, device = [model.data, state.data, strains, stiffness], model.device
    wp.launch(_kernels(model.precision).stiffnesses, model.element_count, inputs=inputs, device=device)
    if model.switches.has("hook"):
        kernel, inputs = _hook_kernels(model.precision).add_stiffness, [model.data, state.data, stiffness]
        wp.launch(kernel, model.flagellum_count, inputs=inputs, device=device)


def add_random_moments(
    model: DeviceModel, state: DeviceState, strains: Any, noise: Any, steps: Any, share: float
) -> None:
    """Adds the random elastic force to the joints' energy gradients, which have been evaluated.

    Args:
        model, state: of the batch.
        strains: struct `Strains`, with J at this pose.
        noise: struct `Noise`.
        steps: number of the step that begins, shape [cell_count].
        share: factor on the force.
    """
    inputs, device = [model.data, strains, noise, steps, share, state.data], model.device
    wp.launch(_kernels(model.precision).random_moments, model.element_count, inputs=inputs, device=device)
    if model.switches.has("hook"):
        kernel, inputs = _hook_kernels(model.precision).add_random_moment, [model.data, noise, steps, share, state.data]
        wp.launch(kernel, model.flagellum_count, inputs=inputs, device=device)
