"""The prediction of a step: what the last two increments let one expect of it, and how much of that it begins with.

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


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real = p.real
    Model, State = structs(p).Model, structs(p).State
    Implicit, Increment = collocation.struct(p), chain_chart.types(p).Increment
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

    return SimpleNamespace(predict=predict, join=join)


def predict(
    model: DeviceModel, state: DeviceState, data: Any, last: Any, before: Any, predicted: Any, start: Any
) -> None:
    """Predicts a step where it starts.

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
