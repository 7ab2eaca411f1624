"""Increments that are kept while a cell turns and bends.

Kept in the lab, the displacements of a mode no longer fit a filament that has turned meanwhile, and the smallest misfit
stretches segments, against their stiffest spring. So of every segment the difference of its nodes' displacements is
kept in the segment's own axes (e1, e2, e3), and of the body translation and rotation in the body's: brought back at
another pose the increment strains every segment as before.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, structs
from warpflag_kernels.rod import chain_chart


@functools.cache
def _kernels(p: Precision) -> SimpleNamespace:
    real, vec3, vec4 = p.real, p.vec3, p.vec4
    Model, Pose, Increment, vec6 = (
        structs(p).Model,
        structs(p).Pose,
        chain_chart.types(p).Increment,
        chain_chart.types(p).vec6,
    )
    of_node = chain_chart.displacement(p)
    module = p.module("kept_increment")

    @wp.func(module=module)
    def turned(x: vec3, e1: vec3, e3: vec3, to_lab: wp.int32):
        """Lab components of a vector from those along (e1, e3 x e1, e3), or the other way round."""
        e2 = wp.cross(e3, e1)
        y = x[0] * e1 + x[1] * e2 + x[2] * e3
        if to_lab == 0:
            y = vec3(wp.dot(x, e1), wp.dot(x, e2), wp.dot(x, e3))
        return y

    @wp.kernel(module=module)
    def turn_flagella(
        # Model:
        model: Model,
        # State:
        which: wp.array(dtype=wp.int32),
        pose: Pose,
        to_lab: wp.int32,
        # Out:
        x: Increment,
    ):
        k = wp.tid()
        first = model.first_node[k]
        if which[model.cell_of[first]] == 0:
            return
        before = of_node(model, pose.position, x, first, k)
        e = first + 1
        while e < model.first_node[k + 1]:
            n = x.node[e]
            own = vec3(n[0], n[1], n[2])
            if to_lab != 0:
                before += turned(own, pose.director[e], pose.tangent[e], to_lab)
                x.node[e] = vec4(before[0], before[1], before[2], n[3])
            else:
                d = turned(own - before, pose.director[e], pose.tangent[e], to_lab)
                before = own
                x.node[e] = vec4(d[0], d[1], d[2], n[3])
            e += 1

    @wp.kernel(module=module)
    def turn_bodies(
        # State:
        which: wp.array(dtype=wp.int32),
        pose: Pose,
        to_lab: wp.int32,
        # Out:
        x: Increment,
    ):
        c = wp.tid()
        if which[c] == 0:
            return
        axes = wp.quat_to_matrix(pose.body_orientation[c])
        e1 = vec3(real(axes[0, 0]), real(axes[1, 0]), real(axes[2, 0]))
        e3 = vec3(real(axes[0, 2]), real(axes[1, 2]), real(axes[2, 2]))
        b = x.body[c]
        u = turned(vec3(b[0], b[1], b[2]), e1, e3, to_lab)
        w = turned(vec3(b[3], b[4], b[5]), e1, e3, to_lab)
        x.body[c] = vec6(u[0], u[1], u[2], w[0], w[1], w[2])

    return SimpleNamespace(turn_flagella=turn_flagella, turn_bodies=turn_bodies)


def random(model: DeviceModel) -> Any:
    """A kept increment of random numbers, the same in every run and cell, of bodies that rest; struct `Increment`.

    That of a right-handed filament is the mirror image of a left-handed one's, so that mirrored cells move alike.
    """
    first_node = model.data.first_node.numpy()
    nodes = np.diff(first_node[model.data.first_flagellum.numpy()])
    x = np.concatenate([np.random.default_rng(0).standard_normal((n, 4)) / np.sqrt(n) for n in nodes])
    twist = model.data.rod.rest_strain.numpy()[first_node[:-1] + 1, 2]
    x[np.repeat(twist > 0.0, np.diff(first_node))] *= (1.0, -1.0, 1.0, -1.0)  # along e1, e2 and e3, and of the spin
    increment = chain_chart.allocate(model)
    increment.node.assign(x)
    return increment


def keep(model: DeviceModel, which: wp.array, pose: Any, x: Any) -> None:
    """Turns an increment in place into the form in which it is kept.

    Args:
        model: of the batch.
        which: 1: the cell's part is turned, shape [cell_count].
        pose: at which it is one, struct `Pose`.
        x: struct `Increment`.
    """
    _turn(model, which, pose, x, to_lab=False)


def bring_back(model: DeviceModel, which: wp.array, pose: Any, x: Any) -> None:
    """Turns one that was kept into an increment at this pose; arguments as of `keep`."""
    _turn(model, which, pose, x, to_lab=True)


def _turn(model: DeviceModel, which: wp.array, pose: Any, x: Any, to_lab: bool) -> None:
    """The displacement of r_0 is that of the body in the lab, whose part is turned before or after accordingly."""
    kernels, inputs = _kernels(model.precision), [which, pose, int(to_lab), x]
    bodies = (kernels.turn_bodies, model.cell_count, inputs)
    flagella = (kernels.turn_flagella, model.flagellum_count, [model.data, *inputs])
    for kernel, count, arguments in (bodies, flagella) if to_lab else (flagella, bodies):
        wp.launch(kernel, count, inputs=arguments, device=model.device)
