"""Speeds and rates beside two experiments: against the number of flagella, and against body length with the number.

    uv run examples/behaviour/scans.py [number] [length] [--duration 0.1]

number: 2, 5 and 8 flagella on one body, beside Lisevich et al. 2024 (2.12, 4.76, 7.57 flagella a cell).
length: bodies of 2 to 6 um with 2 to 6 flagella, beside Kamdar et al. 2023 (speed independent of body length).
Flagella of 7.5 um begin bundled at the rear pole; motors on the 175/300 Hz curve with a stall of 1.26 pN um; format 1.
A minute of one core. Means over the second half of each run. Units: um, pN, s.
"""

import argparse
import time

import numpy as np

from warpflag import Scene, Simulation, with_values

options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
options.add_argument("scans", nargs="*", default=["number", "length"])
options.add_argument("--duration", type=float, default=0.1, help="of each run [s]")
options.add_argument("--accuracy", default="standard", help="numerics.accuracy")
options = options.parse_args()

CELLS = {
    "number": [(2, 2.5), (5, 2.5), (8, 2.5)],
    "length": [(2, 2.0), (3, 3.0), (4, 4.0), (5, 5.0), (6, 6.0)],
}
MEASURED = {"number": ["22.4, body 30", "26.6, body 37", "24.7, body 38"], "length": ["the same for all"] * 5}


def means(count: int, length: float) -> list[float]:
    """Speed [um/s], motor rate [Hz], filament rate in the lab [Hz], body rate [Hz], torque [pN um], l_r."""
    values = {
        "duration": options.duration,
        "frames": 200,
        "flagella.count": count,
        "flagella.length": 7.5,
        "flagella.opening_angle": 0.0,
        "flagella.anchor_offset": length / 2 - 0.05,
        "flagella.on_axis": True,
        "body.length": length,
        "motor.axis_angle": 0.0,
        "motor.law": "torque_speed",
        "motor.torque": 1.26,
        "numerics.accuracy": options.accuracy,
        "numerics.on_accuracy": "warn",
    }
    scene = with_values(Scene(name="scan"), values)
    frames = list(Simulation(scene, device="cpu").frames(options.duration))
    late = frames[len(frames) // 2 :]
    speed = np.linalg.norm(late[-1].body_position - late[0].body_position) / (late[-1].time - late[0].time)
    motor, body, torque, bundled = (
        float(np.mean([frame.observables[name] for frame in late]))
        for name in ("motor_rate", "body_rate", "motor_torque", "bundle_length")
    )
    return [float(speed), motor, motor + body, body, torque, bundled]


for scan in options.scans:
    print(f"{scan}\n  N  body um  um/s  motor Hz  filament Hz  body Hz  pN um   l_r   s of CPU  measured")
    for (count, length), measured in zip(CELLS[scan], MEASURED[scan], strict=True):
        began = time.process_time()
        row = means(count, length)
        text = "{:6.1f} {:8.0f} {:11.0f} {:9.0f} {:7.2f} {:6.2f}".format(*row)
        print(f"{count:3d} {length:8.1f} {text} {time.process_time() - began:9.0f}    {measured}", flush=True)
