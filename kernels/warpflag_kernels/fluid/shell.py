"""The shell of beads that stands for a body in the flow: what the device keeps of it, see `body_flow`.

A CPU takes a cell in one thread, in vectors of beads; their number is filled up to whole vectors by distant beads
without load.
"""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warpflag_kernels.base.precision import Precision
from warpflag_kernels.base.types import DeviceModel

LANES = 16  # beads are filled up to multiples of this: lanes of the widest register in float32
FAR = 1.0e3  # coordinate of beads without load [um]: a thousand times the body, so that they reach nothing


@dataclass(frozen=True)
class Shells:
    """Shells of beads of a batch, on the host, without repetition; in body axes.

    Attributes:
        of: shell of each cell, shape [cell_count].
        points: centres of the beads [um], one array [beads, 3] per shell.
        radius: of the beads [um], per shell.
        inverse: M_c^-1 per 8 pi eta [um], one array [3, beads, 3, beads] per shell.
        rigid: M_c^-1 K per 8 pi eta [um, um^2], one array [3, beads, 6] per shell.
    """

    of: np.ndarray
    points: tuple[np.ndarray, ...]
    radius: tuple[float, ...]
    inverse: tuple[np.ndarray, ...]
    rigid: tuple[np.ndarray, ...]


@functools.cache
def struct(p: Precision) -> Any:
    """The struct `Shell`: beads of the bodies, and nodes in body axes."""
    real, vec3 = p.real, p.vec3

    @wp.struct
    class Shell:
        first: wp.array(dtype=wp.int32)  # [C + 1], where the beads of a cell begin among those of all cells
        # Shells without repetition, in body axes.
        own: wp.array(dtype=wp.int32)  # [C], where the beads of a cell's shell begin in x, y, z
        entry: wp.array(dtype=wp.int32)  # [C], where its matrix begins in `inverse`
        radius: wp.array(dtype=real)  # [C], of its beads [um]
        x: wp.array(dtype=real)  # centres of beads [um]
        y: wp.array(dtype=real)
        z: wp.array(dtype=real)
        inverse: wp.array(dtype=real)  # M_c^-1 over 8 pi eta [um]; component after component, as loads and flows
        rigid: wp.array(dtype=real)  # its product with K, column after column [um, um^2]
        # Coefficients of node and bead, flow = c f + d dd (dd . f), dd the vector between them; only where stored.
        pair: wp.array(dtype=wp.int32)  # [C], where those of a cell begin, node after node
        c: wp.array(dtype=real)  # [1/um]
        d: wp.array(dtype=real)  # [1/um^3]
        # Nodes in body axes [E].
        px: wp.array(dtype=real)  # position [um]
        py: wp.array(dtype=real)
        pz: wp.array(dtype=real)
        fx: wp.array(dtype=real)  # force, zero on r_0 [pN]
        fy: wp.array(dtype=real)
        fz: wp.array(dtype=real)
        # Beads of every cell [3 * beads]: x of all beads of a cell, then y, then z.
        flow: wp.array(dtype=real)  # that nodes cause, 8 pi eta times the velocity [pN/um]
        load: wp.array(dtype=real)  # mu, then lambda [pN]
        # Of the held loads on the body, lab axes [C].
        force: wp.array(dtype=vec3)  # [pN]
        torque: wp.array(dtype=vec3)  # about its centre [pN um]

    return Shell


def most_beads(model: DeviceModel) -> int:
    """Beads of the largest shell, filled up."""
    return -(-max(map(len, model.shells.points)) // LANES) * LANES


def allocate(model: DeviceModel, p: Precision) -> Any:
    """The struct `Shell` of a batch in a precision; no arrays without body flow.

    Args:
        model: of the batch.
        p: of the beads' flows.
    """
    s, shells, device = struct(p)(), model.shells, model.device
    if shells is None:
        return s
    counts = [-(-len(x) // LANES) * LANES for x in shells.points]

    def ints(values: Any) -> wp.array:
        return wp.array(np.asarray(values), dtype=wp.int32, device=device)

    def reals(values: Any) -> wp.array:
        return wp.array(np.concatenate([np.ravel(v) for v in values]), dtype=p.real, device=device)

    def starts(sizes: Any) -> np.ndarray:
        return np.concatenate([[0], np.cumsum(sizes)])

    def filled(x: np.ndarray, axes: tuple[int, ...], count: int, value: float = 0.0) -> np.ndarray:
        """With so many beads along some axes."""
        pads = [(0, count - size if axis in axes else 0) for axis, size in enumerate(x.shape)]
        return np.pad(x, pads, constant_values=value)

    s.first = ints(starts([counts[k] for k in shells.of]))
    s.own, s.entry = ints(starts(counts)[shells.of]), ints(starts([9 * n * n for n in counts])[shells.of])
    s.radius = wp.array(np.array(shells.radius)[shells.of], dtype=p.real, device=device)
    points = [filled(x, (0,), n, FAR) for x, n in zip(shells.points, counts, strict=True)]
    s.x, s.y, s.z = (reals([x[:, axis] for x in points]) for axis in range(3))
    s.inverse = reals([filled(m, (1, 3), n) for m, n in zip(shells.inverse, counts, strict=True)])
    s.rigid = reals([np.moveaxis(filled(m, (1,), n), 2, 0) for m, n in zip(shells.rigid, counts, strict=True)])
    for name in ("px", "py", "pz", "fx", "fy", "fz"):
        setattr(s, name, wp.zeros(model.element_count, dtype=p.real, device=device))
    for name in ("flow", "load"):
        setattr(s, name, wp.zeros(3 * sum(counts[k] for k in shells.of), dtype=p.real, device=device))
    if model.plan.by_cells:
        first_node = model.data.first_node.numpy()[model.data.first_flagellum.numpy()]
        pairs = starts(np.diff(first_node) * np.array([counts[k] for k in shells.of]))
        s.pair = ints(pairs[:-1])
        s.c, s.d = (wp.zeros(int(pairs[-1]), dtype=p.real, device=device) for _ in range(2))
    s.force, s.torque = (wp.zeros(model.cell_count, dtype=p.vec3, device=device) for _ in range(2))
    return s
