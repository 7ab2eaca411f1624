"""GMRES for the linearised equations of an implicit step, with the full mobility, preconditioned by the step's matrix.

The matrix, inverse P, holds the local mobility; with the full one the equations are K x = b, K = D^-1 (1/dt + g M H).
In stiff cells, where P K has eigenvalues far from 1 (`stability`), each of a step's two iterations solves P K x = P b
in the Krylov space of P K and P b (Saad & Schultz, SIAM J. Sci. Stat. Comput. 7, 856 (1986)), `DIMENSION` products a
solution, more with flow round the body and where there is thermal noise. It does so after the contact solve, with the
contact forces found there in b: forces balance as far as GMRES converges, and only the gaps are those that the matrix
predicts, which the second iteration corrects.

The inner product counts displacements in segment lengths, spins and the body's rotation in radians. A thread does a
cell's sums: the cells that need it are few.
"""

import functools
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel, DeviceState, structs
from warpflag_kernels.implicit import linearised
from warpflag_kernels.implicit import stability as stability_stage
from warpflag_kernels.rod import chain_chart

DIMENSION = 6  # of the Krylov space (docs/numerics.md)
LEAST_PIVOT = 1.0e-12  # pivot of the least squares below which a direction is left out: round-off of float64
DIMENSION_AROUND_BODIES = 12  # of that of cells with flow round their bodies, whose modes are coupled more


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Krylov`; vectors one after the other."""
    vec4, vec6 = p.vec4, chain_chart.types(p).vec6

    @wp.struct
    class Krylov:
        # n: the dimension of the space.
        node: wp.array(dtype=vec4)  # [(n + 1) * E], basis, node parts
        body: wp.array(dtype=vec6)  # [(n + 1) * C], body parts
        hessenberg: wp.array(dtype=wp.float64)  # [C * (n + 2) * n], column after column
        right: wp.array(dtype=wp.float64)  # [C * (n + 1)]

    return Krylov


@dataclass(frozen=True)
class Space:
    """A Krylov space on the device.

    Attributes:
        data: the struct `Krylov`.
        basis: its vectors as structs `Increment`, which share their memory; one more than the space has dimensions.
    """

    data: Any
    basis: list[Any]

    @property
    def dimension(self) -> int:
        """Products of a solution."""
        return len(self.basis) - 1


def allocate(model: DeviceModel, dimension: int = DIMENSION) -> Space:
    """Room for a space of so many dimensions, zero."""
    p, device, cells, elements = model.precision, model.device, model.cell_count, model.element_count
    t, k, count = chain_chart.types(p), struct(p)(), dimension + 1
    k.node = wp.zeros(count * elements, dtype=p.vec4, device=device)
    k.body = wp.zeros(count * cells, dtype=t.vec6, device=device)
    k.hessenberg = wp.zeros(cells * (dimension + 2) * dimension, dtype=wp.float64, device=device)
    k.right = wp.zeros(cells * count, dtype=wp.float64, device=device)
    basis = []
    for j in range(count):
        x = t.Increment()
        x.node, x.body = k.node[j * elements : (j + 1) * elements], k.body[j * cells : (j + 1) * cells]
        basis.append(x)
    return Space(k, basis)


@functools.cache
def _kernels(p: Precision, size: int) -> SimpleNamespace:
    real, Model, State = p.real, structs(p).Model, structs(p).State
    Krylov, Stability, Increment = struct(p), stability_stage.struct(p), chain_chart.types(p).Increment
    dimension, least_pivot = wp.constant(size), wp.constant(wp.float64(LEAST_PIVOT))
    module = p.module("krylov", "" if size == DIMENSION else str(size))

    @wp.kernel(module=module)
    def mask(
        # Out:
        stability: Stability,
        state: State,
    ):
        c = wp.tid()
        stability.active[c] = state.active[c]
        state.active[c] = state.active[c] * stability.strong[c]

    @wp.kernel(module=module)
    def unmask(
        # Out:
        stability: Stability,
        state: State,
    ):
        c = wp.tid()
        state.active[c] = stability.active[c]
        if c == 0:
            strong = int(0)
            for i in range(stability.strong.shape[0]):
                strong = wp.max(strong, stability.strong[i])
            stability.any_strong[0] = strong

    @wp.func(module=module)
    def inner(model: Model, krylov: Krylov, c: wp.int32, i: wp.int32, w: Increment):
        """Inner product of basis vector i of cell c and w."""
        offset = i * model.cell_of.shape[0]
        cells = model.first_flagellum.shape[0] - 1
        total = wp.float64(0.0)
        k = model.first_flagellum[c]
        length = model.rod.segment_length[k]
        b = krylov.body[i * cells + c]
        v = w.body[c]
        for r in range(3):
            total += wp.float64(b[r] * v[r] / (length * length) + b[r + 3] * v[r + 3])
        while k < model.first_flagellum[c + 1]:
            scale = real(1.0) / (model.rod.segment_length[k] * model.rod.segment_length[k])
            e = model.first_node[k]
            while e < model.first_node[k + 1]:
                x = krylov.node[offset + e]
                y = w.node[e]
                total += wp.float64(scale * (x[0] * y[0] + x[1] * y[1] + x[2] * y[2]) + x[3] * y[3])
                e += 1
            k += 1
        return total

    @wp.func(module=module)
    def add(model: Model, krylov: Krylov, c: wp.int32, i: wp.int32, scale: wp.float64, w: Increment):
        """Adds scale times basis vector i of cell c to w."""
        s = real(scale)
        offset = i * model.cell_of.shape[0]
        cells = model.first_flagellum.shape[0] - 1
        w.body[c] = w.body[c] + s * krylov.body[i * cells + c]
        e = model.first_node[model.first_flagellum[c]]
        while e < model.first_node[model.first_flagellum[c + 1]]:
            w.node[e] = w.node[e] + s * krylov.node[offset + e]
            e += 1

    @wp.func(module=module)
    def store(model: Model, krylov: Krylov, c: wp.int32, i: wp.int32, scale: wp.float64, w: Increment):
        """Stores scale times w as basis vector i of cell c."""
        s = real(scale)
        offset = i * model.cell_of.shape[0]
        cells = model.first_flagellum.shape[0] - 1
        krylov.body[i * cells + c] = s * w.body[c]
        e = model.first_node[model.first_flagellum[c]]
        while e < model.first_node[model.first_flagellum[c + 1]]:
            krylov.node[offset + e] = s * w.node[e]
            e += 1

    @wp.func(module=module)
    def normalised(model: Model, krylov: Krylov, c: wp.int32, i: wp.int32, w: Increment):
        """Stores w as basis vector i of unit length; returns its length. A vector without length is stored as zero."""
        store(model, krylov, c, i, wp.float64(1.0), w)
        size = wp.sqrt(inner(model, krylov, c, i, w))
        scale = wp.float64(0.0)
        if size > wp.float64(0.0):
            scale = wp.float64(1.0) / size
        store(model, krylov, c, i, scale, w)
        return size

    @wp.kernel(module=module)
    def begin(
        # Model:
        model: Model,
        # State:
        state: State,
        x: Increment,
        # Out:
        krylov: Krylov,
    ):
        c = wp.tid()
        if state.active[c] == 0:
            return
        for i in range(dimension + 1):
            krylov.right[c * (dimension + 1) + i] = wp.float64(0.0)
        krylov.right[c * (dimension + 1)] = normalised(model, krylov, c, 0, x)

    @wp.kernel(module=module)
    def orthogonalise(
        # Model:
        model: Model,
        # State:
        state: State,
        j: wp.int32,
        # Out:
        w: Increment,
        krylov: Krylov,
    ):
        """One column of the Arnoldi process, by modified Gram-Schmidt."""
        c = wp.tid()
        if state.active[c] == 0:
            return
        column = (c * dimension + j) * (dimension + 2)
        i = int(0)
        while i <= j:
            projection = inner(model, krylov, c, i, w)
            krylov.hessenberg[column + i] = projection
            add(model, krylov, c, i, -projection, w)
            i += 1
        krylov.hessenberg[column + j + 1] = normalised(model, krylov, c, j + 1, w)

    @wp.kernel(module=module)
    def combine(
        # Model:
        model: Model,
        # State:
        state: State,
        # Out:
        krylov: Krylov,
        x: Increment,
    ):
        """Least squares by Givens rotations, and the solution from the basis."""
        c = wp.tid()
        if state.active[c] == 0:
            return
        first = c * dimension * (dimension + 2)
        right = c * (dimension + 1)
        j = int(0)
        while j < dimension:
            column = first + j * (dimension + 2)
            a = krylov.hessenberg[column + j]
            b = krylov.hessenberg[column + j + 1]
            r = wp.sqrt(a * a + b * b)
            cosine = wp.float64(1.0)
            sine = wp.float64(0.0)
            if r > wp.float64(0.0):
                cosine = a / r
                sine = b / r
            i = int(j)
            while i < dimension:
                other = first + i * (dimension + 2)
                u = krylov.hessenberg[other + j]
                v = krylov.hessenberg[other + j + 1]
                if i == j:
                    v = b
                krylov.hessenberg[other + j] = cosine * u + sine * v
                if i > j:
                    krylov.hessenberg[other + j + 1] = cosine * v - sine * u
                i += 1
            u = krylov.right[right + j]
            krylov.right[right + j] = cosine * u
            krylov.right[right + j + 1] = -sine * u
            j += 1
        j = dimension - 1
        while j >= 0:
            value = krylov.right[right + j]
            i = j + 1
            while i < dimension:
                value -= krylov.hessenberg[first + i * (dimension + 2) + j] * krylov.right[right + i]
                i += 1
            pivot = krylov.hessenberg[first + j * (dimension + 2) + j]
            if wp.abs(pivot) > least_pivot:
                krylov.right[right + j] = value / pivot
            else:
                krylov.right[right + j] = wp.float64(0.0)
            j -= 1
        zero = x.body[c] - x.body[c]
        x.body[c] = zero
        e = model.first_node[model.first_flagellum[c]]
        while e < model.first_node[model.first_flagellum[c + 1]]:
            x.node[e] = x.node[e] - x.node[e]
            e += 1
        j = int(0)
        while j < dimension:
            add(model, krylov, c, j, krylov.right[right + j], x)
            j += 1

    return SimpleNamespace(mask=mask, unmask=unmask, begin=begin, orthogonalise=orthogonalise, combine=combine)


def solve(
    model: DeviceModel,
    state: DeviceState,
    stiffness: Any,
    band: Any,
    gain: wp.array,
    stability: Any,
    space: Space,
    work: Any,
    x: Any,
) -> None:
    """From P b to the solution with the full mobility, in place, in the cells whose kappa `stability` found large.

    b may hold contact forces: what the contact solve has added to x then is P times their velocities.

    Args:
        model, state: of the batch; forces and velocities of `state` are overwritten in those cells.
        stiffness, band: at the state's pose.
        gain: g, shape [cell_count].
        stability: struct `Stability`.
        space: room for the Krylov space.
        work: room for an increment, struct `Increment`.
        x: struct `Increment`.
    """
    kernels, device, cells = _kernels(model.precision, space.dimension), model.device, model.cell_count
    wp.launch(kernels.mask, cells, inputs=[stability, state.data], device=device)
    wp.launch(kernels.begin, cells, inputs=[model.data, state.data, x, space.data], device=device)
    for j in range(space.dimension):
        linearised.apply(model, state, stiffness, band, gain, space.basis[j], work)
        linearised.solve(model, state, band, work)
        wp.launch(kernels.orthogonalise, cells, inputs=[model.data, state.data, j, work, space.data], device=device)
    wp.launch(kernels.combine, cells, inputs=[model.data, state.data, space.data, x], device=device)
    wp.launch(kernels.unmask, cells, inputs=[stability, state.data], device=device)
