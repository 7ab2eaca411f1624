"""When a polar flagellum wraps round the body: torque, hook, forms, thresholds, body and number, beside wrapped.toml.

    uv run examples/behaviour/wrapping.py [--duration 0.1]

For each cell when the first flagellum has gone round the body once, how much of the flagella lies along it and how
often they go round at the end (means of the last tenth), and the speed along the body towards the flagella's pole over
the last half. Half a minute of one core. Units: um, pN, s.
"""

import argparse
import itertools
from pathlib import Path

import numpy as np

from warpflag import Simulation, load, with_values
from warpflag.base.rotations import axis_of_body
from warpflag.observables.behaviour import wrapping
from warpflag.run.simulation import NumericalError

options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
options.add_argument("--duration", type=float, default=0.1, help="of each run, the motor reverses at 5 ms [s]")
options = options.parse_args()

SCENE = load(Path(__file__).parents[1] / "wrapped.toml")
EASY = {  # thresholds that motors of 0.6 pN um reach
    "polymorphs.nucleation": 0.4,
    "polymorphs.nucleation_back": 0.2,
    "polymorphs.propagation": 0.15,
    "polymorphs.propagation_back": 0.1,
}
TWO = {"flagella.count": 2, "flagella.anchor_offset": 1.2}
PULLED = {"motor.torque": -3.4, "motor.switching": "none", "motor.switch_times": []}
COILED = {"flagella.intrinsic_curvature": (0.0, 1.82, -0.6), "polymorphs.enabled": False}
CELLS = {
    "wrapped.toml": {},
    "h = 0.1": {"flagella.segment_length": 0.1},
    "body 0.8 um wide": {"body.width": 0.8},
    "body 3 um long": {"body.length": 3.0, "flagella.anchor_offset": 1.5},
    "two flagella": TWO,
    "three": {**TWO, "flagella.count": 3},
    "forward again at 30 ms": {"motor.switch_times": (0.005, 0.03)},
    "keeps its form": {"polymorphs.enabled": False},
    "keeps its form, hook 0.1": {"polymorphs.enabled": False, "hook.stiffness": 0.1},
    "semicoiled": {"polymorphs.target": "semicoiled"},
    "curly-1": {"polymorphs.target": "curly_1"},
    "coiled all along, reverse": {**COILED, **PULLED},
    "coiled all along, reverse, hook 0.1": {**COILED, **PULLED, "hook.stiffness": 0.1},
    "torque 2.5": {"motor.torque": 2.5},
    "stall 3.4, 175/300 Hz": {"motor.law": "torque_speed"},
    **{f"hook {k}": {"hook.stiffness": k} for k in (1.0, 2.0, 4.0)},
    **{
        f"low thresholds, torque {torque}, hook {k}": {**EASY, "motor.torque": torque, "hook.stiffness": k}
        for torque, k in itertools.product((0.63, 1.26, 2.5), (0.1, 0.2, 0.4, 0.65, 1.0))
    },
}


def measured(values: dict) -> tuple[float, float, float, float]:
    """When it wraps [s], share along the body, turns of a flagellum, speed towards the flagella's pole [um/s]."""
    own = {"duration": options.duration, "frames": 200, "numerics.accuracy": "draft", "numerics.on_accuracy": "warn"}
    scene = with_values(SCENE, {**own, **values})
    simulation = Simulation(scene, device="cpu")
    frames = list(simulation.frames(options.duration))
    times, places = np.array([f.time for f in frames]), np.array([f.body_position for f in frames])
    axes = axis_of_body(np.array([f.body_orientation for f in frames]))
    nodes, first_node = np.array([f.positions for f in frames]), simulation.first_node
    found = wrapping(nodes, first_node, places, axes, scene.body.length, scene.body.width)
    once = found.wrapped[:, 0]
    late, half = slice(-len(times) // 10, None), len(times) // 2
    velocity = np.diff(places[half:], axis=0) / np.diff(times[half:])[:, None]
    return (
        float(times[once.argmax()]) if once.any() else np.nan,
        float(found.share[late].mean()),
        float(found.turns[late].mean()),
        float(np.vecdot(velocity, axes[half:-1]).mean()),
    )


print("                                       wraps ms   along body   turns   um/s to the flagella's pole")
for name, values in CELLS.items():
    try:
        when, share, turns, speed = measured(values)
        print(f"{name:38s} {1e3 * when:8.1f} {share:12.2f} {turns:7.1f} {speed:8.1f}", flush=True)
    except NumericalError as error:
        print(f"{name:38s} {error}", flush=True)
