"""What decides whether the bundle comes later without hydrodynamic interactions between the flagella?

The paper's comes about 10 ms later, in this program it does not. A designed study over what the paper leaves open:

    uv run python examples/paper/study.py     about ten minutes on two cores; goes on where it was stopped

A full factorial design crosses motor torque, length, anchor offset, twist rigidity of the hook, bearing torque and
starting phase with six readings of the hydrodynamics; a star around the standard run varies one more thing at a time.
Every run ends when its bundle has been complete for 0.25 ms. Results: study.csv; tables: printed and in study.md.
"""

from __future__ import annotations

import csv
import itertools
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scenes import scene

from warpflag.scene import Scene, SceneError, with_values
from warpflag.scene.resistance import filament_mobility, pair_radius

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "study.csv"

FACTORS = {
    "motor.torque": (2.0, 3.4),
    "flagella.length": (6.0, 8.0),
    "flagella.anchor_offset": (0.3, 0.6, 0.85),
    "flagella.hook_twist_factor": (1.0, 3.0),
    "motor.bearing_torque": (True, False),
    "azimuth": (0.0, 90.0),  # of the first anchor; phases are counted from a fixed direction, so this turns both
}
STANDARD = {**{key: values[0] for key, values in FACTORS.items()}, "motor.torque": 3.4}
STANDARD |= {"flagella.anchor_offset": 0.6, "flagella.hook_twist_factor": 3.0}

STAR = [
    *({"azimuth": angle} for angle in (45.0, 135.0, 180.0, 225.0, 270.0, 315.0)),
    *({"flagella.phase_difference": theta} for theta in (0.2, 0.4, 0.6, 0.9)),
    *(
        {"flagella.opening_angle": float(phi), "flagella.phase_difference": theta}
        for phi, theta in ((44, 0.6), (90, 0.588))
    ),
    *({"apart": angle} for angle in (60.0, 90.0, 120.0)),
    *({"motor.torque": torque} for torque in (1.0, 1.5, 5.0)),
    *({"motor.axis_angle": angle} for angle in (35.0, 65.0, 70.0, 75.0)),
    {"motor.axis_angle": 75.0, "motor.torque": 2.0},
    {"flagella.length": 10.0},
    {"flagella.segment_length": 0.1},
    {"flagella.segment_length": 0.3},
    {"body.contact": False},
    {"steric.diameter": 0.06},
    {"steric.strength": 8.0},
]
"""One thing at a time, the rest as in the standard run. apart: azimuth between the anchors, same opening angle."""

HYDRODYNAMICS = ("all", "within", "between", "none", "consistent", "consistent-within")
PAIRS = {
    "all / within": ("all", "within"),
    "all / none": ("all", "none"),
    "between / none": ("between", "none"),
    "consistent / its own within": ("consistent", "consistent-within"),
}
"""With and without hydrodynamic interactions between the flagella: four readings of the paper's sentence."""


def build(values: dict, hydrodynamics: str) -> Scene:
    """The scene of one point of the study."""
    torque = values["motor.torque"]
    own = {key: value for key, value in values.items() if key not in ("azimuth", "apart")}
    apart = values.get("apart", 180.0)
    turn = {"flagellum.0.azimuth": values["azimuth"], "flagellum.1.azimuth": (values["azimuth"] + apart) % 360.0}
    if apart != 180.0:
        half = np.radians(23.0 / 2)
        tilt = float(np.degrees(np.arcsin(np.sin(half) / np.sin(np.radians(apart) / 2))))
        turn |= {"flagellum.0.tilt": tilt, "flagellum.1.tilt": tilt}
    mode = hydrodynamics.removesuffix("-within")
    built = scene("study", 0.030 * 3.4 / torque, {**own, **turn, "hydrodynamics.mode": mode})
    if hydrodynamics != "consistent-within":
        return built
    # The same local drag and pair radius as mode "consistent", but no pairs of different flagella.
    h = built.resolved_flagella()[0].segment_length
    local = filament_mobility(built, h)
    drags = {"fluid.drag_parallel": 1 / (local.along * h), "fluid.drag_perpendicular": 1 / (local.across * h)}
    radius = {"hydrodynamics.mode": "within", "hydrodynamics.pair_radius": pair_radius(built)}
    return with_values(built, {**drags, **radius})


def points() -> dict[str, tuple[dict, str]]:
    """Every point of the study by a key that names it."""
    crossed = [dict(zip(FACTORS, levels, strict=True)) for levels in itertools.product(*FACTORS.values())]
    star = [{**STANDARD, **change} for change in STAR]
    found = {}
    for values in crossed + star:
        for hydrodynamics in HYDRODYNAMICS:
            name = " ".join(f"{key.rpartition('.')[2]}={value:g}" for key, value in values.items())
            found[f"{name} {hydrodynamics}"] = (values, hydrodynamics)
    return found


def measure(values: dict, hydrodynamics: str) -> tuple[float, float, str]:
    """When <theta> first falls below 0.15 and when the zip is complete [ms], NaN where never; and what went wrong."""
    import warp as wp

    wp.config.quiet = True
    from warpflag.observables import zip_time
    from warpflag.run.simulation import NumericalError, Simulation

    times, lengths, synchronised = [], [], float("nan")
    try:
        built = build(values, hydrodynamics)
        for frame in Simulation(built, device="cpu").frames(built.duration):
            times.append(frame.time)
            lengths.append(frame.observables["bundle_length"])
            if np.isnan(synchronised) and frame.observables["phase_difference"] < 0.15:
                synchronised = frame.time
            if not np.isnan(zip_time(np.array(times), np.array(lengths), hold=2.5e-4)):
                break
    except (NumericalError, SceneError) as error:
        return 1e3 * synchronised, float("nan"), str(error).partition(";")[0]
    return 1e3 * synchronised, 1e3 * zip_time(np.array(times), np.array(lengths), hold=2.5e-4), ""


def run_missing() -> dict[str, tuple[float, float, str]]:
    """Results by key; runs what study.csv lacks."""
    results = {}
    if RESULTS.exists():
        with RESULTS.open(newline="") as file:
            results = {
                row["run"]: (float(row["sync"]), float(row["zip"]), row["fault"]) for row in csv.DictReader(file)
            }
    missing = {key: point for key, point in points().items() if key not in results}
    with RESULTS.open("a", newline="") as file, ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool:
        writer = csv.writer(file, lineterminator="\n")
        if not results:
            writer.writerow(["run", "sync", "zip", "fault"])
        jobs = {pool.submit(measure, *point): key for key, point in missing.items()}
        for done, job in enumerate(as_completed(jobs), start=1):
            key = jobs[job]
            results[key] = job.result()
            sync, zipped, fault = results[key]
            writer.writerow([key, f"{sync:.2f}", f"{zipped:.2f}", fault])
            file.flush()
            if done % 50 == 0:
                print(f"{done} of {len(jobs)}", flush=True)
    return results


def tables(results: dict[str, tuple[float, float, str]]) -> str:
    """The study's tables in Markdown."""
    by_point: dict[str, dict[str, float]] = {}
    values_of: dict[str, dict] = {}
    for key, (values, hydrodynamics) in points().items():
        name = key.removesuffix(f" {hydrodynamics}")
        by_point.setdefault(name, {})[hydrodynamics] = results[key][1]
        values_of[name] = values
    crossed = [name for name, values in values_of.items() if values.keys() == FACTORS.keys() and _crossed(values)]
    star = {name: values for name, values in values_of.items() if name not in crossed}
    lines = ["# The study", "", f"{len(results)} runs, {sum(bool(fault) for *_, fault in results.values())} of them"]
    lines[-1] += (
        " stopped by a guard. Delay: time of the zip without minus with interactions between the flagella [ms]."
    )
    lines += ["", f"## Delay over the {len(crossed)} combinations of the factorial design", ""]
    lines += ["| with / without | zip with, median | delay, median | least | most | delays ≥ 5 ms | not both zip |"]
    lines += ["|---|---:|---:|---:|---:|---:|---:|"]
    delays = {pair: np.array([_delay(by_point[name], pair) for name in crossed]) for pair in PAIRS}
    for pair, found in delays.items():
        usual = np.nanmedian([by_point[name][PAIRS[pair][0]] for name in crossed])
        least, most = np.nanmin(found), np.nanmax(found)
        numbers = f"{usual:.1f} | {np.nanmedian(found):+.1f} | {least:+.1f} | {most:+.1f}"
        lines.append(f"| {pair} | {numbers} | {(found >= 5).sum()} | {np.isnan(found).sum()} |")
    lines += ["", "## Mean delay at each level of each factor", ""]
    lines += ["| factor | level | " + " | ".join(PAIRS) + " |", "|---|---:" + "|---:" * len(PAIRS) + "|"]
    for factor, levels in FACTORS.items():
        for level in levels:
            at = np.array([values_of[name][factor] == level for name in crossed])
            means = " | ".join(f"{np.nanmean(found[at]):+.1f}" for found in delays.values())
            lines.append(f"| {factor} | {level} | {means} |")
    lines += ["", "## One thing at a time, from the standard run: zip [ms] and delays", ""]
    lines += ["| change | " + " | ".join((*HYDRODYNAMICS, *PAIRS)) + " |"]
    lines += ["|---" + "|---:" * (len(HYDRODYNAMICS) + len(PAIRS)) + "|"]
    standard = next(name for name in crossed if values_of[name] == STANDARD)
    for name, values in {standard: STANDARD, **star}.items():
        change = ", ".join(f"{key} = {value:g}" for key, value in values.items() if STANDARD.get(key) != value)
        cells = [_cell(*results[f"{name} {hydrodynamics}"][1:]) for hydrodynamics in HYDRODYNAMICS]
        cells += ["" if np.isnan(delay) else f"{delay:+.1f}" for delay in (_delay(by_point[name], p) for p in PAIRS)]
        lines.append(f"| {change or 'none'} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _cell(zipped: float, fault: str) -> str:
    return "stopped" if fault else "never" if np.isnan(zipped) else f"{zipped:.1f}"


def _crossed(values: dict) -> bool:
    return all(values[key] in levels for key, levels in FACTORS.items())


def _delay(zips: dict[str, float], pair: str) -> float:
    with_interaction, without = PAIRS[pair]
    return zips[without] - zips[with_interaction]


if __name__ == "__main__":
    text = tables(run_missing())
    (HERE / "study.md").write_text(text, encoding="utf-8")
    print(text)
