"""Colours of the nodes by a quantity: which there are, their ranges, and linear RGB as USD's displayColor wants it.

Ranges are fixed by the scene, not by the data: equal colours mean equal values in any two movies of a scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpflag.base.output import OutputError
from warpflag.observables.contact import own_spacing
from warpflag.record import Record
from warpflag.scene import Scene
from warpflag.view.node_quantities import contact_load, curvature, nearest_phase_difference

__all__ = [
    "BODY_COLOR",
    "DISPLAY_RADIUS",
    "FLAGELLUM_COLORS",
    "FORM_COLORS",
    "QUANTITIES",
    "UNDEFINED_COLOR",
    "Coloring",
    "form_names",
    "linear",
    "map_color",
]

QUANTITIES = ("flagellum", "phase_difference", "curvature", "steric_force", "form")

_PRIMVARS = {
    "flagellum": "flagellum",
    "phase_difference": "phaseDifference",
    "curvature": "curvature",
    "steric_force": "stericForce",
    "form": "form",
}
_LABELS = {
    "phase_difference": "phase difference",
    "curvature": "curvature 1/µm",
    "steric_force": "steric force pN",
    "form": "form",
}
FORM_COLORS = ("#0072b2", "#e69f00", "#d55e00")
"""Of the ground state, the target and the second form."""

# The first seven are Okabe & Ito's, told apart by colour-blind eyes too; the rest are far from them and each other.
FLAGELLUM_COLORS = (
    *("#d55e00", "#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#5b2a86", "#8a1538", "#7d4b1c", "#7fb800", "#00504f", "#4a4a4a"),
)
"""Of flagella and runs, sRGB; repeated beyond twelve."""
# Samples of a map that grows evenly in lightness: dark violet, red, orange, pale yellow.
_MAP = ("#2b1055", "#5c126e", "#8f2469", "#bf3952", "#e35933", "#f98c0a", "#f9c932", "#fcf4a3")
UNDEFINED_COLOR = "#9a9a9a"
BODY_COLOR = "#dfcfae"
DISPLAY_RADIUS = 0.05
"""Of the flagella in pictures, pages and meshes, where they are thinner [um]: true to scale they would vanish."""


def form_names(scene: Scene) -> list[str]:
    """Names of the forms that a scene with polymorphs has, in the order of their numbers."""
    forms = scene.polymorphs
    names = ["ground state", forms.target, *([] if forms.second == "none" else [forms.second])]
    return [name.replace("_", "-") for name in names]


def linear(color: str) -> NDArray[np.float32]:
    """Linear RGB of a colour "#rrggbb" in sRGB, shape [3]."""
    return _decoded(_srgb(color))


def map_color(share: ArrayLike) -> NDArray[np.float64]:
    """Colour of the map at a share of its range, sRGB 0 to 255, shape [..., 3]."""
    at = np.clip(share, 0.0, 1.0)
    table = np.stack([_srgb(color) for color in _MAP])
    return 255.0 * np.stack([np.interp(at, np.linspace(0.0, 1.0, len(table)), table[:, i]) for i in range(3)], axis=-1)


def _srgb(color: str) -> NDArray[np.float64]:
    return np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0


def _decoded(srgb: NDArray[np.floating]) -> NDArray[np.float32]:
    """Linear intensities of sRGB in 0 to 1."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


@dataclass(frozen=True)
class Coloring:
    """How a record's nodes are coloured by a quantity.

    Attributes:
        quantity: one of `QUANTITIES`: flagellum, a colour each; phase_difference, `nearest_phase_difference` from 0 to
            1; curvature, `curvature` from 0 to twice the intrinsic one; steric_force, `contact_load` from 0 to 8 F_0,
            a firm contact of two bundled flagella; form, that of the joint at a node, a colour each.
        record: the run.
        scene: of the record.
    """

    quantity: str
    record: Record
    scene: Scene

    @property
    def primvar(self) -> str:
        """Name of the USD primvar with the raw values."""
        return _PRIMVARS[self.quantity]

    @property
    def label(self) -> str:
        """Name and unit for a legend; empty where colours only tell flagella apart."""
        return _LABELS.get(self.quantity, "")

    @property
    def names(self) -> list[str]:
        """What each of the colours means, of a quantity that has a colour each; empty of others, and of flagella."""
        return form_names(self.scene) if self.quantity == "form" else []

    @property
    def changes(self) -> bool:
        """Whether the colours change from frame to frame."""
        return self.quantity != "flagellum"

    @cached_property
    def highest(self) -> float:
        """The value of the last colour; the first one's is 0."""
        bend = np.hypot(*self.scene.flagella.ground_strain[:2])
        return float(
            {
                "flagellum": len(self.record.first_node) - 2,
                "phase_difference": 1.0,
                "curvature": 2.0 * bend or 1.0,
                "steric_force": 8.0 * self.scene.steric.strength or 1.0,
                "form": len(FORM_COLORS) - 1,
            }[self.quantity]
        )

    def values(self, positions: NDArray[np.floating], frames: slice) -> NDArray[np.floating]:
        """The quantity at the nodes of a block of frames, shape [frame, node]; a single row where it never changes.

        Args:
            positions: of these frames [um], shape [frame, node, 3].
            frames: which they are.
        """
        first_node = self.record.first_node
        if self.quantity == "flagellum":
            return np.repeat(np.arange(len(first_node) - 1.0), np.diff(first_node))[None]
        if self.quantity == "curvature":
            return curvature(positions, first_node)
        if self.quantity == "phase_difference":
            return nearest_phase_difference(positions, self.record.directors[frames], first_node)
        if self.quantity == "form":
            return self._forms(frames)
        steric = self.scene.steric
        diameter = 4.0 * self.record.filament_radius if steric.diameter is None else steric.diameter
        strength = steric.strength if steric.enabled else 0.0
        lengths = [spec.segment_length for spec in self.scene.resolved_flagella()]
        own = np.array([own_spacing(diameter, h) for h in lengths]) if steric.self_contact else None
        return contact_load(positions, first_node, strength, diameter, own)

    def _forms(self, frames: slice) -> NDArray[np.floating]:
        """Ends of a flagellum, which have no joint, look like their neighbours."""
        if self.record.forms is None:
            raise OutputError(f"color form: {self.record.path} has none; its scene has polymorphs.enabled = false")
        values, first_node = self.record.forms[frames].astype(float), self.record.first_node
        values[:, first_node[:-1]] = values[:, first_node[:-1] + 1]
        values[:, first_node[1:] - 1] = values[:, first_node[1:] - 2]
        return values

    def colors(self, values: ArrayLike) -> NDArray[np.float32]:
        """Linear RGB of values, shape [..., 3]; grey where they are undefined."""
        values = np.asarray(values, float)
        if self.quantity in ("flagellum", "form"):
            shown = FLAGELLUM_COLORS if self.quantity == "flagellum" else FORM_COLORS
            table = np.stack([linear(color) for color in shown])
            return table[values.astype(int) % len(table)]
        # By a table of 256: decoding each of millions of values would take longer than all the rest.
        table = np.vstack([_decoded(map_color(np.linspace(0.0, 1.0, 256)) / 255.0), linear(UNDEFINED_COLOR)])
        index = np.where(np.isnan(values), 256, np.clip(255.0 * values / self.highest + 0.5, 0.0, 255.0))
        return table[index.astype(int)]
