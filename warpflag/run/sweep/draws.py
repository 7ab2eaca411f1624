"""What is random in a sweep: values per cell or per flagellum, and where the flagella are anchored.

Every value has a stream of random numbers of its own, made from the seed, its key, its draw and its repeat: another
axis, key or draw does not change it, and members at different axis values share their draws. So do seeds of noise and
of switching motors, which depend on that of the base, too.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from warpflag.model.geometry import initial_state
from warpflag.scene import Scene, SceneError, with_values
from warpflag.scene.reading import check_key

__all__ = ["Draws"]

_TRIES = 2000  # places drawn for an anchor before the sweep is refused: one in 500 that are free is missed at 2 %
_FLAGELLUM_PREFIX = "flagellum."
_ANCHOR_KEYS = ("placement", "least_distance", "from", "to", "clearance", "given")
_GOLDEN_DEGREES = 180.0 * (3.0 - math.sqrt(5.0))  # deg; successive points of an even spiral


class Draws:
    """The table [random] of a sweep.

    Args:
        table: `seed`, `draws`, `anchors`, and by dotted key {low, high} or {mean, deviation}; a key flagellum.NAME is
            drawn for every flagellum by itself.
        base: the scene that the values belong to.

    Raises:
        SceneError: the table is not sound.
    """

    def __init__(self, table: Mapping[str, Any], base: Scene) -> None:
        self._seed = _whole("random.seed", table.get("seed", 0), 0)
        self.count = _whole("random.draws", table.get("draws", 1), 1)
        self._values = {key: table[key] for key in table if key not in ("seed", "draws", "anchors")}
        self._anchors = table.get("anchors")
        for key, spread in self._values.items():
            _check_varied(key, spread)
            _check_spread(f"random.{key}", spread)
        if self._anchors is not None:
            self._anchors = _checked_anchors(self._anchors, base)

    @property
    def differs(self) -> bool:
        """Whether anything is drawn."""
        return bool(self._values) or (self._anchors is not None and self._anchors["placement"] == "random")

    @property
    def differs_in_repeats(self) -> bool:
        """Whether the repeats of a point differ."""
        placed = self._anchors is not None and self._anchors["placement"] == "random"
        return placed or any(key.startswith(_FLAGELLUM_PREFIX) for key in self._values)

    def values(self, scene: Scene, draw: int, repeat: int) -> dict[str, Any]:
        """The random values of one member by dotted key.

        Args:
            scene: with the member's axis values.
            draw: number of the draw.
            repeat: number of the repeat.

        Raises:
            SceneError: there is no room for the anchors.
        """
        count, values = scene.flagella.count, {}
        for key, spread in self._values.items():
            if key.startswith(_FLAGELLUM_PREFIX):
                name = key[len(_FLAGELLUM_PREFIX) :]
                drawn = _drawn(spread, self._stream(key, draw, repeat), count)
                values |= {f"flagellum.{k}.{name}": float(value) for k, value in enumerate(drawn)}
            else:
                values[key] = float(_drawn(spread, self._stream(key, draw), 1)[0])
        if self._anchors is not None:
            for k, (azimuth, offset) in enumerate(self._placed(with_values(scene, values), draw, repeat)):
                values |= {f"flagellum.{k}.azimuth": azimuth, f"flagellum.{k}.anchor_offset": offset}
        if values.get("fluid.temperature", scene.fluid.temperature) > 0.0 and (draw or repeat):
            values["fluid.seed"] = self._seed_of("fluid.seed", scene.fluid.seed, draw, repeat)
        if scene.motor.switching == "markov" and (draw or repeat):
            values["motor.seed"] = self._seed_of("motor.seed", scene.motor.seed, draw, repeat)
        return values

    def _seed_of(self, key: str, base: int, draw: int, repeat: int) -> int:
        """A seed for the random numbers of a member; those of bases with other seeds have nothing in common."""
        return int(self._stream(f"{key} {base}" if base else key, draw, repeat).integers(2**31))

    def _stream(self, key: str, draw: int, repeat: int | None = None) -> np.random.Generator:
        return np.random.default_rng(
            [self._seed, zlib.crc32(key.encode()), draw, *([] if repeat is None else [repeat])]
        )

    def _placed(self, scene: Scene, draw: int, repeat: int) -> list[tuple[float, float]]:
        """Azimuth [deg] and offset [um] of every anchor."""
        table, count = self._anchors, scene.flagella.count
        assert table is not None
        if table["placement"] == "given":
            if len(table["given"]) != count:
                problem = f"must be {count} pairs of azimuth and offset, one per flagellum"
                raise SceneError("random.anchors.given", len(table["given"]), problem)
            return [(float(azimuth), float(offset)) for azimuth, offset in table["given"]]
        cylinder = (scene.body.length - scene.body.width) / 2
        low, high = table.get("from", -cylinder), table.get("to", cylinder)
        if table["placement"] == "even":
            offsets = low + (high - low) * (np.arange(count) + 0.5) / count
            return [(float(k * _GOLDEN_DEGREES % 360.0), float(offset)) for k, offset in enumerate(offsets)]
        return _random_anchors(scene, table, low, high, self._stream("anchors", draw, repeat))


def _random_anchors(
    scene: Scene, table: Mapping[str, Any], low: float, high: float, stream: np.random.Generator
) -> list[tuple[float, float]]:
    """Anchors one after another, each drawn until it is far enough from those before it.

    Two lengths keep flagella apart: that between the anchors along the body's surface, and that between the initial
    shapes, which may cross although their anchors are far apart.
    """
    least, clearance = table.get("least_distance", 0.1), table.get("clearance", 0.1)
    around = math.pi * scene.body.width
    placed: list[tuple[float, float]] = []
    shapes: list[np.ndarray] = []
    for k in range(scene.flagella.count):
        for _ in range(_TRIES):
            azimuth, offset = float(stream.uniform(0.0, 360.0)), float(stream.uniform(low, high))
            arcs = [abs((azimuth - other + 180.0) % 360.0 - 180.0) / 360.0 * around for other, _ in placed]
            gaps = [math.hypot(arc, offset - other) for arc, (_, other) in zip(arcs, placed, strict=True)]
            if min(gaps, default=math.inf) < least:
                continue
            shape = _shape(scene, k, azimuth, offset)
            if all(_apart(shape, other, clearance) for other in shapes):
                placed.append((azimuth, offset))
                shapes.append(shape)
                break
        else:
            problem = f"found no place for flagellum {k} in {_TRIES} tries; shorten least_distance or clearance"
            raise SceneError("random.anchors.least_distance", least, problem)
    return placed


def _shape(scene: Scene, k: int, azimuth: float, offset: float) -> np.ndarray:
    """Points along flagellum k from r_1 on, four per segment [um], if it was anchored there."""
    spec = scene.resolved_flagella()[k]
    own = {"azimuth": azimuth, "anchor_offset": offset, "tilt": spec.tilt, "length": spec.length, "phase": spec.phase}
    alone = replace(scene, flagella=replace(scene.flagella, count=1), flagellum=())
    nodes = initial_state(with_values(alone, {f"flagellum.0.{name}": value for name, value in own.items()}))
    points = nodes.positions[0][1:]
    fractions = np.arange(4)[:, None, None] / 4
    return (points[:-1] + fractions * np.diff(points, axis=0)).reshape(-1, 3)


def _apart(a: np.ndarray, b: np.ndarray, distance: float) -> bool:
    """Whether no two points of two shapes are nearer than a distance [um]."""
    centres, radii = zip(
        *((x.mean(axis=0), np.linalg.norm(x - x.mean(axis=0), axis=1).max()) for x in (a, b)), strict=True
    )
    if np.linalg.norm(centres[0] - centres[1]) > sum(radii) + distance:
        return True
    squared = np.vecdot(a, a)[:, None] + np.vecdot(b, b) - 2.0 * a @ b.T
    return bool(squared.min() >= distance * distance)


def _drawn(spread: Mapping[str, float], stream: np.random.Generator, count: int) -> np.ndarray:
    if "low" in spread:
        return stream.uniform(spread["low"], spread["high"], count)
    return stream.normal(spread["mean"], spread["deviation"], count)


def _check_varied(key: str, spread: Any) -> None:
    """That scenes have the key of a spread."""
    own = key.startswith(_FLAGELLUM_PREFIX)
    name = key[len(_FLAGELLUM_PREFIX) :] if own else key
    if own and name[:1].isdigit():
        problem = f"is drawn for every flagellum by itself: write {_FLAGELLUM_PREFIX}{name.partition('.')[2]}"
        raise SceneError(f"random.{key}", spread, problem)
    try:
        check_key(f"{_FLAGELLUM_PREFIX}0.{name}" if own else key, spread)
    except SceneError as error:
        raise SceneError(
            f"random.{key}", spread, error.problem.replace(f"{_FLAGELLUM_PREFIX}0.", _FLAGELLUM_PREFIX)
        ) from None


def _check_spread(key: str, spread: Any) -> None:
    """That a spread is {low, high} or {mean, deviation}, in order."""
    kinds = ({"low", "high"}, {"mean", "deviation"})
    if not isinstance(spread, dict) or spread.keys() not in kinds or not all(_is_number(x) for x in spread.values()):
        raise SceneError(key, spread, "must be { low = , high = } or { mean = , deviation = }")
    if "low" in spread and not spread["low"] <= spread["high"]:
        raise SceneError(key, spread, "must have low not above high")
    if spread.get("deviation", 0.0) < 0.0:
        raise SceneError(key, spread, "must have a deviation not below 0")


def _checked_anchors(table: Any, base: Scene) -> dict[str, Any]:
    key = "random.anchors"
    if not isinstance(table, dict) or not table.keys() <= set(_ANCHOR_KEYS):
        raise SceneError(key, table, "must be a table of " + ", ".join(_ANCHOR_KEYS))
    if table.get("placement") not in ("even", "given", "random"):
        raise SceneError(f"{key}.placement", table.get("placement"), "must be one of even, given, random")
    for name in ("least_distance", "clearance", "from", "to"):
        least = -math.inf if name in ("from", "to") else 0.0
        if name in table and not (_is_number(table[name]) and table[name] >= least):
            raise SceneError(f"{key}.{name}", table[name], "must be a length in um")
    if table["placement"] == "given" and not (
        isinstance(table.get("given"), list)
        and all(isinstance(pair, list) and len(pair) == 2 and all(map(_is_number, pair)) for pair in table["given"])
    ):
        raise SceneError(f"{key}.given", table.get("given"), "must be pairs of azimuth [deg] and offset [um]")
    if base.flagella.phase_difference is not None and table["placement"] == "random":
        problem = "must be absent where anchors are random: it belongs to the places of two flagella"
        raise SceneError("flagella.phase_difference", base.flagella.phase_difference, problem)
    return table


def _whole(key: str, value: Any, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= 10**9:
        raise SceneError(key, value, f"must be a whole number, {least} to 1000000000")
    return value


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
