"""The shell of beads that stands for the cell body in the flow: where its beads lie, how large they are, its matrices.

Beads sit in rings on a spheroid a little inside the body's, and are so large and so far inside that the shell, moved as
a rigid body, has the drags of the spheroid: along its axis and across, about it and across. The shell is its own mirror
image, as the body is, so that it drives nothing round.
Three numbers, the radius and the two depths, are fitted to four drags at set-up, by least squares; the shape of the
body and the number of beads determine them.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from warpflag_kernels.fluid.shell import Shells

from warpflag.scene import Scene, SceneError
from warpflag.scene.resistance import spheroid_mobility

__all__ = ["BodyShell", "body_shell", "rotne_prager", "shell_mobility", "shells_of"]

LARGEST_ERROR = 0.01
"""Largest error of a drag that a fit may leave; the default body has 4e-4 to 1.4e-3 with 30 to 240 beads."""
_FIT_ITERATIONS = 12  # of the fit, at most: bodies of aspect 1 to 10 with 60 to 240 beads take 4 to 7
_FIT_DIGITS = 4  # of radius and depths over the half width: the same beads on every machine
_HEXAGONAL = math.sqrt(3) / 2  # distance of rows over that of points in a row, of points packed most evenly


@dataclass(frozen=True)
class BodyShell:
    """Beads of one body, in body axes.

    Attributes:
        points: centres [um], shape [beads, 3].
        radius: of a bead [um].
        inverse: M_c^-1 over 8 pi eta, M_c the Rotne-Prager mobility of the beads [um], shape [beads, 3, beads, 3].
        rigid: M_c^-1 K over 8 pi eta, K the rigid motion of the beads [um, um^2], shape [beads, 3, 6].
        resistance: K^T M_c^-1 K over 8 pi eta, of the body, forces first [um to um^3], shape [6, 6].
        error: largest relative error of the spheroid's four drags.
    """

    points: np.ndarray
    radius: float
    inverse: np.ndarray
    rigid: np.ndarray
    resistance: np.ndarray
    error: float


def rotne_prager(x: np.ndarray, a: float | np.ndarray, y: np.ndarray, b: float | np.ndarray) -> np.ndarray:
    """Rotne-Prager tensors of spheres of two radii, times 8 pi eta [1/um], shape [len(x), 3, len(y), 3].

    Args:
        x, y: centres [um], shape [count, 3] each.
        a, b: radii [um], a number or shape [count] each.

    Source:
        Zuk, Wajnryb, Mizerski & Szymczak, J. Fluid Mech. 741, R5 (2014).
    """
    a, b = np.broadcast_arrays(np.reshape(a, (-1, 1)), np.reshape(b, (1, -1)))
    d = x[:, None] - y[None]
    r = np.linalg.norm(d, axis=-1)
    far, inside, r = r > a + b, r <= abs(a - b), np.where(r > 0, r, 1.0)
    squares, less = a * a + b * b, (a - b) ** 2
    near = (16 * r**3 * (a + b) - (less + 3 * r * r) ** 2) / (24 * a * b * r**3)
    near_along = (less - r * r) ** 2 / (8 * a * b * r**3)
    isotropic = np.where(far, (1 + squares / (3 * r * r)) / r, np.where(inside, 4 / (3 * np.maximum(a, b)), near))
    along = np.where(far, (1 - squares / (r * r)) / r, np.where(inside, 0.0, near_along))
    u = d / r[..., None]
    tensor = isotropic[..., None, None] * np.eye(3) + along[..., None, None] * u[..., :, None] * u[..., None, :]
    return tensor.transpose(0, 2, 1, 3)


def _ring_counts(count: int, long: float, wide: float) -> tuple[tuple[int, ...], ...]:
    """Beads of each ring round a prolate spheroid from pole to pole, in the order in which they are to be tried.

    Rings lie as densely along the surface as beads on them, in a hexagonal pattern, and hold beads as their
    circumferences. There is an odd number of rings, as many beads in one as in its mirror image.
    """
    heights, lengths = _meridian(long, wide)
    spacing = math.sqrt(_HEXAGONAL * _area(long, wide) / count)
    wanted = 2 * round((lengths[-1] / spacing - 1) / 2) + 1
    found = []
    for rings in (wanted, wanted + 2, wanted - 2):
        least = 3 if 3 * rings <= count else 2
        rings = max(1, min(rings, 2 * ((count // least - 1) // 2) + 1))
        round_each = np.sqrt(1 - np.interp(_middles(rings), lengths / lengths[-1], heights) ** 2)
        half = rings // 2
        counts = np.full(half + 1, least)
        counts[half] += (count - least) % 2
        while (left := count - counts[half] - 2 * counts[:half].sum()) > 0:
            ring = int(np.argmin((counts + 1) / round_each[: half + 1]))
            counts[ring] += min(left, 2) if ring == half else 1
        found.append((*map(int, counts), *map(int, counts[half - 1 :: -1] if half else ())))
    return tuple(dict.fromkeys(found))


def _meridian(long: float, wide: float) -> tuple[np.ndarray, np.ndarray]:
    """Heights over the long semi-axis of points on a spheroid from pole to pole, and the way to them [um]."""
    angle = np.linspace(0.0, math.pi, 2001)
    steps = np.hypot(long * np.diff(np.cos(angle)), wide * np.diff(np.sin(angle)))
    return -np.cos(angle), np.concatenate([[0.0], np.cumsum(steps)])


def _middles(count: int) -> np.ndarray:
    return (np.arange(count) + 0.5) / count


def _rings(counts: tuple[int, ...], long: float, wide: float) -> np.ndarray:
    """Points on a prolate spheroid with these semi-axes, long along z: rings at equal distances along the surface.

    Every second ring is turned by half the angle between its points. Together they are their own mirror images in the
    plane across y and, as long as the rings are, in that across z.
    """
    heights, lengths = _meridian(long, wide)
    height = np.interp(_middles(len(counts)), lengths / lengths[-1], heights)
    points = []
    for ring, (count, z) in enumerate(zip(counts, height, strict=True)):
        turned = 0.5 * ((ring - len(counts) // 2) % 2)
        angle, across = 2 * math.pi * (np.arange(count) + turned) / count, wide * math.sqrt(1 - z * z)
        points.append(np.stack([across * np.cos(angle), across * np.sin(angle), np.full(count, long * z)], axis=1))
    return np.concatenate(points)


def _rigid_motion(x: np.ndarray) -> np.ndarray:
    """K: velocities of points x [um] per velocity and spin of the body, shape [count, 3, 6]."""
    k = np.zeros((len(x), 3, 6))
    k[:, :, :3] = np.eye(3)
    for axis in range(3):
        k[:, :, 3 + axis] = np.cross(np.eye(3)[axis], x)
    return k


def _assembled(counts: tuple[int, ...], long: float, wide: float, radius: float, depths: np.ndarray) -> tuple:
    """Points, M_c, M_c^-1 K and K^T M_c^-1 K of one choice of rings, radius and depths."""
    x, count = _rings(counts, long - depths[0], wide - depths[1]), sum(counts)
    mobility = rotne_prager(x, radius, x, radius).reshape(3 * count, 3 * count)
    k = _rigid_motion(x).reshape(3 * count, 6)
    rigid = np.linalg.solve(mobility, k)
    return x, mobility, rigid, k.T @ rigid


def _fit(counts: tuple[int, ...], length: float, width: float) -> tuple[float, np.ndarray]:
    """Radius of the beads and depths of their spheroid over the half width of the body, by least squares.

    Returns:
        the largest relative error that they leave of a drag of the body; the three numbers.
    """
    long, wide, count = length / 2, width / 2, sum(counts)
    exact = spheroid_mobility(length, width, 1 / (8 * math.pi))
    wanted = 1 / np.array([exact.along, exact.across, exact.spin, exact.tumble])

    def errors(numbers: np.ndarray) -> np.ndarray:
        """Relative errors of the four drags, across the axis the mean of both directions."""
        r = np.diagonal(_assembled(counts, long, wide, wide * numbers[0], wide * numbers[1:])[3])
        return np.array([r[2], (r[0] + r[1]) / 2, r[5], (r[3] + r[4]) / 2]) / wanted - 1

    # Start: beads that cover the surface, a third of a radius inside; Gauss-Newton with halved steps where needed.
    covering = math.sqrt(_area(long, wide) / (math.pi * count)) / wide
    numbers = covering * np.array([0.9, 0.27, 0.27])
    found = errors(numbers)
    for _ in range(_FIT_ITERATIONS):
        small = 1e-4
        slopes = np.stack([(errors(numbers + small * axis) - found) / small for axis in np.eye(3)], axis=1)
        step = -np.linalg.lstsq(slopes, found, rcond=1e-6)[0]
        share = 1.0
        while share > 0.1:
            tried = numbers + share * step
            if tried[0] > 0 and (tried[1:] < [0.9 * long / wide, 0.9]).all():
                new = errors(tried)
                if new @ new < found @ found:
                    break
            share /= 2
        else:
            break
        moved, numbers, found = float(np.abs(share * step).max()), tried, new
        if moved < 10**-_FIT_DIGITS / 5:
            break
    numbers = np.round(numbers, _FIT_DIGITS)
    return float(np.abs(errors(numbers)).max()), numbers


@functools.cache
def body_shell(length: float, width: float, count: int) -> BodyShell:
    """The fitted shell of a body.

    Args:
        length, width: of the body [um].
        count: of beads.

    Raises:
        SceneError: so many beads can't have the drags of this body.
    """
    long, wide = length / 2, width / 2
    fits = []
    for counts in _ring_counts(count, long, wide):
        fits.append((*_fit(counts, length, width), counts))
        if fits[-1][0] < LARGEST_ERROR / 2:
            break
    worst, numbers, counts = min(fits, key=lambda fit: fit[0])
    if worst > LARGEST_ERROR:
        problem = f"leaves a drag of the body off by {100 * worst:.2g} %; more beads fit a body that is so long"
        raise SceneError("hydrodynamics.body_beads", count, problem, ["body.length", "body.width"])
    x, mobility, rigid, resistance = _assembled(counts, long, wide, wide * numbers[0], wide * numbers[1:])
    inverse = np.linalg.inv(mobility)
    inverse = (inverse + inverse.T) / 2
    return BodyShell(
        points=x,
        radius=float(wide * numbers[0]),
        inverse=inverse.reshape(count, 3, count, 3),
        rigid=rigid.reshape(count, 3, 6),
        resistance=(resistance + resistance.T) / 2,
        error=worst,
    )


def _area(long: float, wide: float) -> float:
    """Surface of a prolate spheroid [um^2]."""
    e = math.sqrt(max(1 - (wide / long) ** 2, 1e-12))
    return 2 * math.pi * (wide * wide + wide * long * math.asin(e) / e)


def shells_of(scenes: Sequence[Scene]) -> Shells:
    """The shells of a batch, without repetition."""
    keys = [(s.body.length, s.body.width, s.hydrodynamics.body_beads) for s in scenes]
    different = list(dict.fromkeys(keys))
    found = [body_shell(*key) for key in different]
    return Shells(
        of=np.array([different.index(key) for key in keys]),
        points=tuple(shell.points for shell in found),
        radius=tuple(shell.radius for shell in found),
        inverse=tuple(shell.inverse.transpose(1, 0, 3, 2) for shell in found),
        rigid=tuple(shell.rigid.transpose(1, 0, 2) for shell in found),
    )


def shell_mobility(scene: Scene) -> np.ndarray:
    """Mobility of the shell as a rigid body in body axes, from force and torque to velocity and spin, shape [6, 6].

    A motion that a switch of the scene prevents has none: what is left is the inverse of the resistance to the others.
    """
    body = scene.body
    free = np.ones(6, dtype=bool)
    free[:3], free[5] = body.translation, body.axial_rotation
    free &= not body.anchored
    shell = body_shell(body.length, body.width, scene.hydrodynamics.body_beads)
    mobility = np.zeros((6, 6))
    if free.any():
        kept = np.ix_(free, free)
        mobility[kept] = np.linalg.inv(shell.resistance[kept]) / (8 * math.pi * scene.fluid.viscosity)
    return mobility
