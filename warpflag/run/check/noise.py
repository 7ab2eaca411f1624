"""What thermal noise does to a run, for `warpflag check`."""

from __future__ import annotations

import math

import numpy as np
from warpflag_kernels.stepping.health import LARGEST_STRAIN

from warpflag.scene import Scene
from warpflag.scene.resistance import filament_mobility, thermal_energy

__all__ = ["of_noise"]

SOUND_IN_CONTACT = 2.0e-6
"""Longest step that has missed no contact of two filaments that lie side by side [s]."""
DEVIATIONS = 6.0
"""Standard deviations that a segment seldom exceeds in a run: chance 2e-9 each time, of 1e7 or 1e8 times."""


def of_noise(scene: Scene, step: float) -> list[str]:
    """What thermal noise does to a run and asks of its step; nothing without a temperature."""
    energy, numerics = thermal_energy(scene), scene.numerics
    if energy == 0.0:
        return []
    spec = max(scene.resolved_flagella(), key=lambda spec: spec.length)
    mobility = filament_mobility(scene, spec.segment_length)
    # Of the straight line from anchor to tip, as a rod that turns about its anchor by its drag across.
    long = spec.length * _axial_share(scene)
    drag, stiffness = long**3 / (3 * mobility.across * spec.segment_length), scene.hook.stiffness

    def tip(time: float) -> float:
        """How far it moves [um]: about each axis it turns by v, on a hook that resists bending up to v = kT/k; the mean
        cosine of the whole turn is exp(-v)."""
        v = 2 * energy * time / drag
        if stiffness > 0.0:
            v = -energy / stiffness * math.expm1(-2 * stiffness * time / drag)
        return long * math.sqrt(-2 * math.expm1(-v))

    method = {
        "euler": "Euler-Maruyama",
        "rkc": "RKC of two stages, the noise held over a step",
        "implicit": "linearly implicit with a random elastic force",
    }[numerics.stepper]
    said = [
        f"thermal noise, {scene.fluid.temperature:g} K, kT {energy:.4g} pN um: {method}, fixed steps; energies of "
        "joints err by up to 0.5 % at 1e-5 s and 300 K, gaps of contacts by 5 % at 1e-6 s, driven motion in "
        "proportion to the step: halve it and compare"
    ]
    if scene.body.enabled:
        said.append(
            f"noise alone turns a flagellum about its hook: tip by about {tip(scene.duration):.2g} um in "
            f"{1e3 * scene.duration:g} ms, {tip(step):.1g} um in a step"
        )
    shortest = min(own.segment_length for own in scene.resolved_flagella())
    strain = math.sqrt(energy / (scene.flagella.stretching_stiffness * shortest))
    if DEVIATIONS * strain > LARGEST_STRAIN:
        said.append(
            f"noise stretches segments by {100 * strain:.2g} % rms, and the run stops at {100 * LARGEST_STRAIN:g} %: "
            "take a lower fluid.temperature, a higher flagella.stretching_stiffness or longer segments"
        )
    several = len(scene.resolved_flagella()) > 1
    if step > SOUND_IN_CONTACT and scene.steric.enabled and (several or scene.steric.self_contact):
        said.append(
            f"steps of {step:g} s miss contacts now and then where filaments touch, and the run stops when one does: "
            f"take numerics.time_step = {SOUND_IN_CONTACT:g} or less"
        )
    return said


def _axial_share(scene: Scene) -> float:
    """Axial length of the helix at rest over its contour length."""
    curvature = np.array(scene.flagella.ground_strain)
    size = float(np.linalg.norm(curvature))
    return abs(float(curvature[2])) / size if size else 1.0
