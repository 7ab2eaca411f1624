"""The prediction of a step by extrapolation, the share of it with which the first iteration begins, and the error
estimate, from how far the step ends from its prediction.

A quadratic path through the last three states says what the correction e of a step would be (`collocation`). The first
iteration begins with a share of it, at the pose R(q, theta w delta + share e): what two iterations leave of the slowly
converging modes is in proportion to the e that is not known yet, of third order in the step instead of second. The
share is that of the last step, by least squares over its nodes, and less where the over-implicitness is large.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.implicit import collocation
from warpflag_kernels.rod import chain_chart
from warpflag_kernels.stepping import accuracy, balance, step_control


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Implicit, Increment = collocation.struct(p), chain_chart.types(p).Increment
    Balance, judge = balance.struct(p), balance.functions(p).judge
    may_make = accuracy.functions(independent=True).may_make
    per_predictor = wp.constant(wp.float64(collocation.ERROR_PER_PREDICTOR))
    round_off = wp.constant(wp.float64(step_control.ROUND_OFF[p.name]))
    module = p.module("prediction")

    @wp.kernel(module=module)
    def predict(
        # Model:
        model: Model,
        # State:
        state: State,
        imp: Implicit,
        last: Increment,
        before: Increment,
        # Out:
        predicted: Increment,
        start: Increment,
    ):
        """e of the path through the last three states, and the increment to where the first iteration begins."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        scale = real(imp.curvature[c])
        ratio = real(imp.ratio_before[c])
        ahead = real(imp.ahead[c])
        begun = real(imp.begun[c])
        p = scale * (last.node[e] - ratio * before.node[e])
        predicted.node[e] = p
        start.node[e] = ahead * last.node[e] + begun * p
        if e == model.first_node[model.first_flagellum[c]]:
            b = scale * (last.body[c] - ratio * before.body[c])
            predicted.body[c] = b
            start.body[c] = ahead * last.body[c] + begun * b

    @wp.kernel(module=module)
    def join(
        # Model:
        model: Model,
        # State:
        state: State,
        imp: Implicit,
        predicted: Increment,
        x: Increment,
        # Out:
        found: Increment,
    ):
        """e after the first iteration: what it began with and what it found."""
        e = wp.tid()
        c = model.cell_of[e]
        if state.active[c] == 0:
            return
        begun = real(imp.begun[c])
        found.node[e] = begun * predicted.node[e] + x.node[e]
        if e == model.first_node[model.first_flagellum[c]]:
            found.body[c] = begun * predicted.body[c] + x.body[c]

    @wp.kernel(module=module)
    def assess(
        # Model:
        first_flagellum: wp.array(dtype=wp.int32),
        first_node: wp.array(dtype=wp.int32),
        # State:
        active: wp.array(dtype=wp.int32),
        step: wp.array(dtype=wp.float64),
        asked: wp.array(dtype=wp.float64),
        # Out:
        imp: Implicit,
        powers: Balance,
    ):
        """Error estimate of a step, share of its prediction in e, and power balance, from sums over its flagella."""
        c = wp.tid()
        if active[c] == 0:
            return
        dt = step[c]
        predictor_error = wp.float64(0.0)
        along = wp.float64(0.0)
        squared = wp.float64(0.0)
        k = first_flagellum[c]
        while k < first_flagellum[c + 1]:
            nodes = first_node[k + 1] - first_node[k] - 1
            predictor_error = wp.max(predictor_error, wp.float64(imp.predictor_error[k]) / wp.float64(nodes))
            along += wp.float64(imp.along[k])
            squared += wp.float64(imp.predicted[k])
            k += 1
        theta = imp.theta[c]
        truncated = wp.float64(1.5) * theta * theta - wp.float64(0.5)
        imp.error[c] = per_predictor * truncated * predictor_error
        imp.share_after[c] = wp.float64(0.0)
        if squared > wp.float64(0.0):
            imp.share_after[c] = wp.clamp(along / squared, wp.float64(0.0), wp.float64(1.0))
        judge(first_flagellum, powers, c, dt, wp.max(round_off, may_make(asked[c], dt)))

    return SimpleNamespace(predict=predict, join=join, assess=assess)


def predict(
    model: DeviceModel, state: DeviceState, data: Any, last: Any, before: Any, predicted: Any, start: Any
) -> None:
    """Predicts e of a step at its start, and the increment to the pose of the first iteration.

    Args:
        model, state: of the batch.
        data: struct `Implicit`, with the coefficients of the step.
        last, before: increments of the last two steps, structs `Increment`, as are the others.
        predicted: where the predicted e goes.
        start: where the increment to the first iteration's pose goes.
    """
    inputs = [model.data, state.data, data, last, before, predicted, start]
    wp.launch(_kernels(model.precision).predict, model.element_count, inputs=inputs, device=model.device)


def join(model: DeviceModel, state: DeviceState, data: Any, predicted: Any, x: Any, found: Any) -> None:
    """What is known of e after the first iteration, into `found`.

    Args:
        model, state: of the batch.
        data: struct `Implicit`.
        predicted: e as it was predicted, at the first iteration's pose, struct `Increment`, as are the others.
        x: what the iteration has found beyond the share that it began with.
        found: where their sum goes.
    """
    inputs = [model.data, state.data, data, predicted, x, found]
    wp.launch(_kernels(model.precision).join, model.element_count, inputs=inputs, device=model.device)


def assess(model: DeviceModel, state: DeviceState, step: Any, asked: Any, data: Any, powers: Any) -> None:
    """Error estimate, share of the prediction and power balance of a step that has been completed, by cell.

    Args:
        model, state: of the batch.
        step: its length [s], shape [cell_count].
        asked: error per simulated time that the accuracy asks for [um/s], shape [cell_count].
        data: struct `Implicit`.
        powers: struct `Balance`, weighed.
    """
    inputs = [model.data.first_flagellum, model.data.first_node, state.data.active, step, asked, data, powers]
    wp.launch(_kernels(model.precision).assess, model.cell_count, inputs=inputs, device=model.device)
