"""Pictures of docs/living-cell.md: runs and tumbles, a filament that changes form, one that wraps, unequal motors.

    warpflag run examples/run_and_tumble.toml
    warpflag run examples/reversal.toml
    warpflag run examples/wrapped.toml
    uv run --extra plot examples/living_cell.py [--runs runs] [-o DIR]

Takes the records of the three runs and simulates the last itself, at several torques of the second motor, in 10 s.
"""

import argparse
from pathlib import Path

import numpy as np

from warpflag import Record, Simulation
from warpflag.base.rotations import matrix
from warpflag.scene import load, loads, with_values
from warpflag.view.coloring import FORM_COLORS

HERE = Path(__file__).parent
SMOOTHING = 0.05  # s, longer than a turn of the body
MOMENTS = (0.0, 0.014, 0.02, 0.028, 0.034, 0.06)  # s, of the pictures of a filament that wraps
TORQUES = (3.4, 3.2, 3.0, 2.7, 2.0)  # of the second motor [pN um]; the first has 3.4

options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
options.add_argument("--runs", type=Path, default=Path("runs"))
options.add_argument("-o", dest="output", type=Path, default=Path())
options = options.parse_args()
options.output.mkdir(parents=True, exist_ok=True)


def pyplot():
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot
    from matplotlib.colors import to_rgb
    from matplotlib.patches import FancyBboxPatch

    return matplotlib.pyplot, FancyBboxPatch, to_rgb


plt, FancyBboxPatch, to_rgb = pyplot()


def save(figure, name: str) -> None:
    figure.savefig(options.output / f"{name}.png", dpi=120)
    plt.close(figure)


def run_and_tumble() -> None:
    """Path in the plane in which it extends most, senses of the motors, speed."""
    with Record(options.runs / "run_and_tumble") as record:
        t, x, drive = record.times[:], record.body_position[:], record.observables["motor_drive"][:]
    half = round(SMOOTHING / (t[1] - t[0]) / 2)
    window = np.ones(2 * half + 1) / (2 * half + 1)
    smooth = np.stack([np.convolve(x[:, i], window, "valid") for i in range(3)], axis=1)
    times, reverse = t[half:-half], (drive < 0).any(axis=1)[half:-half]
    speed = np.linalg.norm(np.gradient(smooth, times, axis=0), axis=1)
    plane = np.linalg.svd(smooth - smooth.mean(axis=0), full_matrices=False)[2][:2]
    path = (smooth - smooth[0]) @ plane.T
    figure = plt.figure(figsize=(8, 3.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=[1, 1.5])
    axes = figure.add_subplot(grid[:, 0], xlabel="µm", ylabel="µm", title="path, from the dot")
    axes.plot(*np.where(reverse[:, None], np.nan, path).T, label="all forward")
    axes.plot(*np.where(reverse[:, None], path, np.nan).T, color="C3", label="a motor in reverse")
    axes.plot(0, 0, "ko", ms=4)
    axes.set_aspect("equal", "datalim")
    axes.legend(frameon=False, fontsize=8)
    axes = figure.add_subplot(grid[0, 1], title="motors in reverse", ylabel="motor", xlim=(0, t[-1]))
    for k in range(drive.shape[1]):
        axes.fill_between(t, k - 0.4, k + 0.4, where=drive[:, k] < 0, color="C3")
    axes.set_yticks(range(drive.shape[1]))
    axes.set_ylim(-0.6, drive.shape[1] - 0.4)
    axes = figure.add_subplot(grid[1, 1], xlabel="s", ylabel="speed, µm/s", xlim=(0, t[-1]))
    axes.plot(times, speed, "k")
    axes.set_ylim(0)
    save(figure, "run_and_tumble")


def reversal() -> None:
    """Forms along the filament over time, and the motor's sense."""
    with Record(options.runs / "reversal") as record:
        forms = record.forms
        assert forms is not None
        t, along = 1e3 * record.times[:], 6.0 / 30 * np.arange(1, 30)
        drive, joints = record.observables["motor_drive"][:, 0], forms[:, 1:-1]
    shape = {"figsize": (6, 3.8), "height_ratios": [1, 4], "layout": "constrained"}
    figure, (above, axes) = plt.subplots(2, sharex=True, **shape)
    above.fill_between(t, 0, drive, color="C3", lw=0)
    above.set(ylabel="drive", ylim=(-1.2, 1.2))
    axes.contourf(t, along, joints.T, levels=[-0.5, 0.5, 1.5], colors=FORM_COLORS[:2])
    for name, color in zip(("normal", "semicoiled"), FORM_COLORS, strict=False):
        axes.plot([], [], "s", color=color, label=name)
    axes.set(xlabel="ms", ylabel="contour from the motor, µm", xlim=(0, t[-1]), ylim=(0, 7.2))
    axes.legend(fontsize=8, frameon=False, loc="upper right", ncols=2)
    save(figure, "reversal")


def wrapped() -> None:
    """Body and filament in the body's axes, at some moments; what is behind the body is pale, or hidden by it."""
    with Record(options.runs / "wrapped") as record:
        size, wraps, forms = loads(record.scene_text).body, record.wrapping(), record.forms
        assert forms is not None
        seen = []
        for moment in MOMENTS:
            k = int(np.argmin(np.abs(record.times - moment)))
            nodes = (record.positions[k] - record.body_position[k]) @ matrix(record.body_orientation[k])
            title = f"{1e3 * record.times[k]:.0f} ms, {abs(wraps.turns[k, 0]):.1f} turns"
            seen.append((nodes, forms[k], title))
    figure, panels = plt.subplots(3, 2, figsize=(9, 5.4), layout="constrained", sharex=True, sharey=True)
    cap = size.width / 2
    outline = {"boxstyle": f"round,pad=0,rounding_size={cap}", "fc": "#e8d9b8", "ec": "#8a7a50", "zorder": 2}
    for axes, (nodes, form, title) in zip(panels.flat, seen, strict=True):
        axes.add_patch(FancyBboxPatch((-size.length / 2, -cap), size.length, 2 * cap, **outline))
        for i in range(len(nodes) - 1):
            behind = nodes[i : i + 2, 0].mean() < 0
            color = 1.0 - (0.45 if behind else 1.0) * (1.0 - np.array(to_rgb(FORM_COLORS[form[i]])))
            axes.plot(*nodes[i : i + 2, [2, 1]].T, color=color, lw=2.5, zorder=1 if behind else 3)
        axes.set(title=title, aspect="equal", xlim=(-1.6, 7.4), ylim=(-1.4, 1.4))
    for axes in panels[-1]:
        axes.set_xlabel("µm along the body")
    for name, color in zip(("normal", "coiled"), FORM_COLORS, strict=False):
        panels[0, 1].plot([], [], color=color, lw=2.5, label=name)
    panels[0, 1].legend(fontsize=8, frameon=False, loc="lower right")
    save(figure, "wrapped")


def unequal_motors() -> None:
    """Turns by which the second motor lags, and bundle length, over time."""
    figure, (above, below) = plt.subplots(2, sharex=True, figsize=(7, 4.4), layout="constrained")
    for torque in TORQUES:
        values = {"flagellum.1.torque": torque, "numerics.on_accuracy": "warn"}
        scene = with_values(load(HERE / "unequal_motors.toml"), values)
        frames = list(Simulation(scene, device="cpu").frames(scene.duration))
        t = [1e3 * frame.time for frame in frames]
        angles = np.array([frame.motor_angle for frame in frames])
        above.plot(t, (angles[:, 0] - angles[:, 1]) / (2 * np.pi), label=f"{TORQUES[0]:g} and {torque:g}")
        length = np.convolve([frame.observables["bundle_length"] for frame in frames], np.ones(25) / 25, "valid")
        below.plot(t[12:-12], length)
    above.set(ylabel="lag, turns", ylim=(-0.5, 8))
    figure.legend(*above.get_legend_handles_labels(), loc="outside right upper", title="torques, pN µm", frameon=False)
    below.set(xlabel="ms", ylabel="$l_r$, mean of 5 ms", xlim=(0, t[-1]), ylim=(0, 1.05))
    save(figure, "unequal_motors")


run_and_tumble()
reversal()
wrapped()
unequal_motors()
