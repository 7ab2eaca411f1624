"""Tables and plots of the hydrodynamics: rigid helices and rods, the shell of beads, eigenvalues of the mobility.

    uv run examples/hydrodynamics/tables.py [-o DIR] [--states 1000]

Dense mobilities are put together from the coefficients that a run uses (`warpflag.scene.resistance`,
`warpflag.model.shell`); tests/fluid compares them with what the kernels apply.
"""

from __future__ import annotations

import argparse
import itertools
import math
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "tools"))
import cells
import helices
import joint

ETA = 1e-3
BEADS = (30, 60, 120, 480)
GAPS = (0.06, 0.1, 0.2, 0.5)
MODES = ("none", "as_printed", "all", "consistent")  # of a single helix, within is all and between is none


def table(title: str, head: list[str], rows: list[list[str]]) -> str:
    """A table in Markdown."""
    lines = [f"## {title}", "", "| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows), ""])


def johnson() -> str:
    """Thrust, torque and drag of a helix (R 1, a 0.04, pitch 10.2, axial length 30.9, eta 1) beside Johnson's."""
    exact = np.array([41.58, 11.93, 87.77])
    rows = []
    for count in (39, 78, 160, 260, 336):
        for mode in MODES:
            nodes, length = helices.nodes(1.0, 10.2, 30.9, count)
            found = helices.resistance(nodes, length, 0.04, 1.0, mode)
            off = 100 * (found / exact - 1)
            rows.append(
                [
                    f"{length / count / 0.04:.1f}",
                    mode,
                    *(f"{x:.2f} ({d:+.1f} %)" for x, d in zip(found, off, strict=True)),
                ]
            )
    return table(
        "A helix beside slender-body theory (Johnson): drag 41.58, thrust 11.93, torque 87.77",
        ["h/a", "mode", "drag A", "thrust B", "torque D"],
        rows,
    )


def rodenborn() -> str:
    """Three helices of Rodenborn et al. (2013), experiment, in units of eta and R."""
    measured = {2.226: (52.1, 6.26, 131.9), 6.509: (39.4, 11.03, 81.9), 9.811: (35.3, 9.57, 72.7)}
    rows = []
    for pitch, values in measured.items():
        for mode in MODES:
            nodes, length = helices.nodes(
                1.0, pitch, 20.63, round(20.63 / pitch * math.hypot(pitch, 2 * math.pi) / 0.3)
            )
            found = helices.resistance(nodes, length, 0.063, 1.0, mode)
            off = 100 * (found / np.array(values) - 1)
            rows.append([f"{pitch}", mode, *(f"{x:.1f} ({d:+.0f} %)" for x, d in zip(found, off, strict=True))])
    return table(
        "Helices of Rodenborn et al. (2013), deviation from the experiment",
        ["pitch/R", "mode", "drag", "thrust", "torque"],
        rows,
    )


def rods() -> str:
    """A straight rod along and across, and a ring, beside slender-body theory; and two rods that sink side by side."""
    rows = []
    for h in (0.4, 0.2, 0.1):
        along, across = helices.rod_drag(10.0, h, 0.01, ETA)
        log = math.log(2 * 10.0 / 2 / 0.01)
        exact = (
            2 * math.pi * ETA * 10.0 / (log + math.log(2) - 1.5),
            4 * math.pi * ETA * 10.0 / (log + math.log(2) - 0.5),
        )
        ring = helices.ring_drag(1.0, h, 0.01, ETA)
        log = math.log(8 / 0.01)
        thin = 8 * math.pi**2 * ETA / (log + 0.5)
        faster = helices.two_rods(6.0, h, 0.01, ETA, 0.5)
        rows.append(
            [f"{h}", f"{along / exact[0]:.3f}", f"{across / exact[1]:.3f}", f"{ring / thin:.3f}", f"{faster:.3f}"]
        )
    head = ["h um", "rod along", "rod across", "ring, broadside", "two rods 0.5 um apart over one alone"]
    return table("Mode consistent over slender-body theory (rod 10 um, ring of radius 1 um, a 0.01 um)", head, rows)


def shell() -> str:
    """Drags of the shells over the spheroid's, and the radial mobility of a node beside the equator."""
    rows = []
    for beads in BEADS:
        drags, beside = cells.shell_drags(beads), [cells.radial_mobility(beads, gap) for gap in GAPS]
        rows.append([str(beads), *(f"{100 * d:+.2f} %" for d in drags), *(f"{m:.2f}" for m in beside)])
    head = ["beads", "along", "across", "spin", "tumble", *(f"mobility at {g} um" for g in GAPS)]
    return table("Shells of beads", head, rows)


def eigenvalues(states: int) -> str:
    """The smallest eigenvalue of the whole mobility, body flow included, over that of a free node."""
    rows = []
    for mode in ("all", "consistent"):
        for kind in cells.KINDS:
            found = [cells.smallest(mode, kind, seed) for seed in range(states // len(cells.KINDS))]
            rows.append([mode, kind, str(len(found)), f"{min(found):.3g}", "yes" if min(found) > 0 else "no"])
    return table(
        "Smallest eigenvalue of the mobility of body and nodes",
        ["mode", "states", "number", "smallest / (um/(s pN))", "positive"],
        rows,
    )


def coaxial() -> str:
    """One polar flagellum on a hook: linear stability of the same nodes as a rigid body beside runs, and speeds."""
    rows = []
    for length, torque, flow in itertools.product((6.0, 8.0), (0.38, 1.0), (True, False)):
        shares = np.array([1e-3, 0.35, 0.65])
        scenes = [joint.polar_cell(torque, share * torque, flow, length) for share in shares]
        exact = np.array([joint.stability(scene).growth for scene in scenes])
        stiff = joint.polar_cell(torque, 100.0, flow, length)
        speed, motor = joint.rigid_speed(stiff)
        found = joint.growth_rates(scenes, 2.2 / motor)
        swum = joint.speed_of_run(stiff, motor)[0]
        thresholds = [float(np.interp(0.0, -growth[1:], shares[1:])) for growth in (exact, found)]
        rows.append([
            f"{length:g}", f"{torque:g}", "yes" if flow else "no", f"{exact[0]:.1f}", f"{found[0]:.1f}",
            *(f"{x:.3f}" for x in thresholds), f"{speed:.2f}", f"{swum:.2f}",
        ])  # fmt: skip
    head = ["length", "torque", "body flow", "growth 1/s", "of runs", "threshold / torque", "of runs"]
    return table(
        "A polar flagellum: growth with a free joint, hook stiffness that makes it stable, speed with a stiff hook",
        [*head, "rigid um/s", "of runs"],
        rows,
    )


def plot(path: Path) -> None:
    """Radial mobility beside the body, and the far field of a swimmer."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    near, far = figure.subplots(1, 2)
    gaps = np.geomspace(0.04, 1.0, 24)
    for beads in BEADS:
        near.semilogx(gaps, [cells.radial_mobility(beads, gap) for gap in gaps], label=f"{beads} beads")
    near.set(xlabel="distance from the equator [µm]", ylabel="radial mobility of a node over free", ylim=(0, 1.02))
    near.legend()
    distance = np.geomspace(15, 1500, 20)
    flow = cells.far_field(distance)
    far.loglog(distance, flow, "o", label="swimmer, mean over directions")
    far.loglog(distance, flow[-1] * (distance[-1] / distance) ** 2, "-", label="1/r²: force dipole")
    far.set(xlabel="distance from the body [µm]", ylabel="flow [µm/s]")
    far.legend()
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, default=Path("runs/hydrodynamics"))
    parser.add_argument("--states", type=int, default=1000, help="poses per mode whose eigenvalues are found")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    text = "\n".join([johnson(), rodenborn(), rods(), shell(), coaxial(), eigenvalues(options.states)])
    (options.output / "tables.md").write_text(text, encoding="utf-8")
    print(text)
    plot(options.output / "hydrodynamics.png")


if __name__ == "__main__":
    main()
