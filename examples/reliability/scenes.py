"""Attacks on scenes: malformed files, and random valid scenes each against a finer run."""

from __future__ import annotations

import random
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from examples.reliability.attempt import Found, found
from examples.reliability.malformed import malformed
from warpflag.model.geometry import InitialState
from warpflag.record.cell_state import CellState
from warpflag.run.growth import growth, growth_words, wanted
from warpflag.run.simulation import NumericalError, Simulation
from warpflag.run.summary import accuracy_kept
from warpflag.scene import Scene, SceneError, load, with_values

FINER = 30.0
"""Accuracy over that of the finer run."""
CUT_OFF = 60.0
"""Computing time of a finer run [s]."""
LOOKS = 10
"""Times at which two runs are compared."""
BEYOND = 10.0
"""Error over what was asked from which a run is wrong."""


def malformed_scene(seed: int, folder: Path) -> Found:
    """A malformed scene file is refused in lines of one problem each, within seconds; a sound one is read."""
    path = folder / "scene.toml"
    path.write_bytes(malformed(seed))
    begin = time.monotonic()
    try:
        load(path)
    except SceneError as error:
        if any(not line.strip() for line in str(error).splitlines()) or time.monotonic() - begin > 5.0:
            return found("wrong", f"{time.monotonic() - begin:.1f} s: {error}")
        return found("refused", str(error))
    except Exception as error:
        return found("traceback", f"{type(error).__name__}: {error}")
    return found("right", "is sound")


def random_values(seed: int) -> dict[str, Any]:
    """Values of a valid scene, by key: each one is left at its default or drawn from what the schema allows."""
    chance = random.Random(f"scene {seed}")
    count = chance.choice([1, 2, 2, 2, 3, 4, 6])

    def maybe(share: float, value: Any) -> Any:
        return value if chance.random() < share else None

    def spread(usual: float, factor: float) -> float:
        return usual * factor ** chance.uniform(-1, 1)

    drawn: dict[str, Any] = {
        "flagella.count": count,
        "flagella.phase_difference": None,
        "flagella.segment_length": chance.choice([0.1, 0.2, 0.2, 0.25]),
        "flagella.opening_angle": chance.uniform(10, 150),
        "flagella.bending_rigidity": maybe(0.4, spread(3.5, 10)),
        "flagella.twist_rigidity": maybe(0.4, spread(3.5, 10)),
        "flagella.stretching_stiffness": maybe(0.3, spread(3e3, 10)),
        "fluid.viscosity": maybe(0.4, spread(1e-3, 10)),
        "motor.torque": maybe(0.7, spread(1.5, 4)),
        "motor.axis_angle": maybe(0.3, chance.uniform(20, 90)),
        "motor.bearing_torque": maybe(0.2, True),
        "steric.strength": maybe(0.3, spread(0.8, 5)),
        "body.length": maybe(0.4, chance.uniform(1.5, 4.0)),
        "body.width": maybe(0.4, chance.uniform(0.6, 1.2)),
        "body.contact": maybe(0.2, False),
        "body.anchored": maybe(0.2, True),
        "hydrodynamics.mode": maybe(0.6, chance.choice(["none", "within", "all", "consistent"])),
        "numerics.stepper": maybe(0.2, "rkc"),
        "numerics.precision": maybe(0.2, "float32"),
        "external.body_force": maybe(0.1, (0.0, chance.uniform(-2, 2), 1.0)),
        "duration": 10 ** chance.uniform(-4, -3),
        "frames": 10,
    }
    for k in range(count if chance.random() < 0.5 else 0):
        drawn |= {
            f"flagellum.{k}.length": chance.uniform(2.0, 6.0),
            f"flagellum.{k}.torque": chance.choice([-1, 1]) * spread(1.5, 4),
            f"flagellum.{k}.phase": chance.uniform(-180, 180),
            f"flagellum.{k}.azimuth": 360.0 * (k + chance.uniform(-0.3, 0.3)) / count,
        }
    return {key: value for key, value in drawn.items() if value is not None or key == "flagella.phase_difference"}


def living_values(seed: int) -> dict[str, Any]:
    """Those of `random_values` with terms beyond the paper: hooks, flow round the body, motors on curves or at given
    rates that reverse, filaments that change form, contact of a flagellum with itself, free filaments."""
    chance = random.Random(f"living scene {seed}")
    values = random_values(seed)
    duration = values["duration"]

    def maybe(share: float, value: Any) -> Any:
        return value if chance.random() < share else None

    def spread(usual: float, factor: float) -> float:
        return usual * factor ** chance.uniform(-1, 1)

    if chance.random() < 0.08:  # no body, and nothing that belongs to one
        kept = ("flagella.", "fluid.", "numerics.", "steric.")
        values = {key: value for key, value in values.items() if key.startswith(kept)}
        values |= {"flagella.count": 1, "body.enabled": False, "duration": duration, "frames": 10}
        values["external.force_per_length"] = tuple(chance.uniform(-0.5, 0.5) for _ in range(3))
        return values
    mode = chance.choice(["none", "within", "all", "consistent", "consistent", "consistent"])
    knee = chance.uniform(20, 250)
    drawn: dict[str, Any] = {
        "hydrodynamics.mode": mode,
        "hydrodynamics.body_flow": chance.random() < 0.5 if mode in ("all", "consistent") else None,
        "flagella.nodes_on_helix": maybe(0.2, True),
        "flagella.on_axis": maybe(0.2, True),
        "steric.self_contact": maybe(0.25, True),
        "hook.length": maybe(0.6, chance.uniform(0.02, 0.12)),
        "hook.stiffness": maybe(0.6, spread(0.65, 6)),
        "hook.stiffening_torque": maybe(0.2, spread(1.0, 3)),
        "motor.law": chance.choice(["constant", "torque_speed", "torque_speed", "rate"]),
        "motor.knee": knee,
        "motor.no_load": knee + spread(100, 3),
        "motor.reverse_torque": maybe(0.3, spread(1.0, 3)),
        "motor.rate": chance.choice([-1, 1]) * spread(120, 3),
        "motor.switching": chance.choice(["none", "none", "schedule", "markov"]),
        "motor.switch_times": tuple(sorted(duration * chance.random() for _ in range(chance.randint(1, 3)))),
        "motor.switch_ramp": max(duration * chance.uniform(0.02, 0.3), 1e-6),
        "motor.to_reverse": chance.uniform(0.5, 3) / duration,
        "motor.to_forward": chance.uniform(0.5, 3) / duration,
        "motor.coupling": maybe(0.2, chance.random()),
        "motor.seed": chance.randrange(1000),
        "polymorphs.enabled": maybe(0.35, True),
        "polymorphs.target": chance.choice(["semicoiled", "curly_1", "coiled"]),
        "polymorphs.front_speed": spread(300, 4),
        "external.force_per_length": maybe(0.15, tuple(chance.uniform(-0.3, 0.3) for _ in range(3))),
    }
    if drawn["motor.switching"] != "schedule":
        drawn["motor.switch_times"] = None
    values |= {key: value for key, value in drawn.items() if value is not None}
    for k in range(values["flagella.count"] if chance.random() < 0.5 else 0):
        values[f"flagellum.{k}.anchor_offset"] = chance.uniform(-0.4, 1.0) * values.get("body.length", 2.5) / 2
    return values


def looks(
    scene: Scene, start: InitialState | None, cut_off: float
) -> tuple[list[CellState], float, str, Simulation | None]:
    """States at equal times to the end of a scene, as far as it comes; computing time [s]; how it ended."""
    seen: list[CellState] = []
    begin = time.process_time()

    class Late(Exception):
        pass

    def watch() -> None:
        if time.process_time() - begin > cut_off:
            raise Late

    sim = None
    try:
        sim = Simulation(scene, device="cpu", starts=start)
        sim.prepare()
        begin = time.process_time()
        for k in range(LOOKS):
            sim.advance(scene.duration * (k + 1) / LOOKS, watch)
            seen.append(sim.cell_state())
    except NumericalError as error:
        return seen, time.process_time() - begin, str(error), sim
    except Late:
        return seen, time.process_time() - begin, "cut off", sim
    return seen, time.process_time() - begin, "", sim


def asked(scene: Scene, time: float) -> float:
    """Node error that a scene's accuracy allows after a time [um]: in proportion to it, or of independent errors."""
    share = time / 1e-3
    return scene.numerics.asked * max(share, share**0.5)


def told(scene: Scene, sim: Simulation, states: list[CellState]) -> str:
    """What the run itself says of an error beyond what was asked; empty where it says nothing."""
    kept = accuracy_kept(scene, sim.checkpoint())
    if scene.numerics.time_step and (kept["estimate"] or 0.0) > BEYOND * kept["asked"]:
        return f"fixed steps, whose estimate is {kept['estimate'] / kept['asked']:.3g} times"
    steps, flagella = int(sim.steps[0]), len(scene.resolved_flagella())
    if (doubtful := wanted(kept, steps, flagella, stopped=False)) is None:
        return ""
    step = 0.5 * float(sim.times[0]) / steps
    return growth_words(growth(scene, states, sim.first_node, "cpu", step, followed=doubtful.within))


def against_finer(
    scene: Scene,
    start: InitialState | None = None,
    reference: str | None = None,
    cut_off: float | None = None,
    changed: Mapping[str, Any] | None = None,
) -> Found:
    """A scene against a finer run.

    Args:
        scene: whose accuracy is asked for.
        start: of both; None: the scene's.
        reference: stepper of the finer run; None: the scene's.
        cut_off: computing time of each [s]; None: `CUT_OFF`.
        changed: values that the finer run has beside a thirtieth of the accuracy.
    """
    cut_off = cut_off or CUT_OFF
    seen, seconds, end, sim = looks(scene, start, cut_off)
    states = seen[::-1]
    if end and end != "cut off" and not seen:
        return found("stopped", end, seconds=seconds)
    accuracy = scene.numerics.asked / FINER
    own = {"numerics.accuracy": accuracy, "numerics.precision": "float64", "numerics.on_accuracy": "warn"}
    if reference:
        own["numerics.stepper"] = reference
    finer = with_values(scene, {**own, **(changed or {})})
    exact, _, exact_end, _ = looks(finer, start, cut_off)
    count = min(len(seen), len(exact))
    if not count:
        outcome = "stopped" if end and end != "cut off" else "unfinished"
        return found(outcome, f"nothing to compare: {end}; finer: {exact_end}", seconds=seconds)
    shares = []
    for k in range(count):
        error = np.linalg.norm(seen[k].positions - exact[k].positions, axis=1).max()
        shares.append(float(error) / asked(scene, scene.duration * (k + 1) / LOOKS))
    numbers = {"seconds": seconds, "error_over_asked": shares[-1], "compared_to": count / LOOKS}
    numbers["steps"] = int(sim.steps[0]) if sim else 0
    said = f"error {shares[-1]:.3g} times what was asked at {count / LOOKS:g} of the run"
    if end and end != "cut off":
        return found("stopped", f"{end}; {said} before", **numbers)
    if max(shares) <= BEYOND:
        return found("right", f"{said}; {end or 'ran'}; finer: {exact_end or 'ran'}", **numbers)
    words = told(scene, sim, states) if sim else ""
    return found("told" if words else "wrong", f"{said}; {words}", **numbers)


def random_scene(seed: int, folder: Path, living: bool = False) -> Found:
    """A random valid scene against a run of a thirtieth of its accuracy.

    Args:
        seed: of the scene.
        folder: not used.
        living: whether it has terms beyond the paper.
    """
    try:
        values = living_values(seed) if living else random_values(seed)
        scene = with_values(Scene(name=f"random {seed}"), values)
        return against_finer(scene)
    except SceneError as error:
        return found("refused", str(error))
    except Exception as error:
        return found("traceback", f"{type(error).__name__}: {error}")
