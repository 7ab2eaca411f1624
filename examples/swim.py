"""Builds a cell in Python, lets it swim, and reads the record.

    uv run examples/swim.py [DURATION in s] [-o run.h5]

Two flagella a third shorter than the paper's, from the same side of the body. Units: um, pN, s; angles in degrees.
"""

import argparse
from pathlib import Path

import numpy as np

from warpflag import Record, Recorder, Scene, Simulation
from warpflag.scene import Flagella, FlagellumOverride, Motor

options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
options.add_argument("duration", nargs="?", type=float, default=0.002)
options.add_argument("-o", dest="output", default="run.h5")
arguments = options.parse_args()
if Path(arguments.output).exists():
    options.error(f"{arguments.output}: exists already; name another with -o, or remove it")

scene = Scene(
    name="swim",
    duration=arguments.duration,
    frames=40,
    flagella=Flagella(count=2, length=4.0),
    flagellum=(FlagellumOverride(azimuth=-40.0), FlagellumOverride(azimuth=40.0)),
    motor=Motor(torque=2.0),
)
simulation = Simulation(scene, device="cpu", reporters=[Recorder(arguments.output)])
simulation.run()

with Record(arguments.output) as record:
    swum = np.linalg.norm(record.body_position[-1] - record.body_position[0])
    turns = record.motor_angle[-1] / (2 * np.pi)
    theta = record.observables["phase_difference"]
    print(f"{record.frame_count} frames to {1e3 * record.times[-1]:.3g} ms")
    print(f"swum {swum:.3f} um, motors turned {turns[0]:.2f} and {turns[1]:.2f} times")
    print(f"phase difference {theta[0]:.3f} -> {theta[-1]:.3f}")
