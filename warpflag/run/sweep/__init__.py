"""Sweeps: many runs that differ in a few values, on all devices or cores of a machine, or on a cluster."""

from warpflag.run.sweep.plan import BadMembers, Sweep, grid_axes, read
from warpflag.run.sweep.sweep import SweepRun, resume, resume_or_start, start

__all__ = ["BadMembers", "Sweep", "SweepRun", "grid_axes", "read", "resume", "resume_or_start", "start"]
