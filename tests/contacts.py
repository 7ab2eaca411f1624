"""Cells in contact for the tests of contacts in an implicit step: their list, and dense matrices of what it does.

B: unit forces at the contacts on (body, nodes); M: the mobility; P: the factorised system. Y = P g M B is what a load
adds to the increment, W = B^T Y what it adds to the gaps. Layout as in `tests.bench`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from warpflag_kernels.base.plan import Plan
from warpflag_kernels.contact import search
from warpflag_kernels.implicit import collocation, contact_solve, step_flow

from tests.bench import Bench, dense_solver, flat
from tests.helpers import shaken, touching_cell
from tests.oracles import CUTOFF
from tests.plans import plan
from warpflag.stepping.stepper import DEFAULT_ACCURACY

SIGMA = 0.04
REACH = (CUTOFF + search.MARGIN) * SIGMA
STEP, GAIN = 1e-5, 2 / 3  # s, and g of BDF2 at a constant step
FINE = {"float64": contact_solve.FINEST * SIGMA, "float32": contact_solve.FINEST_SINGLE * SIGMA}


def controlled(step: float) -> float:
    """Tolerance of a gap in a step of more than 2 us at the usual accuracy [um]."""
    return collocation.GAP_SHARE * DEFAULT_ACCURACY * float(np.sqrt(step / 1e-3))


CROWD = {"flagella.count": 3, "flagellum.2.azimuth": 357.0, "flagellum.1.length": 1.2, "flagella.opening_angle": 90.0}
BUNDLE = {"flagella.count": 3, "flagellum.2.azimuth": 353.0}  # all along, and with the body
CELLS = {"all": {}, "none": {"hydrodynamics.mode": "none"}, "within": {"hydrodynamics.mode": "within"}}
CELLS |= {
    "between": {"hydrodynamics.mode": "between"},
    "three": CROWD,
    "bundle": BUNDLE,
    "anchored": {"body.anchored": True},
}
CELLS |= {"no body contact": {"body.contact": False}, "strong": {"steric.strength": 80.0}}


def touching(
    values: dict[str, Any],
    precision: str,
    device: str,
    seed: int = 1,
    separation: float = 0.042,
    planned: Callable[[Plan], Plan] = lambda own: own,
) -> Bench:
    scene = touching_cell({"flagella.length": 1.0, **values}, precision, separation)
    return Bench(scene, shaken(scene, seed, node=2e-3, spin=0.05), device, planned(plan(scene, device)))


def find(b: Bench) -> None:
    search.find(b.model, b.state, b.data.pose, b.stepper.contacts)


def listed_contacts(b: Bench) -> dict[tuple[int, int], dict[str, Any]]:
    """What the search found, by (segment, other segment or -1 for the body)."""
    c, count = b.stepper.contacts, b.stepper.contacts.count.numpy()[0]
    assert c.overflow.numpy()[0] == 0
    names = ("segment", "other", "at", "at_other", "normal", "gap", "anchored")
    columns = {name: getattr(c, name).numpy()[:count] for name in names}
    found = {}
    for i in range(count):
        row = {name: column[i] for name, column in columns.items()}
        found[int(row["segment"]), int(row["other"])] = row
    assert len(found) == count  # none twice
    return found


# Dense matrices.


def dense_jacobian(b: Bench, contact_forces: list[np.ndarray] | None = None) -> np.ndarray:
    """B: unit contact forces on (body, nodes), shape [6 + 4 count, contacts].

    contact_forces: takes those on the nodes, those of r_0 included, shape [count, 3] each.
    """
    columns = []
    arms = np.concatenate(b.start.positions) - b.start.body_position
    for (e, other), row in listed_contacts(b).items():
        forces = np.zeros((b.count, 3))
        n = row["normal"].astype(np.float64)
        on_body = np.zeros(6)
        if other < 0:
            forces[e] = n
            on_body = -np.concatenate([n, np.cross(arms[e], n)])
        else:
            for sign, second, at in ((1, e, row["at"]), (-1, other, row["at_other"])):
                forces[second] += sign * at * n
                forces[second - 1] += sign * (1 - at) * n
        if contact_forces is not None:
            contact_forces.append(forces.copy())
        on_anchor = forces[b.first]
        on_body += np.concatenate([on_anchor, np.cross(arms[b.first], on_anchor)], axis=1).sum(axis=0)
        forces[b.first] = 0.0
        columns.append(np.concatenate([on_body, np.hstack([forces, np.zeros((b.count, 1))]).ravel()]))
    return np.stack(columns, axis=1)


def steric_force(gap: np.ndarray, strength: float) -> np.ndarray:
    """F_0 [2 (sigma/r)^13 - (sigma/r)^7] below the cutoff, along its tangent below 0.7 sigma [pN]."""
    x = np.asarray(gap, dtype=np.float64) / SIGMA
    y = 1 / np.clip(x, 0.7, CUTOFF)
    slope = 26 * 0.7**-14 - 7 * 0.7**-8
    return np.where(x < CUTOFF, strength * (2 * y**13 - y**7 + slope * np.maximum(0.7 - x, 0.0)), 0.0)


def stiffness(gap: np.ndarray, strength: float) -> np.ndarray:
    """-dF/dgap [pN/um]."""
    x = np.asarray(gap, dtype=np.float64) / SIGMA
    y = 1 / np.clip(x, 0.7, CUTOFF)
    return np.where(x < CUTOFF, strength / SIGMA * (26 * y**14 - 7 * y**8), 0.0)


def dense_solution(free: np.ndarray, compliance: np.ndarray, acting: np.ndarray, strength: float) -> np.ndarray:
    """Gaps that obey gap = free + W (F(gap) - acting): Newton's method, shortened until the residual falls."""

    def residual(gap: np.ndarray) -> np.ndarray:
        return gap - free - compliance @ (steric_force(gap, strength) - acting)

    gap = np.full_like(free, SIGMA)
    for _ in range(200):
        r = residual(gap)
        if np.abs(r).max() < 1e-13:
            return gap
        change = -np.linalg.solve(np.eye(len(r)) + compliance * stiffness(gap, strength), r)
        share = 1.0
        while np.linalg.norm(residual(gap + share * change)) > np.linalg.norm(r) and share > 1e-9:
            share /= 2
        gap = gap + share * change
    raise AssertionError("the oracle has no solution")


@dataclass
class Listed:
    """A bench whose contacts are listed and its system factorised, with dense B, P, Y and W."""

    bench: Bench
    jacobian: np.ndarray
    solver: np.ndarray
    columns: np.ndarray
    compliance: np.ndarray
    tolerance: float = FINE["float64"]

    @property
    def strength(self) -> float:
        return self.bench.scene.steric.strength

    def own(self, name: str) -> np.ndarray:
        """Of the contacts: their gaps, or what the law holds."""
        arrays = self.bench.stepper.contacts if name == "gap" else self.bench.stepper.law
        return getattr(arrays, name).numpy()[: self.jacobian.shape[1]].astype(np.float64)

    def set(self, name: str, values: Any) -> None:
        array = getattr(self.bench.stepper.contacts if name == "gap" else self.bench.stepper.law, name)
        whole = array.numpy()
        whole[: self.jacobian.shape[1]] = values
        array.assign(whole)

    def warm_start(self) -> None:
        s = self.bench.stepper
        contact_solve.warm_start(
            self.bench.model, self.bench.state, s.data.one, self.bench.increment(), s.contacts, s.law
        )

    def solve(self, start: Any, coarse: float = 1.0, anew: bool = True) -> np.ndarray:
        """The increment with the answer of the contacts."""
        b, s, out = self.bench, self.bench.stepper, self.bench.increment()
        contact_solve.solve(b.model, b.state, s.contacts, s.band, s.flow, start, s.law, out, coarse, anew)
        return flat(out)

    def failed(self) -> bool:
        return bool(self.bench.stepper.law.failed.numpy()[0])

    def push(self, way: float) -> Any:
        """An increment that moves all that is near toward each other, by about `way` [um]."""
        return self.bench.increment(0.0, -way * self.jacobian.sum(axis=1)[6:].reshape(-1, 4))


def listed(b: Bench, step: float = STEP, tolerance: float | None = None) -> Listed:
    s, band = b.stepper, b.factorise(step, 1.3 * GAIN)
    tolerance = tolerance or FINE[b.model.precision.name]
    s.law.gain.fill_(GAIN)
    s.law.gap_tolerance.fill_(tolerance)
    s.law.failed.zero_()
    find(b)
    contact_solve.warm_start(b.model, b.state, s.data.one, b.increment(), s.contacts, s.law)
    jacobian, solver = dense_jacobian(b), dense_solver(b, step, 1.3 * GAIN)
    if b.model.switches.pairs != "none":
        step_flow.build(b.model, b.state, s.flow, s.contacts)
    assert band.singular.numpy()[0] == 0
    columns = solver @ (GAIN * b.mobility() @ jacobian)
    return Listed(b, jacobian, solver, columns, jacobian.T @ columns, tolerance)
