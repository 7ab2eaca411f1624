"""The observables of a record as curves over time: which there are, with symbol and unit, for figures and pages."""

from __future__ import annotations

from dataclasses import dataclass

from warpflag.observables import STRAY
from warpflag.observables.arrays import Array
from warpflag.observables.recorded import bundle_lengths
from warpflag.record import Record
from warpflag.scene import loads

__all__ = ["Curve", "curves"]

# Observable of the record, words, symbol and unit; in the order in which they are shown.
_KNOWN = (
    ("phase_difference", "phase difference", "⟨θ⟩", ""),
    ("bundle_length", "bundle length", "l_r", ""),
    ("steric_force_density", "contact force", "f_c", "pN/µm"),
    ("body_speed", "swimming speed", "v", "µm/s"),
    ("motor_rate", "motor rate", "", "Hz"),
    ("motor_torque", "motor torque", "", "pN µm"),
    ("motor_drive", "motor drive", "", ""),
    ("target_form_share", "share in the target form", "", ""),
    ("body_rate", "body rate", "", "Hz"),
    ("elastic_energy", "elastic energy", "", "pN µm"),
)
_WITH_BODY = ("motor_rate", "motor_torque", "motor_drive", "body_rate")
_FOR_TWO = ("phase_difference", "bundle_length", "steric_force_density")


@dataclass(frozen=True)
class Curve:
    """An observable over time.

    Attributes:
        name: of the observable in the record.
        words: what it is, in words.
        symbol: as in the paper; empty where there is none.
        unit: empty for a pure number.
        values: NaN where a frame has none, shape [frame_count, line_count]; motor rates have a line per flagellum.
    """

    name: str
    words: str
    symbol: str
    unit: str
    values: Array

    @property
    def label(self) -> str:
        """Words, symbol and unit in one line, as for an axis."""
        symbol = f" {self.symbol}" if self.symbol else ""
        return f"{self.words}{symbol}" + (f" ({self.unit})" if self.unit else "")


def curves(record: Record) -> list[Curve]:
    """The known observables that a record has, in a fixed order.

    A cell with one flagellum has no phase difference, bundle or contact force, a filament without a body no motor. The
    bundle length passes over gaps of `observables.STRAY`; the record holds the plain one.
    """
    found, measured = [], record.observables
    alone = len(record.first_node) == 2
    free = alone and not loads(record.scene_text).body.enabled
    for name, words, symbol, unit in _KNOWN:
        if name not in measured or (alone and name in _FOR_TWO) or (free and name in _WITH_BODY):
            continue
        values = bundle_lengths(record, gap=STRAY) if name == "bundle_length" else measured[name]
        found.append(Curve(name, words, symbol, unit, values.reshape(len(values), -1)))
    return found
