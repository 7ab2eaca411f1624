"""Starts that are clear: no node inside the body or pressed onto it, no flagellum on another.

A scene's own shape is taken as it is where it is clear. Else the flagella at fault whose phase the scene leaves free
start at another one. Where no phase is clear they are turned about their anchors as rigid bodies, step by step along
what their contacts ask for: they keep their shape, and only the hooks bend.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from warpflag_kernels.contact.constants import LINEAR_BELOW
from warpflag_kernels.stepping.health import LARGEST_STRAIN

from warpflag.model.geometry import InitialState, at_time_0, flagellum_at_rest, rotation_matrix
from warpflag.observables import closest_parameters, steric_force
from warpflag.scene import Body, FlagellumSpec, Scene, SceneError
from warpflag.scene.resistance import steric_diameter

__all__ = ["body_gaps", "clear_start", "pairs_within"]

Array = NDArray[np.floating]

_PHASES = np.array([5.0 * sign * i for i in range(1, 37) for sign in (1, -1)][:-1])  # deg from the usual one, in turn
_PHASE_ROUNDS = 3  # rounds over the flagella at fault: one that changes its phase may then touch another
_WANTED = 0.9  # distance that a flagellum at fault is given, in diameters of the contact
_TURNS = 300  # steps of turning
_LARGEST_STEP = 0.03  # rad: moves the tip of a flagellum of 7 um by the radius of its helix
_LARGEST_TOTAL_TURN = 45.0  # deg; a flagellum that would have to be turned by more is refused
_TOO_HARD = 2.0  # of 15 random starts the guard stopped 12 of the 13 beyond it within 0.2 us
_SOFT = 1e-4  # um^2; regularises the least squares: lever arms below its root, 0.01 um, hardly count
_RUN = 64  # nodes of a flagellum that are looked at together
_MOST_FLAGELLA = 500  # in larger crowds flagella that overlap at the start are left to the contact force


def body_gaps(body: Body, points: Array) -> Array:
    """Distances of points in body axes from the body's surface [um], shape [count]; negative inside."""
    return _from_body(body, points)[0]


def clear_start(scene: Scene, start: InitialState) -> InitialState:
    """The start of a scene from its own shape `start`, in body axes.

    Clear is a flagellum whose nodes r_1..r_N are outside the body and whose segments are no nearer to those of others
    than 0.7 sigma, below which the contact law is only continued; as far as the scene has these contacts. Nor may the
    body press on a node so hard that the guard of strains would stop the first steps; where that can't be helped, a
    note says so.

    Raises:
        SceneError: a flagellum can't start clear; it names the tilt that could.
    """
    cell = _Cell(scene, start)
    faults, pressed = cell.faults(), cell.pressed()
    if not faults and not pressed:
        return start
    notes = []
    free = [spec.phase is None for spec in scene.resolved_flagella()]
    if scene.flagella.phase_difference is not None:
        free[:2] = [False] * 2
    changed: dict[int, float] = {}
    for _ in range(_PHASE_ROUNDS):
        for k in sorted({*faults, *pressed}):
            if free[k] and (cell.shortfall(k, cell.nodes[k]) > 0.0 or cell.press(k)):
                changed[k] = cell.choose_phase(k, changed.get(k))
        faults, pressed = cell.faults(), cell.pressed()
        if not any(free[k] for k in (*faults, *pressed)):
            break
    if changed:
        said = ", ".join(f"{k} at {phase:g} deg" for k, phase in sorted(changed.items()))
        notes.append(f"starts clear of body and other flagella with the phase of flagellum {said}")
    turns: dict[int, float] = {}
    if faults:
        turns = cell.turn()
        for k in cell.faults():
            turns |= cell.tilt(k)
        faults = cell.faults()
        if faults:
            raise cell.refusal(faults[0])
    for k in cell.pressed():
        if (turn := cell.ease(k, turns.get(k, 0.0))) > 0.0:
            turns[k] = turns.get(k, 0.0) + turn
    if turns:
        said = ", ".join(f"{k} by {math.degrees(turn):.2g} deg" for k, turn in sorted(turns.items()))
        notes.append(f"starts clear of body and other flagella after turning about its anchor flagellum {said}")
    for k in cell.pressed():
        force, node = cell.press(k) or (0.0, 0)
        avoid = "a longer hook.length or flagella.segment_length, or another phase or tilt, avoids that"
        notes.append(f"starts with node {node} of flagellum {k} pressed by the body with {force:.3g} pN; {avoid}")
    if not changed and not turns:
        return dataclasses.replace(start, notes=tuple(notes))
    shapes = list(zip(cell.nodes, cell.directors, strict=True))
    return dataclasses.replace(at_time_0(scene, shapes), notes=tuple(notes))


class _Cell:
    """Flagella that are moved until they are clear.

    Attributes:
        nodes: r_0..r_N of every flagellum in body axes [um], shape [N + 1, 3].
        directors: e1 of segments 1..N, shape [N, 3].
    """

    def __init__(self, scene: Scene, start: InitialState) -> None:
        self._scene, self._specs = scene, scene.resolved_flagella()
        self._with_body = scene.body.contact and scene.body.enabled
        self._with_others = scene.steric.enabled and 1 < len(self._specs) <= _MOST_FLAGELLA
        self._diameter = steric_diameter(scene)
        self.nodes = [np.array(x) for x in start.positions]
        self.directors = [np.array(e1[1:]) for e1 in start.directors]

    def faults(self) -> list[int]:
        """Flagella that are not clear, in order."""
        return [k for k, nodes in enumerate(self.nodes) if self.shortfall(k, nodes) > 0.0]

    def shortfall(self, k: int, nodes: Array, wanted: float | None = None) -> float:
        """How much nearer flagellum k comes than it may, with these nodes [um]; 0 where it is clear.

        wanted: distance from body and others that counts as clear [diameters]; default: the least that is allowed.
        """
        to_body = 0.0 if wanted is None else wanted * self._diameter
        to_others = (LINEAR_BELOW if wanted is None else wanted) * self._diameter
        found = [0.0]
        if self._with_body:
            found.append(to_body - float(_from_body(self._scene.body, nodes[1:])[0].min()))
        if self._with_others:
            gaps = self._near(k, nodes, to_others)[0]
            found.append(to_others - float(gaps.min(initial=to_others)))
        return max(found)

    def pressed(self) -> list[int]:
        """Flagella outside the body on which it presses too hard, in order."""
        return [k for k in range(len(self.nodes)) if self.press(k)]

    def press(self, k: int, most: float = _TOO_HARD) -> tuple[float, int] | None:
        """Force [pN] and number of the node of flagellum k on which the body presses hardest, where too hard.

        A node is pushed outward until its segments' tension holds it, within nanoseconds. Were its neighbours at rest,
        a segment would by then be strained beyond what the guard allows if the force that is left at that strain
        exceeds the tension's part along it; they give way, so `most` times that is too hard.
        """
        if not self._with_body:
            return None
        nodes, h, steric = self.nodes[k], self._specs[k].segment_length, self._scene.steric
        gaps, outward = _from_body(self._scene.body, nodes[1:])
        along = np.abs(np.vecdot(outward, np.diff(nodes, axis=0))) / h
        strained = 1.0 + LARGEST_STRAIN
        way = h * (np.sqrt(along**2 + strained**2 - 1.0) - along)  # that strains a segment so far
        left = steric_force(gaps + way, steric.strength, self._diameter)
        held = LARGEST_STRAIN * self._scene.flagella.stretching_stiffness * (along + way / h) / strained
        if not (left > most * held).any():
            return None
        forces = steric_force(gaps, steric.strength, self._diameter)
        return float(forces.max()), int(forces.argmax()) + 1

    def ease(self, k: int, turned: float) -> float:
        """Turns flagellum k, which is clear but pressed, as little as frees it; by how much [rad], 0 if that fails.

        turned: by how much it was turned before [rad].
        """
        nodes, directors, total = self.nodes[k], self.directors[k], np.eye(3)
        for _ in range(_TURNS):
            step = self._asked_turn(k)
            angle = float(np.linalg.norm(step))
            if angle == 0.0:
                break
            total = rotation_matrix(step / angle, min(angle, _LARGEST_STEP)) @ total
            if turned + _angle(total) > math.radians(_LARGEST_TOTAL_TURN):
                break
            self.nodes[k] = nodes[0] + (nodes - nodes[0]) @ total.T
            self.directors[k] = directors @ total.T
            if self.shortfall(k, self.nodes[k]) == 0.0 and not self.press(k, 1.0):
                return _angle(total)
        self.nodes[k], self.directors[k] = nodes, directors
        return 0.0

    def choose_phase(self, k: int, before: float | None) -> float:
        """Gives flagellum k the phase [deg] nearest to 180 at which it is well clear, else the best; returns it."""
        best = self.shortfall(k, self.nodes[k], _WANTED), before, (self.nodes[k], self.directors[k])
        for phase in 180.0 + np.concatenate([[0.0], _PHASES]):
            shape = flagellum_at_rest(self._scene, dataclasses.replace(self._specs[k], phase=float(phase)))
            short = self.shortfall(k, shape[0], _WANTED)
            if short < best[0] or best[1] is None:
                best = short, float(phase), shape
            if short == 0.0:
                break
        self.nodes[k], self.directors[k] = best[2]
        assert best[1] is not None
        return best[1]

    def turn(self) -> dict[int, float]:
        """Turns flagella about their anchors until they are clear or a limit is reached; their turns [rad]."""
        turned: dict[int, Array] = {}
        for _ in range(_TURNS):
            faults, moved = self.faults(), False
            for k in faults:
                step = self._asked_turn(k)
                angle = float(np.linalg.norm(step))
                if angle == 0.0:
                    continue
                rotation = rotation_matrix(step / angle, min(angle, _LARGEST_STEP))
                total = rotation @ turned.get(k, np.eye(3))
                if _angle(total) > math.radians(_LARGEST_TOTAL_TURN):
                    continue
                turned[k], moved = total, True
                anchor = self.nodes[k][0]
                self.nodes[k] = anchor + (self.nodes[k] - anchor) @ rotation.T
                self.directors[k] = self.directors[k] @ rotation.T
            if not moved:
                break
        return {k: _angle(total) for k, total in turned.items()}

    def tilt(self, k: int) -> dict[int, float]:
        """Gives flagellum k the nearest tilt at which it is clear, if there is one; returns by how much [rad]."""
        for spec, shape in self._tilted(k, _LARGEST_TOTAL_TURN):
            if self.shortfall(k, shape[0]) == 0.0:
                self.nodes[k], self.directors[k] = shape
                return {k: math.radians(abs(spec.tilt - self._specs[k].tilt))}
        return {}

    def _tilted(self, k: int, most: float) -> Iterator[tuple[FlagellumSpec, tuple[Array, Array]]]:
        """Flagellum k at other tilts, in steps of 1 deg up to `most`, the nearest first; at usual phases where free."""
        own = self._specs[k]
        phases = 180.0 + np.concatenate([[0.0], _PHASES[::6]]) if own.phase is None else [own.phase]
        for tilt in (own.tilt + sign * change for change in range(1, int(most) + 1) for sign in (1, -1)):
            if 0.0 <= tilt <= 180.0:
                for phase in phases:
                    spec = dataclasses.replace(own, tilt=tilt, phase=float(phase))
                    yield spec, flagellum_at_rest(self._scene, spec)

    def _asked_turn(self, k: int) -> Array:
        """Rotation vector that gives flagellum k the wanted distances, in the sense of least squares."""
        nodes, wanted = self.nodes[k], _WANTED * self._diameter
        arms: list[Array] = []
        normals: list[Array] = []
        lacking: list[Array] = []
        if self._with_body:
            gaps, outward = _from_body(self._scene.body, nodes[1:])
            near = gaps < wanted
            arms.append(nodes[1:][near] - nodes[0])
            normals.append(outward[near])
            lacking.append(wanted - gaps[near])
        if self._with_others:
            gaps, points, away = self._near(k, nodes, wanted)
            arms.append(points - nodes[0])
            normals.append(away)
            lacking.append(wanted - gaps)
        turning = np.cross(np.concatenate(arms), np.concatenate(normals))
        return np.linalg.solve(turning.T @ turning + _SOFT * np.eye(3), turning.T @ np.concatenate(lacking))

    def _near(self, k: int, nodes: Array, reach: float) -> tuple[Array, Array, Array]:
        """Segments of other flagella within a reach of those of flagellum k: distances, points on k, and unit vectors
        from the other to k."""
        others = [x for j, x in enumerate(self.nodes) if j != k]
        p, d = nodes[:-1], np.diff(nodes, axis=0)
        q = np.concatenate([x[:-1] for x in others])
        e = np.concatenate([np.diff(x, axis=0) for x in others])
        longest = np.linalg.norm(d, axis=1).max() + np.linalg.norm(e, axis=1).max()
        span = reach + longest / 2
        i, j = pairs_within(p + d / 2, q + e / 2, span)
        s, t = closest_parameters(p[i], d[i], q[j], e[j])
        points = p[i] + s[:, None] * d[i]
        away = points - q[j] - t[:, None] * e[j]
        gaps = np.linalg.norm(away, axis=1)
        close = gaps < reach
        away = away[close] / np.maximum(gaps[close], np.finfo(float).tiny)[:, None]
        return gaps[close], points[close], away

    def refusal(self, k: int) -> SceneError:
        """What is wrong with flagellum k, and the nearest tilt that would do."""
        spec, nodes = self._specs[k], self.nodes[k]
        gaps = _from_body(self._scene.body, nodes[1:])[0]
        if self._with_body and gaps.min() < 0.0:
            deep = f"node {int(gaps.argmin()) + 1} is {-gaps.min():.3g} um deep"
            problem = f"starts flagellum {k} inside the body: {deep}"
        else:
            apart = self._near(k, nodes, self._diameter)[0].min()
            problem = f"starts flagellum {k} on another one: {apart:.3g} um apart"
        for other, shape in self._tilted(k, 180.0):
            if self.shortfall(k, shape[0]) == 0.0:
                problem += f"; a tilt of {other.tilt:g} deg would do"
                break
        related = ["flagella.opening_angle", "flagella.phase_difference", f"flagellum.{k}.azimuth"]
        return SceneError(f"flagellum.{k}.tilt", spec.tilt, problem, related)


def pairs_within(a: Array, b: Array, span: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices i, j of points a_i and b_j less than a span apart, in ascending order.

    Neighbours along a flagellum lie beside each other, so runs of them are in small boxes: only those of boxes within
    the span are compared one by one.
    """
    starts = np.arange(0, len(b), _RUN)
    lowest, highest = np.minimum.reduceat(b, starts), np.maximum.reduceat(b, starts)
    found_i, found_j = [], []
    for first in range(0, len(a), _RUN):
        own = a[first : first + _RUN]
        low, high = own.min(axis=0) - span, own.max(axis=0) + span
        runs = starts[((lowest < high) & (highest > low)).all(axis=1)]
        near = (runs[:, None] + np.arange(_RUN)).ravel()
        near = near[near < len(b)]
        near = near[((b[near] > low) & (b[near] < high)).all(axis=1)]
        apart = own[:, None] - b[near]
        i, j = np.nonzero(np.vecdot(apart, apart) < span * span)
        found_i.append(first + i)
        found_j.append(near[j])
    return np.concatenate(found_i), np.concatenate(found_j)


def _from_body(body: Body, points: Array) -> tuple[Array, Array]:
    """Distances of points in body axes from the body's surface, negative inside, and the normals there."""
    half = (body.length - body.width) / 2
    out = np.array(points)
    out[:, 2] -= np.clip(points[:, 2], -half, half)
    distances = np.linalg.norm(out, axis=1)
    return distances - body.width / 2, out / np.maximum(distances, np.finfo(float).tiny)[:, None]


def _angle(rotation: Array) -> float:
    return math.acos(min(1.0, max(-1.0, (float(np.trace(rotation)) - 1.0) / 2.0)))
