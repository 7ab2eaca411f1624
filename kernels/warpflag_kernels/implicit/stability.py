"""Stability of the two iterations of an implicit step: the over-implicitness that it needs, measured.

The matrix of a step holds the local mobility alone. Under the full mobility M a stiff mode relaxes kappa times as fast
as with the local one, since filaments side by side drag each other along. With the stiffness weighted by the
over-implicitness w, a step of two iterations multiplies such a mode by (1 - kappa/w)^2, so w must exceed kappa/2.
kappa is the largest eigenvalue of w P (1/dt + g M H), P the inverse of the matrix. A power iteration follows it: one
product every few steps, applied to a vector, the probe, that is kept in between and turns with the flagella meanwhile.

kappa is taken to be the growth of the probe's length. The product is not symmetric, so that may exceed the eigenvalue;
it tells of modes that two iterations would magnify at first. One or two flexible flagella need little more than the
least w and are measured rarely; between two measurements the cell changes, and the growth of an outdated probe exceeds
kappa. There kappa is the Rayleigh quotient of the probe x in the inner product with H, in which both sides are
symmetric: with the forces f = -H x,

    kappa = w (x.H x/dt + g f.M f) / (x.H x/dt + w g f.D f),

never more than the eigenvalue where H is positive and symmetric, and never taken to be more than the growth.

The larger w, the more of every stiff mode a step leaves behind, which no error estimate sees. So w follows kappa only
in flexible cells; where kappa is large, in stiff ones, the equations are solved with the full mobility (`krylov`).
"""

import functools
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.fluid import body
from warpflag_kernels.implicit import block_band, linearised
from warpflag_kernels.rod import chain_chart, kept_increment

LEAST_OVER_IMPLICIT = 1.3  # least over-implicitness, enough for kappa up to 2.6
OVER_IMPLICIT_PER_KAPPA = 0.6  # stability needs 0.5; the rest covers the growth of kappa between two measurements
# Least ratio of an over-implicitness to the one before: a power iteration approaches the eigenvalue from below.
LARGEST_FALL = 0.985
MOST_OVER_IMPLICIT = 9.0  # largest over-implicitness, enough for LARGE_KAPPA_OF_FLEXIBLE
FIRST_MEASUREMENTS = 30  # steps after a start that are all measured
LARGE_KAPPA = 2.6  # twice LEAST_OVER_IMPLICIT, the limit of stability: from there on the full mobility is solved with
LARGE_KAPPA_OF_FLEXIBLE = 15.0  # the same for flexible cells: growths up to 13 amid contacts are of sound steps
FREE_ROD = 4.730041  # first root of cosh q cos q = 1: a free rod's slowest bending decays at A q^4/(gamma_perp L^4)
RELAXED = 0.14  # decay times of that mode in a step from which a cell counts as stiff
# Decay times of the longest stretching mode, at K pi^2/(gamma_par L^2), in the longest step, from which a cell counts
# as stiff: two flagella of the default stiffness go through seven.
TIGHT = 14.0
INTERVAL = 4  # steps between two measurements later; 8 lost stability for 0.1 ms once, 0.02 um in all nodes
LONG_INTERVAL = 32  # the same for one or two flexible flagella of small kappa
FIRST_OF_FLEXIBLE = 8  # step after a start at which those are first measured
KAPPA_ALONE = 2.8  # of one flagellum, h = 0.05 um, in mode consistent; a power iteration takes twenty products to it
KAPPA_POWER = 0.45  # it falls as h to the power of minus this: 2.0, 1.5 at h = 0.1, 0.2 um


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Stability`, per cell [C] unless said otherwise."""
    Increment = chain_chart.types(p).Increment

    @wp.struct
    class Stability:
        kappa: wp.array(dtype=wp.float64)
        measured: wp.array(dtype=wp.int32)  # 1: the cell is measured in this pass
        least: wp.array(dtype=wp.float64)  # least over-implicitness of one or two flexible flagella
        active: wp.array(dtype=wp.int32)  # copy of `State.active`, which is masked during a measurement
        due: wp.array(dtype=wp.int32)  # [1], 1: some cell is measured in this pass
        probe: Increment  # of the power iteration, unit length, as `kept_increment` keeps it
        strong: wp.array(dtype=wp.int32)  # 1: kappa is large, the equations are solved with the full mobility
        any_strong: wp.array(dtype=wp.int32)  # [1], 1: some cell's is
        size: wp.array(dtype=wp.float64)  # [K], squared length of the flagellum's part of a product
        # Of the probe x and its forces f = -H x, by flagellum [K]: x.H x [pN um], f.M f and f.D f [pN um/s]; the last
        # without the body's part.
        stored: wp.array(dtype=wp.float64)
        full: wp.array(dtype=wp.float64)
        local: wp.array(dtype=wp.float64)
        # Rates of the longest mode of the flagellum in which it relaxes fastest [1/s].
        bending_rate: wp.array(dtype=wp.float64)
        stretching_rate: wp.array(dtype=wp.float64)
        quotient: wp.array(dtype=wp.float64)  # the Rayleigh quotient of the probe, times the over-implicitness

    return Stability


def allocate(model: DeviceModel) -> Any:
    """The struct `Stability`, its probe a random increment with a share of every mode."""
    cells, device = model.cell_count, model.device
    s = struct(model.precision)()
    s.kappa, s.quotient = (wp.zeros(cells, dtype=wp.float64, device=device) for _ in range(2))
    for name in ("size", "stored", "full", "local"):
        setattr(s, name, wp.zeros(model.flagellum_count, dtype=wp.float64, device=device))
    s.measured, s.active, s.strong = (wp.zeros(cells, dtype=wp.int32, device=device) for _ in range(3))
    # Conditional kernels load in the first pass, which takes no step.
    s.due, s.any_strong = (wp.ones(1, dtype=wp.int32, device=device) for _ in range(2))
    first = model.data.first_flagellum.numpy()
    h = np.minimum.reduceat(model.data.rod.segment_length.numpy().astype(float), first[:-1])
    alone = OVER_IMPLICIT_PER_KAPPA * KAPPA_ALONE * (0.05 / h) ** KAPPA_POWER
    s.least = wp.array(np.clip(alone, LEAST_OVER_IMPLICIT, MOST_OVER_IMPLICIT), dtype=wp.float64, device=device)
    bending, stretching = _relaxation_rates(model)
    s.bending_rate = wp.array(bending, dtype=wp.float64, device=device)
    s.stretching_rate = wp.array(stretching, dtype=wp.float64, device=device)
    s.probe = kept_increment.random(model)
    return s


def _relaxation_rates(model: DeviceModel) -> tuple[np.ndarray, np.ndarray]:
    """Rates at which the longest bending and stretching modes relax, the largest of a cell's flagella [1/s], shape [C].

    With the local mobility: A q^4 mu_across per length, q L the root `FREE_ROD`; K (pi/L)^2 mu_along of a half wave.
    """
    first_node, first_flagellum = model.data.first_node.numpy(), model.data.first_flagellum.numpy()[:-1]
    rod, drag, first = model.data.rod, model.data.drag, first_node[:-1] + 1
    a, k, h = (x.numpy().astype(float) for x in (rod.bending_rigidity, rod.stretching_stiffness, rod.segment_length))
    across, along = (x.numpy()[first].astype(float) for x in (drag.mobility_across, drag.mobility_along))
    length = (np.diff(first_node) - 1) * h
    bending, stretching = a * h * across * (FREE_ROD / length) ** 4, k * h * along * (math.pi / length) ** 2
    return np.maximum.reduceat(bending, first_flagellum), np.maximum.reduceat(stretching, first_flagellum)


@functools.cache
def _kernels(p: Precision, body_flow: bool) -> SimpleNamespace:
    """The kernels; those of cells with flow round their bodies, or without."""
    real, vec3, vec4, respond = p.real, p.vec3, p.vec4, body.mobility(p).respond
    Band = block_band.types(p).Band
    Model, State, Stability, Increment = structs(p).Model, structs(p).State, struct(p), chain_chart.types(p).Increment
    module = p.module("stability", "body_flow" if body_flow else "")
    first_measurements, interval = wp.constant(FIRST_MEASUREMENTS), wp.constant(INTERVAL)
    long_interval, first_of_flexible = wp.constant(LONG_INTERVAL), wp.constant(FIRST_OF_FLEXIBLE)
    large_kappa, large_kappa_of_flexible = (wp.constant(wp.float64(x)) for x in (LARGE_KAPPA, LARGE_KAPPA_OF_FLEXIBLE))
    large_kappa_of_stiff = wp.constant(wp.float64(0.0 if body_flow else LARGE_KAPPA))
    tight, relaxed = wp.constant(wp.float64(TIGHT)), wp.constant(wp.float64(RELAXED))
    least, most = (wp.constant(wp.float64(x)) for x in (LEAST_OVER_IMPLICIT, MOST_OVER_IMPLICIT))
    share, fall = (wp.constant(wp.float64(x)) for x in (OVER_IMPLICIT_PER_KAPPA, LARGEST_FALL))

    @wp.func(module=module)
    def flexible_in(stability: Stability, c: wp.int32, step: wp.float64):
        """Whether no flagellum's longest mode of bending or of stretching is stiff in steps of this length [s]."""
        return step * stability.bending_rate[c] <= relaxed and step * stability.stretching_rate[c] <= tight

    @wp.func(module=module)
    def weakly_coupled(model: Model, stability: Stability, c: wp.int32, longest_step: wp.float64):
        """Whether kappa is always small: one or two flagella that are flexible in the longest step [s]."""
        few = model.first_flagellum[c + 1] - model.first_flagellum[c] <= 2
        return few and flexible_in(stability, c, longest_step)

    @wp.kernel(module=module)
    def schedule(
        # Model:
        model: Model,
        # State:
        state: State,
        steps: wp.array(dtype=wp.int32),
        accepted: wp.array(dtype=wp.int32),
        longest_step: wp.array(dtype=wp.float64),
        # Out:
        stability: Stability,
    ):
        c = wp.tid()
        stability.active[c] = state.active[c]
        measured = int(0)
        due = accepted[c] == 0
        if weakly_coupled(model, stability, c, longest_step[c]) and stability.kappa[c] <= large_kappa:
            due = due or steps[c] % long_interval == first_of_flexible
        else:
            due = due or steps[c] < first_measurements or steps[c] % interval == 0
        if state.active[c] != 0 and due:
            measured = 1
            stability.due[0] = 1
        stability.measured[c] = measured

    @wp.kernel(module=module)
    def mask(
        # State:
        stability: Stability,
        # Out:
        state: State,
    ):
        c = wp.tid()
        state.active[c] = stability.measured[c]

    @wp.kernel(module=module)
    def dissipate(
        # Model:
        model: Model,
        # State:
        state: State,
        band: Band,
        probe: Increment,
        # Out:
        stability: Stability,
    ):
        """What the probe stores, and what its forces dissipate with the full mobility and with the local one."""
        k = wp.tid()
        first = model.first_node[k]
        c = model.cell_of[first]
        if stability.measured[c] == 0:
            return
        spin_mobility = model.drag.spin_mobility[k]
        force = state.flagellum_force[k]
        torque = state.flagellum_torque[k]
        b = probe.body[c]
        stored = -wp.dot(force, vec3(b[0], b[1], b[2])) - wp.dot(torque, vec3(b[3], b[4], b[5]))
        full = wp.dot(force, state.body_velocity[c]) + wp.dot(torque, state.body_spin[c])
        local = real(0.0)
        e = first
        while e < model.first_node[k + 1]:
            spin_torque = state.spin_torque[e]
            x = probe.node[e]
            stored -= spin_torque * x[3]
            spin_power = spin_mobility * spin_torque * spin_torque
            local += spin_power
            full += spin_power
            if e > first:
                f = state.force[e]
                across = model.drag.mobility_across[e]
                along = wp.dot(f, band.tangent[e])
                stored -= wp.dot(f, vec3(x[0], x[1], x[2]))
                local += across * wp.dot(f, f) + (model.drag.mobility_along[e] - across) * along * along
                full += wp.dot(f, state.velocity[e])
            e += 1
        stability.stored[k] = wp.float64(stored)
        stability.full[k] = wp.float64(full)
        stability.local[k] = wp.float64(local)

    @wp.kernel(module=module)
    def divide(
        # Model:
        model: Model,
        # State:
        state: State,
        step: wp.array(dtype=wp.float64),
        gain: wp.array(dtype=wp.float64),
        over_implicit: wp.array(dtype=wp.float64),
        # Out:
        stability: Stability,
    ):
        """The Rayleigh quotient of the probe, from what `dissipate` found; a kernel of its own for its registers."""
        c = wp.tid()
        if stability.measured[c] == 0:
            return
        stored = wp.float64(0.0)
        full = wp.float64(0.0)
        local = wp.float64(0.0)
        force = vec3(real(0.0))
        torque = vec3(real(0.0))
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            stored += stability.stored[k]
            full += stability.full[k]
            local += stability.local[k]
            force += state.flagellum_force[k]
            torque += state.flagellum_torque[k]
            k += 1
        velocity, spin = respond(model, state, c, force, torque)
        local += wp.float64(wp.dot(force, velocity) + wp.dot(torque, spin))
        dt = step[c]
        w = over_implicit[c]
        stability.quotient[c] = w  # soft modes under load, whose x.H x may be negative, say nothing of the stiffness
        denominator = stored / dt + w * gain[c] * local
        if denominator > wp.float64(0.0):
            stability.quotient[c] = w * (stored / dt + gain[c] * full) / denominator

    @wp.kernel(module=module)
    def measure(
        # Model:
        model: Model,
        # State:
        response: Increment,
        # Out:
        stability: Stability,
    ):
        k = wp.tid()
        first = model.first_node[k]
        if stability.measured[model.cell_of[first]] == 0:
            return
        scale = real(1.0) / model.rod.segment_length[k]
        total = wp.float64(0.0)
        e = first
        while e < model.first_node[k + 1]:
            d = response.node[e]
            if e == first:
                d = vec4(real(0.0), real(0.0), real(0.0), d[3])  # r_0 has no displacement of its own
            stability.probe.node[e] = d
            x = scale * scale * (d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
            total += wp.float64(x + d[3] * d[3])
            e += 1
        stability.size[k] = total

    @wp.kernel(module=module)
    def choose(
        # Model:
        model: Model,
        # State:
        response: Increment,
        step: wp.array(dtype=wp.float64),
        longest_step: wp.array(dtype=wp.float64),
        # Out:
        stability: Stability,
        over_implicit: wp.array(dtype=wp.float64),
        state: State,
    ):
        c = wp.tid()
        state.active[c] = stability.active[c]
        stability.due[0] = 0
        if stability.measured[c] == 0:
            return
        total = wp.float64(0.0)
        k = model.first_flagellum[c]
        while k < model.first_flagellum[c + 1]:
            total += stability.size[k]
            k += 1
        ratio = wp.sqrt(total)
        if wp.isfinite(ratio) and ratio > wp.float64(0.0):
            weak = weakly_coupled(model, stability, c, longest_step[c])
            crowd = model.first_flagellum[c + 1] - model.first_flagellum[c] > 2
            flexible = weak or (crowd and flexible_in(stability, c, step[c]))
            # A probe of any direction may grow by far more than kappa: stiff cells are solved with the full mobility
            # until it has turned toward the leading eigenvector.
            kappa = ratio * over_implicit[c]
            if weak:
                kappa = wp.min(kappa, stability.quotient[c])
            most_kappa = wp.where(flexible, large_kappa_of_flexible, large_kappa_of_stiff)
            stability.strong[c] = wp.where(kappa > most_kappa, 1, 0)
            if stability.strong[c] != 0:
                stability.any_strong[0] = 1
            w = wp.where(weak, stability.least[c], least)
            if flexible:
                w = wp.max(w, fall * over_implicit[c])
                if stability.strong[c] == 0:
                    w = wp.clamp(share * kappa, w, most)
            over_implicit[c] = w
            stability.kappa[c] = kappa
            scale = real(wp.float64(1.0) / ratio)
            stability.probe.body[c] = scale * response.body[c]
            e = model.first_node[model.first_flagellum[c]]
            while e < model.first_node[model.first_flagellum[c + 1]]:
                stability.probe.node[e] = scale * stability.probe.node[e]
                e += 1

    return SimpleNamespace(
        schedule=schedule, mask=mask, dissipate=dissipate, divide=divide, measure=measure, choose=choose
    )


def schedule(
    model: DeviceModel, state: DeviceState, steps: Any, accepted: Any, longest_step: Any, stability: Any
) -> None:
    """Which cells are measured in this pass, into `measured` and `due`.

    At each of its first steps, then at every fourth, and after a rejected one; one or two flexible flagella less often.

    Args:
        model, state: of the batch.
        steps, accepted: attempted by every cell so far; 1: the last one was accepted; shape [cell_count].
        longest_step: [s], shape [cell_count]: a cell that is stiff in such steps is measured often.
        stability: struct `Stability`.
    """
    inputs = [model.data, state.data, steps, accepted, longest_step, stability]
    kernel = _kernels(model.precision, model.switches.flows.body).schedule
    wp.launch(kernel, model.cell_count, inputs=inputs, device=model.device)


def measure(
    model: DeviceModel,
    state: DeviceState,
    stiffness: Any,
    band: Any,
    gain: wp.array,
    response: Any,
    stability: Any,
    over_implicit: Any,
    longest_step: Any,
) -> None:
    """One power iteration of the cells that are due, and their over-implicitness from it.

    Args:
        model, state: of the batch; the forces and velocities of `state` are overwritten.
        stiffness, band: at the state's pose.
        gain, over_implicit: shape [cell_count]; longest_step: as in `schedule`.
        response: room for an increment, struct `Increment`.
        stability: struct `Stability`.
    """
    kernels, device = _kernels(model.precision, model.switches.flows.body), model.device
    wp.launch(kernels.mask, model.cell_count, inputs=[stability, state.data], device=device)
    kept = (model, stability.measured, state.data.pose, stability.probe)
    kept_increment.bring_back(*kept)
    linearised.apply(model, state, stiffness, band, gain, stability.probe, response)
    inputs = [model.data, state.data, band, stability.probe, stability]
    wp.launch(kernels.dissipate, model.flagellum_count, inputs=inputs, device=device)
    inputs = [model.data, state.data, band.step, gain, over_implicit, stability]
    wp.launch(kernels.divide, model.cell_count, inputs=inputs, device=device)
    linearised.solve(model, state, band, response)
    inputs = [model.data, response, stability]
    wp.launch(kernels.measure, model.flagellum_count, inputs=inputs, device=device)
    inputs = [model.data, response, band.step, longest_step, stability, over_implicit, state.data]
    wp.launch(kernels.choose, model.cell_count, inputs=inputs, device=device)
    kept_increment.keep(*kept)
