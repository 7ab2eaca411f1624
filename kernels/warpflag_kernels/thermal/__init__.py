"""Thermal motion: the step that keeps the Boltzmann distribution, its chart, and the random elastic force."""
