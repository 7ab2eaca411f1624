"""Explicit stepping, step control and guards."""
