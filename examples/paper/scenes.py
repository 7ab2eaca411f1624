"""The runs behind the figures: the shipped scenes with other values, by name.

All use the implicit stepper. Run from the command line, this file lists them.
"""

from __future__ import annotations

from pathlib import Path

from warpflag.scene import Scene, load, with_values

EXAMPLES = Path(__file__).resolve().parent.parent
FRAME = 5e-5  # s between frames: a motor turns by 20 degrees, far less than the half turn that rates allow

ANGLES = {23: 0.8, 44: 0.6, 60: 0.6, 90: 0.588}
"""Opening angles of the paper's Fig. 3 [deg], with the initial phase difference (Fig. 3(a); for 60 deg a guess)."""

ABLATIONS = {
    "standard": {},
    "no-hi-between": {"hydrodynamics.mode": "within"},
    "no-hi": {"hydrodynamics.mode": "none"},
    "no-axial-rotation": {"body.axial_rotation": False},
    "no-translation": {"body.translation": False},
    "no-steric": {"steric.enabled": False},
    "no-steric-no-hi-between": {"steric.enabled": False, "hydrodynamics.mode": "within"},
    "no-steric-no-hi": {"steric.enabled": False, "hydrodynamics.mode": "none"},
    "anchored": {"body.anchored": True},
}
"""The paper's Fig. 4, (i), (ii), (iii), (iv), (v), (vi), and three more."""


def scene(name: str, duration: float, values: dict | None = None, angle: int = 23, frame: float = FRAME) -> Scene:
    """Two flagella at one opening angle with other values; duration and time between frames in s."""
    changed = {
        "name": name,
        "duration": duration,
        "frames": round(duration / frame),
        "flagella.opening_angle": float(angle),
        "flagella.phase_difference": ANGLES[angle],
        "numerics.stepper": "implicit",
        **(values or {}),
    }
    return with_values(load(EXAMPLES / "zipping_23.toml"), changed)


def figure_3() -> dict[str, Scene]:
    """Opening angles, for flagella of 8 um (nearest to the paper's curves) and of 6 um."""
    runs = {}
    for length, duration in ((8, 0.020), (6, 0.020)):
        for angle in ANGLES:
            name = f"L{length}-phi{angle}"
            runs[name] = scene(name, duration, {"flagella.length": float(length)}, angle)
    return runs


def figure_4() -> dict[str, Scene]:
    """The ablations, at the paper's torque and at 2 pN um, where the finished bundle is stable."""
    runs = {}
    for torque, duration in ((3.4, 0.030), (2.0, 0.040)):
        for ablation, values in ABLATIONS.items():
            name = f"T{torque:g}-{ablation}"
            runs[name] = scene(name, duration, {"motor.torque": torque, **values})
    return runs


def choices() -> dict[str, Scene]:
    """Initial phase differences, motor torques, the form of the torque on the body, and steppers against each other."""
    runs = {}
    for angle, thetas in ((23, (0.2, 0.4, 0.6)), (90, (0.2, 0.4, 0.8))):
        for theta in thetas:
            name = f"phi{angle}-theta{theta:g}"
            runs[name] = scene(name, 0.020, {"flagella.phase_difference": theta}, angle)
    for angle in (23, 90):
        name = f"phi{angle}-no-bearing-torque"
        runs[name] = scene(name, 0.030, {"motor.bearing_torque": False}, angle)
    runs["check-accuracy"] = scene("check-accuracy", 0.015, {"numerics.accuracy": 1e-3})
    runs["check-rkc"] = scene("check-rkc", 0.015, {"numerics.stepper": "rkc"})
    accurate = {"numerics.accuracy": 1e-3, **ABLATIONS["no-axial-rotation"]}
    runs["check-no-axial-rotation"] = scene("check-no-axial-rotation", 0.030, accurate)
    return runs


def torques() -> dict[str, Scene]:
    """Motor torques below the paper's, down to those that give its rates; long runs, for zipping is slow there."""
    runs = {}
    for torque, duration in ((2.0, 0.040), (1.0, 0.060), (0.5, 0.200), (0.34, 0.300)):
        for angle in {2.0: (90,), 1.0: (23, 90)}.get(torque, (23,)):
            name = f"phi{angle}-T{torque:g}"
            runs[name] = scene(name, duration, {"motor.torque": torque}, angle, FRAME * 3.4 / torque)
    return runs


BURST = 5.2e-3
"""When the run with the mobility as printed is looked at closely [s]; it bursts 0.05 ms later."""


def printed_mobility() -> dict[str, Scene]:
    """The paper's pair radius against the one that keeps the mobility positive definite, in steps of 1 us; others."""
    steps = {"numerics.stepper": "rkc", "numerics.time_step": 1e-6}
    printed = {"hydrodynamics.mode": "as_printed"}
    return {
        "printed": scene("printed", BURST, {**printed, **steps}),
        "derived": scene("derived", BURST, steps),
        "printed-2us": scene("printed-2us", 0.008, {**printed, **steps, "numerics.time_step": 2e-6}),
        "printed-implicit": scene("printed-implicit", 0.008, printed),
    }


def continued(runs: Path) -> dict[str, Scene]:
    """Runs from the last frame of others, which are in the directory `runs`.

    The burst microsecond by microsecond, and a finished bundle with motors so weak that it would take long to form.
    """
    near = {"duration": 8e-5, "frames": 80}
    weak = {"motor.torque": 0.5, "start.record": str(runs / "T2-standard")}
    found = {"bundle-T0.5": scene("bundle-T0.5", 0.060, weak, frame=2e-4)}
    for name in ("printed", "derived"):
        there = {**near, "name": f"{name}-closely", "start.record": str(runs / name)}
        found[f"{name}-closely"] = with_values(printed_mobility()[name], there)
    return found


if __name__ == "__main__":
    for runs in (figure_3(), figure_4(), choices(), torques(), printed_mobility(), continued(Path("runs"))):
        print("\n".join(f"{name:30s} {1e3 * run.duration:7.2f} ms" for name, run in runs.items()), end="\n\n")
