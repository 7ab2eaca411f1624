"""The report's table: what was measured in every run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from warpflag.model import zipper
from warpflag.observables import STRAY, ZIPPED, recorded, zip_time
from warpflag.record import Record

COLUMNS = (
    "run",
    "⟨θ⟩ at 0",
    "⟨θ⟩ < 0.15",
    "least ⟨θ⟩",
    "contact",
    "zip",
    "zip, held",
    "frames zipped",
    "f_c peak",
    "at",
    "motor",
    "helix",
    "body",
    "speed",
)
UNITS = ("", "", "ms", "", "ms", "ms", "ms", "%", "pN/µm", "ms", "Hz", "Hz", "Hz", "µm/s")
NOTES = """\
zip: first frame with l_r ≥ 0.98 by the plain rule, which one stray node resets. zip, held: l_r, passing over gaps of
1 µm, is ≥ 0.98 for 0.25 ms. frames zipped: by the plain rule. Rates by difference over the last third of the run:
motors about their axes and helices about theirs in the lab, the body about its axis; speed: net displacement over time.
"""


def markdown(runs: Path, groups: dict[str, list[str]]) -> str:
    """The tables of all groups of runs, and of the fitted zipper."""
    lines = ["# Measured", "", NOTES]
    for title, names in groups.items():
        lines += [f"## {title}", "", *_table([COLUMNS, UNITS], [row(runs / name) for name in names]), ""]
    lines += [*_main_run(runs / "L8-phi90"), *_checks(runs)]
    return "\n".join([*lines, *_zipper(runs, next(iter(groups.values())))]) + "\n"


def row(directory: Path) -> list[str]:
    with Record(directory) as record:
        measured, times = record.observables, 1e3 * record.times
        theta, lengths, force = (
            measured[name] for name in ("phase_difference", "bundle_length", "steric_force_density")
        )
        swimming = recorded.swimming(record)
        summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
        stopped = f" (stopped at {1e3 * summary['time']:.2f} ms)" if summary["status"] == "stopped" else ""
        touched, peak = force > 0.0, int(force.argmax())
        return [
            directory.name + stopped,
            f"{theta[0]:.2f}",
            _ms(times[np.argmax(theta < 0.15)] if (theta < 0.15).any() else np.nan),
            f"{theta.min():.3f}",
            _ms(times[np.argmax(touched)] if touched.any() else np.nan),
            _ms(1e3 * zip_time(record.times, lengths)),
            _ms(1e3 * zip_time(record.times, recorded.bundle_lengths(record, STRAY), hold=2.5e-4)),
            f"{100 * (lengths >= ZIPPED).mean():.0f}",
            f"{force[peak]:.2f}",
            _ms(times[peak] if force[peak] > 0.0 else np.nan),
            f"{swimming.motor_rate_lab.mean():.0f}",
            f"{swimming.helix_rate.mean():.0f}",
            f"{swimming.body_rate:.1f}",
            f"{swimming.net_speed:.0f}",
        ]


def _main_run(directory: Path) -> list[str]:
    """Straightness of <theta> and l_r, and the fall of f_c."""
    with Record(directory) as record:
        times, force = 1e3 * record.times, record.observables["steric_force_density"]
        theta, lengths = record.observables["phase_difference"], recorded.bundle_lengths(record, STRAY)
    zipped = 1e3 * zip_time(times / 1e3, lengths, hold=2.5e-4)
    lines = [f"## {directory.name}: is it linear?", ""]
    for name, values, start, stop in (("⟨θ⟩", theta, 7.0, 13.5), ("l_r", lengths, 4.0, zipped)):
        window = (times >= start) & (times <= stop)
        slope, offset = np.polyfit(times[window], values[window], 1)
        rest = values[window] - offset - slope * times[window]
        share = 1 - rest.var() / values[window].var()
        lines.append(
            f"- {name} from {start:g} to {stop:g} ms: {slope:+.4f} per ms, {100 * share:.1f} % of its variance"
        )
    low, fallen = int(theta.argmin()), (times > times[force.argmax()]) & (force < force.max() / 10)
    lines.append(f"- ⟨θ⟩ first below 0.05 at {times[np.argmax(theta < 0.05)]:.2f} ms, least at {times[low]:.2f} ms")
    lines.append(f"- f_c below a tenth of its peak {times[np.argmax(fallen)] - zipped:.2f} ms after the zip")
    return [*lines, ""]


def _checks(runs: Path) -> list[str]:
    """Steppers against each other, f_c by its rules, and where the work of the motors goes."""
    lines = ["## Checks on the standard run", ""]
    with Record(runs / "L6-phi23") as record, Record(runs / "check-rkc") as other:
        until = int(np.searchsorted(record.times, 0.013 - 1e-9)) + 1
        apart = np.linalg.norm(record.positions[:until] - other.positions[:until], axis=-1).max()
        lines.append(f"- nodes of the implicit run against `check-rkc` to 13 ms: at most {apart:.3f} µm apart")
        peaks = [
            f"{recorded.steric_force_densities(record, rule).max():.2f} ({rule})" for rule in ("pairs", "nodes", "net")
        ]
        lines.append(f"- peak of f_c by rule of counting: {', '.join(peaks)} pN/µm")
        last = recorded.swimming(record)
        lines.append(
            f"- motors work {last.motor_power:.0f} pN µm/s, {last.body_power:.0f} of it in the body's drag, "
            f"{last.stored_power:.0f} stored; thrust {last.thrust:.2f} pN"
        )
    return [*lines, ""]


def _zipper(runs: Path, names: list[str]) -> list[str]:
    columns = (
        "run",
        "from",
        "to",
        "pitch x rate",
        "v_c",
        "ω_c/2π",
        "R",
        "residual",
        "v_e",
        "residual",
        "v_e/(pitch x rate)",
    )
    units = ("", "ms", "ms", "µm/s", "µm/s", "Hz", "µm", "of l_r", "µm/s", "of l_r", "")
    paper = zipper.PAPER
    rows = [["the paper", "", "", f"{paper.phase_velocity:.0f}", f"{paper.body_speed:g}", f"{paper.body_rate:g}"]]
    rows[0] += [f"{paper.radius:.2f}", "", "", "", ""]
    for name in names:
        with Record(runs / name) as record:
            times, lengths = zipper.zipping(record)
            model = zipper.measured(record, times[0], times[-1])
        by_radius = zipper.fit(model, times - times[0], lengths)
        by_velocity = zipper.fit(model, times - times[0], lengths, "phase_velocity")
        effective = by_velocity.zipper.phase_velocity
        rows.append([
            name, _ms(1e3 * times[0]), _ms(1e3 * times[-1]), f"{model.phase_velocity:.0f}", f"{model.body_speed:.0f}",
            f"{model.body_rate:.0f}", f"{by_radius.zipper.radius:.2f}", f"{by_radius.residual:.3f}", f"{effective:.0f}",
            f"{by_velocity.residual:.3f}", f"{effective / model.phase_velocity:.2f}",
        ])  # fmt: skip
    title = "The analytic zipper: measured over the zip, fitted R and l_r(0), or v_e and l_r(0) with R = 0"
    return [f"## {title}", "", *_table([columns, units], rows)]


def _table(header: list, rows: list) -> list[str]:
    first = [f"{name}<br>{unit}" if unit else name for name, unit in zip(*header, strict=True)]
    lines = ["| " + " | ".join(row) + " |" for row in (first, *rows)]
    return [lines[0], "|---" + "|---:" * (len(first) - 1) + "|", *lines[1:]]


def _ms(time: float) -> str:
    return "never" if np.isnan(time) else f"{time:.2f}"
