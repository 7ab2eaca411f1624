"""The paper's measures of synchronisation, bundling and swimming, as NumPy functions.

Functions of one frame take the flagella as flat arrays, flagellum after flagellum, and `first_node`, shape
[flagellum_count + 1]: flagellum k has the rows first_node[k] to first_node[k + 1] - 1, its nodes r_0..r_N.
Row i of a flagellum's directors belongs to segment i, which joins r_{i-1} and r_i; row 0 is the motor tripod.
"The paper" is Adhyapak & Stark, Phys. Rev. E 92, 052701 (2015). Units um, pN, s.

Functions of a window take consecutive frames, and the rates are differences over that window: instantaneous
velocities of a stiff model contain fast modes that do not move the cell.

`warpflag.observables.recorded` has the same measures on the record of a run.
"""

from warpflag.observables.bundle import (
    BUNDLE_DISTANCE,
    STRAY,
    ZIPPED,
    bundle_length,
    bundled_fraction,
    bundled_nodes,
    zip_time,
)
from warpflag.observables.contact import closest_parameters, steric_force, steric_force_density
from warpflag.observables.motion import (
    body_power,
    body_rate,
    body_speed,
    helix_rate,
    lab_motor_rate,
    motor_axes,
    motor_rate,
    net_speed,
    thrust,
)
from warpflag.observables.phase import local_phase_difference, phase_difference, segment_tangents
from warpflag.observables.power import PowerBalance, power_balance
from warpflag.observables.shape import (
    elastic_energy,
    helix_axis,
    helix_pitch,
    phase_velocity,
    strain,
    turns_about_axis,
    winding_number,
)

__all__ = [
    "BUNDLE_DISTANCE",
    "STRAY",
    "ZIPPED",
    "PowerBalance",
    "body_power",
    "body_rate",
    "body_speed",
    "bundle_length",
    "bundled_fraction",
    "bundled_nodes",
    "closest_parameters",
    "elastic_energy",
    "helix_axis",
    "helix_pitch",
    "helix_rate",
    "lab_motor_rate",
    "local_phase_difference",
    "motor_axes",
    "motor_rate",
    "net_speed",
    "phase_difference",
    "phase_velocity",
    "power_balance",
    "segment_tangents",
    "steric_force",
    "steric_force_density",
    "strain",
    "thrust",
    "turns_about_axis",
    "winding_number",
    "zip_time",
]
