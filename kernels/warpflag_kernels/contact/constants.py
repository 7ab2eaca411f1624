"""Numbers of the steric law that kernels and NumPy measures share; this file imports nothing."""

CUTOFF = 2.0 ** (1.0 / 6.0)
"""Distance from which on there is no force, where the Lennard-Jones force changes sign [steric diameters]."""
LINEAR_BELOW = 0.7
"""Distance below which the force continues along its tangent, so that it stays finite [steric diameters]."""
OWN_SPACING = 3.0
"""Contour between two segments of one flagellum from which on they can touch [steric diameters]. Their ends are then at
least half of it apart along the contour, so that a straight filament is not in contact with itself."""
PARALLEL = 1.0e-10
"""Square of the sine between two segments below which they count as parallel."""
