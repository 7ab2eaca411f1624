"""The choices that are compared, by the source of the error that they change: time step, precision, mesh, model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from warpflag.scene import Scene, SceneError, with_values
from warpflag.scene.run_sections import ACCURACY_LEVELS
from warpflag.stepping.stepper import DEFAULT_ACCURACY

__all__ = ["REFERENCE", "SOURCES", "Choice", "choices_of", "reference", "relative_cost"]

SOURCES = ("time step", "precision", "mesh", "model", "execution")
"""What an error comes from, in the order of the report."""
REFERENCE = "reference"
"""Name of what all others are compared with."""
_DRAFT, _CAREFUL = ACCURACY_LEVELS["draft"], ACCURACY_LEVELS["careful"]
_ACCURACIES = (_DRAFT, 2e-2, 1e-2, DEFAULT_ACCURACY, 2e-3, 1e-3, _CAREFUL, 1e-4)  # um per ms, of the implicit stepper
_RKC_ACCURACIES = (_DRAFT, DEFAULT_ACCURACY)  # finer ones take minutes
_FIXED_STEPS = (2e-5, 1e-5)  # fixed steps [s]: near those that step control takes
_RELATIVE_COST = {"rkc": 10.0}  # of a stepper, roughly: zipping.toml takes nine times as long
_COST_POWER = 0.4  # cost goes as accuracy to the minus this: errors of steps as dt^2.5
_MESHES = (2.0, 1.5, 0.75, 0.5)  # segment lengths over the scene's: to either side by a factor of two
_MODES = ("none", "within", "all", "consistent")


@dataclass(frozen=True)
class Choice:
    """One way to run the scene.

    Attributes:
        name: short, unique.
        source: of the error that it changes, one of `SOURCES`.
        values: of the scene, by dotted key.
        strict: kernels without reassociation.
        device: None: the one of the study.
        turn: choices of lower turns are measured first.
    """

    name: str
    source: str
    values: dict[str, Any] = field(default_factory=dict)
    strict: bool = False
    device: str | None = None
    turn: int = 0

    def scene(self, base: Scene) -> Scene:
        """The scene run in this way.

        Raises:
            SceneError: it can't be.
        """
        return with_values(base, self.values)


_IMPLICIT = {"numerics.stepper": "implicit", "numerics.time_step": None, "numerics.precision": "float64"}
_EXACT = {**_IMPLICIT, "numerics.pair_precision": "same"}


def reference(accuracy: float) -> Choice:
    """What all others are compared with, at this accuracy [um/ms]."""
    return Choice(REFERENCE, "time step", {**_EXACT, "numerics.accuracy": accuracy}, turn=-1)


def relative_cost(choice: Choice, scene: Scene) -> float:
    """Cost over that of the default accuracy, roughly: to tell whether there is time for it."""
    values = choice.values
    cost = (values.get("numerics.accuracy", DEFAULT_ACCURACY) / DEFAULT_ACCURACY) ** -_COST_POWER
    cost *= _RELATIVE_COST.get(values["numerics.stepper"], 1.0)
    h = scene.flagella.segment_length
    return cost * (h / values.get("flagella.segment_length", h)) ** 2


def choices_of(scene: Scene, devices: list[str]) -> list[Choice]:
    """All choices that this scene allows and that differ from each other, in the order in which they are measured.

    Args:
        scene: of the user.
        devices: other devices of this machine, by name.
    """
    standard = {**_EXACT, "numerics.accuracy": DEFAULT_ACCURACY}
    found = [
        Choice(
            f"accuracy {a:g}",
            "time step",
            {**_EXACT, "numerics.accuracy": a},
            turn=0 if a in ACCURACY_LEVELS.values() else 1,
        )
        for a in _ACCURACIES
    ]
    single = {"numerics.pair_precision": "float32"}
    found += [
        Choice("pairs float32", "precision", {**standard, **single}, turn=1),
        Choice(
            f"accuracy {_DRAFT:g}, pairs float32",
            "precision",
            {**standard, **single, "numerics.accuracy": _DRAFT},
            turn=2,
        ),
        Choice("float32", "precision", {**standard, "numerics.precision": "float32"}, turn=3),
    ]
    h = scene.flagella.segment_length
    found += [
        Choice(
            f"h {r * h:.3g}", "mesh", {**standard, "flagella.segment_length": r * h}, turn=1 if r in (2.0, 0.5) else 2
        )
        for r in _MESHES
    ]
    radius = {"hydrodynamics.pair_radius": None}
    found += [
        Choice(f"mode {m}", "model", {**standard, **radius, "hydrodynamics.mode": m}, turn=3)
        for m in _MODES
        if m != scene.hydrodynamics.mode
    ]
    found += _switched(scene, standard)
    found += [Choice(f"step {s:g}", "time step", {**_EXACT, "numerics.time_step": s}, turn=3) for s in _FIXED_STEPS]
    found += [
        Choice(f"rkc {a:g}", "time step", {**_EXACT, "numerics.stepper": "rkc", "numerics.accuracy": a}, turn=4)
        for a in _RKC_ACCURACIES
    ]
    found.append(Choice("strict kernels", "execution", standard, strict=True, turn=4))
    found += [Choice(f"device {name}", "execution", standard, device=name, turn=2) for name in devices]
    return sorted((choice for choice in found if _allowed(choice, scene)), key=lambda choice: choice.turn)


def _switched(scene: Scene, standard: dict[str, Any]) -> list[Choice]:
    """The other setting of every part of the model that a scene can have or leave out."""
    found = []
    hook = {"hook.length": 0.0, "hook.stiffness": 0.0, "hook.stiffening_torque": None}
    if scene.hook.length or scene.hook.stiffness:
        found.append(Choice("no hook", "model", {**standard, **hook}, turn=3))
    else:
        found.append(Choice("hook 0.055 um", "model", {**standard, "hook.length": 0.055}, turn=3))
    if scene.has_body_flow or with_values(scene, {"hydrodynamics.body_flow": None}).has_body_flow:
        on = not scene.has_body_flow
        name = "body flow" if on else "no body flow"
        found.append(Choice(name, "model", {**standard, "hydrodynamics.body_flow": on}, turn=3))
    if scene.steric.enabled and len(scene.resolved_flagella()) > 1:
        found.append(Choice("no contact", "model", {**standard, "steric.enabled": False}, turn=4))
    return found


def _allowed(choice: Choice, scene: Scene) -> bool:
    try:
        own = choice.scene(scene)
    except SceneError:
        return False
    if choice.source == "mesh":  # not where every flagellum has a number of segments of its own
        here, there = ([spec.segment_count for spec in one.resolved_flagella()] for one in (scene, own))
        return here != there
    if choice.values.get("numerics.pair_precision") == "float32":
        return scene.hydrodynamics.mode != "none"
    return True
