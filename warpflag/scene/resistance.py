"""Drag and hydrodynamic coefficients of a scene, as plain numbers for the device model.

Local drag per unit length is the paper's (gamma_par, gamma_perp, gamma_R). A node has the drag of a length h, the free
end that of h/2. The body moves by the mobility of a prolate spheroid of its aspect ratio.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np

from warpflag.scene import Scene, SceneError

__all__ = [
    "FilamentMobility",
    "SpheroidMobility",
    "filament_mobility",
    "pace",
    "pair_radii",
    "pair_radius",
    "spheroid_mobility",
    "steric_diameter",
    "thermal_energy",
]

_WATER = 1.0e-3  # pN s/um^2, the viscosity that the paper's drag coefficients belong to
_PRINTED = (1.6e-3, 2.8e-3, 1.26e-6)  # gamma_par, gamma_perp [pN s/um^2] and gamma_R [pN s] of the paper
_ZETA_3 = 1.2020569031595942  # sum of 1/n^3 over n = 1, 2, ...
_NEARLY_ONE = 1 - 1e-9  # round-off: a pair radius so close to the least allowed one is taken, it may be chosen equal
_BOLTZMANN = 1.380649e-5  # pN um/K, exact


@dataclass(frozen=True)
class SpheroidMobility:
    """Mobility of the body.

    Attributes:
        along: translation along the axis [um/(s pN)].
        across: translation across it [um/(s pN)].
        spin: rotation about the axis [1/(pN um s)].
        tumble: rotation about an axis across it [1/(pN um s)].
    """

    along: float
    across: float
    spin: float
    tumble: float


@dataclass(frozen=True)
class FilamentMobility:
    """Mobility of a node that has the drag of one segment length.

    Attributes:
        along: translation along the tangent [um/(s pN)].
        across: translation across it [um/(s pN)].
        spin: rotation of a segment about its tangent [1/(pN um s)].
    """

    along: float
    across: float
    spin: float


def spheroid_mobility(length: float, width: float, viscosity: float) -> SpheroidMobility:
    """Mobility of a prolate spheroid; a sphere where length equals width.

    Args:
        length: of the long axis [um].
        width: of the short axes, not above the length [um].
        viscosity: of the fluid [pN s/um^2].

    Source:
        Kim & Karrila, Microhydrodynamics, table 3.4.
    """
    a = length / 2
    e2 = 1.0 - (width / length) ** 2
    translation, rotation = 6 * math.pi * viscosity * a, 8 * math.pi * viscosity * a**3
    if e2 < 1e-4:  # the closed forms cancel here; first order in the eccentricity squared
        xa, ya, xc, yc = 1 - 2 * e2 / 5, 1 - 3 * e2 / 10, 1 - 6 * e2 / 5, 1 - 9 * e2 / 10
    else:
        e = math.sqrt(e2)
        log = math.log((1 + e) / (1 - e))
        xa = 8 / 3 * e**3 / (-2 * e + (1 + e2) * log)
        ya = 16 / 3 * e**3 / (2 * e + (3 * e2 - 1) * log)
        xc = 4 / 3 * e**3 * (1 - e2) / (2 * e - (1 - e2) * log)
        yc = 4 / 3 * e**3 * (2 - e2) / (-2 * e + (1 + e2) * log)
    return SpheroidMobility(1 / (translation * xa), 1 / (translation * ya), 1 / (rotation * xc), 1 / (rotation * yc))


def pair_radii(scene: Scene) -> list[float]:
    """Radius of the Rotne-Prager pair term of every flagellum's nodes [um], see `pair_radius`."""
    lengths = [spec.segment_length for spec in scene.resolved_flagella()]
    found = {h: pair_radius(scene, h) for h in (set(lengths) if scene.hydrodynamics.mode == "consistent" else ())}
    common = 0.0 if found else pair_radius(scene)
    return [found.get(h, common) for h in lengths]


def pair_radius(scene: Scene, segment_length: float | None = None) -> float:
    """Radius a of the Rotne-Prager pair term [um].

    As printed (the filament radius), a node's local mobility 1/(gamma_perp h) is below that of a bead of radius a
    once h > 6 pi eta a/gamma_perp, and the mobility of two nodes in contact has a negative eigenvalue: they attract
    where they should repel. With a = max(filament radius, gamma_perp h/(6 pi eta)) it is positive definite. Mode
    consistent has a radius for every segment length, the others the one that the longest segment needs.

    Args:
        scene: gives drag, viscosity and hydrodynamics mode.
        segment_length: h of the flagellum [um]; default: the longest.

    Raises:
        SceneError: in mode consistent, segments too short for any radius; a given radius at which the mobility is not
            positive definite.
    """
    radius = scene.flagella.filament_radius
    if scene.hydrodynamics.pair_radius is not None:
        _check_given(scene, scene.hydrodynamics.pair_radius)
        return scene.hydrodynamics.pair_radius
    if scene.hydrodynamics.mode == "as_printed":
        return radius
    if scene.hydrodynamics.mode == "consistent" and segment_length is not None:
        return _consistent_radius(segment_length, radius)
    h = max(spec.segment_length for spec in scene.resolved_flagella())
    if scene.hydrodynamics.mode == "consistent":
        return _consistent_radius(h, radius)
    return max(radius, _least_radius(scene, h))


def _least_radius(scene: Scene, h: float) -> float:
    """Radius of the bead that moves as easily as the local drag of a segment allows [um]."""
    return max(_drag(scene)[:2]) * h / (6 * math.pi * scene.fluid.viscosity)


def _check_given(scene: Scene, given: float) -> None:
    """Refuses a pair radius with which some node would move less easily by itself than its bead does."""
    mode, lengths = scene.hydrodynamics.mode, {spec.segment_length for spec in scene.resolved_flagella()}
    radius = scene.flagella.filament_radius

    def sound(a_pair: float) -> bool:
        if mode == "consistent":
            return all(_positive(h, radius, a_pair) for h in lengths)
        return a_pair >= _NEARLY_ONE * _least_radius(scene, max(lengths))

    if mode not in ("all", "within", "consistent") or sound(given):
        return
    least = _least_radius(scene, max(lengths))
    if mode == "consistent":
        least = max(_consistent_radius(h, radius) for h in lengths)
    enough = math.ceil(1e4 * least - 1e-6) / 1e4
    problem = f"makes the mobility indefinite; {enough:g} um is the least that does not"
    if not sound(enough):
        problem = "makes the mobility indefinite, as any does for all of the scene's segment lengths; leave it out"
    raise SceneError("hydrodynamics.pair_radius", given, problem, ["flagella.segment_length", "hydrodynamics.mode"])


def steric_diameter(scene: Scene) -> float:
    """sigma of the contacts [um]: given, or four filament radii."""
    given = scene.steric.diameter
    return 4 * scene.flagella.filament_radius if given is None else given


def filament_mobility(scene: Scene, segment_length: float) -> FilamentMobility:
    """Local mobility of a node and of a segment's spin.

    In mode "consistent" the local drag is what slender-body theory leaves once the pair sum contains the flow from
    distances of h and more, so that nothing counts twice and the sum of both converges with h.

    Args:
        scene: gives drag, viscosity and hydrodynamics mode.
        segment_length: h [um].

    Raises:
        SceneError: in mode consistent, segments too short for any pair radius.
    """
    parallel, perpendicular, rotation = _drag(scene)
    h = segment_length
    if scene.hydrodynamics.mode != "consistent":
        return FilamentMobility(1 / (parallel * h), 1 / (perpendicular * h), 1 / (rotation * h))
    along, across = _slender_body(h, scene.flagella.filament_radius, pair_radius(scene, h))
    scale = 1 / (4 * math.pi * scene.fluid.viscosity * h)
    return FilamentMobility(scale * along, scale * across, 1 / (rotation * h))


def thermal_energy(scene: Scene) -> float:
    """kT [pN um]; zero without thermal noise."""
    return _BOLTZMANN * scene.fluid.temperature


def _drag(scene: Scene) -> tuple[float, float, float]:
    """gamma_par, gamma_perp [pN s/um^2] and gamma_R [pN s]; the paper's belong to water and scale with viscosity."""
    fluid, scale = scene.fluid, scene.fluid.viscosity / _WATER
    given = (fluid.drag_parallel, fluid.drag_perpendicular, fluid.drag_rotation)
    values = [p * scale if g is None else g for g, p in zip(given, _PRINTED, strict=True)]
    return values[0], values[1], values[2]


def pace(scene: Scene) -> float:
    """Largest ratio of the paper's drag in water to the scene's: how much faster a flagellum moves than in water."""
    found = zip((*_drag(scene), scene.fluid.viscosity), (*_PRINTED, _WATER), strict=True)
    return max(printed / value for value, printed in found)


def _slender_body(h: float, radius: float, a_pair: float) -> tuple[float, float]:
    """Local mobility along and across a filament in units of 1/(4 pi eta h): Lighthill's theorem less the pair sum.

    The theorem: u = f_n/(4 pi eta) + the flow of Stokeslets beyond delta = a sqrt(e)/2. On a straight filament the
    pair sum over nodes n h gives the logarithm of that integral up to ln(h/delta) - 0.5772 per side, and its
    a_pair^2/r^2 terms add up to zeta(3): both are corrected here.

    Args:
        h: segment length [um].
        radius: of the filament, a [um].
        a_pair: radius of the pair term [um].

    Source:
        Lighthill, SIAM Rev. 18, 161 (1976).
    """
    delta = radius * math.sqrt(math.e) / 2
    log = math.log(h / delta) - np.euler_gamma
    ratio = (a_pair / h) ** 2 * _ZETA_3
    return 2 * log + 4 / 3 * ratio, 1 + log - 2 / 3 * ratio


@functools.cache
def _consistent_radius(h: float, radius: float) -> float:
    """Smallest pair radius that keeps the consistent mobility positive definite [um]."""
    for a_pair in np.linspace(min(radius, h / 2), h / 2, 400):
        if _positive(h, radius, a_pair):
            return float(a_pair)
    problem = f"must be at least about {2.6 * radius:.3g} um in mode consistent (2.6 filament radii)"
    raise SceneError("flagella.segment_length", h, problem, ["hydrodynamics.mode"])


def _positive(h: float, radius: float, a_pair: float) -> bool:
    """Whether a node's local mobility in mode consistent is no less than that of its bead, 1/(6 pi eta a_pair)."""
    return min(_slender_body(h, radius, a_pair)) >= 2 / 3 * h / a_pair
