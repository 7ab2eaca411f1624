"""Implicit stepping: collocation, its linear system, stability, contact forces and motor torques of a step."""
