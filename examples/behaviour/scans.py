"""Speeds and rates against the number of flagella, body length with the number, and viscosity with the number.

    uv run examples/behaviour/scans.py [number] [length] [viscosity] [--duration 0.1]

number: 2, 5 and 8 flagella on one body, beside Lisevich et al. 2024 (2.12, 4.76, 7.57 flagella a cell).
length: bodies of 2 to 6 um with 2 to 6 flagella, beside Kamdar et al. 2023 (speed independent of body length).
viscosity: 1 to 16 flagella in 1, 2, 4 and 8 times the viscosity of water, beside Tatulea-Codrean & Lauga 2024 (a speed
    that peaks at a number of flagella, and at more flagella in a more viscous fluid).
Flagella of 7.5 um begin bundled at the rear pole; motors on the 175/300 Hz curve with a stall of 1.26 pN um; format 1.
A minute of one core, viscosity five. Means over the second half of each run. Units: um, pN, s.
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

CELLS = {  # flagella, body length [um], viscosity over that of water, and what was measured or calculated elsewhere
    "number": [(2, 2.5, 1, "22.4, body 30"), (5, 2.5, 1, "26.6, body 37"), (8, 2.5, 1, "24.7, body 38")],
    "length": [(number, float(number), 1, "the same speed for all") for number in (2, 3, 4, 5, 6)],
    "viscosity": [
        (number, 2.5, viscosity, "") for viscosity in (1, 2, 4, 8) for number in (1, 2, 3, 4, 6, 8, 10, 12, 14, 16)
    ],
}


def means(count: int, length: float, viscosity: float) -> list[float]:
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
        "fluid.viscosity": 1e-3 * viscosity,
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
    print(f"{scan}\n  N  body um  viscosity  um/s  motor Hz  filament Hz  body Hz  pN um   l_r   s of CPU  elsewhere")
    for count, length, viscosity, elsewhere in CELLS[scan]:
        began = time.process_time()
        row = means(count, length, viscosity)
        text = "{:6.1f} {:8.0f} {:11.0f} {:9.0f} {:7.2f} {:6.2f}".format(*row)
        cost = time.process_time() - began
        print(f"{count:3d} {length:8.1f} {viscosity:10g} {text} {cost:9.0f}    {elsewhere}", flush=True)
