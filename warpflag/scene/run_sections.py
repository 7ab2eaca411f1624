"""The sections of a scene that say how it is run: method, step and precision, and where it starts.

Settings are declared as in `warpflag.scene.sections`.
"""

from __future__ import annotations

from dataclasses import dataclass

from warpflag.scene.settings import Section, choice, integer, number, text

ACCURACY_LEVELS = {"draft": 7e-2, "standard": 5e-3, "careful": 5e-4}
"""Node error per simulated ms that the words for `numerics.accuracy` ask for [um]."""
SHORT_PAIRS_IN, SHORT_PAIRS_FROM = ("draft", "standard"), 1000
"""Levels, and number of segments from which on, at which flows of pairs are taken in float32 unless the scene says
otherwise: that saves a good part of a step, and its error is far below what these levels allow."""


@dataclass(frozen=True)
class Numerics(Section, key="numerics"):
    """How time is stepped: numerical method, step and precision."""

    stepper: str = choice(
        "implicit",
        ("euler", "rkc", "implicit"),
        "explicit Euler, stabilised explicit Runge-Kutta-Chebyshev, or linearly implicit",
    )
    time_step: float | None = number(
        None,
        "s",
        1e-14,
        1e-2,
        "fixed step, not above the duration",
        derived="from numerics.accuracy; euler: just below its stability limit",
    )
    precision: str = choice("float64", ("float64", "float32"), "floating point numbers of forces and positions")
    accuracy: float | str | None = number(
        None,
        "um",
        1e-9,
        1,
        "wanted node error per simulated ms; draft: 7e-2, standard: 5e-3, careful: 5e-4",
        choices=tuple(ACCURACY_LEVELS),
        derived="5e-3, but euler takes fixed steps",
    )
    on_accuracy: str = choice(
        "stop", ("stop", "warn"), "what happens when error estimates are beyond ten times the accuracy"
    )
    pair_precision: str | None = choice(
        None,
        ("same", "float32"),
        "numbers of the flow of one pair; float32: those alone, added up in numerics.precision",
        derived="same; float32 with accuracy draft or standard (the words) from a thousand segments on",
    )

    @property
    def asked(self) -> float:
        """Node error per simulated ms that steps are to keep [um]."""
        given = "standard" if self.accuracy is None else self.accuracy
        return ACCURACY_LEVELS[given] if isinstance(given, str) else given

    def short_pairs(self, segments: int) -> bool:
        """Whether flows of pairs are taken in float32 in a run in float64, with so many segments."""
        wanted = self.pair_precision == "float32"
        if self.pair_precision is None:
            wanted = self.accuracy in SHORT_PAIRS_IN and segments >= SHORT_PAIRS_FROM
        return wanted and self.precision == "float64"


@dataclass(frozen=True)
class Start(Section, key="start"):
    """Where the run starts: from the scene's own shape, or from a frame of a record.

    A record gives the shape of the flagella, their phases and the body's pose; phases of the scene are then unused.
    """

    record: str | None = text(
        None, "run directory or run.h5, from the working directory", derived="the scene's own shape"
    )
    frame: int = integer(-1, -1, 10**9, "frame of the record; -1 is the last")
