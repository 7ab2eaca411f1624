"""Implicit stepping: collocation, its linear system, contact forces of a step."""
