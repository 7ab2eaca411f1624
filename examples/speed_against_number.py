"""Speed of a cell against the number of its flagella, with motors of constant torque and on a torque-speed curve.

    uv run examples/speed_against_number.py [--counts 1 2 3 4] [--duration 0.1] [--length 8] [--mode all]

Prints a table: means over the second half of each run, beside a bundle of rigid helices in phase with flow round the
body, which was calculated apart, for 8 um, with the flows of mode "all". The flagella begin beside each other at the
rear pole, bundled. As it is, it takes a quarter of a minute of one core. Units: um, pN, s.
"""

import argparse

import numpy as np

from warpflag import Simulation
from warpflag.scene import paper_scene, with_values

TORQUE, STALL, KNEE, NO_LOAD = 0.38, 0.38, 175.0, 300.0  # pN um, Hz
RIGID = {
    "constant": {1: 14.8, 2: 21.1, 3: 26.8, 4: 32.3, 6: 41.5, 8: 47.4},
    "torque_speed": {1: 14.8, 2: 21.1, 3: 24.3, 4: 25.8, 6: 27.7, 8: 28.1},
}  # um/s

options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
options.add_argument("--counts", type=int, nargs="+", default=[1, 2, 3, 4])
options.add_argument("--duration", type=float, default=0.1, help="of each run [s]")
options.add_argument("--length", type=float, default=8.0, help="of the flagella [um]")
options.add_argument("--mode", default="all", help="hydrodynamics.mode: all (as the rigid ones), consistent, ...")
options.add_argument("--on-accuracy", default="stop", help="warn: go on where many flagella jostle at the start")
options = options.parse_args()


def means(law: str, count: int) -> list[float]:
    """Speed [um/s], motor rate [Hz], torque [pN um], body rate [Hz], and l_r of one cell, of its second half."""
    scene = with_values(
        paper_scene(name="speed_against_number"),
        {
            "duration": options.duration,
            "frames": 200,
            "flagella.count": count,
            "flagella.length": options.length,
            "flagella.opening_angle": 0.0,
            "flagella.anchor_offset": 1.2,
            "motor.axis_angle": 0.0,
            "flagella.on_axis": True,
            "motor.law": law,
            "motor.torque": TORQUE if law == "constant" else STALL,
            "motor.knee": KNEE,
            "motor.no_load": NO_LOAD,
            "hook.length": 0.055,
            "hook.stiffness": 0.65,
            "hydrodynamics.mode": options.mode,
            "hydrodynamics.body_flow": True,
            "numerics.on_accuracy": options.on_accuracy,
        },
    )
    frames = list(Simulation(scene, device="cpu").frames(options.duration))
    late = frames[len(frames) // 2 :]
    moved = np.asarray(late[-1].body_position) - late[0].body_position
    speed = float(np.linalg.norm(moved)) / (late[-1].time - late[0].time)

    def mean(name: str, otherwise: float) -> float:
        return float(np.mean([frame.observables.get(name, otherwise) for frame in late]))

    return [
        speed,
        mean("motor_rate", 0.0),
        mean("motor_torque", TORQUE),
        mean("body_rate", 0.0),
        mean("bundle_length", 1.0),
    ]


print("law           N   um/s  rigid   motor Hz   pN um   body Hz   l_r")
for law, rigid in RIGID.items():
    for count in options.counts:
        speed, rate, torque, body, bundle = means(law, count)
        beside = f"{rigid[count]:5.1f}" if count in rigid and options.length == 8.0 else "    -"
        numbers = f"{rate:8.1f}   {torque:5.3f}   {abs(body):7.1f}  {bundle:5.2f}"
        print(f"{law:12s} {count:2d}  {speed:5.1f}  {beside}   {numbers}", flush=True)
