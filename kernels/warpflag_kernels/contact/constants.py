"""Constants of the contact law that device code and NumPy code share; imports nothing."""

CUTOFF = 2.0 ** (1.0 / 6.0)
"""Distance from which the steric force is zero, in units of sigma: the minimum of the Lennard-Jones potential."""

LINEAR_BELOW = 0.7
"""Distance in units of sigma below which the steric force continues along its tangent, so that it stays finite."""

PARALLEL = 1.0e-10
"""Squared sine of the angle between two segments below which their closest points are those of parallel segments."""
