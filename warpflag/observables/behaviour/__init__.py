"""Measures of behaviour as they are published of swimming cells: runs and tumbles, bundles and their members, flagella
wrapped round the body, wobble, motor loads.

Functions of arrays, each tested on a construction; `warpflag.observables.behaviour.of_record` has them on the record of
a run. Units um, pN, s; angles in rad.
"""

from warpflag.observables.behaviour.body_wrapping import Wrapping, wrapping
from warpflag.observables.behaviour.bundles import bundle_axes, bundle_counts, bundle_membership
from warpflag.observables.behaviour.load import LoadPoint, load_points, operating_rate, torque_at
from warpflag.observables.behaviour.precession import Wobble, wobble
from warpflag.observables.behaviour.runs import RunsAndTumbles, exponential_mean, runs_and_tumbles

__all__ = [
    "LoadPoint",
    "RunsAndTumbles",
    "Wobble",
    "Wrapping",
    "bundle_axes",
    "bundle_counts",
    "bundle_membership",
    "exponential_mean",
    "load_points",
    "operating_rate",
    "runs_and_tumbles",
    "torque_at",
    "wobble",
    "wrapping",
]
