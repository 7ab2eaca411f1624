"""Hydrodynamics: Rotne-Prager pair sum, node velocities, motion of the body."""
